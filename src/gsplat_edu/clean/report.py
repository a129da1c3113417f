"""What a cleaning says: lines for the user, an entry for metrics.json."""

from __future__ import annotations

from typing import Any

from gsplat_edu.clean.guard import Cleaning
from gsplat_edu.clean.judge import Reason
from gsplat_edu.evaluate.metrics import SPILLED


def report_lines(cleaning: Cleaning) -> list[str]:
    """Describe a cleaning: counts by reason, PSNR before and after, and what the guard took back.

    Args:
        cleaning: The cleaning.
    """
    counts, judged = cleaning.counts(), int((cleaning.judged != Reason.KEPT).sum())
    total, removed = len(cleaning.reasons), sum(counts.values())
    text = [f"removed {removed:,} of {total:,} splats, judged by {cleaning.views} views"]
    text += [f"  {count:9,}  {reason.sentence}" for reason, count in counts.items()]
    which = "held-out" if cleaning.held_out else "training"
    if not cleaning.held_out:
        text.append("no view is held out, so the training views guard, whose PSNR is weaker evidence")
    if cleaning.before is None or cleaning.after is None:
        text.append("PSNR: no view has a pixel that counts")
        return text
    if removed < judged:
        assert cleaning.all_removed is not None
        text.append(
            f"{judged:,} were judged removable, but without them PSNR would be {cleaning.all_removed:.2f} dB:"
            f" kept the {judged - removed:,} least certain"
        )
    change = cleaning.after - cleaning.before
    text.append(
        f"PSNR of {cleaning.guards} {which} views: {cleaning.before:.2f} dB before,"
        f" {cleaning.after:.2f} dB after ({change:+.3f} dB)"
    )
    if cleaning.outside is not None and cleaning.outside > SPILLED:
        text.append(
            f"{100 * cleaning.outside:.0f} % of the scene's solid area still lies outside of what the photos cut out,"
            " where their alpha is 0; train again without --white-background and --background"
        )
    return text


def record_of(cleaning: Cleaning) -> dict[str, Any]:
    """Return the entry for metrics.json."""
    counts = {reason.name.lower(): count for reason, count in cleaning.counts().items()}
    return {
        "removed": counts,
        "judged": int((cleaning.judged != Reason.KEPT).sum()),
        "psnr_before": cleaning.before,
        "psnr_after": cleaning.after,
        "held_out": cleaning.held_out,
        "outside_cut_outs": cleaning.outside,
    }
