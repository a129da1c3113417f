"""Checks of a trained run: its length, views the scene does not explain, overfitting, floaters and faint splats."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from gsplat_edu.base.text import Told, spelled_seconds
from gsplat_edu.doctor.diagnosis import Advice, Diagnosis, in_order, new_run
from gsplat_edu.evaluate.metrics import SPILLED
from gsplat_edu.evaluate.verdict import Cause
from gsplat_edu.survey.finding import (
    AS_LONG,
    FEWER_PHOTOS,
    FEWER_SPLATS,
    LONGER,
    MORE_PHOTOS,
    MORE_SPLATS,
    NAMED,
    SHORTER,
    Change,
    Examined,
    Finding,
    Severity,
    command,
)
from gsplat_edu.survey.residuals import Residual
from gsplat_edu.survey.trained import FAINT, Trained, far_below, logged, mean_psnr

FITTED = 27.0
"""Blame a photo for its low PSNR only if the training views' median PSNR is at least this, dB; otherwise the scene is
too small or too little trained. 18 photos of `fern` with 45,000 Gaussians had a mean of 25.8, `snowmiku97` has 29."""

FAINT_SHARE = 0.4
"""Report faint splats when their share exceeds this. Three runs of 2,000 iterations had 0.1 to 0.33."""


def examine_run(run: Trained, parts: Sequence[Examined] = ()) -> Diagnosis:
    """Run all checks on a trained scene.

    Args:
        run: The scene and its residuals.
        parts: What the parts of its training find (`gsplat_edu.runs.parts.judgements`).
    """
    checks = [
        ("length", _length(run)),
        ("outliers", _outliers(run)),
        ("test views", _gap(run)),
        *([("cut-outs", _spilled(run))] if _outsides(run) else []),
        ("splats", _splats(run)),
        *(check for part in parts for check in part.checks.items()),
    ]
    findings, fine = in_order(checks)
    named = {finding.name for finding in findings}
    causes = [_of_cause(cause, named) for cause in run.causes.values() if cause.name not in named]
    facts = (*_facts(run), *(fact for part in parts for fact in part.facts))
    return Diagnosis(facts, (*findings, *causes), fine, _otherwise(run))


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


def _at_its_pace(run: Trained) -> str:
    """Estimate how long that takes: hours on a slow computer.

    At the speed of the last iterations, or for the recipe fast, whose photos grow in proportion to the length, at the
    mean speed.
    """
    fast = run.strategy == "fast"
    paces = [ms for at, ms in logged(run.log, "ms", run.reached) if fast or at > 0.75 * run.reached]
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
            facts.append((name, f"{len(views)} views, PSNR {mean_psnr(views):.2f} dB; worst {worst}"))
    return tuple(facts)


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
            options=run.longer,
            changes=(LONGER,),
        )
    ]


def _outliers(run: Trained) -> list[Finding]:
    low = [view for views in (run.train, run.test) for view in far_below(views)]
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
        options = (("max_gaussians", str(2 * len(run.gaussians))), *(run.longer if longer else ()))
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


def _gap(run: Trained) -> list[Finding]:
    if not run.train or not run.test or "overfitted" not in run.causes:
        return []
    gap = mean_psnr(run.train) - mean_psnr(run.test)
    what = f"test views are {gap:.1f} dB below the training views: the scene overfits its {len(run.train)} photos"
    photos = "take more photos between the existing ones"
    if run.rising or "poor fit" in run.causes:
        # the test views still gain, or the scene is too small: less would not help
        return [Finding("overfitted", Severity.WARNING, what, photos, changes=(MORE_PHOTOS,))]
    fewer, rest = max(len(run.gaussians) // 2, 1), "with the present ones, stop earlier or"
    advice = Told(f"{photos}; {rest} lower --max-gaussians", f"{photos}; {rest} train with fewer splats")
    options, changes = (("max_gaussians", str(fewer)),), (MORE_PHOTOS, SHORTER, FEWER_SPLATS)
    return [Finding("overfitted", Severity.WARNING, what, advice, options=options, changes=changes)]


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
    return found
