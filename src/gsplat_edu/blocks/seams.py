"""Scores of held-out views near the cuts between cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.blocks.plan import Area, Cell
from gsplat_edu.evaluate.metrics import MSE_FLOOR, Renderer, over_backgrounds
from gsplat_edu.ops.depth import LEAST_ALPHA
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.scene.views import View

STRIP_SHARE = 0.05
"""Half the width of the strip along a cut, as a fraction of the mean side of the cells."""

Mask = Bool[np.ndarray, "H W"]


def strip_width(area: Area, cells: Sequence[Cell]) -> float:
    """Return half the width of the strip along a cut, world units.

    Args:
        area: The ground.
        cells: The cells.
    """
    parts = [cell.clipped(area.low, area.high) for cell in cells]
    return STRIP_SHARE * float(np.mean([part.high[i] - part.low[i] for part in parts for i in range(2)]))


def near_a_cut(
    places: Float64[np.ndarray, "N D"], cells: Sequence[Cell], width: float
) -> Bool[np.ndarray, " N"]:
    """Return which places on the ground lie near an edge between two cells.

    Args:
        places: (N, 2) or more columns, of which the first two are a and b.
        cells: The cells.
        width: Largest distance from the edge, world units.
    """
    near = np.zeros(len(places), dtype=bool)
    for cell in cells:
        rows = np.flatnonzero(cell.holds(places))
        for i in range(2):
            for edge in (cell.low[i], cell.high[i]):  # no place is near infinity
                near[rows] |= np.abs(places[rows, i] - edge) < width
    return near


def strip_masks(
    area: Area,
    cells: Sequence[Cell],
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    render: Renderer,
) -> list[Mask]:
    """Return which pixels of each view show places near a cut, by the mean depth of the scene without its sky.

    Pixels less than half of which the scene covers show no place: the sky behind it, or nothing.

    Args:
        area: The ground.
        cells: The cells.
        gaussians: The scene; a shell of a sky (`gsplat_edu.scene.shells.far_shell`) does not count.
        cameras: The cameras of the views.
        render: Renders Gaussians from a camera, with depths.
    """
    sky = torch.from_numpy(far_shell(gaussians.means.numpy(force=True))).to(gaussians.means.device)
    solid, width = gaussians[~sky] if sky.any() else gaussians, strip_width(area, cells)
    masks = []
    for camera in cameras:
        with torch.no_grad():
            output = render(solid, camera)
        z = output.mean_depth.where(output.alpha >= LEAST_ALPHA, 0.0).double().numpy(force=True).ravel()
        near = near_a_cut(area.ground.coordinates(_places(camera, z)), cells, width)
        masks.append(np.asarray((near & (z > 0)).reshape(camera.H, camera.W)))
    return masks


def _places(camera: Camera, z: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
    """Return the places at the depths of all pixels; NaN, which is near no cut, where a lens has no ray."""
    if not camera.pinhole:
        return np.asarray(camera.origins().reshape(-1, 3) + z[:, None] * camera.rays().reshape(-1, 3))
    columns, rows = np.meshgrid(np.arange(camera.W), np.arange(camera.H))
    x, y = (columns.ravel() - camera.cx) / camera.fx * z, (rows.ravel() - camera.cy) / camera.fy * z
    return np.asarray(np.stack([x, y, z], axis=1) @ camera.R + camera.eye)


def pooled_psnr(
    gaussians: Gaussians,
    views: Sequence[View],
    masks: Sequence[Mask],
    render: Renderer,
    background: ArrayLike,
) -> tuple[float | None, float | None]:
    """Return the PSNR of all masked pixels of all views together, and of the others; None where there are none.

    Args:
        gaussians: The scene.
        views: Held-out views.
        masks: One for each view.
        render: Renders Gaussians from a camera.
        background: (3,) colour behind photos that are not opaque.
    """
    sums, counts = np.zeros(2), np.zeros(2)
    for view, mask in zip(views, masks, strict=True):
        photo = view.read()
        counted = np.ones_like(mask) if photo.mask is None else photo.mask
        with torch.no_grad():
            output = render(gaussians, view.camera)
        pairs = over_backgrounds(photo, output, background)
        error = np.mean([_squares(shown, behind, photo) for shown, behind in pairs], axis=0)
        for part, pixels in enumerate((mask & counted, ~mask & counted)):
            sums[part] += float(error[pixels].sum())
            counts[part] += int(pixels.sum())
    inside, outside = (
        float(-10 * np.log10(max(total / count, MSE_FLOOR))) if count else None
        for total, count in zip(sums, counts, strict=True)
    )
    return inside, outside


def _squares(output: RenderOutput, behind: ArrayLike, photo: Photo) -> Float64[np.ndarray, "H W"]:
    """Return the squared error of each pixel, a mean over channels, over the background `behind`."""
    truth = np.asarray(photo.over(behind))
    truth = truth / 255.0 if truth.dtype == np.uint8 else truth.astype(np.float64)
    image = np.clip(output.image.double().numpy(force=True), 0.0, 1.0)
    return np.asarray(np.square(image - truth).mean(axis=2))
