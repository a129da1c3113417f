"""The exposure and white balance of each photo, measured while the scene is trained.

y_i = A_i x,  where A_i applies the gains exp(l_i - mean(l)) to the channels; see `gsplat_edu.exposure`

The render x of the scene becomes y_i, which is compared with photo i. Subtracting the mean fixes the gauge exactly: the
geometric mean of the corrections is the identity, so the scene itself has the mean exposure of the capture, in any
viewer.

Of a photo that is not opaque, only the object is corrected, not the background before which it is compared; see
`gsplat_edu.recolor`.

The l_i are measured whenever photo i is drawn, not learned by gradient descent. There is no rate to choose, and one
draw is enough to know them. docs/RECIPE.md has what else was tried.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.exposure import color_matrix, measured_gains
from gsplat_edu.recolor import Behind, recolored
from gsplat_edu.threads import one_thread
from gsplat_edu.train.feed import Target
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.view_model import Identity, Seen

NAME = "exposures"
"""Name of the state, as in checkpoints."""

WARM_UP = 0.015
"""Share of the run before the first measurement: the scene has to show something."""

OPAQUE = 0.05
"""Only pixels of a lower transmittance count: elsewhere the render is dark because the scene is not finished."""

NEWEST = 0.3
"""Weight of a measurement against those before it; 1, 1/2, 1/3 for the first ones of a photo."""


class Exposure(Identity):
    """Gains of the colour channels for each training photo, as a view model.

    Its state has four columns per view: the natural logarithms of the three gains, and the number of measurements.

    Args:
        count: Number of views.
        iterations: Length of the schedule.
        like: A tensor of the renders' dtype and device.
    """

    def __init__(self, count: int, iterations: int, like: Tensor) -> None:
        self._state = like.new_zeros(count, 4)
        self._begin = WARM_UP * iterations

    def parameters(self) -> Mapping[str, Tensor]:
        """Return the state, (views, 4)."""
        return {NAME: self._state}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return none: gradients do not move it."""
        return {}

    def image(self, index: int, seen: Seen, target: Target, iteration: int) -> Float[Tensor, "H W 3"]:
        """Return the render with the exposure of photo `index`, which is measured first."""
        if iteration >= self._begin:
            self._measure(index, seen, target)
        matrix = color_matrix(self.log_gains()[index])
        behind = None if target.opaque is None else Behind(seen.transmittance, seen.background)
        return recolored(
            seen.image, matrix, target.image if target.image.dtype == torch.uint8 else None, behind
        )

    def log_gains(self) -> Float[Tensor, "views 3"]:
        """Return the natural logarithm of every view's gains; their mean over the views is 0."""
        logs = self._state[:, :3]
        with one_thread():
            return logs - logs.mean(dim=0)

    @torch.no_grad()
    def _measure(self, index: int, seen: Seen, target: Target) -> None:
        counts = seen.transmittance < OPAQUE
        for plane in (target.mask, target.opaque):
            if plane is not None:
                counts &= plane
        row, mean = self._state[index], self._state[:, :3]
        with one_thread():
            mean = mean.mean(dim=0)
        weight = (1.0 / (1.0 + row[3])).clamp_min(NEWEST)
        row[:3] += weight * (measured_gains(seen.image, target.image, counts) + mean - row[:3])
        row[3] += 1.0
