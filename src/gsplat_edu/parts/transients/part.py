"""The part that masks things that move: the setting `transients`."""

from __future__ import annotations

import functools

from gsplat_edu.parts.transients.search import Transients
from gsplat_edu.render.api import render
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class TransientsPart(Part):
    """Finds and masks what only single photos show."""

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return what masks the photos.

        Raises:
            ArgumentError: there are too few views.
        """
        if settings.transients == "none":
            return None
        features = functools.partial(render, backend=setup.backend)
        return Begun(masker=Transients(setup.views, settings.means_rate_iterations, features))


TRANSIENTS = TransientsPart()
