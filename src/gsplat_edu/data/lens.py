"""Lens models of captured cameras, and the conversion of photos to pinhole images.

Capture formats place the centre of the first pixel at (0.5, 0.5). This project places it at (0, 0), as OpenCV does.
`lens_of` is the only place that subtracts the half pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsplat_edu.errors import DatasetError
from gsplat_edu.intrinsics import Intrinsics

PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of a perspective lens in OpenCV's order; k4 to k6 belong to the denominator."""

FISHEYE = ("k1", "k2", "k3", "k4")
"""Coefficients of a fisheye lens in OpenCV's order: theta (1 + k1 theta² + k2 theta⁴ + ...)."""

MAX_SIDE = 2**20
"""Longest plausible side of a photo, px; a larger number indicates a corrupt file."""

FOCAL_RANGE = 3.0
"""Largest factor by which undistortion may change the focal length. Beyond it, the coefficients fold the image, or the
pinhole would stretch the rim and blur the centre so much that the image is useless."""

MAX_ANGLE = math.radians(70.0)
"""Largest angle between the optical axis and the middle of an edge of the pinhole image, radians: a field of view of
140 degrees."""

MAX_REMAPPED = 32767
"""OpenCV resamples only photos with sides up to this, px."""

BAND = 128
"""Rows undistorted at a time: the maps of a whole photo would need more memory than the photo."""

FOLD_GRID = 128
"""Points along the longer side of the grid used to detect folds."""


@dataclass(frozen=True)
class Lens(Intrinsics):
    """Intrinsics of a camera, including distortion.

    Args:
        W: Image width, px.
        H: Image height, px.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px; pixel centres have integer coordinates.
        cy: Row of the principal point, px.
        coefficients: In the order of `PERSPECTIVE` or `FISHEYE`; missing trailing ones are zero.
        fisheye: Whether the image radius depends on the angle instead of its tangent.

    Raises:
        DatasetError: a size or focal length is not positive, or a number is NaN or infinite.
    """

    coefficients: tuple[float, ...] = ()
    fisheye: bool = False

    def __post_init__(self) -> None:
        if not (1 <= self.W <= MAX_SIDE and 1 <= self.H <= MAX_SIDE):
            raise DatasetError(f"size {self.W}x{self.H} is not a valid image size")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(value := getattr(self, name)) or abs(value) > 1e12:
                raise DatasetError(f"{name} is {value}, but must be finite")
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise DatasetError(f"focal length {name} is {getattr(self, name):g}, but must be positive")
        if not all(math.isfinite(c) for c in self.coefficients):
            raise DatasetError(f"distortion {self.coefficients} is not finite")

    @property
    def distorts(self) -> bool:
        """Whether this differs from a pinhole. A fisheye always does, even with zero coefficients."""
        return self.fisheye or any(self.coefficients)

    def undistorted(self) -> Intrinsics:
        """Return the pinhole of the undistorted photo, see `undistorted_pinhole`."""
        return undistorted_pinhole(self)


def lens_of(values: Mapping[str, float], W: int, H: int, *, fisheye: bool = False) -> Lens:
    """Make a lens from a file's intrinsics, in which the first pixel's centre is (0.5, 0.5).

    Args:
        values: fx, fy, cx, cy in px, and any of k1 to k6, p1, p2.
        W: Image width, px.
        H: Image height, px.
        fisheye: Whether the coefficients belong to a fisheye lens.

    Raises:
        DatasetError: as for `Lens`; the caller adds the file and the camera.
    """
    names = FISHEYE if fisheye else PERSPECTIVE
    coefficients = tuple(float(values.get(name, 0.0)) for name in names)
    return Lens(
        W, H, values["fx"], values["fy"], values["cx"] - 0.5, values["cy"] - 0.5, coefficients, fisheye
    )


@lru_cache(maxsize=4096)
def undistorted_pinhole(lens: Lens) -> Intrinsics:
    """Return the pinhole with the largest field of view that shows nothing outside the photo.

    OpenCV finds the largest rectangle of directions covered by the photo and stretches it over the image, each axis on
    its own. Here both focal lengths are multiplied by the larger of the two ratios instead, about the rectangle's
    middle: this keeps the shape of pixels and shows a part of the rectangle. OpenCV examines only points of the rim, so
    some pixels may still lie outside; `undistortion` marks them.

    Args:
        lens: The original camera.

    Returns:
        Intrinsics for the same size and with the same ratio of focal lengths; the lens's own if it does not distort.

    Raises:
        DatasetError: the photo is too large, or no such pinhole has a plausible focal length and field of view.
    """
    if not lens.distorts:
        return Intrinsics(lens.W, lens.H, lens.fx, lens.fy, lens.cx, lens.cy)
    size, coefficients = (lens.W, lens.H), _padded(lens)
    if max(size) >= MAX_REMAPPED:
        reason = (
            f"a photo of {lens.W}x{lens.H} px cannot be undistorted here, only sides below {MAX_REMAPPED} px"
        )
        raise DatasetError(
            f"{reason}; undistort it with `colmap image_undistorter`, or make it smaller", reason
        )
    try:
        if lens.fisheye:
            K = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                lens.K, coefficients, size, np.eye(3), balance=0.0
            )
        else:
            K = cv2.getOptimalNewCameraMatrix(lens.K, coefficients, size, 0.0)[0]
    except cv2.error:
        K = np.full((3, 3), np.nan)
    ratio = max(K[0, 0] / lens.fx, K[1, 1] / lens.fy)
    found = min(size) > 1 and bool(np.isfinite(K).all()) and min(K[0, 0], K[1, 1]) > 0
    if not found:
        raise _not_a_pinhole(lens, "the photo covers no rectangle of directions")
    if not 1 / FOCAL_RANGE < ratio < FOCAL_RANGE:
        raise _not_a_pinhole(lens, f"the focal length would change {ratio:.3g}-fold")
    fx, fy = ratio * lens.fx, ratio * lens.fy
    middle_x, middle_y = (lens.W - 1) / 2, (lens.H - 1) / 2
    cx = middle_x - (middle_x - K[0, 2]) * fx / K[0, 0]
    cy = middle_y - (middle_y - K[1, 2]) * fy / K[1, 1]
    slope = max(
        max(abs(c + 0.5), abs(side - 0.5 - c)) / f for c, f, side in ((cx, fx, lens.W), (cy, fy, lens.H))
    )
    if (angle := math.atan(slope)) > MAX_ANGLE:
        raise _not_a_pinhole(lens, f"it would look {math.degrees(angle):.0f} degrees to the side")
    return Intrinsics(lens.W, lens.H, float(fx), float(fy), float(cx), float(cy))


def _not_a_pinhole(lens: Lens, why: str) -> DatasetError:
    return DatasetError(
        f"distortion {lens.coefficients} at focal length {lens.fx:g} px cannot be undone in a pinhole image: {why}; "
        "check the calibration, or undistort the capture with a tool made for wide lenses, such as "
        "`colmap image_undistorter`",
        why,
    )


class Maps(NamedTuple):
    """For each pixel in some rows of the undistorted photo, its position in the original photo."""

    columns: Float32[np.ndarray, "h W"]  # px
    rows: Float32[np.ndarray, "h W"]  # px
    valid: Bool[np.ndarray, "h W"]  # false if there is no such position


def bands(H: int) -> Iterator[slice]:
    """Divide the rows of a photo into bands that are undistorted one at a time."""
    return (slice(top, min(top + BAND, H)) for top in range(0, H, BAND))


def undistortion(lens: Lens, band: slice) -> Maps:
    """Return the maps from some rows of `lens.undistorted()` to a photo of `lens`.

    A pixel is valid if its position lies within the photo's edges (half a pixel beyond the outermost pixel centres) and
    the image is not folded there.

    Args:
        lens: The original camera.
        band: The rows.

    Raises:
        DatasetError: as for `undistorted_pinhole`, or no pixel of the photo remains.
    """
    pinhole, unfolded = lens.undistorted(), _unfolded(lens)
    h = band.stop - band.start
    u, v = _maps(lens, replace(pinhole, H=h, cy=pinhole.cy - band.start))
    valid = (u >= -0.5) & (u <= lens.W - 0.5) & (v >= -0.5) & (v <= lens.H - 0.5)
    if unfolded is not None:
        # Pixel centres of the grid, as in `Intrinsics.scaled`. Between valid and invalid grid points nothing is valid.
        x = (np.arange(lens.W, dtype=np.float32) + 0.5) * (unfolded.shape[1] / lens.W) - 0.5
        y = (np.arange(band.start, band.stop, dtype=np.float32) + 0.5) * (unfolded.shape[0] / lens.H) - 0.5
        X, Y = np.meshgrid(x, y)
        valid &= cv2.remap(unfolded, X, Y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 255
    return Maps(u, v, valid)


@lru_cache(maxsize=4096)
def _unfolded(lens: Lens) -> UInt8[np.ndarray, "h w"] | None:
    """Detect folds on a coarse grid; return 255 where the image is not folded, or None if it is folded nowhere.

    Beyond the radius where the polynomial turns back, the formula repeats the image, mirrored: there the map's Jacobian
        determinant is negative, or the position lies on the other side of the principal point.

    Raises:
        DatasetError: no pixel of the photo remains.
    """
    scale = min(1.0, FOLD_GRID / max(lens.W, lens.H))
    w, h = max(2, round(scale * lens.W)), max(2, round(scale * lens.H))
    small, pinhole = lens.scaled(w, h), lens.undistorted().scaled(w, h)
    u, v = (plane.astype(np.float64) for plane in _maps(small, pinhole))
    u_y, u_x = np.gradient(u)
    v_y, v_x = np.gradient(v)
    good = u_x * v_y - u_y * v_x > 0
    x, y = np.arange(w) - pinhole.cx, np.arange(h)[:, None] - pinhole.cy
    # Tangential distortion may shift the centre itself by a few pixels; a fold lies much farther out.
    good &= ((u - small.cx) * x + (v - small.cy) * y > 0) | (x * x + y * y < 0.01 * (w * w + h * h))
    if not (good & (u > -1.0) & (u < w) & (v > -1.0) & (v < h)).any():
        raise _not_a_pinhole(lens, "it leaves no pixel of the photo")
    return None if good.all() else np.where(good, 255, 0).astype(np.uint8)


def _maps(lens: Lens, pinhole: Intrinsics) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the column and row in a photo of `lens`, px, for each pixel of an image of `pinhole`."""
    make = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    u, v = make(lens.K, _padded(lens), np.eye(3), pinhole.K, (pinhole.W, pinhole.H), cv2.CV_32FC1)
    return u, v


def _padded(lens: Lens) -> Float64[np.ndarray, " c"]:
    """Pad the coefficients to the number that OpenCV expects."""
    missing = len(FISHEYE if lens.fisheye else PERSPECTIVE) - len(lens.coefficients)
    return np.array([*lens.coefficients, *[0.0] * missing])
