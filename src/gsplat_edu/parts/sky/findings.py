"""Findings about a sky: one that photos show, which needs far splats, and haze in a scene that lacks these."""

from __future__ import annotations

import torch

from gsplat_edu.base.text import Told
from gsplat_edu.parts.sky.find import Sky, find_sky
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Finding, Remedy, Severity
from gsplat_edu.survey.trained import FAINT, Trained

HUGE_SHARE = 0.01
"""Warn when the share of splats larger than the cameras' extent exceeds this; a sky needs a few."""


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


def check_haze(run: Trained) -> list[Finding]:
    """Report splats that are larger than the scene and no sky."""
    if not len(run.gaussians):
        return []
    sizes = run.gaussians.scales.amax(dim=1)
    sky = torch.from_numpy(far_shell(run.gaussians.means.numpy(force=True))).to(sizes.device)
    huge = float(((sizes > run.extent) & (run.gaussians.opacities >= FAINT) & ~sky).double().mean())
    if huge > HUGE_SHARE:
        what = f"{100 * huge:.1f} % of the splats are larger than the cameras' extent and look like haze"
        jumps, points = "check the photos for exposure jumps", "distant start points become such splats too"
        advice = Told(
            f"{jumps}, and train with --sky shell if they show sky; {points}",
            f"{jumps}, and train with a sky if they show one; {points}",
        )
        return [Finding("huge splats", Severity.WARNING, what, advice, options=(("sky", "shell"),))]
    return []
