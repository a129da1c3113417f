"""Clean captures that tests plant faults in: a textured room, ray traced from cameras in several layouts."""

import functools
import math

import numpy as np
from scipy.ndimage import map_coordinates

from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View

WALL = 5.0
"""Half the edge of the room."""

BALL = 0.9
"""Radius of the ball in the middle of the room."""

OCTAVES = 8
"""Octaves of the texture; their cells have sizes from 1 down to 1/128, finer than a pixel."""

COUNT = 24
"""Default number of views."""


@functools.cache
def noise():
    """Return random numbers on a periodic lattice, one channel for grey and three for colours."""
    return np.random.default_rng(0).normal(size=(4, 32, 32, 32)).astype(np.float32)


def texture(points, footprint):
    """Return the colour of points in space: octaves of noise whose amplitude falls slowly with scale, as on real
    surfaces.

    Detail finer than what a pixel covers (`footprint`, world units) is smoothed away, as a lens does.
    """
    gray, *hues = noise()
    light, color = np.zeros(len(points)), np.zeros((3, len(points)))
    for octave in range(OCTAVES):
        cell = 0.5**octave
        height = cell**0.3 * np.exp(-0.5 * (1.5 * footprint / cell) ** 2)
        where = (points / cell + 7.3 * octave).T
        light += height * map_coordinates(gray, where, order=1, mode="grid-wrap")
        if octave < 4:
            color += height * [map_coordinates(hue, where, order=1, mode="grid-wrap") for hue in hues]
    return np.clip(0.5 + 0.18 * light + 0.05 * color, 0.05, 0.95).T


def cast(eye, directions, ball, radius=BALL):
    """Return where rays from a point inside the room hit the ball, if there is one, or a wall."""
    with np.errstate(divide="ignore"):
        reach = np.min((WALL * np.sign(directions) - eye) / directions, axis=1)
    if ball:
        along, apart = directions @ eye, eye @ eye - radius**2
        root = along**2 - apart
        hit = -along - np.sqrt(np.maximum(root, 0.0))
        reach = np.where((root > 0) & (hit > 0), hit, reach)
    return eye + reach[:, None] * directions


def rays(camera):
    u, v = np.meshgrid(np.arange(camera.W), np.arange(camera.H))
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    directions = local.reshape(-1, 3) @ camera.R
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def camera_at(eye, target, size, height=None):
    height = height or round(0.75 * size)
    focal = 0.9 * max(size, height)
    return Camera(look_at(eye, target), eye, focal, focal, (size - 1) / 2, (height - 1) / 2, height, size)


def placed(layout, i, count):
    """Return where camera i stands, and a point it looks at."""
    turn = 2 * math.pi * i / count
    if layout == "orbit":
        return np.array([3 * math.sin(turn), -0.4 - 0.6 * math.sin(2 * turn), -3 * math.cos(turn)]), np.zeros(
            3
        )
    if layout == "forward":
        across = np.array([(i % 6 - 2.5) * 0.35, (i // 6 - 1.5) * 0.35, -3.0])
        return across, across * (0.7, 0.7, 0.0) + (0.0, 0.0, 2.0)
    if layout == "outward":
        out = np.array([math.sin(turn), 0.3 * math.sin(3 * turn), math.cos(turn)])
        return 0.8 * out, 3 * out
    return np.array([4.0 * i / count - 2.0, 0.0, -3.0 + 0.2 * math.sin(turn)]), np.array(
        [5 * i / count - 2.5, 0.0, 3.0]
    )


@functools.cache
def room(layout="orbit", size=160, count=COUNT, height=None, ending="bmp"):
    """Photograph the ball from all sides, one wall, or the whole room from its middle.

    Files named .bmp are written and read fastest.
    """
    ball = layout in ("orbit", "forward")
    views, points = [], []
    rng = np.random.default_rng(1)
    for i in range(count):
        camera = camera_at(*placed(layout, i, count), size, height)
        ends = cast(camera.eye, rays(camera), ball)
        footprint = np.linalg.norm(ends - camera.eye, axis=1) / camera.fx
        image = np.round(255.0 * texture(ends, footprint)).astype(np.uint8).reshape(camera.H, camera.W, 3)
        views.append(View(camera, image, name=f"view_{i:03d}.{ending}"))
        points.append(ends[rng.choice(len(ends), 60)] + 0.01 * rng.normal(size=(60, 3)))
    return views, np.concatenate(points)


def turned(view, degrees):
    """Return the view with its camera turned about the camera's vertical axis, and the same photo."""
    a = math.radians(degrees)
    R = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]]) @ view.camera.R
    return with_camera(view, R=R)


def with_camera(view, **changes):
    """Return the view with other camera parameters and the same photo."""
    camera = view.camera
    names = ("R", "eye", "fx", "fy", "cx", "cy", "H", "W")
    return View(Camera(**{**{n: getattr(camera, n) for n in names}, **changes}), view.image, name=view.name)


def with_photo(view, image):
    """Return the view with another photo."""
    return View(view.camera, np.clip(np.round(image), 0, 255).astype(np.uint8), name=view.name)


def replaced(views, changed):
    """Return views with some of them changed, by index."""
    return [changed.get(i, view) for i, view in enumerate(views)]
