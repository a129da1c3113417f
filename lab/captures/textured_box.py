"""Photos with known cameras of a textured box on a floor, with enough texture for feature matching.

Six textured rectangles are drawn with OpenCV homographies instead of this package's renderer, so training on them is an
independent test. Structure from motion is tested on these photos. Chapter 14 compares cameras by `align_cameras`.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from gsplat_edu.scene.camera import Camera, look_at

BOX_FACES = np.array(
    [
        # corner and the two edges from it; y points down, the floor is y = 0
        [(-4.0, 0.0, -4.0), (8.0, 0.0, 0.0), (0.0, 0.0, 8.0)],
        [(-0.7, -1.0, -0.5), (1.4, 0.0, 0.0), (0.0, 0.0, 1.0)],
        [(-0.7, -1.0, -0.5), (1.4, 0.0, 0.0), (0.0, 1.0, 0.0)],
        [(0.7, -1.0, 0.5), (-1.4, 0.0, 0.0), (0.0, 1.0, 0.0)],
        [(0.7, -1.0, -0.5), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)],
        [(-0.7, -1.0, 0.5), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)],
    ]
)
"""The floor, then the box's top and sides, world units, in drawing order: later faces cover earlier ones."""

BOX_INSIDE = np.array([0.0, -0.5, 0.0])
"""A point inside the box."""

BOX_TARGET = np.array([0.1, -0.4, 0.0])
"""Target of the cameras."""

BOX_DISTANCE = 4.0
"""Distance from the target to a camera, world units."""

BOX_FOCAL = 1.1
"""Focal length as a fraction of the photo's longer side: 352 px at 320."""

BOX_SHARPER = 2
"""Supersampling factor of the photos, for smooth edges."""

BEHIND = 90
"""Grey value behind the floor and the box."""


class Alignment(NamedTuple):
    """The similarity x' = s R x + t, and the remaining errors of the cameras."""

    s: float
    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, "3"]
    moved: Float64[np.ndarray, " n"]  # distances between centres, as fractions of the true extent
    turned: Float64[np.ndarray, " n"]  # angles between rotations, degrees


def box_camera(azimuth: float, elevation: float = 0.45, size: tuple[int, int] = (320, 240)) -> Camera:
    """Make a camera facing the box.

    Args:
        azimuth: Around the vertical, radians.
        elevation: Above the floor, radians.
        size: Width and height of its photo, px; the focal length is the same in portrait and landscape.
    """
    W, H = size
    direction = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            -math.sin(elevation),
            -math.cos(elevation) * math.cos(azimuth),
        ]
    )
    eye, focal = BOX_TARGET + BOX_DISTANCE * direction, BOX_FOCAL * max(size)
    return Camera(look_at(eye, BOX_TARGET), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def box_orbit(count: int, turn: float = 2 * math.pi, size: tuple[int, int] = (320, 240)) -> list[Camera]:
    """Make cameras around the box; the height oscillates, so that the poses determine the focal length.

    Args:
        count: Number of cameras.
        turn: Angle that they span, radians.
        size: Width and height of the photos, px.
    """
    angles = turn * np.arange(count) / count
    return [box_camera(float(angle), 0.45 + 0.15 * math.sin(3 * angle), size) for angle in angles]


def photograph_box(camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
    """Render a photo of the box, RGB.

    Args:
        camera: The camera; pixel centres have integer coordinates.
    """
    s = BOX_SHARPER
    # resizing is relative to the image's corner, (-1/2, -1/2)
    middle = [(c + 0.5) * s - 0.5 for c in (camera.cx, camera.cy)]
    K = np.array([[camera.fx * s, 0, middle[0]], [0, camera.fy * s, middle[1]], [0, 0, 1]])
    size = (s * camera.W, s * camera.H)
    image = np.full((size[1], size[0], 3), BEHIND, np.uint8)
    for number, (corner, a, b) in enumerate(BOX_FACES):
        outward = np.cross(a, b)
        outward *= np.sign(outward @ (corner + (a + b) / 2 - BOX_INSIDE))
        if corner[1] == 0.0:
            outward = np.array([0.0, -1.0, 0.0])  # the floor is seen from above
        if outward @ (camera.eye - corner) <= 0:
            continue
        picture = box_texture(number)
        side = len(picture)
        first = corner + (a + b) / (2 * side)  # the centre of the texture's first pixel
        homography = K @ camera.R @ np.stack([a / side, b / side, first - camera.eye], axis=1)
        drawn = cv2.warpPerspective(picture, homography, size, flags=cv2.INTER_LINEAR)
        everywhere = np.full((side, side), 255, np.uint8)
        covered = cv2.warpPerspective(everywhere, homography, size, flags=cv2.INTER_NEAREST)
        image[covered > 0] = drawn[covered > 0]
    return np.asarray(cv2.resize(image, (camera.W, camera.H), interpolation=cv2.INTER_AREA), dtype=np.uint8)


@functools.cache
def box_texture(face: int) -> UInt8[np.ndarray, "side side 3"]:
    """Return the texture of a face: coloured noise at all scales, which gives features near and far.

    Args:
        face: Index in `BOX_FACES`; also the seed of the noise.
    """
    side = 512 if face == 0 else 256
    rng, image = np.random.default_rng(face), np.zeros((side, side, 3), np.float32)
    for cells in (4, 8, 16, 32, 64, 128):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        image += cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128 + 30 * image, 0, 255).astype(np.uint8))


def align_cameras(found: Mapping[str, Camera], truth: Mapping[str, Camera]) -> Alignment:
    """Align cameras with the ground truth by the similarity that minimises the distances of their centres.

    Args:
        found: Cameras by name, at least three, not collinear.
        truth: True cameras by name; may contain more names.

    Returns:
        The similarity and the remaining errors, in the order of the sorted names of `found`.

    Source: Umeyama 1991.
    """
    names = sorted(found)
    a, b = (np.stack([cameras[name].eye for name in names]) for cameras in (found, truth))
    A, B = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(B.T @ A)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ sign @ Vt
    s = float(np.trace(np.diag(S) @ sign) / (A**2).sum())
    moved = np.linalg.norm(s * A @ R.T - B, axis=1) / np.linalg.norm(B, axis=1).max()
    traces = np.array([np.trace(found[name].R @ R.T @ truth[name].R.T) for name in names])
    turned = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    return Alignment(s, R, b.mean(axis=0) - s * R @ a.mean(axis=0), moved, turned)
