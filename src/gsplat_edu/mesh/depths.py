"""Depth maps of a scene for a mesh: rendered, checked against their neighbours, and weighted.

A pixel's depth is the median depth, which ignores fog: on a textured box, meshes of mean depths had an F1 of 0.91 and
those of median depths one of 0.97 (the earlier results that benchmarks/RESULTS.md names). A depth is dropped
where the scene is not opaque, where the surface is seen edge-on, where it is too far for the voxels, and where two
neighbouring views see through it.

Weight of a pixel: cos(angle between ray and normal) / z², at most 1 at the nearest depth of the scene.

All maps are in memory at once, 10 bytes a pixel: the checks say which pixels they keep instead of making a second
set of maps, and weights are computed from a byte, the cosine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8

from gsplat_edu.mesh.faces import faces_of, in_view
from gsplat_edu.ops.surface import normals_of_depth
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.field import within_field
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell

LEAST_ALPHA = 0.5
"""Pixels with less accumulated alpha have no surface."""

CLEAR = 0.1
"""Pixels with less accumulated alpha see through everything that other views place there."""

LEAST_COSINE = 0.17
"""Surfaces seen at more than 80 degrees from their normal are dropped (PGSR)."""

SEEN_THROUGH = 0.02
"""A neighbour contradicts a depth if it sees farther than the point by more than this fraction, or nothing at all."""

CONTRADICTIONS = 2
"""A depth that so many neighbours contradict is dropped."""

NEIGHBOURS = 6
"""Neighbouring views that check a depth map."""

BAND = 32
"""Rows of a depth map that are checked at a time."""

Progress = Callable[[str, int, int], None]
"""Called with what is done, how much of it is done, and how much there is."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """A view of the scene for the mesh.

    Args:
        name: Name of the view.
        camera: Its camera, a pinhole.
        rendered: (H, W) camera depth before the checks, world units; 0 where there is no surface.
        facing: (H, W) cosine of the angle between ray and normal, 255 for 1.
        image: (H, W, 3) the rendered colours.
        clear: (H, W) pixels in the middle of an area that is less opaque than `CLEAR`: nothing is there.
        transparent: Number of pixels that are less opaque than `LEAST_ALPHA`.
        kept: (H, W) pixels that the checks keep; None for all.
        scale: Divisor of the weights.
        lens: The camera of which this is a face; None for a view of a pinhole.
    """

    name: str
    camera: Camera
    rendered: Float32[np.ndarray, "H W"]
    facing: UInt8[np.ndarray, "H W"]
    image: UInt8[np.ndarray, "H W 3"]
    clear: Bool[np.ndarray, "H W"]
    transparent: int
    kept: Bool[np.ndarray, "H W"] | None = None
    scale: float = 1.0
    lens: Camera | None = None

    @property
    def depth(self) -> Float32[np.ndarray, "H W"]:
        """(H, W) camera depth, world units; 0 where there is no surface, or the checks dropped it."""
        return self.rendered if self.kept is None else self.rendered * self.kept

    @property
    def weight(self) -> Float32[np.ndarray, "H W"]:
        """(H, W) weight of each pixel; 0 where there is no depth."""
        depth, weight = self.depth, np.zeros(self.rendered.shape)
        np.divide(self.facing / 255.0, depth.astype(np.float64) ** 2, out=weight, where=depth > 0)
        return weight.astype(np.float32) / np.float32(self.scale)

    def only(self, chosen: Bool[np.ndarray, "H W"]) -> DepthView:
        """Return the view with the depths of some pixels only."""
        return replace(self, kept=chosen if self.kept is None else chosen & self.kept)


@dataclass(frozen=True)
class DepthCounts:
    """What happened to the pixels of all depth maps.

    Args:
        pixels: All pixels.
        transparent: Less opaque than `LEAST_ALPHA`.
        edge_on: Seen at more than 80 degrees, or at the border of an image or of a surface.
        far: Too far for the voxels.
        contradicted: Seen through by `CONTRADICTIONS` neighbours.
        error: Median relative difference between a depth and those of its neighbours there; 0 without neighbours.
    """

    pixels: int
    transparent: int
    edge_on: int
    far: int
    contradicted: int
    error: float


def render_depths(
    gaussians: Gaussians,
    cameras: Sequence[tuple[str, Camera]],
    settings: RenderSettings,
    backend: Backend,
    progress: Progress = lambda what, done, total: None,
) -> list[DepthView]:
    """Render the depth maps, with the depths of transparent pixels, edge-on surfaces and the sky 0.

    Args:
        gaussians: The scene.
        cameras: Names and cameras. One that is no pinhole gives a view for each of its `faces_of`, with its own name.
        settings: The scene's render settings; without its Jacobian limit, splats beside a camera would veil its image.
        backend: What renders.
        progress: Called after every view.
    """
    sky = torch.from_numpy(far_shell(gaussians.means.numpy(force=True)))
    views, device = [], gaussians[~sky].to(backend.device)
    wanted = replace(settings, depth=False, median_depth=True)
    faces = [(name, camera, face) for name, camera in cameras for face in faces_of(camera)]
    for done, (name, lens, camera) in enumerate(faces, 1):
        with torch.no_grad():
            shown = device if lens is camera else within_field(device, camera)
            output = render(shown, camera, settings=wanted, backend=backend)
        assert output.median_depth is not None, "the settings ask for it"
        alpha, median, image = (t.cpu() for t in (output.alpha, output.median_depth, output.image))
        seen = torch.ones_like(alpha, dtype=torch.bool)
        if lens is not camera:
            seen = torch.from_numpy(in_view(lens.through(lens.projection), camera))
        depth = torch.where(seen & (alpha >= LEAST_ALPHA), median, 0.0).double()
        transparent = int((depth == 0).sum())
        cosines = facing_cosines(depth, camera)
        found = torch.where(cosines >= LEAST_COSINE, depth, 0.0).numpy().astype(np.float32)
        facing = np.rint(255.0 * cosines.numpy()).astype(np.uint8)
        pixels = np.round(255.0 * image.clamp(0, 1).numpy()).astype(np.uint8)
        # A pixel at the rim of a surface may be clear by rounding.
        see_through = (seen & (alpha < CLEAR)).numpy().astype(np.uint8)
        clear = cv2.erode(see_through, np.ones((3, 3), np.uint8)) > 0
        own = None if lens is camera else lens
        views.append(DepthView(name, camera, found, facing, pixels, clear, transparent, lens=own))
        progress("depth maps", done, len(faces))
    return views


def facing_cosines(depth: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Return the cosine of the angle between each ray and the depth map's normal, (H, W); 0 without a normal."""
    rays = torch.from_numpy(camera.rays())
    normals = normals_of_depth(depth, rays)
    lengths = rays.norm(dim=-1)
    cosines: torch.Tensor = -(normals * rays).sum(dim=-1) / lengths
    return cosines.clamp(0.0, 1.0)


def focal(camera: Camera) -> float:
    """Return the geometric mean of a camera's focal lengths, px."""
    return math.sqrt(camera.fx * camera.fy)


def camera_points(points: Float64[np.ndarray, "n 3"], camera: Camera) -> Float64[np.ndarray, "n 3"]:
    """Return many points in camera coordinates, as `Camera.world_to_cam` does but for rounding.

    The product of a BLAS takes several times as long for so narrow a matrix.

    Args:
        points: (n, 3) world units.
        camera: The camera.
    """
    return np.asarray(np.einsum("nd,kd->nk", points - camera.eye, camera.R))


def neighbours_of(index: int, cameras: Sequence[Camera], most: int = NEIGHBOURS) -> list[int]:
    """Return the views most like one: by the angle between the optical axes and the distance of the centres.

    Args:
        index: The view.
        cameras: All cameras.
        most: Largest number of neighbours.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.R[2] for camera in cameras])
    apart = np.linalg.norm(eyes - eyes[index], axis=1)
    spread = float(np.median(apart)) or 1.0
    angles = np.arccos(np.clip(axes @ axes[index], -1.0, 1.0))
    # Views from the same place check nothing, those that look elsewhere see little of the same.
    score = angles + apart / spread + np.where(apart < 1e-6 * spread, np.inf, 0.0)
    order = np.argsort(score, kind="stable")
    return [int(i) for i in order if i != index and np.isfinite(score[i])][:most]


def checked(
    views: Sequence[DepthView],
    coarsest: float = np.inf,
    progress: Progress = lambda what, done, total: None,
) -> tuple[list[DepthView], DepthCounts]:
    """Drop what is too far, and what neighbouring views see through; scale the weights to at most 1.

    Args:
        views: The depth maps of `render_depths`.
        coarsest: Largest size of a pixel on the surface, world units; what is farther is dropped.
        progress: Called after every view.

    Returns:
        The views in the same order, and what happened to the pixels.
    """
    cameras = [view.camera for view in views]
    kept, errors = [], []
    far_pixels = contradicted_pixels = 0
    scale = max((float(view.weight.max(initial=0.0)) for view in views), default=1.0) or 1.0
    for index, view in enumerate(views):
        far = view.depth > coarsest * focal(view.camera)
        against, differences = _contradictions(view, [views[i] for i in neighbours_of(index, cameras)])
        wrong = against & ~far
        far_pixels, contradicted_pixels = far_pixels + int(far.sum()), contradicted_pixels + int(wrong.sum())
        if len(differences):
            errors.append(float(np.median(differences)))
        kept.append(replace(view.only(~(far | wrong)), scale=scale))
        progress("checks", index + 1, len(views))
    pixels = sum(view.depth.size for view in views)
    transparent = sum(view.transparent for view in views)
    edge_on = sum(int((view.depth == 0).sum()) for view in views) - transparent
    error = float(np.median(errors)) if errors else 0.0
    return kept, DepthCounts(pixels, transparent, edge_on, far_pixels, contradicted_pixels, error)


def _contradictions(
    view: DepthView, others: Sequence[DepthView]
) -> tuple[Bool[np.ndarray, "H W"], Float64[np.ndarray, " n"]]:
    """Return which pixels enough neighbours see through, and relative differences to the neighbours that agree.

    A band of rows goes through all neighbours before the next one, so that its numbers stay in the processor's cache.
    """
    against = np.zeros(view.rendered.shape, dtype=bool)
    maps = [(other, other.depth, *_between(view.camera, other.camera)) for other in others]
    depth, differences = view.depth, []
    for first in range(0, len(depth), BAND):
        rows, columns = np.nonzero(depth[first : first + BAND])
        rows += first
        z = depth[rows, columns].astype(np.float64)
        count = np.zeros(len(z), dtype=np.int16)
        for other, seen_by_other, turn, step in maps:
            x, y, far = (
                z * (turn[k, 0] * columns + turn[k, 1] * rows + turn[k, 2]) + step[k] for k in range(3)
            )
            H, W = seen_by_other.shape
            # x / far > -1/2 without the division, which may be one by zero
            inside = (far > 0) & (x > -0.5 * far) & (y > -0.5 * far)
            inside &= (x < (W - 0.5) * far) & (y < (H - 0.5) * far)
            at = np.flatnonzero(inside)
            away = far[at]
            row, column = (
                np.minimum(np.rint(p[at] / away).astype(np.int64), n - 1) for p, n in ((y, H), (x, W))
            )
            place = row * W + column
            seen = seen_by_other.ravel()[place].astype(np.float64)
            relative = np.where(seen > 0, seen / away - 1.0, 0.0)
            count[at] += (relative > SEEN_THROUGH) | other.clear.ravel()[place]
            near = (seen > 0) & (np.abs(relative) <= SEEN_THROUGH)
            differences.append(np.abs(relative[near][::7]))
        against[rows, columns] = count >= CONTRADICTIONS
    found = np.concatenate(differences) if differences else np.zeros(0)
    return against, found


def _between(one: Camera, other: Camera) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return M and t, from a pixel of one camera to the other's image: (u' z', v' z', z') = z M (u, v, 1) + t."""
    K, inverse = (np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]]) for c in (other, one))
    turn = K @ other.R @ one.R.T @ np.linalg.inv(inverse)
    return turn, K @ (other.R @ (one.eye - other.eye))
