"""The part that refines cameras: the setting `refine`."""

from __future__ import annotations

from gsplat_edu.parts.poses.refinement import NEED_LENSES, Refinement
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class PosesPart(Part):
    """Refines poses, lenses and rolling shutters with the scene."""

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the view model that moves the cameras.

        Raises:
            ArgumentError: what is refined makes cameras no pinholes, and the backend knows pinholes only.
        """
        if settings.refine == "none":
            return None
        if settings.refine in NEED_LENSES:
            setup.backend.require("lens", f"refine: {settings.refine}")
        cameras = [view.camera for view in setup.views]
        return Begun(view_model=Refinement(cameras, settings, setup.extent))


POSES = PosesPart()
