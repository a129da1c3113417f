"""The part that learns from depth that views have (`View.depth`)."""

from __future__ import annotations

from gsplat_edu.parts.given_depth.term import DEPTH, DepthTerm
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup
from gsplat_edu.train.rendered import Turns


class GivenDepthPart(Part):
    """Pulls the rendered depth to the given one."""

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the term that compares depths, if views have some.

        weight_d mean rho(z / z* - 1), or for points weight_p extent mean |1/z - 1/z*|
        """
        if all(view.depth is None for view in setup.views):
            return None
        turns = Turns(0, settings.depth_every, settings.batch)
        return Begun({DEPTH: DepthTerm(settings.depth_weight, settings.points_weight, setup.extent, turns)})


GIVEN_DEPTH = GivenDepthPart()
