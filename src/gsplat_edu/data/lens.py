"""How a camera of a capture bends light, and how a photo is made as a pinhole would have taken it.

Formats put the centre of the first pixel at (0.5, 0.5); this project, like OpenCV, puts it at (0, 0). The half
pixel is subtracted in `lens_of` and nowhere else.
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

from gsplat_edu.camera import scaled_intrinsics
from gsplat_edu.errors import DatasetError

PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of a perspective lens in OpenCV's order; k4 to k6 stand below the fraction line."""

FISHEYE = ("k1", "k2", "k3", "k4")
"""Coefficients of a fisheye lens in OpenCV's order: theta (1 + k1 theta² + k2 theta⁴ + ...)."""

MAX_SIDE = 2**20
"""Longest side of a photo that is believed, px: a larger number is a corrupt file."""

FOCAL_RANGE = 3.0
"""How many times longer or shorter undistortion may make the focal length. Beyond that the coefficients fold the
image over itself, or a pinhole would stretch its rim and blur its middle so much that it is of no use."""

MAX_ANGLE = math.radians(70.0)
"""Largest angle between the optical axis and what the middle of an edge of a pinhole image shows, radians: a field of
view of 140 degrees."""

MAX_REMAPPED = 32767
"""OpenCV resamples photos whose sides are below this, px."""

BAND = 128
"""Rows that are undistorted at a time: maps of a whole photo would take more memory than the photo."""

FOLD_GRID = 128
"""Points along the longer side of the grid on which folds are looked for."""


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
        """Return the lens of the same photo at another size, see `gsplat_edu.camera.scaled_intrinsics`.

        Args:
            W: New width, px.
            H: New height, px.
        """
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        fx, fy, cx, cy = scaled_intrinsics(*intrinsics, W / self.W, H / self.H)
        return replace(self, W=W, H=H, fx=fx, fy=fy, cx=cx, cy=cy)


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

    OpenCV finds the largest rectangle of directions that the photo covers, and stretches it over the image, each
    axis by itself. Both focal lengths are multiplied by the larger of the two ratios instead, about the middle of
    that rectangle: pixels keep their shape, and what is shown is a part of the rectangle. OpenCV looks at points
    of the rim only, so pixels that do lie outside are left to `undistortion`.

    Args:
        lens: The camera as it was; returned as it is where it is a pinhole.

    Returns:
        A lens of the same size, and the same ratio of the focal lengths, that does not distort.

    Raises:
        DatasetError: the photo is too large, or no such pinhole has a sensible focal length and field of view.
    """
    if not lens.distorts:
        return replace(lens, coefficients=())
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
    return Lens(lens.W, lens.H, float(fx), float(fy), float(cx), float(cy))


def _not_a_pinhole(lens: Lens, why: str) -> DatasetError:
    return DatasetError(
        f"distortion {lens.coefficients} at focal length {lens.fx:g} px cannot be undone in a pinhole image: {why}; "
        "check the calibration, or undistort the capture with a tool made for wide lenses, such as "
        "`colmap image_undistorter`",
        why,
    )


class Maps(NamedTuple):
    """Where each pixel of some rows of the straightened photo lies in the photo as it was taken."""

    columns: Float32[np.ndarray, "h W"]  # px
    rows: Float32[np.ndarray, "h W"]  # px
    valid: Bool[np.ndarray, "h W"]  # false where there is no such place


def bands(H: int) -> Iterator[slice]:
    """Divide the rows of a photo into those that are undistorted at a time."""
    return (slice(top, min(top + BAND, H)) for top in range(0, H, BAND))


def undistortion(lens: Lens, band: slice) -> Maps:
    """Return the maps that turn a photo of `lens` into some rows of one of `straightened(lens)`.

    A pixel is valid where its place lies within the photo's edges, half a pixel beyond the outermost centres, and
    where the image is not folded.

    Args:
        lens: The camera that took the photo.
        band: Which rows.

    Raises:
        DatasetError: as for `straightened`, or nothing of the photo is left.
    """
    pinhole, unfolded = straightened(lens), _unfolded(lens)
    h = band.stop - band.start
    u, v = _maps(lens, replace(pinhole, H=h, cy=pinhole.cy - band.start))
    valid = (u >= -0.5) & (u <= lens.W - 0.5) & (v >= -0.5) & (v <= lens.H - 0.5)
    if unfolded is not None:
        # Pixel centres of the grid, as `Lens.resized` has them. Between good and bad grid points nothing is valid.
        x = (np.arange(lens.W, dtype=np.float32) + 0.5) * (unfolded.shape[1] / lens.W) - 0.5
        y = (np.arange(band.start, band.stop, dtype=np.float32) + 0.5) * (unfolded.shape[0] / lens.H) - 0.5
        X, Y = np.meshgrid(x, y)
        valid &= cv2.remap(unfolded, X, Y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) == 255
    return Maps(u, v, valid)


@lru_cache(maxsize=4096)
def _unfolded(lens: Lens) -> UInt8[np.ndarray, "h w"] | None:
    """Look on a coarse grid for folds; return 255 where there is none, or nothing where there is none at all.

    Beyond the radius at which a polynomial turns round, the formula shows the same again, mirrored: the determinant
    of the map's slopes is negative there, or the place lies on the other side of the principal point.

    Raises:
        DatasetError: nothing of the photo is left.
    """
    scale = min(1.0, FOLD_GRID / max(lens.W, lens.H))
    w, h = max(2, round(scale * lens.W)), max(2, round(scale * lens.H))
    small, pinhole = lens.resized(w, h), straightened(lens).resized(w, h)
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


def _maps(lens: Lens, pinhole: Lens) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return column and row in a photo of `lens`, px, of each pixel of an image of `pinhole`."""
    make = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    u, v = make(lens.K, _padded(lens), np.eye(3), pinhole.K, (pinhole.W, pinhole.H), cv2.CV_32FC1)
    return u, v


def _padded(lens: Lens) -> Float64[np.ndarray, " c"]:
    """Return as many coefficients as OpenCV wants."""
    missing = len(FISHEYE if lens.fisheye else PERSPECTIVE) - len(lens.coefficients)
    return np.array([*lens.coefficients, *[0.0] * missing])
