"""How long a training by the recipe fast is: its iterations follow from the number of photos and from its start.

Each photo has to be shown often enough, so many photos need more iterations. Random start points first have to find the
surface. A photo that is shown very often is learned by heart.
"""

from __future__ import annotations

from gsplat_edu.base.text import easily_read
from gsplat_edu.base.validation import one_of, whole_number
from gsplat_edu.train.capacity import PLANNED_VIEWS
from gsplat_edu.train.config import RECIPE_ITERATIONS

QUALITIES = {"draft": 1, "standard": 3, "high": 10}
"""Length of the recipe fast by the name of its quality, as a multiple of the capture's own unit."""

DEFAULT_QUALITY = "standard"

UNIT = 1_000
"""Iterations of a unit for `PLANNED_VIEWS` photos or fewer, from points of the scene. More photos are shown as often:
300 traced ones of 240 x 180 px score 31.8, 33.7 and 35.9 dB after 3,000, 8,500 and 34,000 iterations."""

RANDOM_START = 1.25
"""Factor on the unit if the start points are random."""

VISITS = 125
"""A unit shows no photo more often than this: captures of fewer than 8 photos have shorter trainings."""

LONGEST = 100_000
"""Bound of the iterations of any quality."""


def unit_iterations(views: int, measured: bool = True) -> float:
    """Return the iterations of a capture's unit, which grows with the views.

    unit(v) = min(UNIT max(1, v / PLANNED_VIEWS) (RANDOM_START if the start is random), VISITS v)

    Args:
        views: Number of training views, at least 1.
        measured: Whether the start points are points of the scene; otherwise they are random.

    Raises:
        ArgumentError: `views` is not a number of views.
    """
    whole_number("views", views, 1)
    wanted = UNIT * max(1.0, views / PLANNED_VIEWS) * (1.0 if measured else RANDOM_START)
    return float(min(wanted, VISITS * views))


def planned_iterations(quality: str, views: int, measured: bool = True, batch: int = 1) -> int:
    """Return the iterations of a quality, rounded to two digits (three if the first is 1), as whole batches.

    Args:
        quality: Of `QUALITIES`.
        views: Number of training views, at least 1.
        measured: Whether the start points are points of the scene; otherwise they are random.
        batch: Views of a step.

    Raises:
        ArgumentError: there is no such quality, or `views` is not a number of views.
    """
    one_of("quality", quality, tuple(QUALITIES))
    whole = min(QUALITIES[quality] * unit_iterations(views, measured), LONGEST)
    rounded = easily_read(int(whole))
    return rounded + -rounded % batch


def usual_iterations(strategy: str, views: int) -> int:
    """Return the iterations of a recipe if none are asked for.

    Args:
        strategy: Its strategy.
        views: Number of training views.
    """
    return planned_iterations(DEFAULT_QUALITY, max(views, 1)) if strategy == "fast" else RECIPE_ITERATIONS


def reasons(views: int, measured: bool = True) -> str:
    """Return why a capture's unit is what it is, as a clause.

    Args:
        views: Number of training views, at least 1.
        measured: Whether the start points are points of the scene.
    """
    parts = [f"{views} training photos"]
    if VISITS * views < UNIT:
        parts[0] += f", none of which is shown more than {VISITS} times in a draft"
    parts += [] if measured else ["random start points, which take a quarter longer"]
    return " and ".join(parts)
