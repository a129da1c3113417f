"""Which photos are trained through their own lens, and that lens as a projection.

A projection inside the renderer needs no undistorted copy of a photo: nothing is resampled, and nothing is cropped. The
renderer has the models of `projection_of`; photos of other models are undistorted.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.lens import Lens, undistorted_pinhole
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.panorama import PANORAMIC
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import Distortion, Projection

MOST_CROPPED = 0.1
"""Largest fraction of a photo's pixels that undistortion may crop before `auto` keeps the photo's own lens."""

RIM = 33
"""Points of each edge of a pinhole image that are examined to find its area in the photo."""

WIDEST_PANORAMA = 5024
"""Largest width of a panorama unless the user gives a size, px: that at which its faces would have 1,600 px, to a
multiple of a tile."""

RATIONAL = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "d1", "k5": "d2", "k6": "d3", "p1": "p1", "p2": "p2"}
"""Names of OpenCV's perspective coefficients in `gsplat_edu.scene.projection.COEFFICIENTS`."""

POLYNOMIAL = {"sx1": "s1", "sy1": "s3"}
"""The same of a thin prism, where the names differ."""

ARIA = {f"k{i}": f"k{i + 1}" for i in range(6)} | {
    "p0": "p2", "p1": "p1", "s0": "s1", "s1": "s2", "s2": "s3", "s3": "s4",
}  # fmt: skip
"""The same of the radial tangential prism fisheye."""


def projection_of(lens: Lens) -> Projection | None:
    """Return a lens as a projection of the renderer; None if the renderer does not have its model.

    Args:
        lens: The lens.
    """
    if lens.model == PANORAMIC:
        return Projection("equirectangular")
    kinds: dict[str, tuple[str, dict[str, str]]] = {
        "perspective": ("perspective", RATIONAL),
        "fisheye": ("fisheye", {}),
        "thin prism fisheye": ("fisheye", POLYNOMIAL),
        "radial tangential prism fisheye": ("fisheye", ARIA),
    }
    if lens.model not in kinds:
        return None
    kind, names = kinds[lens.model]
    values = {
        names.get(name, name): value
        for name, value in zip(FORMULAS[lens.model].names, lens.coefficients, strict=False)
    }
    distortion = Distortion.of(radial_first=names is ARIA, **values) if any(lens.coefficients) else None
    return Projection(kind, distortion)


def native_intrinsics(lens: Lens) -> Intrinsics | None:
    """Return a lens's intrinsics with its projection; None if the renderer does not have its model."""
    projection = projection_of(lens)
    if projection is None:
        return None
    fx, fy = lens.fx, lens.fy
    if projection.kind == "equirectangular":
        fx, fy = lens.W / (2.0 * np.pi), lens.H / np.pi
    return Intrinsics(lens.W, lens.H, fx, fy, lens.cx, lens.cy, projection=projection)


def is_native(lens: Lens, mode: str) -> bool:
    """Return whether a photo is trained through its own lens.

    Args:
        lens: Its lens.
        mode: "native", wherever the renderer has the model; "undistort", never; "auto": if the lens is a fisheye or a
            panorama, or undistortion would crop more than `MOST_CROPPED`.
    """
    if mode == "undistort" or not lens.distorts or projection_of(lens) is None:
        return False
    return mode == "native" or lens.wide or cropped_fraction(lens) > MOST_CROPPED


@lru_cache(maxsize=1024)
def cropped_fraction(lens: Lens) -> float:
    """Return the fraction of a photo's area that its undistorted pinhole image does not show.

    Args:
        lens: A perspective lens.
    """
    try:
        pinhole = undistorted_pinhole(lens)
    except DatasetError:
        return 1.0
    along = np.linspace(0.0, 1.0, RIM)[:-1]
    right, bottom = pinhole.W - 0.5, pinhole.H - 0.5
    u = np.concatenate(
        [along * pinhole.W - 0.5, 0 * along + right, right - along * pinhole.W, 0 * along - 0.5]
    )
    v = np.concatenate(
        [0 * along - 0.5, along * pinhole.H - 0.5, 0 * along + bottom, bottom - along * pinhole.H]
    )
    projection = projection_of(lens)
    if projection is None:
        return 1.0
    camera = Camera.posed(
        np.eye(3), np.zeros(3), Intrinsics(lens.W, lens.H, lens.fx, lens.fy, lens.cx, lens.cy)
    )
    rays = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones_like(u)], axis=1)
    x, y, _ = camera.through(projection).project(rays)
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    return 1.0 if not np.isfinite(area) else max(0.0, 1.0 - area / (lens.W * lens.H))


@lru_cache(maxsize=16)
def pixels_with_rays(intrinsics: Intrinsics) -> Bool[np.ndarray, "H W"] | None:
    """Return which pixels a lens has rays for; None if it has one for every pixel.

    Args:
        intrinsics: The lens at the photo's size.
    """
    camera = Camera.posed(np.eye(3), np.zeros(3), intrinsics)
    if _has_rays(camera, *_rim(camera)).all():  # what has rays is convex: if the rim has them, all pixels do
        return None
    columns = np.arange(camera.W, dtype=np.float64)
    found = np.stack([_has_rays(camera, columns, np.full(camera.W, float(v))) for v in range(camera.H)])
    found.flags.writeable = False
    return found


def _rim(camera: Camera) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    u, v = np.arange(camera.W, dtype=np.float64), np.arange(camera.H, dtype=np.float64)
    columns = np.concatenate([u, u, 0 * v, 0 * v + camera.W - 1])
    rows = np.concatenate([0 * u, 0 * u + camera.H - 1, v, v])
    return columns, rows


def _has_rays(
    camera: Camera, u: Float64[np.ndarray, " n"], v: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    rays = camera.projection.directions(
        (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, camera.widest
    )
    return np.asarray(np.isfinite(rays).all(axis=-1))
