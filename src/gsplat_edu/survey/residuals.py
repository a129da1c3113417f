"""Compare a trained scene with its photos: PSNR, brightness, and floaters in front of each camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.evaluate.metrics import Renderer, outside_cut_out, photo_psnr
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.scene.views import View
from gsplat_edu.survey.photos import BRIGHT, DARK, GAMMA

SOLID = 0.5
"""A pixel has a depth if its splats block more than this share of the light."""

NEAR = 0.1
"""Splats nearer than this share of a view's median depth are floaters: real subjects are not that close."""

VEIL = 0.2
"""A pixel is covered if the near splats' opacity exceeds this: the colour behind changes by a fifth."""

Progress = Callable[[int, int], None]
"""Called with (views done, total)."""


@dataclass(frozen=True)
class Residual:
    """Difference between a scene and one photo.

    Args:
        name: The view's name in the capture.
        psnr: dB.
        stops: How much brighter the photo is than the render, median over pixels; negative if it is darker.
        veiled: Share of the pixels covered by splats close to the camera.
        outside: What `outside_cut_out` returns.
    """

    name: str
    psnr: float
    stops: float
    veiled: float
    outside: float | None = None


def residuals(
    gaussians: Gaussians,
    views: Sequence[View],
    render: Renderer,
    background: ArrayLike,
    progress: Callable[[], None] = lambda: None,
) -> list[Residual]:
    """Render views and compare them with their photos.

    Args:
        gaussians: The scene, in the cameras' world coordinates.
        views: Cameras and photos. Views whose mask excludes every pixel are skipped.
        render: Renders Gaussians from a camera, with depth, over `background`.
        background: (3,) RGB behind transparent photos.
        progress: Called after every view.

    Returns:
        In the order of the views.

    Raises:
        DatasetError: a photo cannot be read.
    """
    found = []
    sky = torch.from_numpy(far_shell(gaussians.means.numpy(force=True))).to(gaussians.means.device)
    subject = gaussians.map(lambda tensor: tensor[~sky]) if bool(sky.any()) else gaussians
    for view in views:
        photo = view.read()
        if photo.mask is None or photo.mask.any():
            with torch.no_grad():
                output = render(gaussians, view.camera)
                alone = output if subject is gaussians else render(subject, view.camera)
                veiled = _veiled(subject, view, alone, render)
            truth = photo.over(background)
            pixels = truth / 255.0 if truth.dtype == np.uint8 else np.asarray(truth, dtype=np.float64)
            stops = _stops(pixels, output.image.double().numpy(force=True), photo.mask)
            score = photo_psnr(photo, output, background)
            found.append(Residual(view.name, score, stops, veiled, outside_cut_out(photo, output)))
        progress()
    return found


def _veiled(gaussians: Gaussians, view: View, output: RenderOutput, render: Renderer) -> float:
    """Return the share of a view covered by splats much nearer than the rest."""
    if output.depth is None:
        return 0.0
    stopped = 1.0 - output.transmittance
    solid = stopped > SOLID
    if not bool(solid.any()):
        return 0.0
    depth = float((output.depth[solid] / stopped[solid]).median())
    axis = gaussians.means.new_tensor(view.camera.R[2])
    z = (gaussians.means - gaussians.means.new_tensor(view.camera.eye)) @ axis
    near = (z > 0) & (z < NEAR * depth)
    if not bool(near.any()):
        return 0.0
    in_front = render(gaussians.map(lambda tensor: tensor[near]), view.camera)
    return float((in_front.transmittance < 1.0 - VEIL).double().mean())


def _stops(
    photo: Float64[np.ndarray, "H W 3"],
    image: Float64[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"] | None,
) -> float:
    """Return the median of log2(photo / render) in linear light; 0 if nearly all pixels are clipped."""
    dark, bright = DARK / 255.0, BRIGHT / 255.0
    good = np.all((np.minimum(photo, image) > dark) & (np.maximum(photo, image) < bright), axis=2)
    good = good if mask is None else good & mask
    if good.mean() < 0.01:
        return 0.0
    return float(GAMMA * np.median(np.log2(photo[good] / image[good])))
