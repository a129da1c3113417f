"""Ray-traced captures through other lenses than a pinhole's, and by cameras that move while they are read.

Every capture comes with photos from the same poses by a pinhole at rest, to compare with. No photo is resampled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from gsplat_edu.base.validation import one_of, whole_number
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import PINHOLE, Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from gsplat_edu.scene.views import View
from lab.captures.garden import GARDEN_TARGET, garden_camera, photograph_garden
from lab.captures.solids import solids
from lab.captures.solids_photos import SOLIDS_TARGET, photograph_solids, solids_orbit

LENS_KINDS = ("fisheye", "panorama", "shutter_20", "shutter_40", "blur_8")
"""The kinds of cameras: a fisheye of 180 degrees, a whole sphere, pinholes that move during the readout, by 20 or 40 px
at the image's middle, and pinholes with a global shutter that move by 8 px during the exposure."""

SUB_EXPOSURES = 16
"""Photos of a moment that make up a blurred one."""

FISHEYE_SEES = math.radians(90.0)
"""Largest angle to the optical axis of the fisheye, radians: beyond, its photos are black."""

SHIFTED = 0.25
"""Fraction of the target's motion on the image that the camera's shift makes; its turn makes the rest."""

NEARER = 0.6
"""Distance of fisheyes and panoramas from the target, in those of the pinholes. They see more, so objects are smaller
in their images."""

ROLL = 0.3
"""Standard deviation of the turn about the optical axis, as a fraction of that across it."""

START_NOISE = 0.01
"""Standard deviation of the start points around the surface along each axis, world units."""


class TracedPhoto(NamedTuple):
    """A photo and the surface that it shows."""

    image: UInt8[np.ndarray, "H W 3"]  # RGB
    points: Float64[np.ndarray, "H W 3"]  # where one ray of each pixel ends, world units; NaN if nowhere


class LensScene(NamedTuple):
    """A scene that can be photographed by any camera."""

    target: Float64[np.ndarray, "3"]  # where its cameras look, world units
    cameras: Callable[
        [int, tuple[int, int]], list[Camera]
    ]  # pinholes: a number of them, and their width and height
    photograph: Callable[[Camera], TracedPhoto]


class LensCapture(NamedTuple):
    """Photos through a lens or a moving camera, and photos from the same poses by a pinhole at rest.

    Views whose lens does not reach every pixel have a mask, true where there is a ray.
    """

    views: list[View]
    pinholes: list[View]
    points: Float64[np.ndarray, "N 3"]  # noisy points of the surface that the views show, world units
    colors: Float64[np.ndarray, "N 3"]  # the colours of their pixels, 0 to 1


def _garden_cameras(count: int, size: tuple[int, int]) -> list[Camera]:
    angles = 2 * math.pi * np.arange(count) / count
    return [garden_camera(float(angle), 0.3 + 0.15 * math.sin(3 * angle), size) for angle in angles]


def _garden_photo(camera: Camera) -> TracedPhoto:
    photo = photograph_garden(camera)
    return TracedPhoto(photo.image, photo.points.astype(np.float64))


def _solids_photo(camera: Camera) -> TracedPhoto:
    photo = photograph_solids(solids(True), camera)
    points = camera.origins() + photo.depth[..., None] * camera.rays()
    return TracedPhoto(photo.image, np.where((photo.part >= 0)[..., None], points, np.nan))


LENS_SCENES = {
    "garden": LensScene(GARDEN_TARGET, _garden_cameras, _garden_photo),
    "solids": LensScene(SOLIDS_TARGET, solids_orbit, _solids_photo),
}
"""The scenes by name. The garden surrounds its cameras, so it suits wide lenses."""


def lens_capture(
    kind: str, scene: str = "garden", size: int = 320, count: int = 24, start: int = 4_000, seed: int = 0
) -> LensCapture:
    """Photograph a scene by cameras of a kind, on a ring around it.

    Args:
        kind: One of `LENS_KINDS`.
        scene: A name in `LENS_SCENES`.
        size: Width of the photos, px. Their height is that of a fisheye, half that of a panorama, three quarters that
            of a pinhole.
        count: Number of photos.
        start: Number of start points.
        seed: Seed of start points and motions.

    Raises:
        ArgumentError: the kind or the scene is unknown, or a number is out of range.
    """
    one_of("kind", kind, LENS_KINDS)
    one_of("scene", scene, list(LENS_SCENES))
    place, W = LENS_SCENES[scene], whole_number("size", size, 8)
    pinholes = place.cameras(whole_number("count", count, 1), (W, round(0.75 * W)))
    rng = np.random.default_rng(whole_number("seed", seed, 0))
    if kind in ("fisheye", "panorama"):
        pinholes = [nearer(camera, place.target) for camera in pinholes]
    if kind == "fisheye":
        cameras = [fisheye_180(camera, W) for camera in pinholes]
    elif kind == "panorama":
        cameras = [Camera.panorama(camera.R, camera.eye, max(1, W // 2), W) for camera in pinholes]
    else:
        pixels = float(kind.partition("_")[2])
        cameras = [shaken(camera, pixels, place.target, rng) for camera in pinholes]
        if kind.startswith("blur"):
            cameras = [exposed(camera) for camera in cameras]
    return lens_photos(scene, cameras, pinholes, whole_number("start", start, 1), rng)


def lens_photos(
    scene: str, cameras: Sequence[Camera], pinholes: Sequence[Camera], start: int, rng: np.random.Generator
) -> LensCapture:
    """Photograph a scene by given cameras, of any projection and each with its own shutter.

    Args:
        scene: A name in `LENS_SCENES`.
        cameras: The cameras.
        pinholes: Pinholes at rest, as many.
        start: Number of start points.
        rng: Draws the start points.

    Raises:
        ArgumentError: the scene is unknown.
    """
    one_of("scene", scene, list(LENS_SCENES))
    photograph = LENS_SCENES[scene].photograph
    views, points, colors = [], [], []
    for i, camera in enumerate(cameras):
        photo, there = blurred_photo(photograph, camera), with_rays(camera)
        image = np.where(there[..., None], photo.image, 0).astype(np.uint8)
        mask = None if there.all() else there
        views.append(View(camera, image, mask=mask, name=f"view_{i:03d}.png"))
        shown = there & np.isfinite(photo.points[..., 0])
        points.append(photo.points[shown])
        colors.append(image[shown] / 255.0)
    plain = [
        View(camera, photograph(camera).image, name=f"view_{i:03d}.png") for i, camera in enumerate(pinholes)
    ]
    surface, shades = np.concatenate(points), np.concatenate(colors)
    chosen = rng.integers(0, len(surface), start)
    noisy = surface[chosen] + START_NOISE * rng.normal(size=(start, 3))
    return LensCapture(views, plain, noisy, shades[chosen])


def blurred_photo(photograph: Callable[[Camera], TracedPhoto], camera: Camera) -> TracedPhoto:
    """Photograph a scene by a camera that may have an exposure: the average of photos of a moment, in linear light.

    Args:
        photograph: Takes a photo of a moment.
        camera: The camera.

    Returns:
        The photo, and the surface in the middle of the exposure.
    """
    middle = photograph(camera)
    if (shutter := camera.shutter) is None or not shutter.exposure:
        return middle
    total = np.zeros(middle.image.shape)
    for k in range(SUB_EXPOSURES):
        time = shutter.exposure * ((k + 0.5) / SUB_EXPOSURES - 0.5)
        R, eye = shutter.rotation(time) @ camera.R, camera.eye + time * shutter.shift
        moment = RollingShutter(shutter.turn, shutter.shift, shutter.readout)
        total += linear_light(photograph(Camera.posed(R, eye, camera.intrinsics, moment)).image)
    return TracedPhoto(as_srgb(total / SUB_EXPOSURES), middle.points)


def linear_light(image: UInt8[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "H W 3"]:
    """Return the light of sRGB values, 0 to 1.

    Args:
        image: (H, W, 3) sRGB.
    """
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.asarray(light[image])


def as_srgb(light: Float64[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Return the sRGB values of light; the inverse of `linear_light`.

    Args:
        light: (H, W, 3), 0 to 1.
    """
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * value), dtype=np.uint8)


def with_rays(camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Return which pixels have a ray: of a fisheye, those up to `FISHEYE_SEES`.

    Args:
        camera: The camera.
    """
    rays = camera.rays()
    there = np.isfinite(rays).all(axis=-1)
    if camera.projection.kind == "fisheye":
        still = (
            camera.through(camera.projection).rays() @ camera.R.T
        )  # in the camera's axes when a pixel is read
        there &= np.nan_to_num(still[..., 2], nan=-1.0) >= math.cos(FISHEYE_SEES)
    return np.asarray(there)


def nearer(camera: Camera, target: Float64[np.ndarray, "3"]) -> Camera:
    """Return a camera at `NEARER` times its distance from the target.

    Args:
        camera: The camera.
        target: (3,) world units.
    """
    return Camera.posed(camera.R, target + NEARER * (camera.eye - target), camera.intrinsics, camera.shutter)


def fisheye_180(camera: Camera, size: int) -> Camera:
    """Return an equidistant fisheye in the pose of a camera, whose circle of 180 degrees fills a square image.

    Args:
        camera: The camera.
        size: Side of the image, px.
    """
    focal, middle = size / math.pi, (size - 1) / 2
    square = Camera(camera.R, camera.eye, focal, focal, middle, middle, size, size)
    return square.through(Projection("fisheye"))


def shaken(
    camera: Camera, pixels: float, target: Float64[np.ndarray, "3"], rng: np.random.Generator
) -> Camera:
    """Return a camera with a rolling shutter, during whose readout a point at the image's middle moves.

    Args:
        camera: A camera at rest, whose focal lengths are equal.
        pixels: How far the point moves, px.
        target: (3,) world units; its distance is that of the point.
        rng: Draws the direction of the motion, and the roll.
    """
    direction = rng.uniform(0, 2 * math.pi)
    across = np.array([math.cos(direction), math.sin(direction), 0.0])
    angle = pixels / camera.fx
    # a turn by w moves (0, 0, 1) by w x (0, 0, 1) = (w_y, -w_x, 0), and a shift by V moves it by -R V
    turn = (1 - SHIFTED) * angle * np.array([-across[1], across[0], ROLL * rng.normal()])
    shift = -SHIFTED * angle * float(np.linalg.norm(target - camera.eye)) * (across @ camera.R)
    return camera.through(PINHOLE, RollingShutter(turn, shift, "down"))


def exposed(camera: Camera) -> Camera:
    """Return a camera that exposes all rows at once, for the time in which a rolling shutter reads them.

    Args:
        camera: A camera with a rolling shutter.
    """
    assert camera.shutter is not None
    shutter = RollingShutter(camera.shutter.turn, camera.shutter.shift, AT_ONCE, 1.0)
    return camera.through(camera.projection, shutter)
