"""Checks of a trained run: views the scene does not explain, overfitting, floaters, faint and huge splats."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_edu.base.text import Told, spelled_seconds
from gsplat_edu.doctor.appearance import CORRECTED, EXPOSURE
from gsplat_edu.doctor.finding import (
    AS_LONG,
    FEWER_PHOTOS,
    FEWER_SPLATS,
    LONGER,
    MORE_PHOTOS,
    MORE_SPLATS,
    NAMED,
    SHORTER,
    Advice,
    Change,
    Diagnosis,
    Finding,
    Severity,
    command,
    counted,
    new_run,
)
from gsplat_edu.doctor.moving import check_moved
from gsplat_edu.doctor.residuals import Residual
from gsplat_edu.evaluate.metrics import SPILLED
from gsplat_edu.evaluate.verdict import Cause, Measured, Verdict, causes_of, judged
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.train.config import RECIPE_ITERATIONS
from gsplat_edu.train.length import QUALITIES, planned_iterations, usual_iterations

UNEXPLAINED = 3.0
"""Warn about a view whose PSNR is this far below the median of its split, dB: 3 dB is twice the squared error."""

FITTED = 27.0
"""Blame a photo for its low PSNR only if the training views' median PSNR is at least this, dB; otherwise the scene is
too small or too little trained. 18 photos of `fern` with 45,000 Gaussians had a mean of 25.8, `snowmiku97` has 29."""

UNEXPLAINED_SPREAD = 3.0
"""It must also be this many sigma below the median, with sigma from the median absolute deviation."""

RISING = 0.1
"""Advise longer training if the test views' PSNR rose by at least this in the last quarter of the run, dB."""

FALLING = 0.97
"""The loss is still falling if its mean over the last tenth of the iterations is below this times its mean between
65 % and 75 % of them. Used if no views were held out."""

JUMP = 0.5
"""Warn when a photo is brighter or darker than the scene by more than this, stops. Photos with half the scene in
shadow stay below 0.2."""

VEILED = 0.02
"""Warn if near splats cover more than this fraction of a view's pixels: a spot of a seventh of its width and height."""

FAINT = 0.02
"""Splats below this opacity are hardly visible: they change a white 8-bit pixel by five levels."""

FAINT_SHARE = 0.4
"""Report faint splats when their share exceeds this. Three runs of 2,000 iterations had 0.1 to 0.33."""

HUGE_SHARE = 0.01
"""Warn when the share of splats larger than the cameras' extent exceeds this; a sky needs a few."""

SPREAD_TO_NORMAL = 1.4826
"""Standard deviation of a normal distribution divided by its median absolute deviation."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A run's scene and its residuals.

    Args:
        path: The run's folder.
        gaussians: The scene.
        extent: Extent of the camera positions, world units (`scene_extent`).
        train: Residuals of the training views.
        test: Residuals of the held-out views.
        reached: Completed iterations.
        planned: Planned iterations; None if the run does not record them.
        log: Entries of the run's log.jsonl.
        capture: The capture it was trained on; None if unknown.
        options: Further training options to repeat in an advised longer run, as command-line words.
        beforehand: Findings about exposure from the photos alone.
        uncompared: Why the exposure of the photos was not compared; empty if it was.
        correction: What `--appearance auto` chooses for the capture (`gsplat_edu.doctor.appearance.correction_of`).
        strategy: The run's recipe.
        corrected: Whether the training corrected exposures; the residuals then compare corrected renders, and
            `beforehand` is empty.
        measured: What the run's files tell; None if there is only what the residuals tell.
        plugged: What plug-ins found: sentences, each with what to do about it.
        moved: Name and affected fraction of each training photo that shows objects which other photos do not; empty if
            the training masked them.
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
    correction: str = "none"
    strategy: str = "adc"
    corrected: bool = False
    moved: Sequence[tuple[str, float]] = ()
    plugged: Sequence[tuple[str, str]] = ()
    measured: Measured | None = None

    @cached_property
    def causes(self) -> dict[str, Cause]:
        """What is measured to be wrong, by the names of the findings, in their order."""
        return {cause.name: cause for cause in causes_of(self._scored)}

    @property
    def verdict(self) -> Verdict:
        """The verdict, as the report and the studio show it."""
        return judged(self.measured or self._scored)

    @property
    def _scored(self) -> Measured:
        """What is measured; the residuals give the scores of a run that was not evaluated."""
        known = self.measured or Measured(iterations=self.reached)
        if known.test is not None or known.train is not None:
            return known
        test, train = (_mean(views) if views else None for views in (self.test, self.train))
        return replace(known, test=test, train=train, photos=len(self.train) + len(self.test))

    @property
    def usual(self) -> int:
        """The default number of iterations of the run's recipe."""
        return usual_iterations(self.strategy, len(self.train))

    @property
    def longest(self) -> int:
        """Iterations of the longest run that is advised."""
        if self.strategy != "fast":
            return RECIPE_ITERATIONS
        return planned_iterations(max(QUALITIES, key=lambda name: QUALITIES[name]), max(len(self.train), 1))

    @property
    def next_length(self) -> int:
        """Iterations of the longer run that is advised: those of the recipe first, then those of its best quality."""
        return self.usual if self.reached < self.usual else self.longest

    @property
    def rising(self) -> bool | None:
        """Whether the scene was still improving when training ended; None if the log cannot tell.

        It cannot tell for the recipe fast: its rates fall until the end, which raises the PSNR of any run.
        """
        if self.strategy == "fast":
            return None
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
    """Return (iteration, value) of the log entries that have both, in order."""
    pairs = ((line.get("iteration"), line.get(key)) for line in log)
    return sorted(
        (i, float(v)) for i, v in pairs if isinstance(i, int) and i <= reached and isinstance(v, int | float)
    )


def examine_run(run: Trained) -> Diagnosis:
    """Run all checks on a trained scene.

    Args:
        run: The scene and its residuals.
    """
    checks = (
        ("length", _length),
        ("training views", _fit),
        ("outliers", _outliers),
        ("things that moved", lambda run: check_moved(run.moved, len(run.train))),
        ("test views", _gap),
        ("exposure", _exposure),
        ("floaters", _floaters),
        *([("cut-outs", _spilled)] if _outsides(run) else []),
        ("splats", _splats),
    )
    foreign = [Finding("plug-in", Severity.NOTE, sentence, advice) for sentence, advice in run.plugged]
    findings, fine = list[Finding](), list[str]()
    for name, check in checks:
        found = check(run)
        findings += found
        if not found:
            fine.append(name)
    named = {finding.name for finding in findings}
    findings += [_of_cause(cause, named) for cause in run.causes.values() if cause.name not in named]
    return Diagnosis(_facts(run), (*findings, *foreign), tuple(fine), _otherwise(run))


def _of_cause(cause: Cause, named: Collection[str]) -> Finding:
    """Return the finding of a cause that the verdict names and that no check of the pixels reports.

    Too few photos are advised against with the overfitting that they cause, if that is `named`.
    """
    if cause.name == "few photos" and "overfitted" in named:
        return Finding(cause.name, Severity.WARNING, cause.reason, "")
    advice = cause.advice[0].lower() + cause.advice[1:].removesuffix(".")
    changes = (MORE_PHOTOS,) if cause.name in ("few photos", "hole") else ()
    return Finding(cause.name, Severity.WARNING, cause.reason, advice, changes=changes)


def _otherwise(run: Trained) -> tuple[Advice, ...]:
    """Return advice for scenes with few problems; a longer training only if nothing else is wrong."""
    longer = run.reached < run.longest and run.rising is not False and set(run.causes) <= {"short training"}
    return (
        Advice(Told(f"view it: {command('render', run.path, '--orbit', '--out', 'orbit.mp4')}", "")),
        Advice(
            Told(
                f"a smaller file: {command('convert', run.path, 'scene.spz', '--min-opacity', str(FAINT))}",
                "",
            )
        ),
        Advice(_train_longer(run), (LONGER,))
        if longer
        else Advice(
            Told(
                f"a better scene needs better photos{_what_photos_lack(run)}",
                "a better scene needs better photos",
            )
        ),
    )


def _what_photos_lack(run: Trained) -> str:
    return "" if run.capture is None else f"; to check these: {command('doctor', run.capture)}"


def _train_longer(run: Trained) -> str:
    plain = f"train for {run.next_length:,} iterations{_at_its_pace(run)}"
    if run.capture is None:
        return Told(f"train for {run.next_length:,} iterations", plain)
    name = f"{run.path.resolve().name}_{run.next_length}"
    length = ("--iterations", str(run.next_length))
    words = command("train", run.capture, *length, *run.options, "--out", new_run(name))
    return Told(f"train for longer{_at_its_pace(run)}: {words}", plain)


def _longer(run: Trained) -> tuple[tuple[str, str], ...]:
    """Return the options of the advised longer training."""
    return (("iterations", str(run.next_length)),)


def _at_its_pace(run: Trained) -> str:
    """Estimate how long that takes: hours on a slow computer.

    At the speed of the last iterations, or for the recipe fast, whose photos grow in proportion to the length, at the
    mean speed.
    """
    fast = run.strategy == "fast"
    paces = [ms for at, ms in _pairs(run.log, "ms", run.reached) if fast or at > 0.75 * run.reached]
    if not paces:
        return ""
    takes = spelled_seconds(1e-3 * run.next_length * float(np.mean(paces) if fast else np.median(paces)))
    return f" (about {takes} at this run's pace)" if fast else f" ({takes} or more at this run's pace)"


def view_lines(run: Trained) -> list[str]:
    """Return one line per view, worst first."""
    views = [(view, split) for split, views in (("test", run.test), ("train", run.train)) for view in views]
    ordered = sorted(views, key=lambda entry: entry[0].psnr)
    return [
        f"{view.psnr:7.2f} dB  {split:5}  {view.stops:+5.2f} stops  {view.name}" for view, split in ordered
    ]


def _facts(run: Trained) -> tuple[tuple[str, str], ...]:
    facts = [("verdict", str(run.verdict))]
    facts.append(("run", f"{run.path}: {run.reached:,} iterations, {len(run.gaussians):,} splats"))
    for name, views in (("test", run.test), ("train", run.train)):
        if views:
            low = sorted(views, key=lambda view: view.psnr)[:NAMED]
            worst = ", ".join(f"{view.name} {view.psnr:.1f}" for view in low)
            facts.append((name, f"{len(views)} views, PSNR {_mean(views):.2f} dB; worst {worst}"))
    if run.corrected:
        facts.append(("exposure", "each render was given its photo's exposure first, as in the training"))
    elif run.uncompared:
        facts.append(("exposure", f"compared with the scene only, not between photos: {run.uncompared}"))
    return tuple(facts)


def _mean(views: Sequence[Residual]) -> float:
    return float(np.mean([view.psnr for view in views]))


def _length(run: Trained) -> list[Finding]:
    if run.planned is not None and run.reached < run.planned:
        what = f"the scene was saved at iteration {run.reached:,} of {run.planned:,}"
        advice = Told(
            "finish the training: repeat its command with --resume",
            "finish the training: Resume continues it",
        )
        return [Finding("unfinished", Severity.WARNING, what, advice, changes=(LONGER,))]
    if run.reached >= run.usual:
        return []
    what = f"{run.reached:,} iterations; the recipe has {run.usual:,}"
    if run.rising is False:
        held = "the test views' PSNR no longer rises" if run.test else "the loss no longer falls"
        useless = "more iterations alone will not help much; better photos may"
        advice = Told(f"{useless}{_what_photos_lack(run)}", useless)
        return [Finding("short training", Severity.NOTE, f"{what}, but {held}", advice, changes=(AS_LONG,))]
    if run.rising:
        what += ", and " + (
            "the test views' PSNR was still rising" if run.test else "the loss was still falling"
        )
    return [
        Finding(
            "short training",
            Severity.WARNING,
            what,
            _train_longer(run),
            options=_longer(run),
            changes=(LONGER,),
        )
    ]


def _fit(run: Trained) -> list[Finding]:
    if not run.train or "poor fit" not in run.causes:
        return []
    what = f"the training views reach only {_mean(run.train):.1f} dB on average: the scene does not fit even those"
    place = "" if run.capture is None else f": {command('doctor', run.capture)}"
    advice = f"train with --refine auto if poses are a little off; check poses and intrinsics first{place}"
    plain = "examine the capture's poses; if they are a little off, refine them in the training"
    options: tuple[tuple[str, str], ...] = (("refine", "auto"),)
    early = run.reached < run.usual and bool(run.rising)  # too few iterations may be the only cause
    if early:
        advice, plain = (
            f"train for longer first; if they do not improve, {words}" for words in (advice, plain)
        )
        options = (*_longer(run), *options)
    changes = (LONGER,) if early else ()
    told = Told(advice, plain)
    return [Finding("poor fit", Severity.WARNING, what, told, options=options, changes=changes)]


def _outliers(run: Trained) -> list[Finding]:
    low = [view for views in (run.train, run.test) for view in _far_below(views)]
    if not low:
        return []
    low.sort(key=lambda view: view.psnr)
    names = tuple(view.name for view in low)
    scores = tuple(f"{view.psnr:.1f} dB" for view in low)
    what = f"{len(low)} of {len(run.train) + len(run.test)} photos differ strongly from their renders"
    options: tuple[tuple[str, str], ...] = ()
    changes: tuple[Change, ...] = (FEWER_PHOTOS,)
    if _median_fit(run) < FITTED:
        longer = run.reached < run.longest
        options = (("max_gaussians", str(2 * len(run.gaussians))), *(_longer(run) if longer else ()))
        changes = (MORE_SPLATS, LONGER) if longer else (MORE_SPLATS,)
    advice = _about_outliers(run, low)
    return [Finding("unexplained", Severity.WARNING, what, advice, names, scores, options, changes)]


def _median_fit(run: Trained) -> float:
    """Return the median PSNR of the training views, dB; infinity without any."""
    return float(np.median([view.psnr for view in run.train])) if run.train else float(np.inf)


def _about_outliers(run: Trained, low: Sequence[Residual]) -> str:
    """Return advice. A badly fitted photo is suspicious only if the scene fits the others."""
    usual = _median_fit(run)
    if usual < FITTED:
        number = 2 * len(run.gaussians)
        longer = " or for longer" if run.reached < run.longest else ""
        why = f"the scene fits most training photos badly too (median {usual:.1f} dB)"
        return Told(
            f"train with more Gaussians (--max-gaussians {number}){longer} before you judge single photos: {why}",
            f"train with more splats{longer} before you judge single photos: {why}",
        )
    trained = [view for view in low if any(view is other for other in run.train)]
    if not trained:
        return (
            f"compare {low[0].name} with its render: it was held out, so it needs photos near it in training, or its "
            "pose is wrong"
        )
    name = trained[0].name
    wrong = f"compare {name} with its render: if it is blurred, in shadow or has a wrong pose,"
    return Told(f"{wrong} train without it", f"{wrong} remove it from the photos and find the poses again")


def _far_below(views: Sequence[Residual]) -> list[Residual]:
    """Return the views far below the median PSNR, by a measure that is robust to a few outliers."""
    if len(views) < 4:
        return []
    values = np.array([view.psnr for view in views])
    median = float(np.median(values))
    spread = SPREAD_TO_NORMAL * float(np.median(np.abs(values - median)))
    limit = median - max(UNEXPLAINED, UNEXPLAINED_SPREAD * spread)
    return [view for view in views if view.psnr < limit]


def _gap(run: Trained) -> list[Finding]:
    if not run.train or not run.test or "overfitted" not in run.causes:
        return []
    gap = _mean(run.train) - _mean(run.test)
    what = f"test views are {gap:.1f} dB below the training views: the scene overfits its {len(run.train)} photos"
    photos = "take more photos between the existing ones"
    if run.rising or _fit(run):  # the test views still gain, or the scene is too small: less would not help
        return [Finding("overfitted", Severity.WARNING, what, photos, changes=(MORE_PHOTOS,))]
    fewer, rest = max(len(run.gaussians) // 2, 1), "with the present ones, stop earlier or"
    advice = Told(f"{photos}; {rest} lower --max-gaussians", f"{photos}; {rest} train with fewer splats")
    options, changes = (("max_gaussians", str(fewer)),), (MORE_PHOTOS, SHORTER, FEWER_SPLATS)
    return [Finding("overfitted", Severity.WARNING, what, advice, options=options, changes=changes)]


def _exposure(run: Trained) -> list[Finding]:
    views = (*run.train, *run.test)
    # The render of an unfinished scene is too dark in every view.
    usual = float(np.median([view.stops for view in views])) if views else 0.0
    off = sorted((v for v in views if abs(v.stops - usual) > JUMP), key=lambda v: -abs(v.stops - usual))
    names = tuple(view.name for view in off)
    stops = tuple(f"{view.stops - usual:+.1f}" for view in off)
    what = f"{counted(len(off), 'photo')} brighter or darker than the scene, in stops"
    advice: str = "remove the photos: the scene reproduces the jumps with fog"
    options = CORRECTED if run.correction == "exposure" else ()
    if options:
        advice = Told(
            f"train with --appearance exposure, or {advice}", f"train with exposure correction, or {advice}"
        )
    found = [Finding(EXPOSURE, Severity.WARNING, what, advice, names, stops, options)] if off else []
    # A scene that fits photos of differing exposure hides the difference, so findings from the photos alone count too.
    hidden = "the scene fits them nevertheless, with fog or view-dependent colours"
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
    what = f"{counted(len(veiled), 'view')} with splats floating close to the camera"
    fewer = "they are fewer with real start points and no exposure jumps"
    advice = Told(
        f"remove them with gsplat-edu clean, or train with --clean; {fewer}",
        f"remove them with Clean under Share; {fewer}",
    )
    return [Finding("floaters", Severity.WARNING, what, advice, names, shares)]


def _outsides(run: Trained) -> list[tuple[Residual, float]]:
    """Return the views whose photos have alpha, with their `Residual.outside`."""
    return [(view, view.outside) for view in (*run.train, *run.test) if view.outside is not None]


def _spilled(run: Trained) -> list[Finding]:
    views = _outsides(run)
    mean = float(np.mean([share for _, share in views]))
    if mean <= SPILLED:
        return []
    most = sorted(views, key=lambda entry: -entry[1])[:NAMED]
    names = tuple(view.name for view, _ in most)
    shares = tuple(f"{100 * share:.0f} %" for _, share in most)
    share = f"{100 * mean:.0f} % of the scene's solid area"
    what = f"{share} lies outside of what the photos cut out, where their alpha is 0"
    again = "train again over changing backgrounds, which is the default"
    advice = Told(
        f"remove it with gsplat-edu clean, or {again}: without --white-background and --background",
        f"remove it with Clean under Share, or {again}",
    )
    return [Finding("outside cut-outs", Severity.WARNING, what, advice, names, shares)]


def _splats(run: Trained) -> list[Finding]:
    if not len(run.gaussians):
        again = "train again; the log shows when splats were removed"
        return [Finding("splats", Severity.WARNING, "the scene is empty", again)]
    found = []
    faint = float((run.gaussians.opacities < FAINT).double().mean())
    if faint > FAINT_SHARE:
        what = f"{100 * faint:.0f} % of the splats have an opacity below {FAINT}: they cost time and are hardly visible"
        advice = Told(
            f"remove faint splats: {command('convert', run.path, 'scene.ply', '--min-opacity', str(FAINT))}",
            "leave faint splats out of an export under Share",
        )
        found.append(Finding("faint splats", Severity.NOTE, what, advice))
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
        found.append(Finding("huge splats", Severity.WARNING, what, advice, options=(("sky", "shell"),)))
    return found
