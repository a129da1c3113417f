"""Rendering without Gaussians that have a bad number, instead of an error."""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gsplat_edu.compat.checks import DEGREES

SKIPPING = contextvars.ContextVar("skipping bad Gaussians", default=False)

PLAIN = {
    "means": 0.0,
    "quats": 1.0,
    "scales": 1.0,
    "opacities": 0.0,
    "colors": 0.0,
    "covars": 0.0,
    "extra_signals": 0.0,
}
"""What stands for the numbers of a bad Gaussian. Its opacity is 0, so that it is not drawn."""


@contextlib.contextmanager
def skipping_bad_gaussians() -> Iterator[None]:
    """Let `rasterization` skip Gaussians with NaN, infinity or a quaternion of zero length inside a `with` block.

    They are not drawn, have zero gradients and no effect on others, as in `gsplat_edu.render.api.render`. Outside the
    block they are errors that name the entry: gsplat draws what comes of them, and a training goes on with NaN.
    """
    token = SKIPPING.set(True)
    try:
        yield
    finally:
        SKIPPING.reset(token)


def without_bad_gaussians(given: dict[str, Any]) -> dict[str, Any]:
    """Replace the numbers of bad Gaussians in the arguments of `rasterization`, if skipping is on and shapes agree."""
    means = given["means"]
    if not SKIPPING.get() or not isinstance(means, Tensor) or means.ndim < 2:
        return given
    own = {name: t for name, t in given.items() if name in PLAIN and isinstance(t, Tensor)}
    bad = torch.zeros(means.shape[:-1], dtype=torch.bool)
    degrees = {name: given[degree] for name, degree in DEGREES.items()}
    # Coefficients without leading axes are shared: a bad row of theirs is bad in every scene.
    shared = {name for name in own if degrees.get(name) is not None and own[name].ndim == 3}
    cameras, axes = bad.ndim - 1, bad.ndim
    per_camera = {
        name
        for name, degree in degrees.items()
        if name in own and name not in shared and own[name].ndim == axes + (2 if degree is None else 3)
    }
    for name, tensor in own.items():
        wrong = ~torch.isfinite(tensor.detach())
        if name == "quats" and tensor.ndim:
            wrong = wrong | (tensor.detach() == 0).all(dim=-1, keepdim=True)
        if name in per_camera:
            wrong = wrong.any(dim=cameras)
        leading = 1 if name in shared else axes
        if wrong.shape[:leading] != bad.shape[-leading:]:
            return given  # the check of shapes explains it
        bad |= wrong.reshape(*wrong.shape[:leading], -1).any(dim=-1)
    if not bool(bad.any()):
        return given
    in_every_scene = bad.reshape(-1, bad.shape[-1]).all(dim=0)
    filled = dict(given)
    for name, tensor in own.items():
        rows = bad.unsqueeze(cameras) if name in per_camera else bad
        filled[name] = _filled(name, tensor, in_every_scene if name in shared else rows)
    return filled


def _filled(name: str, tensor: Tensor, bad: Tensor) -> Tensor:
    """Return the tensor with plain numbers where a Gaussian is bad; they pass no gradient."""
    return torch.where(bad.view(*bad.shape, *([1] * (tensor.ndim - bad.ndim))), PLAIN[name], tensor)
