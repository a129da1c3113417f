"""The part that keeps the scene empty outside of the masks of an object: the setting `outside_masks`."""

from __future__ import annotations

from gsplat_edu.parts.empty_outside.findings import check_masks, outside_masks_of
from gsplat_edu.parts.empty_outside.term import OUTSIDE_WEIGHT, EmptyOutside
from gsplat_edu.survey.capture import Survey, Undecided
from gsplat_edu.survey.finding import Examined, Remedy
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class EmptyOutsidePart(Part):
    """Lets nothing be where masks exclude pixels."""

    off_device = ("outside_masks",)

    def examine(self, survey: Survey) -> Examined:
        """Report what the training will do outside the masks."""
        return Examined({"masks": check_masks(survey)} if len(survey.shots) > 1 else {})

    def choose(self, setting: str, capture: Undecided) -> Remedy | None:
        """Choose `outside_masks` by what the masks keep."""
        return outside_masks_of(capture.survey) if setting == "outside_masks" else None

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the term."""
        if settings.outside_masks == "ignore":
            return None
        return Begun({"outside": EmptyOutside(OUTSIDE_WEIGHT)})


EMPTY_OUTSIDE = EmptyOutsidePart()
