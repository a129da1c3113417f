"""Colours of the house in a garden: brick, roof tiles, leaves, grass, panes that mirror the sky, clouds and hills."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8

Directions = Float[np.ndarray, "3 N"]
"""Points, directions or colours; components are the first axis, because NumPy reduces a short last axis slowly."""

Values = Float[np.ndarray, " N"]

MATERIALS = (
    "sky", "grass", "brick", "roof", "chimney", "wood", "leaves", "maple", "spruce", "fence", "glass"
)  # fmt: skip
"""What a pixel can show."""

SUN = np.array([0.45, -0.72, 0.53]) / np.linalg.norm([0.45, -0.72, 0.53])
"""Unit direction towards the sun."""

TILE, TEXELS = 512, 128
"""Side of the texture of noise, texels, and texels per world unit."""

PLAIN = {"wood": (0.42, 0.3, 0.19), "fence": (0.92, 0.9, 0.84), "chimney": (0.5, 0.26, 0.2)}
LEAVES = {"leaves": (0.26, 0.44, 0.13), "maple": (0.82, 0.42, 0.1), "spruce": (0.1, 0.28, 0.19)}

OPENINGS = {
    "front": ((-0.78, -0.38, 0.3, 0.65), (0.38, 0.78, 0.3, 0.65)),
    "back": ((-0.7, -0.3, 0.3, 0.65), (0.1, 0.55, 0.3, 0.65)),
    "gable": ((-0.42, -0.1, 0.3, 0.62), (0.1, 0.42, 0.3, 0.62), (-0.15, 0.15, 0.88, 1.14)),
}
"""Windows of each wall: left, right, lower and upper edge, world units."""

DOOR = (-0.16, 0.16, 0.0, 0.62)
"""The door of the front wall, in the same units."""


@functools.cache
def noise_tile() -> Float32[np.ndarray, "side side"]:
    """Return a texture of noise at all scales that repeats without a seam; mean 0, standard deviation 1."""
    rng, tile = np.random.default_rng(14), np.zeros((TILE, TILE), np.float32)
    for cells in (4, 8, 16, 32, 64, 128, 256):
        wrapped = np.pad(rng.normal(size=(cells, cells)).astype(np.float32), 2, mode="wrap")
        scale = TILE // cells
        side = scale * (cells + 4)
        tile += cv2.resize(wrapped, (side, side), interpolation=cv2.INTER_CUBIC)[
            2 * scale : -2 * scale, 2 * scale : -2 * scale
        ]
    return np.asarray((tile - tile.mean()) / tile.std(), np.float32)


def noise(u: Values, v: Values) -> Values:
    """Return noise at places of a surface, world units."""
    if not u.size:
        return np.zeros(0, np.float32)
    # OpenCV refuses rows of more than 32,767 pixels
    columns, rows = (
        np.resize(np.mod(TEXELS * w, TILE).astype(np.float32), (-(-w.size // 1024), 1024)) for w in (u, v)
    )
    found = cv2.remap(noise_tile(), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found.ravel()[: u.size])


def sky_colors(heading: Directions) -> Directions:
    """Return the colours of sky, clouds and hills.

    Args:
        heading: (3, N) unit vectors.
    """
    x, y, z = heading
    up = np.clip(-y, 0, 1)
    color = _mix(_column(0.85, 0.9, 0.95), _column(0.27, 0.5, 0.86), np.sqrt(np.clip(1.6 * up, 0, 1)))
    flat = 0.35 / (up + 0.18)
    cover = np.clip(0.55 * noise(flat * x, flat * z) + 0.05, 0, 1)
    color = _mix(color, _column(0.98, 0.98, 0.98), 0.85 * cover)
    turn = np.arctan2(x, z)
    for height, ridge, paint_ in ((0.1, 3, (0.55, 0.66, 0.72)), (0.045, 5, (0.36, 0.48, 0.36))):
        crest = height * (1 + 0.35 * np.sin(ridge * turn + 1) + 0.25 * np.sin((2 * ridge + 1) * turn))
        wood = 1 + 0.08 * noise(2 * turn, 6 * up) * (height < 0.1)
        color = np.where(
            up < crest + 0.004 * noise(3 * turn, np.zeros_like(turn)), _column(*paint_) * wood, color
        )
    return np.asarray(color, np.float32)


def ground_colors(points: Directions, distance: Values, shadow: Callable[[Directions], Values]) -> Directions:
    """Return the colours of the ground: grass, flowers, a gravel path, shadows, and haze far away.

    Args:
        points: (3, N) on the ground, world units.
        distance: (N,) from the camera along its axis, world units.
        shadow: Returns 1 for points in shadow, else 0.
    """
    x, _, z = points
    fine, coarse = noise(x, z), noise(0.23 * x + 5, 0.23 * z)
    fade = 1 / (1 + (distance / 9) ** 2)
    grass = _mix(_column(0.32, 0.47, 0.16), _column(0.5, 0.52, 0.2), np.clip(0.4 + 0.3 * coarse, 0, 1))
    color = grass * (1 + 0.2 * fine * fade)
    spots = noise(2.1 * x + 3, 2.1 * z) * (noise(0.4 * x, 0.4 * z + 2) > 0.4) * (distance < 9)
    for sign, petal in ((1, (0.95, 0.9, 0.35)), (-1, (0.93, 0.88, 0.95))):
        color = np.where(sign * spots > 2.3, _column(*petal), color)
    wide = 0.24 + 0.03 * fine + 0.05 * (z > 1.9)
    path = (np.abs(x - 0.08 * np.sin(2 * z)) < wide) & (z > 0.6)
    color = np.where(path, _column(0.72, 0.66, 0.55) * (1 + 0.16 * noise(1.7 * x, 1.7 * z) * fade), color)
    color = color * (1 - 0.5 * shadow(points))
    haze = 1 - np.exp(-((distance / 26) ** 2))
    return np.asarray(_mix(color, _column(0.5, 0.6, 0.52), haze), np.float32)


def paint(
    material: int, points: Directions, normals: Directions, heading: Directions
) -> tuple[Directions, Int8[np.ndarray, " N"]]:
    """Return the colours of points on a solid, and what each shows; a wall has panes.

    Args:
        material: Index in `MATERIALS` of the solid.
        points: (3, N) on its surface, world units.
        normals: (3, N) outward unit normals.
        heading: (3, N) unit directions of the rays that hit the points.
    """
    name = MATERIALS[material]
    shown = np.full(points.shape[1], material, np.int8)
    light = 0.5 + 0.55 * np.clip(SUN.astype(np.float32) @ normals, 0, None)
    u, v = _surface(points, normals)
    if name == "brick":
        color, glass = _wall(points, normals, u)
        mirrored = heading - 2 * (heading * normals).sum(axis=0) * normals
        pane = 0.3 * _column(0.12, 0.15, 0.2) + 0.7 * sky_colors(mirrored)
        shown[glass] = MATERIALS.index("glass")
        return np.asarray(np.where(glass, pane, color * light), np.float32), shown
    if name == "roof":
        color = _courses(points[0], -points[1], (0.11, 0.06), (0.7, 0.27, 0.18), 0.16)
    elif name == "chimney":
        color = _courses(u, v, (0.09, 0.045), PLAIN[name], 0.12)
    elif name in LEAVES:
        rough = np.clip(noise(1.6 * u, 1.6 * v), -1.6, 1.6) + 0.5 * noise(5 * u + 1, 5 * v)
        light = light * np.clip(0.8 + 0.35 * (normals[1] < 0) * -normals[1], 0, None)
        color = _column(*LEAVES[name]) * (1.05 + 0.2 * rough)
    else:
        color = _column(*PLAIN[name]) * (1 + (0.05 if name == "fence" else 0.2) * noise(3 * u, 0.6 * v))
    return np.asarray(color * light, np.float32), shown


def _wall(points: Directions, normals: Directions, u: Values) -> tuple[Directions, Bool[np.ndarray, " N"]]:
    """Return the colours of the walls in full light, and where they have glass."""
    up = -points[1]
    color = _courses(u, up, (0.15, 0.07), (0.8, 0.6, 0.46), 0.1)
    color = color * np.where(up > 0.8, 1, 1 - 0.25 * np.clip((up - 0.68) / 0.12, 0, 1))  # below the eaves
    color = np.where(up < 0.08, _column(0.5, 0.48, 0.45) * (1 + 0.1 * noise(u, up)), color)
    facing = np.where(np.abs(normals[0]) > 0.5, 2, np.where(normals[2] > 0, 0, 1))
    glass = np.zeros(len(u), bool)
    for wall, openings in enumerate(OPENINGS.values()):
        for edges in openings:
            left, right, low, high = edges
            framed = (facing == wall) & _within(u, up, edges, 0.0)
            color = np.where(framed, _column(0.95, 0.94, 0.9), color)
            bars = (np.abs(u - (left + right) / 2) < 0.011) | (np.abs(up - (low + high) / 2) < 0.011)
            glass |= framed & _within(u, up, edges, 0.028) & ~bars
    door = (facing == 0) & _within(u, up, DOOR, 0.0)
    panels = _column(0.16, 0.34, 0.4) * (1 + 0.12 * noise(2 * u, 0.5 * up))
    rim = ~_within(u, up, DOOR, 0.03)
    color = np.where(door, np.where(rim, _column(0.93, 0.92, 0.88), panels), color)
    knob = door & ((u - 0.09) ** 2 + (up - 0.3) ** 2 < 0.018**2)
    return np.where(knob, _column(0.95, 0.8, 0.3), color), glass


def _within(u: Values, v: Values, edges: tuple[float, ...], margin: float) -> Bool[np.ndarray, " N"]:
    left, right, low, high = edges
    return (u > left + margin) & (u < right - margin) & (v > low + margin * (low > 0)) & (v < high - margin)


def _courses(
    u: Values, v: Values, size: tuple[float, float], color: tuple[float, ...], varied: float
) -> Directions:
    """Return the colours of bricks or tiles in staggered rows; each has a shade of its own, joints are darker."""
    row = np.floor(v / size[1])
    along = u / size[0] + 0.5 * np.mod(row, 2)
    column = np.floor(along)
    own = np.sin(12.9898 * row + 78.233 * column) * 437.5453
    own = 2 * (own - np.floor(own)) - 1
    joint = (along - column < 0.08) | (v / size[1] - row < 0.14)
    shade = (1 + varied * own + 0.07 * noise(u, v)) * np.where(joint, 0.76, 1)
    return np.asarray(_column(*color) * shade * (1 + _column(0.0, 0.12, 0.2) * varied * own))


def _surface(points: Directions, normals: Directions) -> tuple[Values, Values]:
    """Return two coordinates along a surface, by the axis that its normal is closest to."""
    x, y, z = points
    most = np.abs(normals).argmax(axis=0)
    return np.where(most == 0, z, x), np.where(most == 1, z, -y)


def _mix(one: Float32[np.ndarray, "3 #N"], other: Float32[np.ndarray, "3 #N"], share: Values) -> Directions:
    return np.asarray(one + (other - one) * share)


def _column(*color: float) -> Float32[np.ndarray, "3 1"]:
    return np.array(color, np.float32)[:, None]
