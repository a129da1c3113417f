"""Scores of held-out views after their poses have been aligned with the scene.

A training that refines its cameras may end with a scene in which a held-out photo, whose pose was never refined, looks
misplaced. Its pose is therefore aligned on the left half of the photo, with the scene fixed, and scored on the right
half, which the alignment has not seen. If the training corrected exposures too, the colours are fitted on the left half
with the pose, as in `gsplat_edu.evaluate.metrics.psnr_fitted`.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import torch

from gsplat_edu.adam import adam_step
from gsplat_edu.camera import Camera
from gsplat_edu.evaluate.metrics import at_exposure_of, psnr, psnr_fitted, seen_through
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.losses import photo_loss
from gsplat_edu.moments import AdamNumbers
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.validation import ArrayLike
from gsplat_edu.views import View

STEPS = 40
"""Steps of Adam for each pose."""

RATE, FINAL_RATE = 2e-3, 1e-4
"""First and last rate, radians and fractions of the extent; log-linear between."""

BETAS, EPS = (0.9, 0.99), 1e-15


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
) -> float | None:
    """Return the PSNR of a view's right half after `STEPS` steps of its pose on the left half.

    Args:
        gaussians: The scene, which does not change.
        view: The view, at the pose to start from.
        render: Renders Gaussians from a camera, over `background`.
        background: (3,) colour behind photos that are not opaque.
        extent: Size of the scene, world units.
        colors: Fit the exposure and white balance on the left half too, at every step.

    Returns:
        dB; None if no pixel counts in one of the halves.
    """
    photo = view.read()
    truth, middle = np.ascontiguousarray(photo.over(background)), view.camera.W // 2
    counts = np.ones(truth.shape[:2], dtype=bool) if photo.mask is None else photo.mask
    left, right = counts.copy(), counts.copy()
    left[:, middle:] = False
    right[:, :middle] = False
    if not left.any() or not right.any():
        return None
    fixed = gaussians.map(lambda tensor: tensor.detach())
    device = fixed.means.device
    target, mask = torch.from_numpy(truth).to(device), torch.from_numpy(left).to(device)
    start = CameraTensors.of(view.camera)
    twist = torch.zeros(6, dtype=torch.float64)
    units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
    first, second = torch.zeros_like(twist), torch.zeros_like(twist)
    for step in range(STEPS):
        leaf = twist.clone().requires_grad_()
        output = render(fixed, start.moved(leaf * units))
        image = output.image
        if colors:
            image = at_exposure_of(truth, image, left, seen_through(photo, output, background))
        (gradient,) = torch.autograd.grad(photo_loss(image, target, mask), leaf)
        adam_step(twist, first, second, gradient, _numbers(step))
    with torch.no_grad():
        output = render(fixed, start.moved(twist * units).value())
    if colors:
        return psnr_fitted(output.image, truth, photo.mask, seen_through(photo, output, background))
    return psnr(output.image, truth, right)


def _numbers(step: int) -> AdamNumbers:
    rate = RATE * (FINAL_RATE / RATE) ** (step / max(STEPS - 1, 1))
    corrections = (1.0 - beta ** (step + 1) for beta in BETAS)
    return AdamNumbers(rate, *BETAS, EPS, *corrections)


def mean_aligned_psnr(scores: list[float | None]) -> float | None:
    """Return the mean of the scores that exist; None if none does."""
    known = [score for score in scores if score is not None]
    return float(np.mean(known)) if known else None
