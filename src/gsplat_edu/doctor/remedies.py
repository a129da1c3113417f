"""Choose the remedies that a capture needs, for the options of `gsplat-edu train` with the value auto.

Each choice is one function of a surveyed capture, whose result the doctor's advice quotes too. This module decides
whether a training should start with a sky; `gsplat_edu.doctor.appearance` decides whether it corrects exposures.
"""

from __future__ import annotations

from collections.abc import Sequence

from gsplat_edu.base.text import Told
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.appearance import correction_of
from gsplat_edu.doctor.cut_out import outside_masks_of
from gsplat_edu.doctor.finding import Finding, Remedy, Severity
from gsplat_edu.doctor.survey import Progress, Survey, prepare
from gsplat_edu.parts.sky.find import Sky, find_sky

ENOUGH = 12
"""`--transients auto` looks for moving objects from this number of training photos on. In smaller captures, fewer than
four photos show most places, which are too few to compare."""


def remedies_for(
    reader: CaptureReader,
    names: Sequence[str],
    progress: Progress | None = None,
    left_out: Sequence[str] | None = None,
) -> dict[str, Remedy]:
    """Choose settings for a capture from its photos, which are read once.

    Args:
        reader: The capture.
        names: Of `CHOICES`.
        progress: Called with (photos done, total) in the calling thread.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    survey = prepare(reader, progress, sharpness=False, left_out=left_out)
    return {name: CHOICES[name](survey) for name in names}


def transients_for(count: int) -> Remedy:
    """Choose `--transients` from the number of training photos. Only the training can find out what moved."""
    if count < ENOUGH:
        return Remedy(
            "none",
            f"{count} training photos are too few to tell what moved; from {ENOUGH} on, they are compared",
        )
    return Remedy(
        "mask",
        f"{count} training photos are enough to tell what moved; a photo where nothing did keeps every pixel",
    )


def sky_of(survey: Survey) -> Remedy:
    """Choose `--sky` for a surveyed capture: "shell" if something at infinity fills enough of its photos."""
    if len(survey.shots) < 2:
        return Remedy("none")
    for kind, some in (
        ("transparent", any(shot.stats.transparent for shot in survey.shots)),
        ("masked", any(shot.stats.masked for shot in survey.shots)),
    ):
        if some:
            return Remedy("none", f"photos are {kind}, and a sky may be cut out of them")
    sky = _sky(survey)
    return Remedy("shell", _sky_sentence(sky, survey)) if sky.is_certain else Remedy("none")


CHOICES = {"appearance": correction_of, "sky": sky_of, "outside_masks": outside_masks_of}
"""Functions that choose a setting for a surveyed capture, by the setting's name."""

BY_COUNT = {"transients": transients_for}
"""Functions that choose a setting for a number of training photos."""


def check_sky(survey: Survey) -> list[Finding]:
    """Report a sky, which needs far splats."""
    if sky_of(survey).value == "none":
        return []
    advice = Told(
        "train with --sky shell, which --sky auto of the recipe fast chooses by itself",
        "nothing: a training adds a sky by itself",
    )
    return [Finding("sky", Severity.NOTE, _sky_sentence(_sky(survey), survey), advice)]


def _sky(survey: Survey) -> Sky:
    shots = survey.shots
    return find_sky([shot.camera for shot in shots], [shot.stats.thumbnail for shot in shots], survey.points)


def _sky_sentence(sky: Sky, survey: Survey) -> str:
    """Describe which part of the photos is sky, and the evidence."""
    where = f"{100 * sky.share:.0f} % of the pixels, in {sky.photos} of {len(survey.shots)} photos"
    blind = "" if len(survey.points) else ", as far as photos without points tell"
    if not sky.lies_at_infinity:
        return f"{where}, are one white above the horizon{blind}"
    return (
        f"{where}, lie at infinity{blind}: in one direction, photos differ by {sky.spread:.1f} %,"
        f" at any finite distance by {sky.spread_near:.1f} % or more"
    )
