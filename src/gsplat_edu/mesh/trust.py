"""How far a mesh can be trusted: who saw it, how well the depth maps agree, where it is open, what intersects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.evaluate.intersections import Intersections, self_intersections
from gsplat_edu.evaluate.surface import Comparison, Counts, SurfaceScores, score_points, visible_points
from gsplat_edu.evaluate.topology import Topology, topology
from gsplat_edu.mesh.depths import DepthView, Progress, camera_points
from gsplat_edu.mesh.extract import MeshResult
from gsplat_edu.mesh.faces import drawn_in, faces_of
from gsplat_edu.mesh.raster import Raster, rasterized
from gsplat_edu.ops.patches import GreyPhoto, Grid, patch_counts
from gsplat_edu.paths.orbits import resized
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.views import View

FEW_VIEWS = 3
"""A part of the surface that fewer views see is uncertain."""

EVERY = 4
"""Every fourth column and row of a held-out depth map is compared with the mesh."""

TRUTH_SIDE = 640
"""Longer side, px, of the images in which it is found out what the cameras see of the truth."""

PATCHES = 4_000
"""About how many patches of a photo are compared with another photo."""

LEAST_TEXTURED = 100
"""Fewer textured patches than this judge no mesh."""

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


@dataclass(frozen=True)
class PhotoAgreement:
    """How well held-out photos agree with another photo when both are seen through the mesh.

    Args:
        views: Number of held-out photos.
        points: Points of the surface that a held-out photo and another one see.
        textured: Those of them with enough texture around them to judge.
        agreeing: Those of the textured ones where the photos agree: `gsplat_edu.ops.patches.patch_counts`.
    """

    views: int
    points: int
    textured: int
    agreeing: int

    @property
    def share(self) -> float | None:
        """Fraction of the textured points where photos agree, 0 to 1; None if too few have texture."""
        return self.agreeing / self.textured if self.textured >= LEAST_TEXTURED else None


@dataclass(frozen=True, eq=False)
class MeshTrust:
    """What is known of a mesh's accuracy.

    Args:
        seen: What the depth maps say of each vertex.
        certain: Fraction of the area that `FEW_VIEWS` views or more see, 0 to 1.
        spread: Mean of `Seen.error` over the area that any view sees, world units; None if none sees any.
        held_out: Agreement with the splats' depths from held-out views; None if none shows a surface.
        photos: Agreement of held-out photos; None without any.
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
    photos: PhotoAgreement | None = None


def trust_of(
    result: MeshResult,
    held_out: Sequence[DepthView],
    scores: SurfaceScores | None = None,
    progress: Progress = lambda what, done, total: None,
    photos: PhotoAgreement | None = None,
) -> MeshTrust:
    """Collect what is known of a mesh's accuracy.

    Args:
        result: The mesh and the depth maps that it was made from.
        held_out: Depth maps of other views.
        scores: Comparison with the truth, if there is one.
        photos: What `photo_agreement` found, if there are held-out photos.
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
    return MeshTrust(seen, certain, spread, agreement, shape, intersections, scores, photos)


def photo_agreement(
    mesh: Mesh,
    pairs: Sequence[tuple[View, View]],
    tolerance: float,
    progress: Progress = lambda what, done, total: None,
) -> PhotoAgreement:
    """Compare held-out photos with other photos through the mesh: unlike its depth maps, they know no splats.

    Patches around points of the surface that both photos of a pair see are carried from one to the other by the plane
    of the mesh there. Where they do not agree, the surface is wrong, shiny, or hidden by something that the mesh lacks.

    Args:
        mesh: The mesh, in the frame of the cameras.
        pairs: Held-out views, each with another view of the same surface. Photos need few pixels: they are compared at
            their own size.
        tolerance: The second photo sees a point if it lies at most so far behind the mesh there, world units.
        progress: Called after each pair, "photos".

    Raises:
        ArgumentError: a camera is orthographic.
        DatasetError: a photo cannot be read.
    """
    total = np.zeros(3, dtype=np.int64)
    for done, (view, other) in enumerate(pairs, 1):
        second, faces = GreyPhoto.of(other.read(), other.camera), faces_of(other.camera)
        depths = [rasterized(mesh, face).depth for face in faces]
        for photo, raster in _drawn(mesh, view):
            sampled, grid = _sampled(mesh, photo.camera, raster, (faces, depths), tolerance)
            total += patch_counts(*sampled, photo, second, grid)
        progress("photos", done, len(pairs))
    return PhotoAgreement(len(pairs), *total.tolist())


def _drawn(mesh: Mesh, view: View) -> Iterator[tuple[GreyPhoto, Raster]]:
    """Yield a photo and the mesh from its camera; those of each face of a camera that is no pinhole."""
    photo, camera = GreyPhoto.of(view.read(), view.camera), view.camera
    if camera.pinhole:
        yield photo, rasterized(mesh, camera)
        return
    valid = np.ones_like(photo.pixels) if photo.counts is None else photo.counts.astype(np.uint8)
    for face in faces_of(camera):
        raster = rasterized(mesh, face)
        depth = np.where(raster.covered, raster.depth, 0.0).astype(np.float32)
        pixels, inside = drawn_in(face, depth, camera, photo.pixels)
        counts, _ = drawn_in(face, depth, camera, valid, cv2.INTER_NEAREST)
        yield GreyPhoto(face, pixels, inside & (counts > 0)), raster


def _sampled(
    mesh: Mesh,
    camera: Camera,
    raster: Raster,
    other: tuple[Sequence[Camera], Sequence[Float64[np.ndarray, "_ _"]]],
    tolerance: float,
) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], Grid]:
    """Return normals, depth and alpha of about `PATCHES` pixels that another camera sees too, and their grid."""
    stride = max(1, math.isqrt(int(raster.covered.sum()) // PATCHES))
    first = stride // 2
    rows, columns = np.nonzero(raster.covered[first::stride, first::stride])
    rows, columns = first + stride * rows, first + stride * columns
    rays = camera.rays()[rows, columns]
    points = camera.eye + raster.depth[rows, columns][:, None] * rays
    seen = visible_points(points, *other, tolerance)
    rows, columns, rays = rows[seen], columns[seen], rays[seen]
    normals, depth = np.zeros((*raster.depth.shape, 3)), np.zeros(raster.depth.shape)
    normals[rows, columns] = _facing(mesh, raster, rows, columns, rays)
    depth[rows, columns] = raster.depth[rows, columns]
    alpha = (depth > 0).astype(np.float64)
    return (torch.from_numpy(normals), torch.from_numpy(depth), torch.from_numpy(alpha)), Grid(
        stride, first, first
    )


def _facing(
    mesh: Mesh,
    raster: Raster,
    rows: Int64[np.ndarray, " n"],
    columns: Int64[np.ndarray, " n"],
    rays: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3"]:
    """Return the normals of the mesh at pixels, interpolated between its vertices, on the side of the camera."""
    corners = mesh.summed_normals()[mesh.faces[raster.face[rows, columns]]]
    lengths = np.linalg.norm(corners, axis=2, keepdims=True)
    units = np.divide(corners, lengths, out=np.zeros_like(corners), where=lengths > 0)
    normals = np.einsum("nk,nkd->nd", raster.weights[rows, columns], units)
    return np.asarray(np.where((normals * rays).sum(axis=1, keepdims=True) > 0, -normals, normals))


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
