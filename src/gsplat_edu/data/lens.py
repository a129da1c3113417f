"""How a camera of a capture bends light, and how a photo is made as a pinhole would have taken it.

Formats put the centre of the first pixel at (0.5, 0.5); this project, like OpenCV, puts it at (0, 0). The half
pixel is subtracted in `lens_of` and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from gsplat_edu.errors import DatasetError

PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of a perspective lens in OpenCV's order; k4 to k6 stand below the fraction line."""

FISHEYE = ("k1", "k2", "k3", "k4")
"""Coefficients of a fisheye lens in OpenCV's order: theta (1 + k1 theta² + k2 theta⁴ + ...)."""

MAX_SIDE = 2**20
"""Longest side of a photo that is believed, px: a larger number is a corrupt file."""

FOCAL_RANGE = 20.0
"""How many times longer or shorter undistortion may make the focal length. Beyond that the coefficients fold the
image over itself, or the lens sees half a turn, which no pinhole does."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera, with its distortion.

    Args:
        W: Image width, px.
        H: Image height, px.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px; pixel centres are whole numbers.
        cy: Row of the principal point, px.
        coefficients: In the order of `PERSPECTIVE` or `FISHEYE`; later ones that are missing are zero.
        fisheye: Whether the image radius goes by the angle, not by its tangent.

    Raises:
        DatasetError: a size or focal length is not positive, or a number is NaN or infinite.
    """

    W: int
    H: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()
    fisheye: bool = False

    def __post_init__(self) -> None:
        if not (1 <= self.W <= MAX_SIDE and 1 <= self.H <= MAX_SIDE):
            raise DatasetError(f"size {self.W}x{self.H} is no image size")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(value := getattr(self, name)) or abs(value) > 1e12:
                raise DatasetError(f"{name} is {value}, but has to be finite")
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise DatasetError(f"focal length {name} is {getattr(self, name):g}, but has to be positive")
        if not all(math.isfinite(c) for c in self.coefficients):
            raise DatasetError(f"distortion {self.coefficients} is not finite")

    @property
    def distorts(self) -> bool:
        """Whether this is anything but a pinhole. A fisheye is, even where its coefficients are zero."""
        return self.fisheye or any(self.coefficients)

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """(3, 3) intrinsics, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, W: int, H: int) -> Lens:
        """Return the lens of the same photo at another size.

        c' = (c + 1/2) s - 1/2,  f' = f s,  s = new size / old size, each axis its own: the image's edge, not
        the centre of its first pixel, is what stays in place.

        Args:
            W: New width, px.
            H: New height, px.
        """
        sx, sy = W / self.W, H / self.H
        return replace(
            self,
            W=W,
            H=H,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


def lens_of(values: Mapping[str, float], W: int, H: int, *, fisheye: bool = False) -> Lens:
    """Make a lens from what a file says, whose first pixel has its centre at (0.5, 0.5).

    Args:
        values: fx, fy, cx, cy in px, and any of k1 to k6, p1, p2.
        W: Image width, px.
        H: Image height, px.
        fisheye: Whether the coefficients are those of a fisheye lens.

    Raises:
        DatasetError: as for `Lens`; the caller adds which file and camera.
    """
    names = FISHEYE if fisheye else PERSPECTIVE
    coefficients = tuple(float(values.get(name, 0.0)) for name in names)
    return Lens(
        W, H, values["fx"], values["fy"], values["cx"] - 0.5, values["cy"] - 0.5, coefficients, fisheye
    )


@lru_cache(maxsize=4096)
def straightened(lens: Lens) -> Lens:
    """Return the pinhole that shows as much of the photo as it can without showing what lies outside of it.

    Args:
        lens: The camera as it was; returned as it is where it is a pinhole.

    Returns:
        A lens of the same size that does not distort.

    Raises:
        DatasetError: no such pinhole has a sensible focal length.
    """
    if not lens.distorts:
        return replace(lens, coefficients=())
    size, coefficients = (lens.W, lens.H), _padded(lens)
    try:
        if lens.fisheye:
            K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                lens.K, coefficients, size, np.eye(3), balance=0.0
            )
        else:
            K = cv2.getOptimalNewCameraMatrix(lens.K, coefficients, size, 0.0)[0]
    except cv2.error:
        K = np.full((3, 3), np.nan)
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    sensible = min(size) > 1 and all(
        1 / FOCAL_RANGE < new / old < FOCAL_RANGE for new, old in ((fx, lens.fx), (fy, lens.fy))
    )
    if not sensible or not math.isfinite(cx + cy):
        raise DatasetError(
            f"distortion {lens.coefficients} at focal length {lens.fx:g} px cannot be undone in a pinhole image; "
            "undistort the capture with a tool made for wide lenses, such as `colmap image_undistorter`"
        )
    return Lens(lens.W, lens.H, fx, fy, cx, cy)


class Maps(NamedTuple):
    """Where each pixel of the straightened photo lies in the photo as it was taken."""

    columns: Float32[np.ndarray, "H W"]  # px
    rows: Float32[np.ndarray, "H W"]  # px
    valid: Bool[np.ndarray, "H W"] | None  # false where there is no such place; None where there always is


@lru_cache(maxsize=4)
def undistortion(lens: Lens) -> Maps:
    """Return the maps that turn a photo of `lens` into one of `straightened(lens)`.

    A pixel is valid where its place lies within the photo's edges, half a pixel beyond the outermost centres, and
    where the image is not folded: beyond the radius at which a polynomial turns round, it shows the same again
    mirrored.

    Raises:
        DatasetError: no pixel is valid.
    """
    K, size = straightened(lens).K, (lens.W, lens.H)
    coefficients = _padded(lens)
    make = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    u, v = make(lens.K, coefficients, np.eye(3), K, size, cv2.CV_32FC1)
    valid = (u >= -0.5) & (u <= lens.W - 0.5) & (v >= -0.5) & (v <= lens.H - 0.5)
    u_y, u_x = np.gradient(u)
    v_y, v_x = np.gradient(v)
    valid &= u_x * v_y - u_y * v_x > 0
    x, y = np.arange(lens.W) - K[0, 2], np.arange(lens.H)[:, None] - K[1, 2]
    # Tangential distortion may shift the centre itself by a few pixels; a fold lies much farther out.
    valid &= ((u - lens.cx) * x + (v - lens.cy) * y > 0) | (x * x + y * y < 0.01 * (lens.W**2 + lens.H**2))
    if not valid.any():
        raise DatasetError(
            f"distortion {lens.coefficients} leaves no pixel of the photo; check the calibration"
        )
    return Maps(u, v, None if valid.all() else valid)


def _padded(lens: Lens) -> Float64[np.ndarray, " c"]:
    """Return as many coefficients as OpenCV wants."""
    missing = len(FISHEYE if lens.fisheye else PERSPECTIVE) - len(lens.coefficients)
    return np.array([*lens.coefficients, *[0.0] * missing])
