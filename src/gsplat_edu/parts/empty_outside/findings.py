"""Decide for `--outside-masks auto` whether masks cut out an object or hide something in front of a scene.

An object's mask keeps a connected region away from most of the photo's border, and differs from photo to photo. A mask
of a passer-by, a tripod or the sky keeps most of the border. A mask of a lens's dark rim is the same in every photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from gsplat_edu.base.text import Told
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Finding, Remedy, Severity

MOST_KEPT = 0.75
"""An object's mask keeps at most this share of the photo's pixels."""

MOST_BORDER = 0.35
"""An object's mask keeps at most this share of the photo's border: it may stand on the lower edge."""

LARGEST_PART = 0.8
"""The largest connected part that an object's mask keeps is at least this fraction of all it keeps."""

MOST_MASKS = 0.8
"""At least this share of the masks has to cut out an object."""

MOST_PHOTOS = 0.9
"""At least this fraction of the photos must have a mask, because the scene learns the surroundings from the others."""


class Shape(NamedTuple):
    """What a mask keeps.

    Args:
        kept: Share of the pixels that count.
        border: Share of the border's pixels that count.
        part: Share of the largest connected part in what is kept.
    """

    kept: float
    border: float
    part: float

    @property
    def cuts_out(self) -> bool:
        """Whether the mask is that of an object."""
        return 0 < self.kept <= MOST_KEPT and self.border <= MOST_BORDER and self.part >= LARGEST_PART


def shape_of(mask: Bool[np.ndarray, "h w"]) -> Shape:
    """Measure what a mask keeps."""
    border = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
    kept = int(np.count_nonzero(mask))
    _, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    largest = int(parts[1:, cv2.CC_STAT_AREA].max(initial=0))
    return Shape(kept / mask.size, float(border.mean()), largest / max(kept, 1))


def outside_masks_for(masks: Sequence[Bool[np.ndarray, "_ _"]], photos: int) -> Remedy:
    """Choose `--outside-masks` for a capture.

    Args:
        masks: The masks of its photos, from `gsplat_edu.survey.photos.PhotoStats`.
        photos: The number of its photos, with and without a mask.
    """
    if not masks:
        return Remedy("ignore")
    alike = len(masks) > 1 and all(np.array_equal(mask, masks[0]) for mask in masks)
    objects = sum(shape_of(mask).cuts_out for mask in masks)
    shown = f"{objects} of {len(masks)} masks cut out an object"
    if alike:
        return Remedy(
            "ignore", "the masks are the same in every photo; what lies outside them may show anything"
        )
    if objects < MOST_MASKS * len(masks):
        return Remedy(
            "ignore", f"{shown}, the others hide parts of photos; the scene may show anything there"
        )
    if len(masks) < MOST_PHOTOS * photos:
        few = f"only {len(masks)} of {photos} photos have a mask"
        return Remedy("ignore", f"{shown}, but {few}; the scene may show anything outside")
    return Remedy("empty", f"{shown}; the scene is kept empty outside them")


def outside_masks_of(survey: Survey) -> Remedy:
    """Choose `--outside-masks` for a surveyed capture."""
    masks = [shot.stats.mask for shot in survey.shots if shot.stats.mask is not None]
    return outside_masks_for(masks, len(survey.shots))


def check_masks(survey: Survey) -> list[Finding]:
    """Report what the training will do outside the masks."""
    remedy = outside_masks_of(survey)
    if not remedy.reason:
        return []
    sentence = Told(
        f"{remedy.reason} (--outside-masks {remedy.value}, which auto chooses, the recipe fast's default)",
        remedy.reason,
    )
    other = "ignore" if remedy.value == "empty" else "empty"
    advice = Told(
        f"to decide otherwise, train with --outside-masks {other}",
        "to decide otherwise, "
        + (
            "keep the scene empty outside the masks"
            if other == "empty"
            else "let the scene show anything there"
        ),
    )
    return [Finding("masks", Severity.NOTE, sentence, advice, options=(("outside_masks", other),))]
