"""Photos and 360-degree panoramas of a textured room with known cameras, drawn ray by ray. The room is a box seen
from inside, with two boxes on its floor. Each ray takes the texture of the nearest rectangle that it hits, so
panoramas are drawn without a projection of this package.
"""

import functools

import cv2
import numpy as np

from gsplat_edu.scene.camera import Camera, look_at

ROOM = np.array([[-3.0, -2.2, -2.5], [3.0, 0.6, 2.5]])
"""Lowest and highest corner of the room, world units; y points down, so the floor is y = 0.6."""

BOXES = np.array([[[-1.9, -0.3, 0.8], [-1.2, 0.6, 1.6]], [[1.0, -0.7, -1.6], [1.8, 0.6, -0.9]]])
"""Two boxes on the floor."""

SHARPER = 2
"""Samples per pixel along each axis."""


@functools.cache
def texture_of(number):
    """Return coloured noise, coarse enough for photos of 163 px, (128, 128, 3)."""
    rng, image = np.random.default_rng(number), np.zeros((128, 128, 3), np.float32)
    for cells in (4, 8, 16, 32):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        image += cv2.resize(noise, (128, 128), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 32 * image, 0, 255)


def rectangles():
    """Return all rectangles, each as (corner, edge, edge)."""
    found = []
    for low, high in (ROOM, *BOXES):
        size = high - low
        for axis in range(3):
            first, second = ((axis + 1) % 3, (axis + 2) % 3)
            a, b = np.zeros(3), np.zeros(3)
            a[first], b[second] = size[first], size[second]
            for end in (low, high):
                corner = low.copy()
                corner[axis] = end[axis]
                found.append((corner, a, b))
    return found


def colours_of(eye, rays):
    """Return the colours that rays from a point hit, (..., 3), 0 to 255.

    Args:
        eye: (3,) the point.
        rays: (..., 3) directions, of any length.
    """
    return _traced(eye, rays)[0]


def depths_of(eye, rays):
    """Return where rays from a point end, (...): in lengths of the ray, infinity where it hits nothing."""
    return _traced(eye, rays)[1]


def _traced(eye, rays):
    flat = rays.reshape(-1, 3)
    nearest = np.full(len(flat), np.inf)
    found = np.zeros((len(flat), 3), np.float32)
    for number, (corner, a, b) in enumerate(rectangles()):
        normal = np.cross(a, b)
        slope = flat @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((corner - eye) @ normal) / slope
            # rays parallel to a rectangle give NaN and infinity, which compare as false
            at = eye + t[:, None] * flat - corner
            s, q = at @ a / (a @ a), at @ b / (b @ b)
            hit = (t > 1e-6) & (t < nearest) & (s >= 0) & (s <= 1) & (q >= 0) & (q <= 1)
        texture = texture_of(number)
        side = len(texture)
        x, y = (np.clip(c[hit] * side - 0.5, 0, side - 1.001) for c in (q, s))
        i, j = x.astype(int), y.astype(int)
        p, r = (x - i)[:, None], (y - j)[:, None]
        upper = texture[j, i] * (1 - p) + texture[j, i + 1] * p
        lower = texture[j + 1, i] * (1 - p) + texture[j + 1, i + 1] * p
        found[hit] = upper * (1 - r) + lower * r
        nearest[hit] = t[hit]
    return found.reshape(rays.shape), nearest.reshape(rays.shape[:-1])


def averaged(dense):
    """Average blocks of `SHARPER` by `SHARPER` samples to pixels."""
    H, W, _ = dense.shape
    blocks = dense.reshape(H // SHARPER, SHARPER, W // SHARPER, SHARPER, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def panorama(eye, turn=0.0, width=512):
    """Draw a panorama, (width/2, width, 3).

    Args:
        eye: Its centre.
        turn: Heading of its middle, radians to the right of +z.
        width: Its width, px.
    """
    W, H = SHARPER * width, SHARPER * width // 2
    longitude = ((np.arange(W) + 0.5) / W - 0.5) * 2 * np.pi + turn
    latitude = (0.5 - (np.arange(H) + 0.5) / H) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    flat = np.cos(latitude)
    rays = np.stack([flat * np.sin(longitude), -np.sin(latitude), flat * np.cos(longitude)], axis=2)
    return averaged(colours_of(np.asarray(eye), rays))


def photo(camera):
    """Draw a photo, (H, W, 3)."""
    offsets = (np.arange(SHARPER) + 0.5) / SHARPER - 0.5
    x = ((np.arange(camera.W)[:, None] + offsets).ravel() - camera.cx) / camera.fx
    y = ((np.arange(camera.H)[:, None] + offsets).ravel() - camera.cy) / camera.fy
    X, Y = np.meshgrid(x, y)
    return averaged(colours_of(camera.eye, np.stack([X, Y, np.ones_like(X)], axis=2) @ camera.R))


def walk(count):
    """Return centres on a loop through the room, (count, 3)."""
    angle = 2 * np.pi * np.arange(count) / count
    x, y, z = 1.1 * np.sin(angle), -0.8 + 0.25 * np.sin(2 * angle + 0.5), 0.8 * np.cos(angle)
    return np.stack([x, y, z], axis=1)


def held_out(count=6, side=160):
    """Return pinhole cameras between the centres, looking around."""
    cameras = []
    for i in range(count):
        angle = 2 * np.pi * (i + 0.4) / count
        eye = np.array([0.8 * np.sin(angle), -0.7, 0.6 * np.cos(angle)])
        target = eye + np.array([np.sin(2.3 * angle), 0.15 * np.sin(5 * angle), np.cos(2.3 * angle)])
        focal = side / 2 / np.tan(np.radians(35))
        middle = (side - 1) / 2
        cameras.append(Camera(look_at(eye, target), eye, focal, focal, middle, middle, side, side))
    return cameras
