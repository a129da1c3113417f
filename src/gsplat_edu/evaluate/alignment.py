"""Scores of held-out views after their poses have been aligned with the scene.

A training that refines its cameras shifts the scene against held-out photos, whose poses it never refines. The pose of
a held-out photo is therefore aligned on half of the photo, with the scene fixed, and scored on the other half. If the
training corrected exposures too, the colours are fitted with the pose.

A photo of a rolling shutter has a motion of its own, too. It can be aligned with the pose (`moving`).

The halves are the light and the dark squares of a chessboard. The left half alone determines some moves of the camera
poorly. On a clean capture, alignment on it cost 0.4 dB on the right half (the earlier results
that benchmarks/RESULTS.md names).
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.evaluate.metrics import at_exposure_of, photo_psnr, transparency_of
from gsplat_edu.ops.adam import adam_in_torch
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

SQUARES = 8
"""Squares along each side of the chessboard."""

STEPS = 40
"""Steps of Adam for each pose."""

RATE, FINAL_RATE = 2e-3, 1e-4
"""First and last rate, radians and fractions of the extent; log-linear between."""

BETAS, EPS = (0.9, 0.99), 1e-15

MOTION_UNIT = 4.0
"""Unit of a motion during the readout, in those of a pose: a motion moves the mean pixel by a quarter of itself."""


@runtime_checkable
class TensorRenderer(Protocol):
    """Renders Gaussians from a camera, differentiably in a camera of tensors."""

    def __call__(self, gaussians: Gaussians, camera: Camera | CameraTensors) -> RenderOutput:
        """Render; see `gsplat_edu.render.api.render`."""
        ...


def aligned_psnr(
    gaussians: Gaussians,
    view: View,
    render: TensorRenderer,
    background: ArrayLike,
    extent: float,
    *,
    colors: bool = False,
    moving: bool = False,
) -> float | None:
    """Return the PSNR of the dark squares of a view after `STEPS` steps of its pose on the light ones.

    Args:
        gaussians: The scene, which does not change.
        view: The view, at the pose to start from.
        render: Renders Gaussians from a camera, over `background`.
        background: (3,) colour behind photos that are not opaque.
        extent: Size of the scene, world units.
        colors: Fit the exposure and white balance on the light squares too, at every step and for the score.
        moving: Align the motion during the readout with the pose, from the view's own motion or from rest.

    Returns:
        dB; None if no pixel counts in one of the halves.
    """
    photo = view.read()
    truth = np.ascontiguousarray(photo.over(background))
    halves = scored_halves(photo.mask, view.camera.H, view.camera.W)
    if halves is None:
        return None
    fitted, scored = halves
    fixed = gaussians.map(lambda tensor: tensor.detach())
    target, mask = torch.from_numpy(truth), torch.from_numpy(fitted)

    def shown(camera: Camera | CameraTensors) -> RenderOutput:
        output = render(fixed, camera)
        if not colors:
            return output
        given = transparency_of(photo, output, background)
        return dataclasses.replace(output, image=at_exposure_of(truth, output.image, fitted, given))

    start = CameraTensors.of(view.camera)
    units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
    changes = torch.zeros(12 if moving else 6, dtype=torch.float64)
    first, second = torch.zeros_like(changes), torch.zeros_like(changes)
    for step in range(STEPS):
        leaf = changes.clone().requires_grad_()
        image = shown(_changed(start, leaf, units)).image
        image = image.cpu()  # the native loss compares the renders of any backend
        (gradient,) = torch.autograd.grad(photo_loss(image, target, mask), leaf)
        adam_in_torch(changes, first, second, gradient, _numbers(step))
    with torch.no_grad():
        aligned = shown(_changed(start, changes, units).value())
        return photo_psnr(photo, aligned, background, scored)


def _changed(camera: CameraTensors, changes: Tensor, units: Tensor) -> CameraTensors:
    """Return a camera after a twist, and after a change of its motion if there are twelve numbers."""
    moved = camera.moved(changes[:6] * units)
    if len(changes) == 6:
        return moved
    start = torch.zeros(6, dtype=torch.float64) if camera.motion is None else camera.motion
    return dataclasses.replace(moved, motion=start + changes[6:] * (MOTION_UNIT * units))


def scored_halves(
    mask: Bool[np.ndarray, "H W"] | None, H: int, W: int
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]] | None:
    """Return the pixels on which a photo is aligned and those on which it is scored; None if either are none.

    Args:
        mask: (H, W) true for pixels that count; None if all do.
        H: Height, px.
        W: Width, px.
    """
    light = light_squares(H, W)
    counts = np.ones_like(light) if mask is None else mask
    fitted, scored = counts & light, counts & ~light
    return (fitted, scored) if fitted.any() and scored.any() else None


def light_squares(H: int, W: int) -> Bool[np.ndarray, "H W"]:
    """Return which pixels of a photo are in the light squares of a chessboard.

    Args:
        H: Height, px.
        W: Width, px.
    """
    rows, columns = (np.arange(side) * SQUARES // side for side in (H, W))
    light: Bool[np.ndarray, "H W"] = (rows[:, None] + columns) % 2 == 0
    return light


def _numbers(step: int) -> AdamNumbers:
    rate = RATE * (FINAL_RATE / RATE) ** (step / max(STEPS - 1, 1))
    corrections = (1.0 - beta ** (step + 1) for beta in BETAS)
    return AdamNumbers(rate, *BETAS, EPS, *corrections)


def mean_aligned_psnr(scores: list[float | None]) -> float | None:
    """Return the mean of the scores that exist; None if none does."""
    known = [score for score in scores if score is not None]
    return float(np.mean(known)) if known else None
