"""How many Gaussians a training makes, and the size of photos that they can resolve. Larger photos only cost time."""

from __future__ import annotations

import math
from collections.abc import Sequence

from gsplat_edu.train.config import TrainConfig

PLANNED = 100_000
"""fast: planned Gaussians for `PLANNED_VIEWS` training views of `PLANNED_PIXELS`. The number grows with the square root
of the views, but only with the cube root of the pixels, since small photos are sharper: at a third of its width,
`snowmiku97` gains 1.4 dB from 50,000 Gaussians instead of 25,000. It is at most one per pixel of a photo."""

PLANNED_PIXELS, PLANNED_VIEWS = 734_580, 85

SEPARATE = 2.0
"""fast: captures of a subject that most photos show have at most this many separate views, 1.0 to 1.8, and the planned
number holds for them: twice as many gain nothing on `snowmiku97`. Aerial photos and photos of a room from within show
more; there, twice as many gain 0.5 dB (a procedural city) and 3.7 dB (a traced room) for 1.6 times the time, and four
times as many over the city lose again. Where each place is in equally many photos, the number grows as the area does,
since separate views grow with the views."""

PIXELS_PER_GAUSSIAN = 16.0
"""Largest useful number of pixels of a photo per planned Gaussian: one Gaussian for 4 x 4 px. At its full size,
`snowmiku97` has 7.3."""

WORTHWHILE = 1.5
"""Reduce photos only if their sides shrink by at least this factor; less saves too little time."""

LEAST_PLANNED = 1_000
"""fast: smallest planned number of Gaussians, for thumbnails."""


GROWTH = (0.005, 0.08)
"""adc: Gaussians added per densification, for each pixel of a photo and for each start point. The model gives 5,700 for
snowmiku97 and 3,000 at half size; whole trainings added 3,100 (3,000 iterations), 4,100 (7,000), 5,500 (7,000, not
rescaled) and 3,900 (1,200, half size). For fox it gives 5,000; 3,500 were added. Scenes with much fine detail need
several times as many."""

FEW_POINTS = 30_000
"""Start points beyond this number do not increase the growth."""


def planned_gaussians(pixels: float, views: int, separate: float = 1.0) -> int:
    """Return the number of Gaussians that the recipe fast grows to, unless a cap is given.

    n(p) = PLANNED (p / PLANNED_PIXELS)^(1/3) (views / PLANNED_VIEWS)^(1/2) more, from LEAST_PLANNED to p more,
    more = max(1, separate / SEPARATE)^(1/2)

    Args:
        pixels: Mean pixels of a view.
        views: Number of training views.
        separate: As many views as show nothing in common, at least 1 (`gsplat_edu.train.overlap.separate_views`).
    """
    share = math.cbrt(pixels / PLANNED_PIXELS) * math.sqrt(views / PLANNED_VIEWS)
    more = math.sqrt(max(1.0, separate / SEPARATE))
    return max(round(min(PLANNED * share, pixels) * more), LEAST_PLANNED)


def wanted_gaussians(
    config: TrainConfig, points: int, pixels: float, views: int = PLANNED_VIEWS, separate: float = 1.0
) -> int:
    """Estimate how many Gaussians the images need: the plan of fast, or the growth of adc within the given iterations.

    Args:
        config: The run; its cap is ignored.
        points: Number of start points.
        pixels: Pixels of a view.
        views: Number of training views.
        separate: As for `planned_gaussians`.
    """
    if config.strategy == "fast":
        return planned_gaussians(pixels, views, separate)
    window = min(config.adc.densify_stop, config.iterations) - config.densify_start
    return points + added_gaussians(points, pixels) * max(window // config.densify_every, 0)


def added_gaussians(points: int, pixels: float) -> int:
    """Return how many Gaussians adc adds per densification.

    n = GROWTH_0 p + GROWTH_1 min(points, FEW_POINTS)

    Args:
        points: Number of start points.
        pixels: Pixels of a view, p.
    """
    return round(GROWTH[0] * pixels + GROWTH[1] * min(points, FEW_POINTS))


def resolvable_pixels(views: int) -> float:
    """Return the pixels of a photo up to which the planned Gaussians resolve it.

    n(p) = PLANNED (p / PLANNED_PIXELS)^(1/3) (views / PLANNED_VIEWS)^(1/2), and p = PIXELS_PER_GAUSSIAN n(p)

    Args:
        views: Number of training views, at least 1.
    """
    at_one = PLANNED * math.sqrt(views / PLANNED_VIEWS) / math.cbrt(PLANNED_PIXELS)
    return math.pow(PIXELS_PER_GAUSSIAN * at_one, 1.5)


def advised_side(sizes: Sequence[tuple[int, int]], views: int) -> int | None:
    """Return the longest side to which photos should be reduced, px, in steps of 10; None to keep their size.

    Args:
        sizes: Width and height of the photos, px; at least one.
        views: Number of training views.
    """
    mean = sum(W * H for W, H in sizes) / len(sizes)
    factor = math.sqrt(mean / resolvable_pixels(max(views, 1)))
    if factor < WORTHWHILE:
        return None
    return max(10 * round(max(max(size) for size in sizes) / factor / 10), 40)
