"""Choose the views of a block: those taken inside it, and those that show enough of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from gsplat_edu.blocks.plan import Area, Block, Cell, halved
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.api import render
from gsplat_edu.render.output import MOST_CHANNELS, RenderOutput
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import EDGE_PLACES

Shares = Float64[np.ndarray, "V B"]
Renderer = Callable[[Gaussians, Camera, Tensor], RenderOutput]
"""Renders Gaussians with features."""

ENOUGH = 0.15
"""A view belongs to a block if it shows the block's cell and margin on more than this fraction of its image."""

LEAST_VIEWS = 50
"""Blocks with fewer training views join a neighbour."""

RAYS = (16, 12)
"""Rays of a view, across and down, that measure how much of its image a box covers."""

SIDE = 96
"""Longer side of the small renders that measure what a view sees, px."""

Measure = Callable[[Sequence[Camera], Sequence[Cell]], Shares]
"""Returns how much of each view's image each cell covers, 0 to 1."""


def feature_renderer(options: RunOptions) -> Renderer:
    """Return a function that renders Gaussians with features as a run renders them.

    Args:
        options: Options of the run.
    """

    def drawn(gaussians: Gaussians, camera: Camera, features: Tensor) -> RenderOutput:
        return render(
            gaussians, camera, settings=options.render_settings, features=features, backend=options.backend
        )

    return drawn


def assigned(
    dataset: Dataset, area: Area, points: np.ndarray, count: int, measure: Measure, least: int
) -> list[Block]:
    """Split a capture into blocks with their views.

    Each training view belongs to one block at least: to the one that it shows most, if it shows none on `ENOUGH` of its
    image, and to the one in whose cell it was taken, if it shows nothing. If a block would have too few training views,
    the ground is split into one block less, and so on.

    Args:
        dataset: The capture.
        area: Its ground.
        points: (N, 3) points of the scene, world units.
        count: Number of blocks.
        measure: How much of a view each cell covers.
        least: Smallest number of training views of a block.
    """
    train, test = ([view.camera for view in views] for views in (dataset.train, dataset.test))
    eyes = area.ground.coordinates(np.stack([camera.eye for camera in train]))
    while True:
        cores = halved(area, train, points, count)
        shares = measure(train, [core.enlarged(area.low, area.high) for core in cores])
        inside = np.stack([core.holds(eyes) for core in cores], axis=1)
        most = np.where(shares.any(axis=1), shares.argmax(axis=1), inside.argmax(axis=1))
        needs = shares > ENOUGH
        needs[np.arange(len(train)), most] = True
        if count == 1 or needs.sum(axis=0).min() >= least:
            break
        count -= 1
    shown = measure(test, cores).argmax(axis=1) if test else np.zeros(0, dtype=int)
    return [
        Block(
            core,
            tuple(sorted(dataset.train[i].name for i in np.flatnonzero(needs[:, number]))),
            tuple(sorted(dataset.test[i].name for i in np.flatnonzero(shown == number))),
        )
        for number, core in enumerate(cores)
    ]


def airspace_shares(area: Area, cameras: Sequence[Camera], cells: Sequence[Cell]) -> Shares:
    """Measure how much of each view's image the airspace of each cell covers: a box from the ground to the roofs.

    Args:
        area: Ground and heights.
        cameras: V cameras.
        cells: B cells; an infinite side ends at the area's rectangle.

    Returns:
        (V, B) fractions of the image.
    """
    parts = [cell.clipped(*_widened(area)) for cell in cells]
    low = np.array([(*part.low, area.heights[0]) for part in parts])
    high = np.array([(*part.high, area.heights[1]) for part in parts])
    turn = np.array(area.ground.axes)
    shares = np.zeros((len(cameras), len(cells)))
    for row, camera in enumerate(cameras):
        eye = area.ground.coordinates(camera.eye[None])[0]
        heading = _directions(camera) @ turn.T
        heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)[:, None]
        one, other = (low - eye) / heading, (high - eye) / heading
        enters, leaves = np.minimum(one, other).max(axis=2), np.maximum(one, other).min(axis=2)
        shares[row] = ((enters < leaves) & (leaves > 0)).mean(axis=0)
    return shares


def seen_shares(
    area: Area, gaussians: Gaussians, render: Renderer, cameras: Sequence[Camera], cells: Sequence[Cell]
) -> Shares:
    """Measure how much of each view's image shows Gaussians of each cell, with occlusion.

    The share is the mean over the pixels of the sum of weights w_i of the Gaussians in the cell.

    Args:
        area: Ground.
        gaussians: A coarse model of the whole scene.
        render: Renders Gaussians with features.
        cameras: V cameras.
        cells: B cells.

    Returns:
        (V, B) fractions of the image.
    """
    places = area.ground.coordinates(gaussians.means.numpy(force=True))
    members = torch.from_numpy(np.stack([cell.holds(places) for cell in cells], axis=1)).to(gaussians.means)
    small = [resized(c, SIDE) if max(c.W, c.H) > SIDE else c for c in cameras]
    shares = np.zeros((len(cameras), len(cells)))
    for start in range(0, len(cells), MOST_CHANNELS):
        part = members[:, start : start + MOST_CHANNELS].contiguous()
        for row, camera in enumerate(small):
            with torch.no_grad():
                image = render(gaussians, camera, part).features
            assert image is not None
            shares[row, start : start + MOST_CHANNELS] = _means(image)
    return shares


def in_any_view(gaussians: Gaussians, cameras: Sequence[Camera]) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians at least one camera may show: within three standard deviations of its frustum.

    The frustum of a camera that is no pinhole at rest is the cone around all of its rays; that of a panorama is all.

    Args:
        gaussians: N Gaussians.
        cameras: The cameras.
    """
    means = gaussians.means.detach().double().numpy(force=True)
    reach = 3.0 * gaussians.scales.detach().double().numpy(force=True).max(axis=1)
    shown = np.zeros(len(means), dtype=bool)
    for camera in cameras:
        rest = np.flatnonzero(~shown)
        x, y, z = _seen_from(camera, means[rest])
        if not camera.pinhole:
            shown[rest[_in_cone(camera, x, y, z, reach[rest])]] = True
            continue
        near = z + reach[rest] > 0
        for place, size, middle, focal in (
            (x, camera.W, camera.cx, camera.fx),
            (y, camera.H, camera.cy, camera.fy),
        ):
            for edge, sign in ((-0.5 - middle, -1.0), (size - 0.5 - middle, 1.0)):
                slope = edge / focal  # the plane through the camera and an edge of its image
                near &= sign * (place - slope * z) <= reach[rest] * np.sqrt(1 + slope * slope)
        shown[rest[near]] = True
    return shown


def _in_cone(
    camera: Camera,
    x: Float64[np.ndarray, " N"],
    y: Float64[np.ndarray, " N"],
    z: Float64[np.ndarray, " N"],
    reach: Float64[np.ndarray, " N"],
) -> Bool[np.ndarray, " N"]:
    """Return which balls a lens may show: those that the cone around its optical axis with all its rays meets.

    A rolling shutter widens the cone by the turn, and the balls by the shift, until the first and the last row.

    Args:
        camera: Any camera but a pinhole at rest.
        x: Camera coordinates of the centres at half time.
        y: The same.
        z: The same.
        reach: Radii, world units.
    """
    widest, shutter = _widest_ray(camera), camera.shutter
    if shutter is not None:
        half = 0.5 * (1 + shutter.exposure)
        widest += half * float(np.linalg.norm(shutter.turn))
        reach = reach + half * float(np.linalg.norm(shutter.shift))
    if widest >= math.pi:
        return np.ones(len(z), dtype=bool)
    distance = np.sqrt(x * x + y * y + z * z)
    off = np.arctan2(np.sqrt(x * x + y * y), z) - widest
    within: Bool[np.ndarray, " N"] = off <= np.arcsin(np.minimum(reach / np.maximum(distance, 1e-300), 1.0))
    within |= reach >= distance
    return within


def _widest_ray(camera: Camera) -> float:
    """Return the largest angle between the optical axis and a ray of the image, radians; pi for no bound."""
    if camera.projection.kind not in ("perspective", "fisheye"):
        return math.pi
    u, v = (np.linspace(-0.5, size - 0.5, EDGE_PLACES) for size in (camera.W, camera.H))
    columns = np.concatenate([u, u, np.full_like(v, u[0]), np.full_like(v, u[-1])])
    rows = np.concatenate([np.full_like(u, v[0]), np.full_like(u, v[-1]), v, v])
    rays = _rays_at(camera, columns, rows)
    if np.isnan(rays).any():
        return camera.widest
    return float(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).max())


def _rays_at(
    camera: Camera, u: Float64[np.ndarray, " n"], v: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Return the rays of places in the image, camera axes; NaN where the lens has none."""
    return camera.projection.directions(
        (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera.widest
    )


def _seen_from(camera: Camera, points: Float64[np.ndarray, "N 3"]) -> list[np.ndarray]:
    """Return camera coordinates, with sums of a fixed order."""
    x, y, z = (points[:, i] - camera.eye[i] for i in range(3))
    return [u * x + v * y + w * z for u, v, w in camera.R.tolist()]


def _widened(area: Area) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the area's rectangle with a tenth of its sides around it, where infinite cells end."""
    by = [0.1 * (area.high[i] - area.low[i]) for i in range(2)]
    return (area.low[0] - by[0], area.low[1] - by[1]), (area.high[0] + by[0], area.high[1] + by[1])


def _directions(camera: Camera) -> Float64[np.ndarray, "N 3"]:
    """Return directions of rays spread evenly over the image."""
    across, down = RAYS
    u = (np.arange(across) + 0.5) * camera.W / across - 0.5
    v = (np.arange(down) + 0.5) * camera.H / down - 0.5
    if not camera.projection.plain:
        across_all, down_all = np.meshgrid(u, v)
        return np.asarray(_rays_at(camera, across_all.ravel(), down_all.ravel()) @ camera.R)
    columns, rows = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return np.asarray(np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)], axis=1) @ camera.R)


def _means(image: Float[Tensor, "H W C"]) -> Float64[np.ndarray, " C"]:
    return np.asarray(image.double().numpy(force=True).mean(axis=(0, 1)))
