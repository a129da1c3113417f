"""Photos at the exposure of the scene, to judge the scene of a run that corrected exposures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.ops.exposure import color_matrix, falloff, measured_gains, measured_vignetting
from gsplat_edu.ops.recolor import recolored
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.views import View

Render = Callable[[Gaussians, Camera], RenderOutput]
"""Renders Gaussians from a camera."""


def at_exposure_of_scene(
    dataset: Dataset,
    gaussians: Gaussians,
    render: Render,
    background: ArrayLike,
    *,
    vignetting: bool = False,
) -> Dataset:
    """Return the capture with photos whose exposure and white balance are those of the scene.

    The gains are measured here, once per view; the photos are converted whenever they are read.

    Args:
        dataset: The capture.
        gaussians: The scene.
        render: Renders Gaussians from a camera, over `background`.
        background: (3,) colour behind photos that are not opaque.
        vignetting: Take off the photos' vignetting too.

    Raises:
        DatasetError: a photo cannot be read.
    """
    measure = measured_vignetting if vignetting else measured_gains

    def converted(views: Sequence[View]) -> tuple[View, ...]:
        return tuple(
            _converted(view, _measured(view, gaussians, render, background, measure)) for view in views
        )

    return replace(dataset, train=converted(dataset.train), test=converted(dataset.test))


def _measured(
    view: View, gaussians: Gaussians, render: Render, background: ArrayLike, measure: Callable[..., Tensor]
) -> Float[Tensor, " numbers"]:
    photo = view.read()
    with torch.no_grad():
        image = render(gaussians, view.camera).image
    counts = photo.mask
    if photo.opaque is not None:
        counts = photo.opaque if counts is None else counts & photo.opaque
    mask = None if counts is None else torch.from_numpy(counts).to(image.device)
    truth = torch.from_numpy(np.ascontiguousarray(photo.over(background))).to(image.device)
    return measure(image, truth, mask).cpu().float()


def _converted(view: View, found: Float[Tensor, " numbers"]) -> View:
    """Return the view with its photo divided by gains and vignetting; alpha stays.

    y becomes y / g + 0.055 (1 / g - 1), with g the product of both.
    """
    return View.stored(view.camera, partial(_read_converted, view, found), view.name)


def _read_converted(view: View, found: Float[Tensor, " numbers"]) -> Photo:
    photo = view.read()
    pixels = photo.image
    scale = 255.0 if pixels.dtype == np.uint8 else 1.0
    values = torch.from_numpy(np.ascontiguousarray(pixels)).float() / scale
    plane = falloff(-found[3], *values.shape[:2]) if len(found) > 3 else None
    image = recolored(values, color_matrix(-found[:3]), falloff=plane).clamp(0.0, 1.0)
    return Photo(image.numpy(), photo.alpha, photo.mask)
