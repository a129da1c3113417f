"""The doctor after training: photos the scene cannot explain, overfitting, floaters, odd splats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.doctor.finding import NAMED, Diagnosis, Finding, Severity, command, counted, new_run
from gsplat_edu.doctor.looks import EXPOSURE
from gsplat_edu.doctor.residuals import Residual
from gsplat_edu.evaluate.report import OVERFITTED
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.text import spelled_seconds
from gsplat_edu.train.config import RECIPE_ITERATIONS

POOR = 20.0
"""Mean PSNR of the training views, dB, below which a scene explains nothing well: a tenth of the range is wrong in the
mean. Three captures had 27 to 32 after 2,000 iterations."""

UNEXPLAINED = 3.0
"""Decibels below the median of its split from which a view may be one the scene cannot explain: twice the squared
error."""

UNEXPLAINED_SPREAD = 3.0
"""It has to be so many standard deviations below as well, by the median absolute deviation."""

RISING = 0.1
"""Decibels that the test views' PSNR has to gain over the last quarter of a training for longer ones to be advised."""

FALLING = 0.97
"""A loss still falls if its mean over the last tenth of a training is below this times that of the tenth that ends a
quarter before the end. Used where no views were held out."""

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
        log: Lines of the run's log.
        capture: The capture it was trained on; None where nobody knows.
        options: Further options of the training that a longer one should have, as words of a command.
        beforehand: What the doctor finds in the photos' exposure without looking at the scene.
        uncompared: Why the photos' exposure was not compared; empty if it was.
    """

    path: Path
    gaussians: Gaussians
    extent: float
    train: Sequence[Residual]
    test: Sequence[Residual]
    reached: int
    planned: int | None
    log: Sequence[Mapping[str, Any]] = ()
    capture: Path | None = None
    options: tuple[str, ...] = ()
    beforehand: Sequence[Finding] = ()
    uncompared: str = ""

    @property
    def rising(self) -> bool | None:
        """Whether the scene was still getting better when the training ended; None where nothing says so."""
        scores = _pairs(self.log, "psnr", self.reached)
        if self.test:
            scores = [pair for pair in scores if pair[0] < self.reached] + [(self.reached, _mean(self.test))]
        earlier = [value for iteration, value in scores if iteration <= 0.75 * self.reached]
        if earlier and self.test:
            return scores[-1][1] - max(earlier[-2:]) >= RISING
        losses = _pairs(self.log, "loss", self.reached)
        last, before = (
            [value for iteration, value in losses if low * self.reached < iteration <= high * self.reached]
            for low, high in ((0.9, 1.0), (0.65, 0.75))
        )
        return float(np.mean(last)) < FALLING * float(np.mean(before)) if last and before else None


def _pairs(log: Sequence[Mapping[str, Any]], key: str, reached: int) -> list[tuple[int, float]]:
    """Return iteration and value of the lines that have both, in order."""
    pairs = ((line.get("iteration"), line.get(key)) for line in log)
    return sorted(
        (i, float(v)) for i, v in pairs if isinstance(i, int) and i <= reached and isinstance(v, int | float)
    )


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
    return Diagnosis(_facts(run), tuple(findings), tuple(fine), _otherwise(run))


def _otherwise(run: Trained) -> tuple[str, ...]:
    """Return advice for scenes with little to mend."""
    longer = run.reached < RECIPE_ITERATIONS and run.rising is not False
    return (
        f"look at it: {command('render', run.path, '--orbit', '--out', 'orbit.mp4')}",
        f"a smaller file: {command('convert', run.path, 'scene.spz', '--min-opacity', str(FAINT))}",
        _train_longer(run) if longer else f"a better scene needs better photos{_what_photos_lack(run)}",
    )


def _what_photos_lack(run: Trained) -> str:
    return "" if run.capture is None else f"; what these lack: {command('doctor', run.capture)}"


def _train_longer(run: Trained) -> str:
    if run.capture is None:
        return f"train for {RECIPE_ITERATIONS:,} iterations, as the recipe does"
    name = f"{run.path.resolve().name}_{RECIPE_ITERATIONS}"
    length = ("--iterations", str(RECIPE_ITERATIONS))
    words = command("train", run.capture, *length, *run.options, "--out", new_run(name))
    return f"train for longer{_at_its_pace(run)}: {words}"


def _at_its_pace(run: Trained) -> str:
    """Say what the recipe's length takes if an iteration takes what the last ones took: on a slow computer, hours."""
    late = [ms for iteration, ms in _pairs(run.log, "ms", run.reached) if iteration > 0.75 * run.reached]
    if not late:
        return ""
    return (
        f" ({spelled_seconds(1e-3 * RECIPE_ITERATIONS * float(np.median(late)))} or more at this run's pace)"
    )


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
    if run.uncompared:
        facts.append(("exposure", f"compared with the scene only, not between photos: {run.uncompared}"))
    return tuple(facts)


def _mean(views: Sequence[Residual]) -> float:
    return float(np.mean([view.psnr for view in views]))


def _length(run: Trained) -> list[Finding]:
    if run.planned is not None and run.reached < run.planned:
        what = f"the scene is that of iteration {run.reached:,} of {run.planned:,}"
        advice = "let the training finish: repeat its command with --resume"
        return [Finding("unfinished", Severity.WARNING, what, advice)]
    if run.reached >= RECIPE_ITERATIONS:
        return []
    what = f"{run.reached:,} iterations; the recipe has {RECIPE_ITERATIONS:,}"
    if run.rising is False:
        held = "the test views' PSNR no longer rises" if run.test else "the loss no longer falls"
        advice = f"more iterations alone will not help much, better photos may{_what_photos_lack(run)}"
        return [Finding("short training", Severity.NOTE, f"{what}, but {held}", advice)]
    if run.rising:
        what += ", and " + (
            "the test views' PSNR was still rising" if run.test else "the loss was still falling"
        )
    return [Finding("short training", Severity.WARNING, what, _train_longer(run))]


def _fit(run: Trained) -> list[Finding]:
    if not run.train or _mean(run.train) >= POOR:
        return []
    what = f"the training views reach only {_mean(run.train):.1f} dB in the mean: the scene does not explain even those"
    place = "" if run.capture is None else f": {command('doctor', run.capture)}"
    advice = f"check poses and intrinsics{place}"
    if run.reached < RECIPE_ITERATIONS and run.rising:  # which alone may explain it
        advice = f"train for longer first; if they stay there, {advice}"
    return [Finding("poor fit", Severity.WARNING, what, advice)]


def _outliers(run: Trained) -> list[Finding]:
    low = [view for views in (run.train, run.test) for view in _far_below(views)]
    if not low:
        return []
    low.sort(key=lambda view: view.psnr)
    names = tuple(view.name for view in low)
    scores = tuple(f"{view.psnr:.1f} dB" for view in low)
    what = f"{len(low)} of {len(run.train) + len(run.test)} photos differ widely from what the scene shows"
    advice = f"look at {names[0]} beside its render: blurred, badly posed, in shadow? then train without it"
    return [Finding("unexplained", Severity.WARNING, what, advice, names, scores)]


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
    if gap < OVERFITTED:
        return []
    what = f"test views are {gap:.1f} dB below the training views: the scene has memorised its {len(run.train)} photos"
    advice = (
        "take more photos between the existing ones; with these, stop earlier or set a lower --max-gaussians"
    )
    return [Finding("overfitted", Severity.WARNING, what, advice)]


def _exposure(run: Trained) -> list[Finding]:
    views = (*run.train, *run.test)
    # A scene that is not finished is too dark for all of them.
    usual = float(np.median([view.stops for view in views])) if views else 0.0
    off = sorted((v for v in views if abs(v.stops - usual) > JUMP), key=lambda v: -abs(v.stops - usual))
    names = tuple(view.name for view in off)
    stops = tuple(f"{view.stops - usual:+.1f}" for view in off)
    what = f"{counted(len(off), 'photo')} brighter or darker than the scene, in stops"
    advice = "take out the photos whose exposure jumps, or make them even: the scene explains them with fog"
    found = [Finding(EXPOSURE, Severity.WARNING, what, advice, names, stops)] if off else []
    # A scene that fits photos of differing exposure hides that they differ: what the photos themselves show counts too.
    hidden = "the scene fits them all the same, by fog or by colours that change with the view"
    unexplained = {view.name for views in (run.train, run.test) for view in _far_below(views)}
    found += [
        before
        if unexplained & set(before.images)
        else replace(before, sentence=f"{before.sentence}; {hidden}")
        for before in run.beforehand
        if before.name != EXPOSURE or not before.images or not set(before.images) <= set(names)
    ]
    return found


def _floaters(run: Trained) -> list[Finding]:
    veiled = sorted((v for v in (*run.train, *run.test) if v.veiled > VEILED), key=lambda view: -view.veiled)
    if not veiled:
        return []
    names = tuple(view.name for view in veiled)
    shares = tuple(f"{100 * view.veiled:.0f} %" for view in veiled)
    what = f"{counted(len(veiled), 'view')} with splats that hang close to the camera"
    advice = "start from real points, not random ones, and leave out exposure jumps; convert --crop cuts away the rest"
    return [Finding("floaters", Severity.WARNING, what, advice, names, shares)]


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
        advice = f"leave out faint splats: {command('convert', run.path, 'scene.ply', '--min-opacity', str(FAINT))}"
        found.append(Finding("faint splats", Severity.NOTE, what, advice))
    sizes = run.gaussians.scales.amax(dim=1)
    huge = float(((sizes > run.extent) & (run.gaussians.opacities >= FAINT)).double().mean())
    if huge > HUGE_SHARE:
        what = f"{100 * huge:.1f} % of the splats are larger than the cameras' spread: they stand for haze"
        advice = "look for exposure jumps and for a sky; start points far outside become such splats too"
        found.append(Finding("huge splats", Severity.WARNING, what, advice))
    return found
