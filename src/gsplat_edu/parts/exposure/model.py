"""The exposure and white balance of each photo, measured while the scene is trained.

y_i = A_i x,  where A_i applies the gains exp(l_i - mean(l)) to the channels; see `gsplat_edu.ops.exposure`

The render x of the scene becomes y_i, which is compared with photo i. Subtracting the mean fixes the gauge exactly: the
geometric mean of the corrections is the identity, so the scene itself has the mean exposure of the capture, in any
viewer.

Vignetting may be measured too: a factor exp(k_i q) of the light that depends on the distance from the photo's centre.
Its geometric mean over the pixels of a photo is 1, so it does not touch the gauge. What all photos have in common is
corrected as well: a place that is in the corner of one photo is in the middle of another.

Of a photo that is not opaque, only the object is corrected, not the background before which it is compared; see
`gsplat_edu.ops.recolor`.

The l_i are measured whenever photo i is drawn, not learned by gradient descent. There is no rate to choose, and one
draw is enough to know them. docs/RECIPE.md has what else was tried.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.exposure import color_matrix, falloff, measured_gains, measured_vignetting
from gsplat_edu.ops.recolor import Backdrop, RecolorKernel
from gsplat_edu.train.feed import Target
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.rendered import NOTHING, Needs
from gsplat_edu.train.view_model import Identity, Rows, ViewRender

NAME = "exposures"
"""Name of the state, as in checkpoints."""

GAINS_START, VIGNETTING_START = 0.015, 0.3
"""Fractions of the run before gains, or gains and vignetting, are measured for the first time.

A gain needs a scene that resembles the photo. Vignetting needs a scene that is finished in the corners of the photos as
well as in their middle: if all cameras look at one subject, a false vignetting common to all photos hardly ever
disappears again."""

OPAQUE = 0.05
"""Only pixels of a lower transmittance count: elsewhere the render is dark because the scene is not finished."""

NEWEST = 0.3
"""Smallest weight of a new measurement in a photo's running mean; its first measurements weigh 1, 1/2 and 1/3."""

VIGNETTING_ERROR = 0.05
"""Standard error of one photo's measured k (the earlier results that benchmarks/RESULTS.md names)."""


class Exposure(Identity):
    """Gains of the colour channels for each training photo, and its vignetting if asked for, as a view model.

    Its state has a row per view: the natural logarithms of the three gains, k if vignetting is corrected, and the
    number of measurements.

    Args:
        count: Number of views.
        iterations: Length of the schedule.
        like: A tensor of the renders' dtype and device.
        recolor: Applies the correction; see `Backend.recolored`.
        vignetting: Correct the vignetting too.
    """

    def __init__(
        self, count: int, iterations: int, like: Tensor, recolor: RecolorKernel, vignetting: bool = False
    ) -> None:
        self._state = like.new_zeros(count, 5 if vignetting else 4)
        self._begin = (VIGNETTING_START if vignetting else GAINS_START) * iterations
        self._recolor, self._vignetting = recolor, vignetting

    @property
    def needs(self) -> Needs:
        """Nothing more: the correction is pixel by pixel, and the measurement applies the mask."""
        return NOTHING

    def parameters(self) -> Mapping[str, Tensor]:
        """Return the state, (views, 4) or (views, 5)."""
        return {NAME: self._state}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return none: gradients do not move it."""
        return {}

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return the row of the view, moved towards what this render and the photo say."""
        if iteration < self._begin:
            return {NAME: self._state[index]}
        return {NAME: self._measured(index, render, target)}

    def correct(self, index: int, render: ViewRender, target: Target, rows: Rows) -> Float[Tensor, "H W 3"]:
        """Return the render with the exposure of photo `index`."""
        state = self._state.clone()
        state[index] = rows[NAME]
        matrix = color_matrix(_log_gains(state)[index])
        photo = target.image if target.image.dtype == torch.uint8 else None
        backdrop = None if target.opaque is None else Backdrop(render.transmittance, render.background)
        plane = falloff(_vignetting(state)[index], *render.image.shape[:2]) if self._vignetting else None
        return self._recolor(render.image, matrix, photo, backdrop, plane)

    def log_gains(self) -> Float[Tensor, "views 3"]:
        """Return the natural logarithm of every view's gains; their mean over the views is 0."""
        return _log_gains(self._state)

    def vignetting(self) -> Float[Tensor, " views"]:
        """Return k of every view, drawn towards the mean m of the measured ones; 0 without `vignetting`.

        min(0, m + f (k_i - m)),  f = max(0, 1 - VIGNETTING_ERROR^2 / var(k))

        Photos of one lens differ by errors of the measurement only, and are then corrected alike. No lens makes corners
        brighter.
        """
        return _vignetting(self._state) if self._vignetting else torch.zeros_like(self._state[:, 3])

    @torch.no_grad()
    def _measured(self, index: int, render: ViewRender, target: Target) -> Tensor:
        counts = render.transmittance < OPAQUE
        for plane in (target.mask, target.opaque):
            if plane is not None:
                counts &= plane
        measure = measured_vignetting if self._vignetting else measured_gains
        row = self._state[index].clone()
        with one_thread():
            found = measure(render.image, target.image, counts)
            found[:3] += self._state[:, :3].mean(dim=0)
        weight = (1.0 / (1.0 + row[-1])).clamp_min(NEWEST)
        row[:-1] += weight * (found - row[:-1])
        row[-1] += 1.0
        return row


@one_thread()
def _log_gains(state: Float[Tensor, "views k"]) -> Float[Tensor, "views 3"]:
    logs = state[:, :3]
    return logs - logs.mean(dim=0)


@one_thread()
def _vignetting(state: Float[Tensor, "views 5"]) -> Float[Tensor, " views"]:
    k, measured = state[:, 3], state[:, -1] > 0
    if not bool(measured.any()):
        return torch.zeros_like(k)
    mean = k[measured].mean()
    share = (1.0 - VIGNETTING_ERROR**2 / k[measured].var(correction=0)).clamp_min(0.0)
    return torch.where(measured, mean + share * (k - mean), mean).clamp_max(0.0)
