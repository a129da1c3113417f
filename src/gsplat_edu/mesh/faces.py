"""Pinholes that together show what a camera with a lens or a rolling shutter sees.

Depth maps, and the volume that they are integrated into, know pinholes. A lens that sees at most 100 degrees along
each side is one pinhole; any other is up to six faces of a cube, each cut to the part that the lens sees. At the
middle of its image, a face has as many px per radian as the lens.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.camera import Camera

WIDEST_PINHOLE = math.tan(math.radians(50.0))
"""Largest |x / z| and |y / z| at the border of an image that one pinhole shows."""

LEAST_SIDE = 8
"""Faces that see less than this along a side, px, are left out."""

COARSE = 4
"""Distance, px, of the rows and columns of a face that are examined to cut it to what the lens sees."""


def faces_of(camera: Camera) -> list[Camera]:
    """Return the pinholes at rest that show what a camera sees: the camera itself if it is one.

    Args:
        camera: The camera. One with a rolling shutter stands where it is in the middle of the readout.

    Raises:
        ArgumentError: the camera is orthographic; its rays have no common centre.
    """
    if camera.pinhole:
        return [camera]
    if camera.projection.kind == "orthographic":
        raise ArgumentError("camera: is orthographic, which no pinhole can show; use other cameras")
    at_rest = camera.through(camera.projection)
    if camera.projection.kind == "perspective":
        whole = _one_pinhole(at_rest)
        if whole is not None:
            return [whole]
    f = max(1, round(math.sqrt(camera.fx * camera.fy)))  # px per radian
    side, middle = 2 * f, f - 0.5
    cube = [Camera(R, camera.eye, f, f, middle, middle, side, side) for R in _cube(camera.R)]
    return [face for face in (_cut(face, at_rest) for face in cube) if face is not None]


def in_view(camera: Camera, face: Camera, step: int = 1) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of a face lie in the image of a camera at the same place.

    Args:
        camera: A camera without a rolling shutter.
        face: A pinhole.
        step: Distance, px, of the rows and columns that are examined.
    """
    rays = face.rays()[::step, ::step]
    seen = camera.sight(face.eye + rays.reshape(-1, 3))
    return _inside(camera, seen.u, seen.v, seen.valid).reshape(rays.shape[:2])


def drawn_in(
    face: Camera,
    depth: Float32[np.ndarray, "H W"],
    camera: Camera,
    image: Shaped[np.ndarray, "h w *c"],
    interpolation: int = cv2.INTER_LINEAR,
) -> tuple[Shaped[np.ndarray, "H W *c"], Bool[np.ndarray, "H W"]]:
    """Draw the photo of a camera in a face, by the depth of each pixel: so a rolling shutter is undone as well.

    Args:
        face: A pinhole.
        depth: (H, W) its depth map, world units; pixels without a positive depth are drawn at the median depth.
        camera: The photo's camera.
        image: (h, w, ...) the photo, of the camera's size.
        interpolation: Of cv2.

    Returns:
        (H, W, ...) the face, and which of its pixels the photo has.
    """
    known = depth[depth > 0]
    filled = np.where(depth > 0, depth, np.median(known) if len(known) else 1.0).astype(np.float64)
    seen = camera.sight((face.eye + filled[..., None] * face.rays()).reshape(-1, 3))
    inside = _inside(camera, seen.u, seen.v, seen.valid).reshape(depth.shape)
    u, v = (
        np.where(inside, place.reshape(depth.shape), -1.0).astype(np.float32) for place in (seen.u, seen.v)
    )
    drawn = cv2.remap(image, u, v, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return np.where(inside[(...,) + (None,) * (image.ndim - 2)], drawn, 0).astype(image.dtype), inside


def _inside(
    camera: Camera,
    u: Float64[np.ndarray, " n"],
    v: Float64[np.ndarray, " n"],
    valid: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Return which places lie on the pixels of a camera's image."""
    return np.asarray(valid & (u >= -0.5) & (v >= -0.5) & (u <= camera.W - 0.5) & (v <= camera.H - 0.5))


def _one_pinhole(camera: Camera) -> Camera | None:
    """Return the pinhole that shows all of a perspective lens; None if the lens is too wide for one."""
    border = np.ones((camera.H, camera.W), dtype=bool)
    border[1:-1, 1:-1] = False
    rays = camera.rays()[border] @ camera.R.T
    x, y = (rays[:, k] / rays[:, 2] for k in range(2))
    if not np.isfinite([x, y]).all() or np.abs([x, y]).max() > WIDEST_PINHOLE:
        return None
    left, top = camera.fx * float(x.min()), camera.fy * float(y.min())
    W, H = (math.ceil(f * float(np.ptp(a))) + 1 for f, a in ((camera.fx, x), (camera.fy, y)))
    return Camera(camera.R, camera.eye, camera.fx, camera.fy, -left, -top, H, W)


def _cube(R: Float64[np.ndarray, "3 3"]) -> list[Float64[np.ndarray, "3 3"]]:
    """Return the rotations of six faces: along the optical axis, to the right, left, down and up, and back."""
    right, down, forward = R
    return [
        np.stack(rows)
        for rows in (
            (right, down, forward),
            (-forward, down, right),
            (forward, down, -right),
            (right, -forward, down),
            (right, forward, -down),
            (-right, down, -forward),
        )
    ]


def _cut(face: Camera, camera: Camera) -> Camera | None:
    """Return a face cut to what the camera sees of it, and a margin of `COARSE` px; None if that is too little."""
    seen = in_view(camera, face, COARSE)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return None
    top, left = (max(0, COARSE * int(found[0]) - COARSE) for found in (rows, columns))
    bottom, right = (
        min(side, COARSE * int(found[-1]) + COARSE + 1) for found, side in ((rows, face.H), (columns, face.W))
    )
    if min(bottom - top, right - left) < LEAST_SIDE:
        return None
    return Camera(
        face.R, face.eye, face.fx, face.fy, face.cx - left, face.cy - top, bottom - top, right - left
    )
