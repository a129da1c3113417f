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

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.lens_formulas import FORMULAS, Plane
from gsplat_edu.scene.intrinsics import Intrinsics

PINHOLE_LIKE, FISHEYE = "perspective", "fisheye"
"""Two names of `gsplat_edu.data.lens_formulas.FORMULAS`."""

OPENCV = (PINHOLE_LIKE, FISHEYE)
"""The models whose maps OpenCV computes."""

MAX_SIDE = 2**20
"""Longest plausible side of a photo, px; a larger number indicates a corrupt file."""

FOCAL_RANGE = 3.0
"""Largest factor by which undistortion may change the focal length. Beyond it, the coefficients fold the image, or the
pinhole would stretch the rim and blur the centre so much that the image is useless."""

MAX_ANGLE = math.radians(70.0)
"""Largest angle between the optical axis and the middle of an edge of the pinhole image, radians: a field of view of
140 degrees."""

CROPPED_ANGLE = math.radians(60.0)
"""The same angle of the pinhole for a lens that sees more than `MAX_ANGLE`, radians. At 70 degrees the focal length
of a photo of 180 degrees would shrink to 0.57 of its own in the centre, at 60 it keeps 0.91."""

STEEPEST = math.radians(88.0)
"""Largest angle to the optical axis at which a ray of the photo's rim is searched, radians."""

MAX_REMAPPED = 32767
"""OpenCV resamples only photos with sides up to this, px."""

NOWHERE = -32768.0
"""Column and row of a pixel that no ray reaches, px."""

FARTHEST = 2.0**24
"""Positions with a larger column or row count as `NOWHERE`, px."""

RIM = 65
"""Number of points of each edge of a photo that are examined to find its pinhole; also the number of angles in the grid
where their rays are searched first."""

NEWTON = 20
"""Steps of Newton's method; quadratic convergence needs about five from the grid's nearest ray."""

BAND = 128
"""Rows undistorted at a time: the maps of a whole photo would need more memory than the photo."""

FOLD_GRID = 128
"""Points along the longer side of the grid used to detect folds."""


@dataclass(frozen=True)
class Lens(Intrinsics):
    """Intrinsics of a camera, including distortion.

    Args:
        W, H, fx, fy, cx, cy: As for `Intrinsics`.
        coefficients: Coefficients of its model, in the model's order; missing trailing ones are zero.
        model: A name in `gsplat_edu.data.lens_formulas.FORMULAS`.

    Raises:
        DatasetError: a size or focal length is not positive, or a number is NaN or infinite.
    """

    coefficients: tuple[float, ...] = ()
    model: str = PINHOLE_LIKE

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
        """Whether this differs from a pinhole. A wide lens always does, even with zero coefficients."""
        return self.wide or any(self.coefficients)

    @property
    def wide(self) -> bool:
        """Whether the model is made for fields of view that no pinhole image can show; such photos are cropped."""
        return self.model != PINHOLE_LIKE

    @property
    def described(self) -> str:
        """The model and its coefficients in words, such as "perspective, k1 -0.1, k2 0.02"; a pinhole is "pinhole"."""
        if not self.distorts:
            return "pinhole"
        names = FORMULAS[self.model].names
        given = zip(names, self.coefficients, strict=False)
        return ", ".join([self.model, *(f"{name} {value:.4g}" for name, value in given if value)])

    @property
    def cropped(self) -> bool:
        """Whether the photo sees more than `MAX_ANGLE`, so that its pinhole shows only `CROPPED_ANGLE`.

        Raises:
            DatasetError: as for `undistorted_pinhole`.
        """
        return self.wide and _chosen(self)[1]

    def rays(
        self, columns: Float64[np.ndarray, " n"], rows: Float64[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "2 n"]:
        """Return x / z and y / z of the rays through pixels.

        Args:
            columns: Their columns, px; pixel centres have integer coordinates.
            rows: Their rows, px.
        """
        with np.errstate(all="ignore"):  # implausible coefficients overflow and give NaN
            return _rays(self, columns, rows)

    def undistorted(self) -> Intrinsics:
        """Return the pinhole of the undistorted photo, see `undistorted_pinhole`."""
        return undistorted_pinhole(self)


def lens_of(values: Mapping[str, float], W: int, H: int, model: str = PINHOLE_LIKE) -> Lens:
    """Make a lens from a file's intrinsics, in which the first pixel's centre is (0.5, 0.5).

    Args:
        values: fx, fy, cx, cy in px, and any of the model's coefficients.
        W: Image width, px.
        H: Image height, px.
        model: A name in `gsplat_edu.data.lens_formulas.FORMULAS`.

    Raises:
        DatasetError: as for `Lens`; the caller adds the file and the camera.
    """
    coefficients = tuple(float(values.get(name, 0.0)) for name in FORMULAS[model].names)
    return Lens(W, H, values["fx"], values["fy"], values["cx"] - 0.5, values["cy"] - 0.5, coefficients, model)


def undistorted_pinhole(lens: Lens) -> Intrinsics:
    """Return the pinhole with the largest field of view that shows nothing outside the photo.

    First the largest rectangle of directions is found that the photo covers. Stretching it over the image, each axis on
    its own, would change the shape of pixels. Instead, both focal lengths are multiplied by the larger of the two
    ratios, about the rectangle's middle; this shows a part of the rectangle. A photo of a wide lens is cropped to
    `CROPPED_ANGLE` if it sees more than `MAX_ANGLE`. Only points of the rim are examined, so some pixels may still lie
    outside; `undistortion` marks them.

    Args:
        lens: The original camera.

    Returns:
        Intrinsics for the same size and with the same ratio of focal lengths; the lens's own if it does not distort.

    Raises:
        DatasetError: the photo is too large, or no such pinhole has a plausible focal length and field of view.
    """
    if not lens.distorts:
        return Intrinsics(lens.W, lens.H, lens.fx, lens.fy, lens.cx, lens.cy)
    return _chosen(lens)[0]


@lru_cache(maxsize=4096)
def _chosen(lens: Lens) -> tuple[Intrinsics, bool]:
    """Return the pinhole of a lens that distorts, and whether it is cropped.

    Raises:
        DatasetError: as for `undistorted_pinhole`.
    """
    if max(lens.W, lens.H) >= MAX_REMAPPED:
        reason = (
            f"a photo of {lens.W}x{lens.H} px cannot be undistorted here, only sides below {MAX_REMAPPED} px"
        )
        raise DatasetError(
            f"{reason}; undistort it with `colmap image_undistorter`, or make it smaller", reason
        )
    if min(lens.W, lens.H) < 2:
        raise _not_a_pinhole(lens, "the photo covers no rectangle of directions")
    found = _fitted(lens, opencv_rectangle(lens) if lens.model in OPENCV else ray_rectangle(lens, STEEPEST))
    cropped = lens.wide and (isinstance(found, str) or _angle(found) > MAX_ANGLE)
    if cropped:
        found = _fitted(lens, ray_rectangle(lens, CROPPED_ANGLE))
    if isinstance(found, str):
        raise _not_a_pinhole(lens, found)
    if (angle := _angle(found)) > MAX_ANGLE:
        raise _not_a_pinhole(lens, f"it would look {math.degrees(angle):.0f} degrees to the side")
    return found, cropped


def _fitted(lens: Lens, K: Float64[np.ndarray, "3 3"]) -> Intrinsics | str:
    """Give the pixels of a rectangle of directions the lens's aspect ratio; return the reason if that is impossible."""
    if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0):
        return "the photo covers no rectangle of directions"
    ratio = max(K[0, 0] / lens.fx, K[1, 1] / lens.fy)
    if not 1 / FOCAL_RANGE < ratio < FOCAL_RANGE:
        return f"the focal length would change {ratio:.3g}-fold"
    fx, fy = ratio * lens.fx, ratio * lens.fy
    middle_x, middle_y = (lens.W - 1) / 2, (lens.H - 1) / 2
    cx = middle_x - (middle_x - K[0, 2]) * fx / K[0, 0]
    cy = middle_y - (middle_y - K[1, 2]) * fy / K[1, 1]
    return Intrinsics(lens.W, lens.H, float(fx), float(fy), float(cx), float(cy))


def _angle(pinhole: Intrinsics) -> float:
    """Return the largest angle between the optical axis and the middle of an edge, radians."""
    sides = ((pinhole.cx, pinhole.fx, pinhole.W), (pinhole.cy, pinhole.fy, pinhole.H))
    return math.atan(max(max(abs(c + 0.5), abs(side - 0.5 - c)) / f for c, f, side in sides))


def opencv_rectangle(lens: Lens) -> Float64[np.ndarray, "3 3"]:
    """Return the intrinsic matrix that stretches the rectangle over the image; NaN if OpenCV finds none."""
    size, coefficients = (lens.W, lens.H), _padded(lens)
    try:
        if lens.model == FISHEYE:
            return np.asarray(
                cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                    lens.K, coefficients, size, np.eye(3), balance=0.0
                )
            )
        return np.asarray(cv2.getOptimalNewCameraMatrix(lens.K, coefficients, size, 0.0)[0])
    except cv2.error:
        return np.full((3, 3), np.nan)


def ray_rectangle(lens: Lens, steepest: float) -> Float64[np.ndarray, "3 3"]:
    """Return this matrix for a model that OpenCV does not know; NaN if there is no rectangle.

    The rectangle ends at the innermost ray of each edge of the photo, and at an angle of `steepest` to the axis.
    """
    along = np.linspace(-0.5, 0.5, RIM)
    zero, x, y = np.zeros(RIM), lens.W * along, lens.H * along
    middle_x, middle_y = (lens.W - 1) / 2, (lens.H - 1) / 2
    columns = np.concatenate([zero - lens.W / 2, zero + lens.W / 2, x, x]) + middle_x
    rows = np.concatenate([y, y, zero - lens.H / 2, zero + lens.H / 2]) + middle_y
    rays = lens.rays(columns, rows)
    slope = math.tan(steepest)
    left, right = max(rays[0, :RIM].max(), -slope), min(rays[0, RIM : 2 * RIM].min(), slope)
    top, bottom = max(rays[1, 2 * RIM : 3 * RIM].max(), -slope), min(rays[1, 3 * RIM :].min(), slope)
    if not (left < right and top < bottom):
        return np.full((3, 3), np.nan)
    fx, fy = lens.W / (right - left), lens.H / (bottom - top)
    return np.array([[fx, 0, -0.5 - fx * left], [0, fy, -0.5 - fy * top], [0, 0, 1]])


def _rays(
    lens: Lens, columns: Float64[np.ndarray, " n"], rows: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "2 n"]:
    """Invert a lens: return x / z and y / z of the rays through pixels.

    The nearest ray of a polar grid is refined by Newton's method, in angles, because images of wide lenses are nearly
    proportional to them. The grid ends where the formula has no image or turns back, and at `STEEPEST`. A pixel beyond
    that gets the grid's nearest ray, which lies on its rim.
    """
    formula, c = FORMULAS[lens.model], _padded(lens)

    def image(theta: Plane, phi: Plane) -> tuple[Plane, Plane]:
        return formula.image(np.tan(theta) * np.cos(phi), np.tan(theta) * np.sin(phi), c)

    theta, phi = np.meshgrid(np.linspace(0.0, STEEPEST, RIM), np.linspace(-np.pi, np.pi, 4 * RIM))
    a, b = image(theta, phi)
    outward = np.diff(np.hypot(a - a[:, :1], b - b[:, :1]), axis=1) > 0
    good = np.concatenate(
        [np.ones((len(a), 1), np.bool_), np.logical_and.accumulate(outward, axis=1)], axis=1
    )
    wanted = np.stack([(columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy])
    a, b, theta, phi = a[good], b[good], theta[good], phi[good]
    nearest = np.argmin((wanted[0][:, None] - a) ** 2 + (wanted[1][:, None] - b) ** 2, axis=1)
    start = np.stack([theta[nearest] * np.cos(phi[nearest]), theta[nearest] * np.sin(phi[nearest])])

    def error(q: Float64[np.ndarray, "2 n"]) -> Float64[np.ndarray, "2 n"]:
        return np.stack(image(np.hypot(*q), np.arctan2(q[1], q[0]))) - wanted

    q, h = start, 1e-6
    dx, dy = np.array([[h], [0.0]]), np.array([[0.0], [h]])
    for _ in range(NEWTON):
        along_x = (error(q + dx) - error(q - dx)) / (2 * h)
        along_y = (error(q + dy) - error(q - dy)) / (2 * h)
        det = along_x[0] * along_y[1] - along_x[1] * along_y[0]
        e = error(q)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (
                np.stack([along_y[1] * e[0] - along_y[0] * e[1], along_x[0] * e[1] - along_x[1] * e[0]]) / det
            )
        q = q - np.where(np.isfinite(step), step, 0.0)
        q = np.where(np.hypot(*q) < STEEPEST, q, start)
    at = np.where(np.hypot(*error(q)) < 1e-9, q, start)  # NaN keeps the start, too
    theta, phi = np.hypot(*at), np.arctan2(at[1], at[0])
    return np.stack([np.tan(theta) * np.cos(phi), np.tan(theta) * np.sin(phi)])


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


def _maps(lens: Lens, pinhole: Intrinsics) -> tuple[Float32[np.ndarray, "h W"], Float32[np.ndarray, "h W"]]:
    """Return the column and row in a photo of `lens`, px, for each pixel of an image of `pinhole`.

    Where a formula has no image, both are `NOWHERE`.
    """
    if lens.model in OPENCV:
        make = cv2.fisheye.initUndistortRectifyMap if lens.model == FISHEYE else cv2.initUndistortRectifyMap
        u, v = make(lens.K, _padded(lens), np.eye(3), pinhole.K, (pinhole.W, pinhole.H), cv2.CV_32FC1)
        return u, v
    x = (np.arange(pinhole.W) - pinhole.cx) / pinhole.fx
    y = (np.arange(pinhole.H) - pinhole.cy) / pinhole.fy
    X, Y = np.meshgrid(x, y)
    with np.errstate(all="ignore"):
        a, b = FORMULAS[lens.model].image(X, Y, _padded(lens))
        u, v = lens.fx * a + lens.cx, lens.fy * b + lens.cy
        seen = (np.abs(u) < FARTHEST) & (np.abs(v) < FARTHEST)
    return np.where(seen, u, NOWHERE).astype(np.float32), np.where(seen, v, NOWHERE).astype(np.float32)


def _padded(lens: Lens) -> Float64[np.ndarray, " c"]:
    """Pad the coefficients to the number that the model has."""
    missing = len(FORMULAS[lens.model].names) - len(lens.coefficients)
    return np.array([*lens.coefficients, *[0.0] * missing])
