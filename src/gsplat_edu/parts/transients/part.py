"""The part that masks things that move: the setting `transients`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.masked import masked_figures
from gsplat_edu.evaluate.report_parts import Section
from gsplat_edu.parts.run_values import Captured, Finished, Reported
from gsplat_edu.parts.transients.files import masked_pictures, write_masks
from gsplat_edu.parts.transients.search import Transients, check_enough
from gsplat_edu.render.api import render
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class TransientsPart(Part):
    """Finds and masks what only single photos show."""

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
