"""The reference renderer: project, sort, composite, one splat at a time, in float64 NumPy.

It is short enough to check by eye against the equations; all other renderers are measured against it.

Chapter: 05_sort_and_composite.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.base.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION,
    DILATION_MAX,
    LAMBDA_FLOOR,
    T_STOP,
    THINNEST,
    TILE,
    Z_NEAR,
)
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, first_index, float64_array, in_range, one_of
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussian_math import project_cov3d
from gsplat_edu.scene.sight import seam_shift

Extent = Literal["box3sigma", "exact"]
Stop = Literal["box", "tile", "none"]
Box = tuple[slice, slice]

RESOLVED = 16 * np.finfo(np.float64).eps
"""Smallest ratio of an ellipse's minor to major variance for which its inverse is reliable. A float64 covariance holds
its smaller variance to about eps times the larger one; at sixteen times that, some digits are left."""

COV_TOLERANCE = 1e-6
"""Largest deviation of a covariance from symmetric and positive, as a fraction of its trace; allows float32 input."""


class ScreenSplats(NamedTuple):
    """The visible splats in the image, near to far; ties keep the input order."""

    order: Int64[np.ndarray, " M"]  # indices of the Gaussians
    means2d: Float64[np.ndarray, "M 2"]  # px
    cov2d: Float64[np.ndarray, "M 2 2"]  # px², dilated and blurred
    factor: Float64[np.ndarray, " M"]  # of the opacities, in (0, 1]: 1 without motion blur


def render_gaussians(
    cam: CameraLike,
    means: ArrayLike,
    cov3ds: ArrayLike,
    colors: ArrayLike,
    opacities: ArrayLike,
    bg: ArrayLike = (0, 0, 0),
    z_near: float = Z_NEAR,
    *,
    extent: Extent = "box3sigma",
    stop: Stop = "box",
    jacobian_limit: float | None = None,
    dilation: float = DILATION,
) -> tuple[Float64[np.ndarray, "H W 3"], Float64[np.ndarray, "H W"]]:
    """Render Gaussians from a camera.

    alpha_i = min(0.99, o_i exp(-d' Sigma2d_i^-1 d / 2)), 0 below 1/255;  d = pixel - mean
    image = sum_i T_i alpha_i c_i + T_final bg,  T_i = product over j nearer than i of (1 - alpha_j)

    Args:
        cam: The camera, any object with the members of a `Camera`; pixels are sampled at integer coordinates.
        means: (N, 3) centres, world units.
        cov3ds: (N, 3, 3) covariances, world units squared, symmetric and positive semi-definite.
        colors: (N, 3) any range.
        opacities: (N,) 0 to 1; a camera with an exposure lowers them, see `screen_splats`.
        bg: (3,) background colour.
        z_near: Means at this camera depth or nearer are culled, world units, >= 0.
        extent: "box3sigma": in a box of radius ceil(3 sqrt(lambda_max)). "exact": wherever alpha >= 1/255.
        stop: When drawing ends. "box": skip a splat if its whole box is below 1e-4 transmittance. "tile": end a 16x16
            tile once all its pixels are. "none": never.
        jacobian_limit: As for `project_cov3d`: the course does not clamp, captures are trained with 1.3.
        dilation: Added to the diagonal of every screen-space covariance, px²; see `RenderSettings`.

    Returns:
        image (H, W, 3), not clipped, the background if the scene is empty; T_final (H, W), in [0, 1].

    Raises:
        ShapeError: a shape differs, or the arguments have different N.
        ArgumentError: an invalid number, covariance, camera or option; or, by index, an ellipse not fit for float64.

    Source: Kerbl et al. 2023, eq. 2-5; Zwicker et al. 2001 for the projection.
    """
    cam = as_camera("cam", cam)
    means, cov3ds, colors, opacities = _checked(means, cov3ds, colors, opacities)
    z_near, dilation = _checked_options(extent, stop, z_near, dilation)
    bg, image = float64_array("bg", bg, (3,)), np.zeros((cam.H, cam.W, 3))
    # Tiles are whole; pixels outside the image have no transmittance and do not keep a tile alive.
    padded = np.pad(np.ones((cam.H, cam.W)), ((0, -cam.H % TILE), (0, -cam.W % TILE)))
    transmittance = padded[: cam.H, : cam.W]
    screen = screen_splats(cam, means, cov3ds, z_near, jacobian_limit, dilation)
    for i, mean2d, cov2d, factor in zip(*screen, strict=True):
        T = transmittance[box := _box(mean2d, cov2d, opacity := factor * opacities[i], cam, extent)]
        if T.size == 0 or (stop == "box" and T.max() < T_STOP):
            continue
        alpha = _alpha(mean2d, _resolved(i, cov2d), opacity, box, cam)
        if stop == "tile":
            alpha = np.where(_in_live_tile(padded, box), alpha, 0.0)
        image[box] += (T * alpha)[..., None] * colors[i]
        T *= 1.0 - alpha
    return image + transmittance[..., None] * bg, transmittance.copy()


def _checked(
    means: ArrayLike, cov3ds: ArrayLike, colors: ArrayLike, opacities: ArrayLike
) -> tuple[
    Float64[np.ndarray, "N 3"],
    Float64[np.ndarray, "N 3 3"],
    Float64[np.ndarray, "N 3"],
    Float64[np.ndarray, " N"],
]:
    sizes: dict[str, int] = {}
    means = float64_array("means", means, ("N", 3), sizes)
    cov3ds = float64_array("cov3ds", cov3ds, ("N", 3, 3), sizes)
    colors = float64_array("colors", colors, ("N", 3), sizes)
    opacities = float64_array("opacities", opacities, ("N",), sizes)
    if np.any(outside := (opacities < 0) | (opacities > 1)):
        raise ArgumentError(f"opacities{first_index(outside)}: is outside 0 to 1")
    with np.errstate(over="ignore"):
        trace = np.abs(np.trace(cov3ds, axis1=1, axis2=2))
    skew = np.abs(cov3ds - np.swapaxes(cov3ds, 1, 2)).max(axis=(1, 2), initial=0.0)
    # The covariance divided by its trace neither overflows nor prevents convergence. A subnormal trace has no digits to
    # judge by: rounding alone makes such a matrix skew.
    unit = np.maximum(trace, np.finfo(np.float64).tiny / COV_TOLERANCE)
    smallest = np.linalg.eigvalsh(cov3ds / unit[:, None, None])[:, 0]
    if np.any(improper := (skew > COV_TOLERANCE * unit) | (smallest < -COV_TOLERANCE)):
        raise ArgumentError(f"cov3ds{first_index(improper)}: is not symmetric and positive semi-definite")
    return means, cov3ds, colors, opacities


def project(
    cam: Camera,
    means: Float64[np.ndarray, "N 3"],
    cov3ds: Float64[np.ndarray, "N 3 3"],
    z_near: float,
    jacobian_limit: float | None,
    dilation: float = DILATION,
) -> tuple[Int64[np.ndarray, " M"], Float64[np.ndarray, "M 2"], Float64[np.ndarray, "M 2 2"]]:
    """Return indices, means and covariances of `screen_splats`: all of them that a camera at rest needs."""
    return screen_splats(cam, means, cov3ds, z_near, jacobian_limit, dilation)[:3]


def screen_splats(
    cam: Camera,
    means: Float64[np.ndarray, "N 3"],
    cov3ds: Float64[np.ndarray, "N 3 3"],
    z_near: float,
    jacobian_limit: float | None,
    dilation: float = DILATION,
) -> ScreenSplats:
    """Project Gaussians that the camera sees to screen-space ellipses, sorted near to far by depth.

    Sigma2d = J W Sigma W' J' + d I, with the dilation d

    J is the Jacobian of the camera's projection and shutter (`Camera.sight`). Perspective lenses have bounds of J.

    With an exposure, the ellipse gets g g' (`Sight.blur` is g). So that the splat keeps its light, its opacity gets the
    factor sqrt(det Sigma2d / det(Sigma2d + g g')): each moment of the exposure draws the dilated ellipse, and a splat's
    light goes with the root of its determinant. With antialiasing, each moment has its factor, too, see
    `opacity_compensation`; the product is sqrt(det(J W Sigma W' J') / det(Sigma2d + g g')).
    """
    with np.errstate(over="ignore", invalid="ignore"):  # overflows are reported below
        if cam.pinhole:
            index, u, v, flat = _through_pinhole(cam, means, cov3ds, z_near, jacobian_limit)
            blur = None
        else:
            index, u, v, flat, blur = _through_lens(cam, means, cov3ds, z_near, jacobian_limit)
        cov2d, factor = flat + dilation * np.eye(2), np.ones(len(index))
        if blur is not None:
            flat, cov2d, factor = _blurred(flat, blur, dilation)
        # As used by _box and _alpha: the determinant, and squared distances.
        fits = np.isfinite(u * u + v * v + np.trace(cov2d, axis1=1, axis2=2) ** 2)
    if not fits.all():
        i = index[np.argmin(fits)]
        raise ArgumentError(f"means[{i}], cov3ds[{i}]: are too large on the screen for float64")
    drawn = _thick(flat, dilation)
    return ScreenSplats(index[drawn], np.stack([u, v], axis=-1)[drawn], cov2d[drawn], factor[drawn])


def _blurred(
    flat: Float64[np.ndarray, "M 2 2"], g: Float64[np.ndarray, "M 2"], dilation: float
) -> tuple[Float64[np.ndarray, "M 2 2"], Float64[np.ndarray, "M 2 2"], Float64[np.ndarray, " M"]]:
    """Return Sigma2d + g g' before and after the dilation, and the factor of the opacities."""
    a, b, c, (x, y) = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1], g.T
    det = np.maximum(a * c - b * b, 0.0) + dilation * (a + c) + dilation**2
    more = np.maximum(x * x * c - 2 * x * y * b + y * y * a, 0.0) + dilation * (x * x + y * y)
    moved = flat + g[:, :, None] * g[:, None, :]
    # 1 / (1 + more / det), but for a point or a needle without dilation, which has no light of its own
    factor = np.sqrt(det / np.maximum(det + more, np.finfo(np.float64).tiny))
    return moved, moved + dilation * np.eye(2), factor


def _through_pinhole(
    cam: Camera,
    means: Float64[np.ndarray, "N 3"],
    cov3ds: Float64[np.ndarray, "N 3 3"],
    z_near: float,
    jacobian_limit: float | None,
) -> tuple[
    Int64[np.ndarray, " M"],
    Float64[np.ndarray, " M"],
    Float64[np.ndarray, " M"],
    Float64[np.ndarray, "M 2 2"],
]:
    """Return the visible Gaussians, near to far, their positions, and their covariances before the dilation."""
    means_cam = cam.world_to_cam(means)
    fits = np.isfinite(means_cam).all(axis=1)
    if not fits.all():
        raise ArgumentError(f"means{first_index(~fits)}: is too far from the camera for float64")
    index = np.flatnonzero(means_cam[:, 2] > z_near)
    index = index[np.argsort(means_cam[index, 2], kind="stable")]
    u, v, _ = cam.project(means_cam[index])
    return index, u, v, project_cov3d(cov3ds[index], means_cam[index], cam, jacobian_limit=jacobian_limit)


def _through_lens(
    cam: Camera,
    means: Float64[np.ndarray, "N 3"],
    cov3ds: Float64[np.ndarray, "N 3 3"],
    z_near: float,
    jacobian_limit: float | None,
) -> tuple[
    Int64[np.ndarray, " M"],
    Float64[np.ndarray, " M"],
    Float64[np.ndarray, " M"],
    Float64[np.ndarray, "M 2 2"],
    Float64[np.ndarray, "M 2"] | None,
]:
    """Return the same for any projection and shutter, and the motion blur, px; None for none."""
    seen = cam.sight(means, z_near, jacobian_limit)
    index = np.flatnonzero(seen.valid)
    index = index[np.argsort(seen.depth[index], kind="stable")]
    JW = np.stack([np.stack(row, axis=-1) for row in seen.jacobian], axis=-2)[index]
    flat = JW @ cov3ds[index] @ np.swapaxes(JW, -1, -2)
    blur = None if seen.blur is None else np.stack(seen.blur, axis=-1)[index]
    return index, seen.u[index], seen.v[index], flat, blur


def _thick(flat: Float64[np.ndarray, "M 2 2"], dilation: float) -> Bool[np.ndarray, " M"]:
    """Return which covariances are thick enough to be drawn after the dilation, det > THINNEST trace."""
    spread = np.trace(flat, axis1=1, axis2=2)
    det = np.maximum(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0], 0.0)
    # det(Sigma2d + d I) = det Sigma2d + d (a + c) + d², without further cancellation
    thick: Bool[np.ndarray, " M"] = det + dilation * spread + dilation**2 > THINNEST * (spread + 2 * dilation)
    return thick


def _box(
    mean2d: Float64[np.ndarray, "2"],
    cov2d: Float64[np.ndarray, "2 2"],
    opacity: float,
    cam: Camera,
    extent: Extent,
) -> Box:
    """Bound the pixels a splat may reach, as (rows, columns) inside the image."""
    if extent == "box3sigma":
        mid, det = np.trace(cov2d) / 2.0, np.linalg.det(cov2d)
        reach = np.ceil(3.0 * np.sqrt(mid + np.sqrt(max(LAMBDA_FLOOR, mid * mid - det))))
    else:  # alpha = ALPHA_MIN on the ellipse d' Sigma^-1 d = 2 ln(o / ALPHA_MIN)
        level = 2.0 * np.log(max(opacity, ALPHA_MIN) / ALPHA_MIN)
        reach = np.sqrt(level * np.diag(cov2d))
    if cam.projection.kind == "equirectangular":  # a splat may reach across the seam: all columns
        top, bottom = (np.floor(mean2d) - np.ceil(reach))[1], (np.ceil(mean2d) + np.ceil(reach) + 1)[1]
        return slice(*np.clip((top, bottom), 0, cam.H).astype(int)), slice(0, cam.W)
    low = np.clip(np.floor(mean2d) - np.ceil(reach), 0, (cam.W, cam.H)).astype(int)
    high = np.clip(np.ceil(mean2d) + np.ceil(reach) + 1, 0, (cam.W, cam.H)).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _checked_options(extent: Extent, stop: Stop, z_near: float, dilation: float) -> tuple[float, float]:
    one_of("extent", extent, ("box3sigma", "exact"))
    one_of("stop", stop, ("box", "tile", "none"))
    return in_range("z_near", z_near, 0.0), in_range("dilation", dilation, 0.0, DILATION_MAX)


def _resolved(i: np.int64, cov2d: Float64[np.ndarray, "2 2"]) -> Float64[np.ndarray, "2 2"]:
    """Return the covariance of Gaussian i; reject an ellipse whose inverse would be dominated by rounding."""
    if np.linalg.det(cov2d) <= RESOLVED * np.trace(cov2d) ** 2:
        raise ArgumentError(
            f"cov3ds[{i}]: is {np.sqrt(np.trace(cov2d)):.2g} px long on the screen and too thin to invert accurately "
            "in float64; remove this Gaussian or make it smaller"
        )
    return cov2d


def _alpha(
    mean2d: Float64[np.ndarray, "2"],
    cov2d: Float64[np.ndarray, "2 2"],
    opacity: float,
    box: Box,
    cam: Camera,
) -> Float64[np.ndarray, "h w"]:
    """Evaluate alpha at every pixel of a box."""
    (A, B), (_, C) = np.linalg.inv(cov2d)
    columns = np.arange(box[1].start, box[1].stop)
    dx = columns - mean2d[0]
    if cam.projection.kind == "equirectangular":
        dx = dx - seam_shift(columns, mean2d[0], cam.W)
    dy = np.arange(box[0].start, box[0].stop)[:, None] - mean2d[1]
    power = -0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy
    alpha = np.minimum(ALPHA_MAX, opacity * np.exp(power))
    return np.where(alpha < ALPHA_MIN, 0.0, alpha)


def _in_live_tile(padded: Float64[np.ndarray, "th tw"], box: Box) -> Bool[np.ndarray, "h w"]:
    """Return, for each pixel of a box, whether its tile has a pixel with at least 1e-4 transmittance."""
    (y0, x0), (y1, x1) = ((s.start // TILE for s in box), (-(-s.stop // TILE) for s in box))
    tiles = padded[y0 * TILE : y1 * TILE, x0 * TILE : x1 * TILE].reshape(y1 - y0, TILE, x1 - x0, TILE)
    live: Bool[np.ndarray, "th tw"] = (
        (tiles.max(axis=(1, 3)) >= T_STOP).repeat(TILE, axis=0).repeat(TILE, axis=1)
    )
    rows, columns = (slice(s.start - t * TILE, s.stop - t * TILE) for s, t in zip(box, (y0, x0), strict=True))
    return live[rows, columns]
