"""Draw a mesh from a camera: which face each pixel shows, where on the face, and how far away.

With the corners a, b, c of a face in camera coordinates and the ray r = ((u - cx) / fx, (v - cy) / fy, 1) of a pixel,
the point z r of the face is a combination of its corners with the weights

    (b × c · r,  c × a · r,  a × b · r) z / det(a, b, c),    1 / z = (b × c + c × a + a × b) · r / det(a, b, c).

Faces that cross the camera's plane need no cutting: a pixel shows the face where all three weights and z are positive.

Source: Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.mesh import Mesh

PAIRS = 1 << 20
"""Pairs of a face and a pixel that are handled at a time."""

FACES = 1 << 18
"""Faces that are handled at a time: their arrays stay below 200 MB."""

ROUNDING = 1e-6
"""Boxes are enlarged by this, px, so that rounding loses no pixel between two faces."""

NEAR = 1e-3
"""Faces are drawn from this depth on, as a share of the largest depth of the mesh."""


@dataclass(frozen=True, eq=False)
class Raster:
    """What the pixels of a camera show of a mesh.

    Args:
        face: (H, W) index of the nearest face, seen from either side; -1 for none.
        weights: (H, W, 3) weights of the face's corners, which sum to 1; 0 for none.
        depth: (H, W) depth along the camera's axis, world units; infinite for none.
    """

    face: Int64[np.ndarray, "H W"]
    weights: Float64[np.ndarray, "H W 3"]
    depth: Float64[np.ndarray, "H W"]

    @property
    def covered(self) -> Bool[np.ndarray, "H W"]:
        """(H, W) which pixels show the mesh."""
        return self.face >= 0

    def of_vertices(self, mesh: Mesh, values: Float64[np.ndarray, "V C"]) -> Float64[np.ndarray, "H W C"]:
        """Interpolate values of the vertices; 0 where no face is.

        Args:
            mesh: The mesh that was drawn.
            values: (V, C) a row for each vertex.
        """
        out = np.zeros((*self.face.shape, values.shape[1]))
        seen = self.covered
        out[seen] = np.einsum("nk,nkc->nc", self.weights[seen], values[mesh.faces[self.face[seen]]])
        return out


def rasterized(mesh: Mesh, camera: Camera) -> Raster:
    """Draw a mesh.

    Of two faces at one depth, a pixel shows the later one.

    Args:
        mesh: The mesh; it may have no faces.
        camera: The camera.
    """
    size = camera.H * camera.W
    face, nearest = np.full(size, -1, dtype=np.int64), np.full(size, np.inf)
    weights = np.zeros((size, 3))
    vertices = camera.world_to_cam(mesh.vertices)
    near = NEAR * max(float(vertices[:, 2].max(initial=0.0)), 1e-30)
    for start in range(0, len(mesh.faces), FACES):
        corners = vertices[mesh.faces[start : start + FACES]]
        planes, sums = _planes(corners)
        for faces, places in boxes(*_extents(corners, camera, near), camera.H, camera.W):
            rays = _rays(places, camera)
            parts = np.einsum("nkd,nd->nk", planes[faces], rays)
            inverse = (sums[faces] * rays).sum(axis=1)
            inside = (parts >= 0.0).all(axis=1) & (inverse * near <= 1.0) & (inverse > 0.0)
            at, depth = places[inside], 1.0 / inverse[inside]
            np.minimum.at(nearest, at, depth)
            first = np.flatnonzero(depth == nearest[at])
            face[at[first]] = start + faces[inside][first]
            weights[at[first]] = parts[inside][first] * depth[first, None]
    shape = (camera.H, camera.W)
    return Raster(face.reshape(shape), weights.reshape(*shape, 3), nearest.reshape(shape))


def picture(mesh: Mesh, raster: Raster, background: tuple[int, int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Colour a drawn mesh: with its texture, else with the colours of its vertices, else light grey.

    Args:
        mesh: The mesh.
        raster: The mesh as `rasterized` drew it.
        background: sRGB of the pixels that show nothing, 0 to 255.
    """
    seen = raster.covered
    image = np.empty((*seen.shape, 3), dtype=np.uint8)
    image[:] = background
    if mesh.texture is not None:
        uvs = mesh.texture.uvs[raster.face[seen]].astype(np.float64)
        places = np.einsum("nk,nkd->nd", raster.weights[seen], uvs)
        image[seen] = np.rint(_looked_up(mesh.texture.image, places)).astype(np.uint8)
    elif mesh.colors is not None:
        colors = raster.of_vertices(mesh, mesh.colors.astype(np.float64))[seen]
        image[seen] = np.rint(255.0 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)
    else:
        image[seen] = 200
    return image


def lit(mesh: Mesh, raster: Raster, camera: Camera) -> Float32[np.ndarray, "H W"]:
    """Return how bright a lamp at the camera makes each pixel: |cos| between the face's normal and the ray.

    Args:
        mesh: The mesh.
        raster: The mesh as `rasterized` drew it.
        camera: The camera that it was drawn from.
    """
    seen = raster.covered
    out = np.zeros(seen.shape, dtype=np.float32)
    normals = (mesh.face_normals() @ camera.R.T)[raster.face[seen]]
    rays = _rays(np.flatnonzero(seen), camera)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    out[seen] = np.abs((normals * rays).sum(axis=1)) / np.where(lengths > 0.0, lengths, 1.0)
    return out


def boxes(
    low: Float64[np.ndarray, "F 2"], high: Float64[np.ndarray, "F 2"], height: int, width: int
) -> Iterator[tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " N"]]]:
    """Yield faces and the pixels of their bounding boxes, about `PAIRS` pairs at a time.

    Args:
        low: (F, 2) least column and row of each face; a box whose low exceeds its high has no pixels.
        high: (F, 2) largest column and row.
        height: Height of the image, px.
        width: Width of the image, px.

    Yields:
        (N,) indices of faces, and (N,) pixels, counted along the rows of the image.
    """
    least = np.clip(np.ceil(low), 0, [width, height]).astype(np.int64)
    sides = np.maximum(np.clip(np.floor(high), -1, [width - 1, height - 1]).astype(np.int64) - least + 1, 0)
    counts = sides.prod(axis=1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        before = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + PAIRS, side="right")))
        faces = np.repeat(np.arange(start, stop), counts[start:stop])
        firsts = np.repeat(ends[start:stop] - counts[start:stop] - before, counts[start:stop])
        within = np.arange(len(faces)) - firsts
        columns = least[faces, 0] + within % sides[faces, 0]
        rows = least[faces, 1] + within // sides[faces, 0]
        yield faces, rows * width + columns
        start = stop


def _planes(
    corners: Float64[np.ndarray, "F 3 3"],
) -> tuple[Float64[np.ndarray, "F 3 3"], Float64[np.ndarray, "F 3"]]:
    """Return the vectors whose products with a ray are the weights over z, and their sums; NaN without an area."""
    a, b, c = np.moveaxis(corners, 1, 0)
    planes = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * planes[:, 0]).sum(axis=1)
    seen_edge_on = np.abs(volume) < 1e-300
    planes /= np.where(seen_edge_on, np.nan, volume)[:, None, None]  # no comparison holds for NaN
    return planes, planes.sum(axis=1)


def _extents(
    corners: Float64[np.ndarray, "F 3 3"], camera: Camera, near: float
) -> tuple[Float64[np.ndarray, "F 2"], Float64[np.ndarray, "F 2"]]:
    """Return the least and the largest column and row of the part of each face that is in front of the camera."""
    following = np.roll(corners, -1, axis=1)
    ahead = corners[..., 2] >= near
    crossing = ahead != (following[..., 2] >= near)
    rise = np.where(crossing, following[..., 2] - corners[..., 2], 1.0)
    cut = corners + ((near - corners[..., 2]) / rise)[..., None] * (following - corners)
    points, exist = np.concatenate([corners, cut], axis=1), np.concatenate([ahead, crossing], axis=1)
    z = np.where(exist, points[..., 2], 1.0)
    on_screen = np.stack(
        [camera.fx * points[..., 0] / z + camera.cx, camera.fy * points[..., 1] / z + camera.cy], axis=-1
    )
    low = np.where(exist[..., None], on_screen, np.inf).min(axis=1)
    high = np.where(exist[..., None], on_screen, -np.inf).max(axis=1)
    return low - ROUNDING, high + ROUNDING


def _rays(places: Int64[np.ndarray, " N"], camera: Camera) -> Float64[np.ndarray, "N 3"]:
    """Return the rays of pixels in camera coordinates, with z = 1."""
    u, v = places % camera.W, places // camera.W
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(places))], axis=1)


def _looked_up(
    image: UInt8[np.ndarray, "h w 3"], places: Float64[np.ndarray, "N 2"]
) -> Float64[np.ndarray, "N 3"]:
    """Interpolate a texture bilinearly at places from 0 to 1."""
    height, width = image.shape[:2]
    u, v = np.clip(places * [width, height] - 0.5, 0.0, [width - 1.0, height - 1.0]).T
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = (u - left)[:, None], (v - top)[:, None]
    upper = (1 - a) * image[top, left] + a * image[top, right]
    return np.asarray((1 - b) * upper + b * ((1 - a) * image[below, left] + a * image[below, right]))
