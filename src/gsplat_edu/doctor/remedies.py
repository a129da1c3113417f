"""Which remedies a capture needs: what `auto` of `gsplat-edu train` chooses for `--appearance` and `--transients`.

The checks of `gsplat_edu.doctor.appearance` name photos that a user should look at. This module decides whether the
training should correct all photos.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsplat_edu.doctor.appearance import Gains
from gsplat_edu.doctor.survey import Progress, Survey, prepare

UNLIKE = 0.25
"""A photo counts if its brightness or a channel's tint differs from its neighbours' by more than this, stops."""

SHARE = 0.1
"""Exposures are corrected if at least this share of the photos counts. snowmiku97 has 0.05, whose phone drifts from
photo to photo (the scene follows as view-dependent colour); gains drawn from +-0.7 stops give 0.4."""

ENOUGH = 12
"""Training photos from which `--transients auto` looks for things that move: with fewer, most places are seen in less
than four, and a photo of them cannot be told to differ from the others."""


@dataclass(frozen=True)
class Remedy:
    """A choice and its reason.

    Args:
        value: What to pass to the option.
        reason: Why, as a clause that follows the option; "" if there is nothing to tell.
    """

    value: str
    reason: str = ""


def appearance_for(path: Path, progress: Progress | None = None) -> Remedy:
    """Choose `--appearance` for a capture from its photos.

    Args:
        path: Folder or transforms.json of the capture.
        progress: Called with (photos done, total) in the calling thread.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    return appearance_of(prepare(path, progress, sharpness=False))


def appearance_of(survey: Survey) -> Remedy:
    """Choose `--appearance` for a surveyed capture: "exposure" if many photos differ from their neighbours."""
    if len(survey.shots) < 2 or any(shot.stats.transparent for shot in survey.shots):
        return Remedy("none")
    gains = Gains(survey)
    differ = (np.abs(gains.light) > UNLIKE) | (gains.tint > UNLIKE)
    if np.mean(differ) < SHARE:
        return Remedy("none")
    largest = float(np.abs(gains.light).max())
    return Remedy(
        "exposure",
        f"{int(differ.sum())} of {len(differ)} photos differ in brightness or tint from neighbours that see the same,"
        f" by up to {largest:.1f} stops",
    )


def transients_for(count: int) -> Remedy:
    """Choose `--transients` for a number of training photos. Whether something moved shows only in the training."""
    if count < ENOUGH:
        return Remedy(
            "none",
            f"{count} training photos are too few to tell what moved; from {ENOUGH} on, they are compared",
        )
    return Remedy(
        "mask",
        f"{count} training photos are enough to tell what moved; a photo where nothing did keeps every pixel",
    )
