"""The doctor after training: photos the scene cannot explain, overfitting, floaters, odd splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsplat_edu.doctor.finding import NAMED, Diagnosis, Finding, Severity, counted
from gsplat_edu.doctor.residuals import Residual
from gsplat_edu.gaussians import Gaussians

POOR = 20.0
"""Mean PSNR of the training views, dB, below which a scene explains nothing well: a tenth of the range is wrong in the
mean. Three captures had 27 to 32 after 2,000 iterations."""

UNEXPLAINED = 3.0
"""Decibels below the median of its split from which a view may be one the scene cannot explain: twice the squared
error."""

UNEXPLAINED_SPREAD = 3.0
"""It has to be so many standard deviations below as well, by the median absolute deviation."""

GAP = 5.0
"""Decibels between training and test views from which the scene knows its photos by heart. After 2,000 iterations a
capture of 97 photos had 2, one of 11 had 9, and one of 50 with random start points 12."""

JUMP = 0.5
"""Difference of a photo's brightness to the scene's from which it is told, stops. Photos in which half the scene is in
shadow stay below 0.2."""

VEILED = 0.02
"""Share of a view's pixels that near splats cover from which it is told: a spot a seventh as wide and high."""

FAINT = 0.02
"""Opacity of splats that hardly show: five steps of a byte on white."""

FAINT_SHARE = 0.4
"""Share of such splats from which it is told. Three runs of 2,000 iterations had 0.1 to 0.33."""

HUGE_SHARE = 0.01
"""Share of splats that reach farther than the cameras are spread from which it is told; a sky needs a few."""

SPREAD_TO_NORMAL = 1.4826
"""A normal distribution's standard deviation over its median absolute deviation."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A run's scene, measured.

    Args:
        path: The run's folder.
        gaussians: The scene.
        extent: How far the cameras are spread, world units.
        train: Residuals of the views it was trained on.
        test: Residuals of the views held out.
        reached: Iterations that were taken.
        planned: Iterations that were meant to be taken; None where the run does not say.
    """

    path: Path
    gaussians: Gaussians
    extent: float
    train: Sequence[Residual]
    test: Sequence[Residual]
    reached: int
    planned: int | None


def examine_run(run: Trained) -> Diagnosis:
    """Say what is wrong with a scene and what to do about it.

    Args:
        run: The scene and its residuals.
    """
    checks = (
        ("length", _length),
        ("training views", _fit),
        ("outliers", _outliers),
        ("test views", _gap),
        ("exposure", _exposure),
        ("floaters", _floaters),
        ("splats", _splats),
    )
    findings, fine = list[Finding](), list[str]()
    for name, check in checks:
        found = check(run)
        findings += found
        if not found:
            fine.append(name)
    otherwise = (
        f"look at it: gsplat-edu render {run.path} --orbit --out orbit.mp4",
        f"a smaller file: gsplat-edu convert {run.path} scene.spz --min-opacity {FAINT}",
        "a better scene needs better photos: gsplat-edu doctor CAPTURE tells of them",
    )
    return Diagnosis(_facts(run), tuple(findings), tuple(fine), otherwise)


def view_lines(run: Trained) -> list[str]:
    """Return a line for each view, the worst first."""
    views = [(view, split) for split, views in (("test", run.test), ("train", run.train)) for view in views]
    ordered = sorted(views, key=lambda entry: entry[0].psnr)
    return [
        f"{view.psnr:7.2f} dB  {split:5}  {view.stops:+5.2f} stops  {view.name}" for view, split in ordered
    ]


def _facts(run: Trained) -> tuple[tuple[str, str], ...]:
    facts = [("run", f"{run.path}: {run.reached:,} iterations, {len(run.gaussians):,} splats")]
    for name, views in (("test", run.test), ("train", run.train)):
        if views:
            low = sorted(views, key=lambda view: view.psnr)[:NAMED]
            worst = ", ".join(f"{view.name} {view.psnr:.1f}" for view in low)
            facts.append((name, f"{len(views)} views, PSNR {_mean(views):.2f} dB; worst {worst}"))
    return tuple(facts)


def _mean(views: Sequence[Residual]) -> float:
    return float(np.mean([view.psnr for view in views]))


def _length(run: Trained) -> list[Finding]:
    if run.planned is None or run.reached >= run.planned:
        return []
    what = f"the scene is that of iteration {run.reached:,} of {run.planned:,}"
    advice = "let the training end: the command that began it, with --resume"
    return [Finding("unfinished", Severity.WARNING, what, advice)]


def _fit(run: Trained) -> list[Finding]:
    if not run.train or _mean(run.train) >= POOR:
        return []
    what = f"the views of training have {_mean(run.train):.1f} dB in the mean: not even they are explained"
    advice = "check poses and intrinsics (gsplat-edu doctor CAPTURE), then train for more iterations"
    return [Finding("poor fit", Severity.WARNING, what, advice)]


def _outliers(run: Trained) -> list[Finding]:
    low = [view for views in (run.train, run.test) for view in _far_below(views)]
    if not low:
        return []
    low.sort(key=lambda view: view.psnr)
    names = tuple(f"{view.name} ({view.psnr:.1f} dB)" for view in low)
    what = f"{len(low)} of {len(run.train) + len(run.test)} photos, far from what the scene shows"
    advice = (
        f"look at {low[0].name} beside its render: blurred, badly posed, in shadow? then train without it"
    )
    return [Finding("unexplained", Severity.WARNING, what, advice, names)]


def _far_below(views: Sequence[Residual]) -> list[Residual]:
    """Return the views far below the median of all, by a measure that a few of them do not move."""
    if len(views) < 4:
        return []
    values = np.array([view.psnr for view in views])
    median = float(np.median(values))
    spread = SPREAD_TO_NORMAL * float(np.median(np.abs(values - median)))
    limit = median - max(UNEXPLAINED, UNEXPLAINED_SPREAD * spread)
    return [view for view in views if view.psnr < limit]


def _gap(run: Trained) -> list[Finding]:
    if not run.train or not run.test:
        return []
    gap = _mean(run.train) - _mean(run.test)
    if gap < GAP:
        return []
    what = f"test views are {gap:.1f} dB below those of training: the scene knows its {len(run.train)} photos by heart"
    advice = "take more photos, from between those there are; with these, stop earlier or cap --max-gaussians"
    return [Finding("overfitted", Severity.WARNING, what, advice)]


def _exposure(run: Trained) -> list[Finding]:
    views = (*run.train, *run.test)
    # A scene that is not finished is too dark for all of them.
    usual = float(np.median([view.stops for view in views])) if views else 0.0
    off = sorted((v for v in views if abs(v.stops - usual) > JUMP), key=lambda v: -abs(v.stops - usual))
    if not off:
        return []
    names = tuple(f"{view.name} ({view.stops - usual:+.1f})" for view in off)
    what = f"{counted(len(off), 'photo')}, in stops against the scene"
    advice = "take out the photos whose exposure jumps, or make them even: the scene explains them with fog"
    return [Finding("exposure", Severity.WARNING, what, advice, names)]


def _floaters(run: Trained) -> list[Finding]:
    veiled = sorted((v for v in (*run.train, *run.test) if v.veiled > VEILED), key=lambda view: -view.veiled)
    if not veiled:
        return []
    names = tuple(f"{view.name} ({100 * view.veiled:.0f} %)" for view in veiled)
    what = f"{counted(len(veiled), 'view')} through splats that hang close to the camera"
    advice = "start from real points, not random ones, and leave out exposure jumps; convert --crop cuts away the rest"
    return [Finding("floaters", Severity.WARNING, what, advice, names)]


def _splats(run: Trained) -> list[Finding]:
    if not len(run.gaussians):
        return [
            Finding(
                "splats", Severity.WARNING, "the scene is empty", "train again; the log says when splats went"
            )
        ]
    found = []
    faint = float((run.gaussians.opacities < FAINT).double().mean())
    if faint > FAINT_SHARE:
        what = (
            f"{100 * faint:.0f} % of the splats have an opacity below {FAINT}: they cost time and hardly show"
        )
        advice = f"leave out faint splats: gsplat-edu convert {run.path} scene.ply --min-opacity {FAINT}"
        found.append(Finding("faint splats", Severity.NOTE, what, advice))
    sizes = run.gaussians.scales.amax(dim=1)
    huge = float(((sizes > run.extent) & (run.gaussians.opacities >= FAINT)).double().mean())
    if huge > HUGE_SHARE:
        what = f"{100 * huge:.1f} % of the splats are larger than the cameras' spread: they stand for haze"
        advice = "look for exposure jumps and for a sky; start points far outside become such splats too"
        found.append(Finding("huge splats", Severity.WARNING, what, advice))
    return found
