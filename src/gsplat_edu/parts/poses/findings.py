"""The finding about photos whose cameras may be a little off."""

from __future__ import annotations

from gsplat_edu.base.text import Told
from gsplat_edu.survey.finding import LONGER, Finding, Severity, command
from gsplat_edu.survey.trained import Trained, mean_psnr


def check_fit(run: Trained) -> list[Finding]:
    """Report training views that the scene does not fit, as with wrong cameras."""
    if not run.train or "poor fit" not in run.causes:
        return []
    what = f"the training views reach only {mean_psnr(run.train):.1f} dB on average: the scene does not fit even those"
    place = "" if run.capture is None else f": {command('doctor', run.capture)}"
    advice = f"train with --refine auto if poses are a little off; check poses and intrinsics first{place}"
    plain = "examine the capture's poses; if they are a little off, refine them in the training"
    options: tuple[tuple[str, str], ...] = (("refine", "auto"),)
    early = run.reached < run.usual and bool(run.rising)  # too few iterations may be the only cause
    if early:
        advice, plain = (
            f"train for longer first; if they do not improve, {words}" for words in (advice, plain)
        )
        options = (*run.longer, *options)
    changes = (LONGER,) if early else ()
    told = Told(advice, plain)
    return [Finding("poor fit", Severity.WARNING, what, told, options=options, changes=changes)]
