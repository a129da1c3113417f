"""The verdict on a run: how good its scene is, in words, from the numbers of metrics.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from gsplat_edu.base.constants import FAR_BELOW

MEASURES = ("psnr", "psnr_8bit", "ssim", "l1", "psnr_fitted")
"""The scores of an image and of a split, by their names in metrics.json and in `ImageScore`."""

SKIPPED = "not_scored"
"""Key of metrics.json: by "test" and "train", the number of views that an evaluation left out."""

FULL_LENGTH = "full_length"
"""Key of metrics.json: the iterations that the training would have without a time limit."""

OVERFITTED = 5.0
"""Report overfitting from this gap between the PSNR of training and test views, dB. Measured after 2,000 iterations: 2
dB for a capture of 97 photos, 9 for one of 11, and 12 for one of 50 with random start points."""

GRADES = ((30.0, "very close"), (25.0, "close"), (20.0, "soft or partly wrong"))
"""Lower limit of the mean test PSNR, dB, and the verdict on the renders; below the last limit, "wrong in places"."""


def verdict(metrics: Mapping[str, Any]) -> str:
    """Say in one sentence how good a scene is; report, command line and studio show it.

    Args:
        metrics: The contents of metrics.json.
    """
    fitted = metrics.get("appearance", "none") != "none"
    key = "psnr_fitted" if fitted else "psnr"
    test, train = (mean_of(metrics, split, key) for split in ("test", "train"))
    steps = metrics.get("iterations")
    after = f"After {steps:,} iterations, " if isinstance(steps, int) else ""
    if short := too_short(metrics):
        after = f"{short} {after}"
    if test is None:
        if skipped := skipped_views(metrics):
            return (
                f"{after or 'The scene was trained; '}nothing was scored: --eval-every 0 skipped {skipped}."
            )
        if train is None:
            return "The scene was not evaluated: no photo was compared with a render."
        known = f"renders of the training photos reach {train:.1f} dB PSNR"
        sentence = f"{after}{known}; no photo was held out, so the quality of new views is unknown."
        return sentence[0].upper() + sentence[1:]
    grade = next((words for least, words in GRADES if test >= least), "wrong in places")
    once = " once their exposure is fitted" if fitted else ""
    parts = [f"{after}renders of the held-out photos reach {test:.1f} dB PSNR{once} ({grade})"]
    if train is not None:
        gap = train - test
        how = f"{abs(gap):.1f} dB {'below' if gap > 0 else 'above'} the training photos"
        parts.append(f"{how}, so the scene has overfitted to them" if gap >= OVERFITTED else how)
    if (low := _worst(metrics)) is not None and not fitted:
        parts.append(f"the worst view is {low[0]} at {low[1]:.1f} dB")
    sentence = "; ".join(parts) + "."
    return sentence[0].upper() + sentence[1:]


def too_short(metrics: Mapping[str, Any]) -> str:
    """Return a sentence if a time limit ended the training long before the scene is usable; empty otherwise.

    Args:
        metrics: The contents of metrics.json.
    """
    steps, full = metrics.get("iterations"), metrics.get(FULL_LENGTH)
    if not isinstance(steps, int) or not isinstance(full, int) or steps >= FAR_BELOW * full:
        return ""
    return f"The scene is not usable: it was trained for {steps:,} of {full:,} iterations; give it more time."


def skipped_views(metrics: Mapping[str, Any]) -> str:
    """Return how many views of a run were not scored because `--eval-every` was 0; empty if they were scored.

    Args:
        metrics: The contents of metrics.json.
    """
    counts = metrics.get(SKIPPED)
    if not isinstance(counts, Mapping):
        return ""
    test, train = (counts.get(split, 0) for split in ("test", "train"))
    return f"{test} held-out and {train} training photos"


def _worst(metrics: Mapping[str, Any]) -> tuple[str, float] | None:
    """Return name and PSNR of the held-out view with the lowest one; None if fewer than two have one."""
    views = metrics.get("test_views")
    scored = [
        (str(view.get("name", "")), float(view["psnr"]))
        for view in (views if isinstance(views, list) else [])
        if isinstance(view, Mapping) and isinstance(view.get("psnr"), int | float)
    ]
    return min(scored, key=lambda view: view[1]) if len(scored) > 1 else None


def mean_of(metrics: Mapping[str, Any], split: str, key: str) -> float | None:
    """Return a mean of metrics.json, for example of the split "test" and the key "psnr"; None if there is none."""
    means = metrics.get(split)
    value = means.get(key) if isinstance(means, Mapping) else None
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
