"""Lay a mesh out in an image, and paint the image with photos of known cameras.

Every texel inside a face has a place on the mesh. Each photo that sees this place, by its depth map, gives a colour.
Its score is cos(angle) (f / z)^2, the number of the photo's pixels on a unit of the surface. The colours with the best
scores are averaged by score. Texels that no photo sees get the vertices' colours, or those of the nearest place that
was seen.

The layout is made by xatlas, which takes long for many faces: decimate first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import install_command
from gsplat_edu.mesh.depths import camera_points
from gsplat_edu.mesh.raster import boxes
from gsplat_edu.mesh.topology import vertex_normals
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.mesh import Mesh, Texture

GUTTER = 4
"""Texels around each chart that repeat its border, so that filters and mipmaps do not mix charts."""

ROWS = 1 << 20
"""Texels that are looked up at a time."""

EDGE = 1e-9
"""Texels this far outside a face, as a share of it, still belong to it: none is lost between two faces."""


@dataclass(frozen=True, eq=False)
class TextureView:
    """A photo and what is needed to know which places it shows.

    Args:
        camera: Its camera.
        image: (H, W, 3) sRGB.
        depth: (H, W) depth along the camera's axis of the nearest surface, world units; anything that is not positive
            and finite is unknown, and shows nothing.
    """

    camera: Camera
    image: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]


@dataclass(frozen=True)
class TextureSettings:
    """How `textured` paints a mesh.

    Args:
        size: Sides of the image that the layout aims at, px; it exceeds them somewhat.
        best: Photos that are blended at each texel.
        tolerance: A place is seen if it lies no further behind the depth map than this share of its depth.
        steepest: Photos do not paint faces that they see at a larger angle from the normal, degrees.
    """

    size: int = 2048
    best: int = 3
    tolerance: float = 0.01
    steepest: float = 80.0

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 16 <= self.size <= 16384:
            raise ArgumentError(f"size: is {self.size}, but must be from 16 to 16384")
        if self.best < 1:
            raise ArgumentError(f"best: is {self.best}, but must be at least 1")
        if not (0.0 < self.tolerance < 1.0 and 0.0 < self.steepest < 90.0):
            raise ArgumentError("tolerance, steepest: must be between 0 and 1, and between 0 and 90")


def textured(mesh: Mesh, views: Iterable[TextureView], settings: TextureSettings | None = None) -> Mesh:
    """Give a mesh a texture that photos paint.

    The same input gives the same bytes.

    Args:
        mesh: The mesh, of at least one face.
        views: The photos; each is used once and can be released then.
        settings: Size and blending; None for the defaults.

    Returns:
        The mesh with the same vertices, faces and colours, and a texture.

    Raises:
        ArgumentError: xatlas is not installed, the mesh has no faces, a photo or a depth map does not have its camera's
            size, or no photo sees any of the mesh and its vertices have no colours.
    """
    settings = TextureSettings() if settings is None else settings
    uvs, height, width = laid_out(mesh, settings.size)
    face, weights, place = covered_texels(uvs, height, width)
    if not len(face):
        raise ArgumentError(f"size: {settings.size} px are too few for any texel of {len(mesh.faces)} faces")
    points = np.einsum("tk,tkd->td", weights, mesh.corners[face])
    normals = np.einsum("tk,tkd->td", weights, vertex_normals(mesh)[mesh.faces[face]])
    found = _Best(len(face), settings.best)
    facing, anchors = mesh.face_normals(), mesh.corners[:, 0]
    for view in views:
        _check_view(view)
        front = (facing * (view.camera.eye - anchors)).sum(axis=1) > 0.0
        texels = np.flatnonzero(front[face])
        for start in range(0, len(texels), ROWS):
            rows = texels[start : start + ROWS]
            seen, scores, colors = _looked_up(view, points[rows], normals[rows], facing[face[rows]], settings)
            found.add(rows[seen], scores, colors)
    painted, seen_by_any = found.colors()
    if not seen_by_any.all():
        _fill(mesh, painted, seen_by_any, points, weights, face)
    image = np.zeros((height * width, 3), dtype=np.uint8)
    image[place] = np.rint(np.clip(painted, 0.0, 255.0)).astype(np.uint8)
    inside = np.zeros(height * width, dtype=bool)
    inside[place] = True
    image = _with_gutter(image.reshape(height, width, 3), inside.reshape(height, width))
    return Mesh(mesh.vertices, mesh.faces, mesh.colors, Texture(image, uvs))


def laid_out(mesh: Mesh, size: int) -> tuple[Float32[np.ndarray, "F 3 2"], int, int]:
    """Lay the faces of a mesh out in an image, without overlap, with room for gutters.

    Args:
        mesh: The mesh, of at least one face.
        size: Sides of the image to aim at, px.

    Returns:
        (F, 3, 2) texture coordinates, 0 to 1, and the image's height and width in px. Faces without area get no place.

    Raises:
        ArgumentError: xatlas is not installed, or the mesh has no faces.
    """
    if not len(mesh.faces):
        raise ArgumentError("mesh: has no faces to put a texture on")
    try:
        import xatlas
    except ImportError:
        raise ArgumentError(
            f"texture: needs xatlas, which is not installed: {install_command('mesh')}"
        ) from None
    centre = mesh.vertices.mean(axis=0)
    scale = float(np.abs(mesh.vertices - centre).max()) or 1.0
    atlas: Any = xatlas.Atlas()
    atlas.add_mesh(((mesh.vertices - centre) / scale).astype(np.float32), mesh.faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = size, 2 * GUTTER
    atlas.generate(xatlas.ChartOptions(), packing)
    _, indices, uvs = atlas[0]
    coordinates = np.clip(np.asarray(uvs, np.float32)[np.asarray(indices)], 0.0, 1.0)
    return coordinates.reshape(-1, 3, 2), int(atlas.height), int(atlas.width)


def covered_texels(
    uvs: Float32[np.ndarray, "F 3 2"], height: int, width: int
) -> tuple[Int64[np.ndarray, " T"], Float64[np.ndarray, "T 3"], Int64[np.ndarray, " T"]]:
    """Return for each texel whose centre lies in a face: the face, the weights of its corners, and its place."""
    corners = uvs.astype(np.float64) * [width, height] - 0.5  # centres of texels are whole numbers
    owner = np.full(height * width, len(uvs), dtype=np.int64)
    low, high = corners.min(axis=1) - EDGE, corners.max(axis=1) + EDGE
    for faces, places in boxes(low, high, height, width):
        weights = _weights(corners[faces], np.stack([places % width, places // width], axis=1))
        inside = (weights >= -EDGE).all(axis=1)
        np.minimum.at(owner, places[inside], faces[inside])  # on a shared edge, the first face
    place = np.flatnonzero(owner < len(uvs))
    face = owner[place]
    weights = _weights(corners[face], np.stack([place % width, place // width], axis=1))
    return face, weights, place


def _weights(
    corners: Float64[np.ndarray, "N 3 2"], points: Int64[np.ndarray, "N 2"]
) -> Float64[np.ndarray, "N 3"]:
    """Return barycentric weights of points in triangles; -1 for triangles without area."""
    arms = corners - points[:, None]
    parts = np.stack([_cross(arms[:, (k + 1) % 3], arms[:, (k + 2) % 3]) for k in range(3)], axis=1)
    whole = parts.sum(axis=1, keepdims=True)
    return np.where(whole != 0.0, parts / np.where(whole != 0.0, whole, 1.0), -1.0)


def _cross(a: Float64[np.ndarray, "N 2"], b: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, " N"]:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _check_view(view: TextureView) -> None:
    size = (view.camera.H, view.camera.W)
    if view.image.shape[:2] != size or view.depth.shape != size:
        raise ArgumentError(
            f"views: a camera is of {size[1]}x{size[0]} px, but its photo and depth map are not"
        )


def _looked_up(
    view: TextureView,
    points: Float64[np.ndarray, "T 3"],
    normals: Float64[np.ndarray, "T 3"],
    facing: Float64[np.ndarray, "T 3"],
    settings: TextureSettings,
) -> tuple[Int64[np.ndarray, " S"], Float32[np.ndarray, " S"], Float32[np.ndarray, "S 3"]]:
    """Return which places a view sees, with their scores and colours.

    Args:
        view: The photo.
        points: (T, 3) places.
        normals: (T, 3) smooth normals there, of any length.
        facing: (T, 3) normals of their faces, of any length.
        settings: Limits.
    """
    camera, depth = view.camera, view.depth
    local = camera_points(points, camera)
    z = local[:, 2]
    safe = np.where(z > 0.0, z, 1.0)
    u = camera.fx * local[:, 0] / safe + camera.cx
    v = camera.fy * local[:, 1] / safe + camera.cy
    towards = camera.eye - points
    distance = np.linalg.norm(towards, axis=1)
    least = np.cos(np.radians(settings.steepest))
    seen = (z > 0.0) & (u >= 0.0) & (v >= 0.0) & (u <= camera.W - 1) & (v <= camera.H - 1)
    seen &= (facing * towards).sum(axis=1) > least * np.linalg.norm(facing, axis=1) * distance
    chosen = np.flatnonzero(seen)
    column, row = (np.minimum(np.floor(x[chosen]), n - 2).clip(0) for x, n in ((u, camera.W), (v, camera.H)))
    x, y = column.astype(np.int64), row.astype(np.int64)
    across, down = np.minimum(x + 1, camera.W - 1), np.minimum(y + 1, camera.H - 1)
    around = [(y, x), (y, across), (down, x), (down, across)]
    depths = np.stack([depth[place] for place in around]).astype(np.float64)
    known = (np.isfinite(depths) & (depths > 0.0)).all(axis=0)
    kept = known & (z[chosen] <= np.where(known, depths.min(axis=0), 0.0) * (1.0 + settings.tolerance))
    a, b = (u[chosen] - column)[kept, None], (v[chosen] - row)[kept, None]
    tones = [view.image[place[0][kept], place[1][kept]].astype(np.float64) for place in around]
    colors = (1 - b) * ((1 - a) * tones[0] + a * tones[1]) + b * ((1 - a) * tones[2] + a * tones[3])
    chosen = chosen[kept]
    lengths = np.linalg.norm(normals[chosen], axis=1) * distance[chosen]
    cosines = (normals[chosen] * towards[chosen]).sum(axis=1) / np.where(lengths > 0.0, lengths, 1.0)
    scores = np.maximum(cosines, least) * camera.fx * camera.fy / z[chosen] ** 2
    return chosen, scores.astype(np.float32), colors.astype(np.float32)


class _Best:
    """The colours of the best scores of every texel.

    Args:
        count: Number of texels.
        best: Colours kept for each.
    """

    def __init__(self, count: int, best: int) -> None:
        self._scores = np.zeros((best, count), dtype=np.float32)  # the best first; 0 for none
        self._colors = np.zeros((best, count, 3), dtype=np.float32)

    def add(
        self,
        texels: Int64[np.ndarray, " S"],
        scores: Float32[np.ndarray, " S"],
        colors: Float32[np.ndarray, "S 3"],
    ) -> None:
        """Add colours of one photo; of equal scores, the earlier photo comes first."""
        for rank in range(len(self._scores)):
            before, shade = self._scores[rank, texels], self._colors[rank, texels]
            better = scores > before
            self._scores[rank, texels] = np.where(better, scores, before)
            self._colors[rank, texels] = np.where(better[:, None], colors, shade)
            scores, colors = (
                np.where(better, before, scores),
                np.where(better[:, None], shade, colors),
            )

    def colors(self) -> tuple[Float32[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
        """Return the colours, 0 to 255, and which texels have one."""
        counts = (self._scores > 0.0).sum(axis=0)
        total = self._scores.sum(axis=0)
        mixed = np.einsum("kt,ktc->tc", self._scores, self._colors)
        mixed = mixed / np.where(total > 0.0, total, 1.0)[:, None]
        return mixed.astype(np.float32), counts > 0


def _fill(
    mesh: Mesh,
    painted: Float32[np.ndarray, "T 3"],
    seen: Bool[np.ndarray, " T"],
    points: Float64[np.ndarray, "T 3"],
    weights: Float64[np.ndarray, "T 3"],
    face: Int64[np.ndarray, " T"],
) -> None:
    """Give texels that no photo sees the vertices' colours, or that of the nearest place that was seen; in place."""
    if mesh.colors is not None:
        shades = mesh.colors[mesh.faces[face[~seen]]].astype(np.float64)
        painted[~seen] = 255.0 * np.einsum("tk,tkc->tc", weights[~seen], shades)
        return
    if not seen.any():
        raise ArgumentError(
            "views: no photo sees any of the mesh; check that cameras and depth maps belong to it"
        )
    _, nearest = cKDTree(points[seen]).query(points[~seen])
    painted[~seen] = painted[seen][nearest]


def _with_gutter(
    image: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Repeat the nearest texel of a chart around it, up to GUTTER texels away; the rest gets the mean colour."""
    distance, (rows, columns) = distance_transform_edt(~inside, return_indices=True)
    mean = np.rint(image[inside].mean(axis=0)).astype(np.uint8)
    return np.asarray(np.where((distance <= GUTTER)[..., None], image[rows, columns], mean))
