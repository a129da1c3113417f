"""How far a mesh can be trusted: who saw it, how well the depth maps agree, where it is open, what intersects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.evaluate.intersections import Intersections, self_intersections
from gsplat_edu.evaluate.paths import resized
from gsplat_edu.evaluate.surface import Comparison, Counts, SurfaceScores, score_points, visible_points
from gsplat_edu.evaluate.topology import Topology, topology
from gsplat_edu.mesh.depths import DepthView, Progress, camera_points
from gsplat_edu.mesh.extract import MeshResult
from gsplat_edu.mesh.raster import rasterized
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.mesh import Mesh

FEW_VIEWS = 3
"""A part of the surface that fewer views see is uncertain."""

EVERY = 4
"""Every fourth column and row of a held-out depth map is compared with the mesh."""

TRUTH_SIDE = 640
"""Longer side, px, of the images in which it is found out what the cameras see of the truth."""

VERTICES = 1 << 13
"""Vertices that are looked up at a time."""


class Seen(NamedTuple):
    """What the depth maps say of each vertex.

    Args:
        views: (V,) number of depth maps that show it.
        error: (V,) mean |difference| between its depth and those of the maps that show it, world units; infinite if
            none does.
    """

    views: Int64[np.ndarray, " V"]
    error: Float64[np.ndarray, " V"]


@dataclass(frozen=True)
class HeldOutDepths:
    """The splats' depths from views that the mesh was not made from: how well it follows the splats, not the photos.

    Args:
        views: Number of views.
        within: Fraction of the splats' depths there that lie within a voxel of the mesh, 0 to 1.
    """

    views: int
    within: float


@dataclass(frozen=True, eq=False)
class MeshTrust:
    """What is known of a mesh's accuracy.

    Args:
        seen: What the depth maps say of each vertex.
        certain: Fraction of the area that `FEW_VIEWS` views or more see, 0 to 1.
        spread: Mean of `Seen.error` over the area that any view sees, world units; None if none sees any.
        held_out: Agreement with held-out views; None if none shows a surface.
        shape: Connectivity and area.
        intersections: Triangles that pass through others.
        scores: Comparison with the truth; None without one.
    """

    seen: Seen
    certain: float
    spread: float | None
    held_out: HeldOutDepths | None
    shape: Topology
    intersections: Intersections
    scores: SurfaceScores | None = None


def trust_of(
    result: MeshResult,
    held_out: Sequence[DepthView],
    scores: SurfaceScores | None = None,
    progress: Progress = lambda what, done, total: None,
) -> MeshTrust:
    """Collect what is known of a mesh's accuracy.

    Args:
        result: The mesh and the depth maps that it was made from.
        held_out: Depth maps of other views.
        scores: Comparison with the truth, if there is one.
        progress: Called after each view, and before and after "intersections".
    """
    seen = seen_by(result.mesh, result.views, result.truncation, progress)
    areas = _areas_of_vertices(result.mesh)
    known = areas * (seen.views > 0)
    spread = None
    if known.any():
        spread = float((known * np.where(seen.views > 0, seen.error, 0.0)).sum() / known.sum())
    agreement, shape = _agreement(result, held_out), topology(result.mesh)
    progress("intersections", 0, 1)
    intersections = self_intersections(result.mesh)
    progress("intersections", 1, 1)
    certain = float((areas * (seen.views >= FEW_VIEWS)).sum() / (areas.sum() or 1.0))
    return MeshTrust(seen, certain, spread, agreement, shape, intersections, scores)


def seen_truth(
    truth: Mesh,
    views: Sequence[DepthView],
    tolerance: float,
    origin: tuple[float, float, float] = ORIGIN,
    progress: Progress = lambda what, done, total: None,
) -> Counts:
    """Return what tells which points of the true surface the views see: no method could find the others.

    Args:
        truth: The true surface.
        views: The depth maps of the mesh, whose cameras count.
        tolerance: A point is seen if it lies at most so far behind the true surface in front of it, world units.
        origin: What was subtracted from the coordinates of the truth for the cameras.
        progress: Called after each view, "truth".
    """
    here = replace(truth, vertices=truth.vertices - np.array(origin))

    def counts(points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        places, seen = points - np.array(origin), np.zeros(len(points), dtype=bool)
        for done, view in enumerate(views, 1):
            camera = view.camera
            if max(camera.W, camera.H) > TRUTH_SIDE:
                camera = resized(camera, TRUTH_SIDE)
            left = np.flatnonzero(~seen)
            depth = rasterized(here, camera).depth
            seen[left] = visible_points(places[left], [camera], [depth], tolerance)
            progress("truth", done, len(views))
        return seen

    return counts


def seen_by(
    mesh: Mesh,
    views: Sequence[DepthView],
    tolerance: float,
    progress: Progress = lambda what, done, total: None,
) -> Seen:
    """Count the depth maps that show each vertex, and measure how far they are from it.

    Args:
        mesh: The mesh.
        views: The depth maps.
        tolerance: A map shows a vertex if its depth there differs by less than this, world units.
        progress: Called after each view, "trust".
    """
    count, total = np.zeros(len(mesh.vertices), dtype=np.int64), np.zeros(len(mesh.vertices))
    for done, view in enumerate(views, 1):
        camera, depths = view.camera, view.depth
        H, W = depths.shape
        for first in range(0, len(mesh.vertices), VERTICES):  # few enough for the processor's cache
            part = slice(first, first + VERTICES)
            x, y, z = camera_points(mesh.vertices[part], camera).T
            right, down = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
            inside = (z > 0) & (right > -0.5 * z) & (down > -0.5 * z)
            at = np.flatnonzero(inside & (right < (W - 0.5) * z) & (down < (H - 0.5) * z))
            z = z[at]
            row, column = (
                np.minimum(np.rint(p[at] / z).astype(np.int64), n - 1) for p, n in ((down, H), (right, W))
            )
            depth = depths[row, column].astype(np.float64)
            apart = np.abs(depth - z)
            shown = (depth > 0) & (apart < tolerance)
            count[part][at] += shown
            total[part][at] += np.where(shown, apart, 0.0)
        progress("trust", done, len(views))
    return Seen(count, np.where(count > 0, total / np.maximum(count, 1), np.inf))


def _areas_of_vertices(mesh: Mesh) -> Float64[np.ndarray, " V"]:
    """Return a third of the area of the faces around each vertex."""
    thirds = np.linalg.norm(mesh.face_normals(), axis=1) / 6.0
    return np.bincount(mesh.faces.ravel(), np.repeat(thirds, 3), minlength=len(mesh.vertices))


def _agreement(result: MeshResult, views: Sequence[DepthView]) -> HeldOutDepths | None:
    """Compare the mesh with the depths of views that it was not made from."""
    points = []
    for view in views:
        depth = view.depth[::EVERY, ::EVERY]
        rows, columns = np.nonzero(depth)
        rays = view.camera.rays()[::EVERY, ::EVERY][rows, columns]
        points.append(view.camera.eye + depth[rows, columns][:, None] * rays)
    if not sum(map(len, points)):
        return None
    scores = score_points(np.concatenate(points), result.mesh, Comparison(result.voxel))
    return HeldOutDepths(len(views), scores.precision)
