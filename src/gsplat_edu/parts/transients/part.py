"""The part that masks things that move: the setting `transients`."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.masked import masked_figures
from gsplat_edu.evaluate.report_parts import Section
from gsplat_edu.parts.run_values import Captured, Ended, Finished, Reported
from gsplat_edu.parts.transients.files import masked_pictures, write_masks
from gsplat_edu.parts.transients.findings import ENOUGH, check_moved, moved_line, moved_parts, transients_for
from gsplat_edu.parts.transients.search import Transients, check_enough
from gsplat_edu.render.api import render
from gsplat_edu.survey.capture import Undecided
from gsplat_edu.survey.finding import Examined, Remedy
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class TransientsPart(Part):
    """Finds and masks what only single photos show."""

    off_device = untimed = ("transients",)

    def choose(self, setting: str, capture: Undecided) -> Remedy | None:
        """Choose `transients` by the number of photos."""
        return transients_for(capture.training_photos) if setting == "transients" else None

    def judge(self, settings: TrainConfig, run: Trained) -> Examined:
        """Report photos that show what others do not, unless the training masked that.

        Raises:
            DatasetError: a photo cannot be read.
        """
        moved: Sequence[tuple[str, float]] = []
        if settings.transients == "none" and run.features is not None:
            moved = moved_parts(run.gaussians, run.views, run.features, run.settings)
        return Examined({"things that moved": check_moved(moved, len(run.train))})

    def remark(self, settings: TrainConfig, run: Ended) -> str:
        """Name the photos that show what others do not, or the command that does.

        Raises:
            DatasetError: a photo cannot be read.
        """
        if settings.transients != "none" or len(run.dataset.train) < ENOUGH:
            return ""
        return moved_line(run)

    def captured(self, settings: TrainConfig, capture: Captured) -> Dataset:
        """Check the number of photos before they are read.

        Raises:
            ArgumentError: there are too few.
        """
        if settings.transients != "none":
            check_enough(len(capture.dataset.train))
        return capture.dataset

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return what masks the photos.

        Raises:
            ArgumentError: there are too few views.
        """
        if settings.transients == "none":
            return None
        features = functools.partial(render, backend=setup.backend)
        return Begun(masker=Transients(setup.views, settings.means_rate_iterations, features))

    def finish(self, settings: TrainConfig, run: Finished) -> Mapping[str, Any]:
        """Write the masks, and list the masked photos.

        Raises:
            DatasetError: a photo cannot be read.
            OSError: a file cannot be written.
        """
        for masker in run.trainer.maskers.values():
            if isinstance(masker, Transients):
                sentence, facts = write_masks(run.path, run.dataset, masker)
                run.say(sentence)
                return {"transients": facts}
        return {}

    def section(self, settings: TrainConfig, run: Reported) -> Section | None:
        """Return the photos with the largest masked parts; None if none has one.

        Raises:
            DatasetError: a photo or a mask cannot be read.
        """
        figures = masked_figures(masked_pictures(run))
        return Section("Masked things that moved", figures=figures) if figures else None


TRANSIENTS = TransientsPart()
