"""The lens as a value: how a point in camera axes comes to its place on the image plane.

A projection takes a point (x, y, z) in camera axes to (a, b), and the focal lengths take it to the image:
u = fx a + cx, v = fy b + cy. Its kinds:

- perspective: (x / z, y / z), then a `Distortion`
- fisheye: (x, y) theta / r, with the angle theta to the optical axis and r = |(x, y)|, then a `Distortion`. It sees
  past 90 degrees.
- equirectangular: longitude atan2(x, z) and latitude atan2(y, |(x, z)|), radians; +y is down
- orthographic: (x, y); a focal length is the number of pixels of a world unit

`gsplat_edu.scene.projection_formulas` has the formulas.

Chapter: 04_splatting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import one_of
from gsplat_edu.scene.projection_formulas import RADIAL, distort, radial_factor, radial_image

PROJECTIONS = ("perspective", "fisheye", "equirectangular", "orthographic")
"""The kinds of projection. Their order is that of the kernels' numbers."""

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "d1", "d2", "d3", "p1", "p2", "s1", "s2", "s3", "s4")
"""The coefficients of a distortion: radial numerator and denominator, decentring, thin prism."""

LENS_MARGIN = 1.5
"""Means are projected up to this multiple of the radius of the farthest corner of the image. Beyond it, a calibration
says nothing about its polynomials; a splat that far outside reaches the image only if it is as large as the image."""

STEEPEST_FISHEYE = math.radians(170.0)
"""Largest angle to the optical axis of a fisheye, radians. Opposite to the axis, an image point has no direction."""

STEEPEST_PERSPECTIVE = math.radians(88.0)
"""The same of a perspective lens, distorted or with a rolling shutter, radians."""

EDGE_PLACES = 33
"""Places on each edge of an image whose rays give its extent before the distortion."""

GRID = 2048
"""Angles at which the radius of the image is examined for the first turn."""

INVERSE_STEPS = 12
"""Steps of Newton's method for the ray of a pixel. From a table of radii, few lenses need more than five."""

CONVERGED = 1e-12
"""Step of Newton's method after which a ray is exact to rounding, because the error of the next one is its square."""

INVERSE_TOLERANCE = 1e-9
"""Largest distance of the ray of a pixel from its pixel, in units of the focal length."""


def jacobian_bound(size: int, middle: Any, focal: Any, limit: float) -> Any:  # noqa: ANN401
    """Return one bound of x/z for the Jacobian of a pinhole; see `Camera.jacobian_bounds`.

    Args:
        size: Width of the image, px.
        middle: cx, px, a number or a tensor without axes.
        focal: fx, px, of the same kind.
        limit: Signed factor on the distance between the image's centre and its edge.
    """
    return (0.5 * (size - 1) + 0.5 * limit * size - middle) / focal


@dataclass(frozen=True)
class Distortion:
    """Distortion of the plane: (a, b) to the image of a real lens, in units of the focal length.

    With q = a² + b²: R = (1 + k1 q + ... + k6 q⁶) / (1 + d1 q + d2 q² + d3 q³), and
    a' = R a + 2 p1 A B + p2 (Q + 2 A²) + s1 Q + s2 Q²,   b' = R b + p1 (Q + 2 B²) + 2 p2 A B + s3 Q + s4 Q²,
    Q = A² + B². (A, B) is (a, b), or (R a, R b) if `radial_first`.

    Args:
        coefficients: As `COEFFICIENTS`; missing trailing ones are zero.
        radial_first: Whether decentring and prism apply to the image of the radial polynomial.

    Raises:
        ArgumentError: there are more than fifteen, or one is NaN or infinite.

    Source: Brown 1966; Kannala and Brandt 2006; OpenCV's and COLMAP's documentation of their camera models; Project
        Aria's documentation for `radial_first`.
    """

    coefficients: tuple[float, ...] = ()
    radial_first: bool = False

    def __post_init__(self) -> None:
        """Check the coefficients, and fill them up with zeros."""
        given = tuple(float(c) for c in self.coefficients)
        if len(given) > len(COEFFICIENTS) or not all(map(math.isfinite, given)):
            raise ArgumentError(
                f"coefficients: have to be at most {len(COEFFICIENTS)} finite numbers, got {given}"
            )
        object.__setattr__(self, "coefficients", given + (0.0,) * (len(COEFFICIENTS) - len(given)))

    @classmethod
    def of(cls, *, radial_first: bool = False, **values: float) -> Distortion:
        """Make a distortion from coefficients by name; those that are not given are zero.

        Raises:
            ArgumentError: a name is not in `COEFFICIENTS`.
        """
        for name in values:
            one_of("name of a coefficient", name, COEFFICIENTS)
        return cls(tuple(values.get(name, 0.0) for name in COEFFICIENTS), radial_first)


@dataclass(frozen=True)
class Projection:
    """Which of the `PROJECTIONS` a camera has, and its distortion.

    Args:
        kind: One of `PROJECTIONS`.
        distortion: Of a perspective lens or a fisheye; None for none. One whose coefficients are zero can be learned.

    Raises:
        ArgumentError: the kind is unknown, or has no distortion but is given one.
    """

    kind: str = "perspective"
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        """Check that the kind exists and may be distorted."""
        one_of("kind", self.kind, PROJECTIONS)
        if self.distortion is not None and self.kind not in ("perspective", "fisheye"):
            raise ArgumentError(f"distortion: an {self.kind} projection has none")

    @property
    def plain(self) -> bool:
        """Whether this is the pinhole: perspective and undistorted."""
        return self.kind == "perspective" and self.distortion is None

    @property
    def radial_first(self) -> bool:
        """`Distortion.radial_first`; False without a distortion."""
        return self.distortion is not None and self.distortion.radial_first

    @property
    def along_ray(self) -> bool:
        """Whether depth is the distance from the camera's centre; otherwise it is z, as of a pinhole."""
        return self.kind in ("fisheye", "equirectangular")

    @property
    def wraps(self) -> bool:
        """Whether the first and the last column of an image are neighbours: an equirectangular one is closed."""
        return self.kind == "equirectangular"

    def turned(self) -> Projection:
        """Return the projection of the photo turned clockwise by a quarter: (a, b) becomes (-b, a).

        Raises:
            ArgumentError: of an equirectangular image, which cannot be turned.
        """
        if self.kind == "equirectangular":
            raise ArgumentError("projection: an equirectangular image cannot be turned by a quarter")
        if self.distortion is None:
            return self
        k, (p1, p2, s1, s2, s3, s4) = self.distortion.coefficients[:9], self.distortion.coefficients[9:]
        turned = (*k, p2, -p1, -s3, -s4, s1, s2)
        return replace(self, distortion=replace(self.distortion, coefficients=turned))

    def widest(self, radius: float) -> float:
        """Return the largest angle to the optical axis at which means are projected, radians.

        The angle at which the radial image has `LENS_MARGIN` times the given radius, or at which it stops growing, if
        that is earlier; at most `STEEPEST_FISHEYE` or `STEEPEST_PERSPECTIVE`. An undistorted perspective image has no
        polynomial, so only the last bound holds: behind a rolling shutter it shows what a pinhole at rest shows.

        Args:
            radius: Distance of the image's farthest corner from the principal point, in units of the focal length.
        """
        if self.plain:
            return STEEPEST_PERSPECTIVE
        angles, image = _radii(self)
        last = len(angles) - 1
        beyond = np.flatnonzero(image > LENS_MARGIN * radius)
        return float(angles[min(last, beyond[0] if len(beyond) else last)])

    def directions(
        self, a: Float64[np.ndarray, "*n"], b: Float64[np.ndarray, "*n"], widest: float
    ) -> Float64[np.ndarray, "*n 3"]:
        """Return the ray of each place on the plane, in camera axes: the inverse of the projection.

        Args:
            a: Columns on the plane, (u - cx) / fx; of an equirectangular image, longitudes, which may be off by turns.
            b: Rows on the plane, (v - cy) / fy.
            widest: Largest angle to the optical axis, radians; of `widest`.

        Returns:
            Rays of depth 1: z is 1 for a perspective and an orthographic projection (whose rays begin at (a, b, 0)),
            the length is 1 for the others. NaN where there is no ray.
        """
        a, b = np.broadcast_arrays(np.asarray(a, np.float64), np.asarray(b, np.float64))
        one = np.ones_like(a)
        if self.kind == "orthographic":
            return np.stack([0 * one, 0 * one, one], axis=-1)
        if self.kind == "equirectangular":
            rays = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)
            return np.where((np.abs(b) <= np.pi / 2)[..., None], rays, np.nan)
        x, y = _undistorted(self, a, b, widest)
        if self.kind == "perspective":
            return np.stack([x, y, np.where(np.isfinite(x), one, np.nan)], axis=-1)
        theta = np.hypot(x, y)
        along = np.sinc(theta / np.pi)
        return np.stack([along * x, along * y, np.cos(theta)], axis=-1)

    def extent(
        self, a: tuple[float, float], b: tuple[float, float], widest: float, scale: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the extent of a distorted perspective image in x/z and y/z, enlarged about its middle.

        Args:
            a: Left and right edge of the image on the plane, (u - cx) / fx.
            b: Upper and lower edge, (v - cy) / fy.
            widest: Largest angle to the optical axis, radians; of `widest`. An edge that has places without a ray has
                the extent of the widest angle.
            scale: Factor of the enlargement.

        Returns:
            (low, high) of x/z and of y/z over the rays of `EDGE_PLACES` places on each edge.
        """
        (x_low, x_high), (y_low, y_high) = _extent(self, a, b, widest)
        x, y, reach = (x_low + x_high) / 2, (y_low + y_high) / 2, scale / 2
        x_half, y_half = reach * (x_high - x_low), reach * (y_high - y_low)
        return (x - x_half, x + x_half), (y - y_half, y + y_half)


PINHOLE = Projection()
"""The projection of a pinhole."""


@lru_cache(maxsize=1024)
def _radii(projection: Projection) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Return angles and the radii of their images, in units of the focal length, up to the first turn."""
    fisheye = projection.kind == "fisheye"
    angles = np.linspace(0.0, STEEPEST_FISHEYE if fisheye else STEEPEST_PERSPECTIVE, GRID)
    plane = angles if fisheye else np.tan(angles)
    image = plane
    if projection.distortion is not None:
        with np.errstate(all="ignore"):
            image = plane * radial_factor(plane * plane, projection.distortion.coefficients)
    # NaN, and a denominator at or below zero, count as a turn
    growing = np.concatenate([[True], np.diff(image) > 0])
    end = len(angles) if growing.all() else int(np.argmin(growing))
    return angles[: max(2, end)], image[: max(2, end)]


@lru_cache(maxsize=1024)
def _extent(
    projection: Projection, a: tuple[float, float], b: tuple[float, float], widest: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the extent in x/z and y/z of the rays through the edges of an image."""
    share = np.linspace(0.0, 1.0, EDGE_PLACES)
    across, down = a[0] + (a[1] - a[0]) * share, b[0] + (b[1] - b[0]) * share
    columns = np.concatenate([across, across, np.full(EDGE_PLACES, a[0]), np.full(EDGE_PLACES, a[1])])
    rows = np.concatenate([np.full(EDGE_PLACES, b[0]), np.full(EDGE_PLACES, b[1]), down, down])
    rays = projection.directions(columns, rows, widest)[:, :2]
    if np.isnan(rays).any():
        most = math.tan(widest)
        rays = np.concatenate([rays[np.isfinite(rays).all(axis=1)], [[-most, -most], [most, most]]])
    (x_low, y_low), (x_high, y_high) = rays.min(axis=0).tolist(), rays.max(axis=0).tolist()
    return (x_low, x_high), (y_low, y_high)


def _undistorted(
    projection: Projection, a: Float64[np.ndarray, "*n"], b: Float64[np.ndarray, "*n"], widest: float
) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Return the places on the plane before the distortion; NaN where there is none up to the widest angle."""
    fisheye = projection.kind == "fisheye"
    limit = widest if fisheye else math.tan(widest)
    x, y = a.copy(), b.copy()
    if projection.distortion is not None:
        angles, image = _radii(projection)
        radius = np.hypot(a, b).ravel()
        start = np.interp(radius, image, angles if fisheye else np.tan(angles))
        radial = not any(projection.distortion.coefficients[RADIAL:])
        if radial:
            wanted = np.where(radius <= image[-1] * (1 + 1e-6), radius, np.nan)  # none beyond the first turn
            start = _radii_before(projection.distortion, wanted, start)
        scale = (start / np.where(radius > 0, radius, 1.0)).reshape(a.shape)
        x, y = scale * a, scale * b
        if not radial:
            x, y = _places_before(projection.distortion, (a, b), (x, y))
    inside = np.hypot(x, y) <= limit * (1 + 1e-9)
    return np.where(inside, x, np.nan), np.where(inside, y, np.nan)


def _radii_before(
    distortion: Distortion, wanted: Float64[np.ndarray, " n"], start: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return the radii of places whose radius after a radial distortion is wanted; NaN where there is none.

    Newton's method for r R(r²) = wanted, at places whose last step was larger than rounding.
    """
    found, left = start.copy(), np.arange(len(start))
    with np.errstate(all="ignore"):
        for _ in range(INVERSE_STEPS):
            r = found[left]
            value, slope = radial_image(r, distortion.coefficients)
            step = (value - wanted[left]) / slope
            found[left] = r - step
            left = left[np.abs(step) > CONVERGED]  # not if it is NaN
            if not len(left):
                break
        off = np.abs(radial_image(found[left], distortion.coefficients)[0] - wanted[left])
    found[left[~(off <= INVERSE_TOLERANCE)]] = np.nan
    return found


def _places_before(
    distortion: Distortion,
    wanted: tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]],
    start: tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]],
) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Return the places whose places after a distortion are wanted; NaN where there is none. The method is the same."""
    shape, (a, b), (x, y) = wanted[0].shape, (w.ravel() for w in wanted), (s.flatten() for s in start)
    left = np.arange(len(x))

    def off(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
        (u, v), K = distort(x[rows], y[rows], distortion.coefficients, distortion.radial_first)
        return u - a[rows], v - b[rows], K

    with np.errstate(all="ignore"):
        for _ in range(INVERSE_STEPS):
            du, dv, ((K00, K01), (K10, K11)) = off(left)
            det = K00 * K11 - K01 * K10
            along_x, along_y = (K11 * du - K01 * dv) / det, (K00 * dv - K10 * du) / det
            x[left] -= along_x
            y[left] -= along_y
            left = left[np.abs(along_x) + np.abs(along_y) > CONVERGED]  # not if one is NaN
            if not len(left):
                break
        du, dv, _ = off(left)
    far = left[~(np.hypot(du, dv) <= INVERSE_TOLERANCE)]
    x[far] = y[far] = np.nan
    return x.reshape(shape), y.reshape(shape)
