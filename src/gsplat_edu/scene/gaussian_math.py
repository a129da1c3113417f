"""The mathematics of a Gaussian, in NumPy.

From quaternion to rotation, from rotation and scales to covariance, from covariance to screen space. Functions ending
in `_batch` process N Gaussians at once; tests check that both agree.

Chapters: 02_gaussians_in_2d, 03_gaussians_in_3d, 04_splatting.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import DET_FLOOR, DILATION, DILATION_MAX
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, check_shape, first_index, float64_array, in_range
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera


def quat_to_R(quat: ArrayLike) -> Float64[np.ndarray, "3 3"]:
    """Convert a quaternion to a rotation matrix.

    Args:
        quat: (4,) quaternion (w, x, y, z) of nonzero length; normalised here.

    Returns:
        (3, 3) rotation; q and -q give the same one.

    Raises:
        ShapeError: not of shape (4,).
        ArgumentError: zero length, NaN or infinite.

    Source: Hamilton 1844; the matrix of v -> q v q*, q of unit length.
    """
    R: Float64[np.ndarray, "3 3"] = _rotations("quat", float64_array("quat", quat, (4,)))
    return R


def quat_to_R_batch(quats: ArrayLike) -> Float64[np.ndarray, "N 3 3"]:
    """Convert N quaternions to rotation matrices; see `quat_to_R`.

    Args:
        quats: (N, 4) quaternions (w, x, y, z) of nonzero length.

    Returns:
        (N, 3, 3) rotations.

    Raises:
        ShapeError: not of shape (N, 4).
        ArgumentError: a quaternion has zero length, or an entry is NaN or infinite.
    """
    R: Float64[np.ndarray, "N 3 3"] = _rotations("quats", float64_array("quats", quats, ("N", 4)))
    return R


def build_cov3d(scale: ArrayLike, R: ArrayLike) -> Float64[np.ndarray, "3 3"]:
    """Build the covariance of a Gaussian from its standard deviations and its rotation.

    Sigma = (R S)(R S)',  S = diag(scale)

    The product of a matrix with its own transpose has no negative eigenvalues, so gradient descent on scale and
    rotation always yields a valid covariance.

    Args:
        scale: (3,) standard deviations along the Gaussian's own axes, world units, >= 0.
        R: (3, 3) rotation from the Gaussian's axes to world axes.

    Returns:
        (3, 3) covariance, world units squared.

    Raises:
        ShapeError: scale is not (3,) or R not (3, 3).
        ArgumentError: a scale is negative, or anything is NaN or infinite.

    Source: Kerbl et al. 2023, eq. 6.
    """
    scales, R = _checked_scales("scale", scale, (3,)), float64_array("R", R, (3, 3))
    cov3d: Float64[np.ndarray, "3 3"] = _covariances(scales, R)
    return cov3d


def build_cov3d_batch(scales: ArrayLike, Rs: ArrayLike) -> Float64[np.ndarray, "N 3 3"]:
    """Build the covariances of N Gaussians; see `build_cov3d`.

    Args:
        scales: (N, 3) standard deviations, world units, >= 0.
        Rs: (N, 3, 3) rotations.

    Returns:
        (N, 3, 3) covariances, world units squared.

    Raises:
        ShapeError: a shape differs, or the two arguments have different N.
        ArgumentError: a scale is negative, or anything is NaN or infinite.
    """
    sizes: dict[str, int] = {}
    deviations = _checked_scales("scales", scales, ("N", 3), sizes)
    cov3ds: Float64[np.ndarray, "N 3 3"] = _covariances(
        deviations, float64_array("Rs", Rs, ("N", 3, 3), sizes)
    )
    return cov3ds


def project_cov3d(
    cov3d: ArrayLike, mean_cam: ArrayLike, cam: CameraLike, *, jacobian_limit: float | None = None
) -> Float64[np.ndarray, "*batch 2 2"]:
    """Project 3D covariances to the image, to first order around their means.

    Sigma2d = J W Sigma W' J',  W = cam.R,  J = [[fx/z, 0, -fx x/z²], [0, fy/z, -fy y/z²]]

    (J: Jacobian of the pinhole at the mean, whose camera coordinates are x y z; other projections have their own.) The
    dilation is not included.

    Args:
        cov3d: (..., 3, 3) covariances in world axes, world units squared.
        mean_cam: (..., 3) means in camera coordinates, world units; the same leading axes.
        cam: The camera: a `Camera` or any object with its members (`CameraLike`).
        jacobian_limit: Clamp x/z and y/z inside J of a perspective lens to this multiple of half the field of view,
            see `Camera.jacobian_bounds`; None disables clamping.

    Returns:
        (..., 2, 2) screen-space covariances, px².

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a mean is not in front of the camera (z <= 0) or not seen by its lens, anything is NaN or
            infinite, or `cam` is not a camera or has a rolling shutter (`Camera.sight` has its Jacobian).

    Source: Zwicker et al. 2002, "EWA Splatting", eq. 31; Kerbl et al. 2023, eq. 5.
    """
    cam = as_camera("cam", cam)
    cov3d = float64_array("cov3d", cov3d, ("...", 3, 3))
    mean_cam = float64_array("mean_cam", mean_cam, ("...", 3))
    check_shape("mean_cam", mean_cam.shape, (*cov3d.shape[:-2], 3), {})
    if not cam.pinhole:
        JW = _lens_jacobian(mean_cam, cam, jacobian_limit) @ cam.R
        through_lens: Float64[np.ndarray, "*batch 2 2"] = JW @ cov3d @ np.swapaxes(JW, -1, -2)
        return through_lens
    x, y, z = np.moveaxis(mean_cam, -1, 0)
    if not np.all(z > 0):
        raise ArgumentError(
            f"mean_cam{first_index(z <= 0)}: z <= 0 is not in front of the camera; cull it first"
        )
    zero = np.zeros_like(z)
    (x_low, x_high), (y_low, y_high) = cam.jacobian_bounds(jacobian_limit)
    x_z, y_z = np.clip(x / z, x_low, x_high), np.clip(y / z, y_low, y_high)
    rows = [[cam.fx / z, zero, -cam.fx * x_z / z], [zero, cam.fy / z, -cam.fy * y_z / z]]
    JW = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) @ cam.R
    cov2d: Float64[np.ndarray, "*batch 2 2"] = JW @ cov3d @ np.swapaxes(JW, -1, -2)
    return cov2d


def _lens_jacobian(
    mean_cam: Float64[np.ndarray, "*batch 3"], cam: Camera, limit: float | None
) -> Float64[np.ndarray, "*batch 2 3"]:
    """Return the Jacobian of a projection that is not a pinhole, by camera axes, px per world unit."""
    if cam.shutter is not None:
        raise ArgumentError(
            "cam: has a rolling shutter; Camera.sight has its Jacobian at points of the world"
        )
    seen = Camera.posed(np.eye(3), np.zeros(3), cam.intrinsics).sight(
        mean_cam.reshape(-1, 3), jacobian_limit=limit
    )
    if not np.all(seen.valid):
        hidden = np.asarray(~seen.valid.reshape(mean_cam.shape[:-1]))
        raise ArgumentError(f"mean_cam{first_index(hidden)}: is not seen by the lens; cull it first")
    rows = np.stack([np.stack(row, axis=-1) for row in seen.jacobian], axis=-2)
    return np.asarray(rows.reshape(*mean_cam.shape[:-1], 2, 3))


def opacity_compensation(cov2d: ArrayLike, dilation: float = DILATION) -> Float64[np.ndarray, "*batch"]:
    """Return the factor by which antialiasing lowers an opacity to compensate for the dilation.

    sqrt(max(det Sigma2d, 1e-12) / det(Sigma2d + d I))

    Args:
        cov2d: (..., 2, 2) screen-space covariances before the dilation, px².
        dilation: d, px², 0 to 1e6.

    Returns:
        (...) factors in (0, 1]. Those of Gaussians that are too thin to be drawn (`gsplat_edu.base.constants.THINNEST`)
        mean nothing.

    Raises:
        ShapeError: the last two axes are not (2, 2).
        ArgumentError: an entry is NaN or infinite, or the dilation is out of range.

    Source: Yu et al. 2024, "Mip-Splatting", eq. 9 with the dilation of Kerbl et al.; the floor is ours.
    """
    cov2d = float64_array("cov2d", cov2d, ("...", 2, 2))
    dilation = in_range("dilation", dilation, 0.0, DILATION_MAX)
    a, b, c = cov2d[..., 0, 0], cov2d[..., 0, 1], cov2d[..., 1, 1]
    det = np.maximum(a * c - b * b, 0.0)
    # det(Sigma2d + d I) = det Sigma2d + d (a + c) + d²: no term is negative, so there is no further cancellation.
    dilated = det + dilation * (a + c) + dilation * dilation
    return np.asarray(np.sqrt(np.maximum(det, DET_FLOOR) / np.maximum(dilated, DET_FLOOR)))


def _rotations(name: str, quats: Float64[np.ndarray, "*batch 4"]) -> Float64[np.ndarray, "*batch 3 3"]:
    # Dividing by the largest entry first keeps the norm from overflowing or underflowing.
    largest = np.abs(quats).max(axis=-1, keepdims=True)
    if not np.all(largest > 0):
        raise ArgumentError(
            f"{name}{first_index(largest[..., 0] == 0)}: has zero length and is not a rotation"
        )
    unit = quats / largest
    w, x, y, z = np.moveaxis(unit / np.linalg.norm(unit, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _covariances(
    scales: Float64[np.ndarray, "*batch 3"], Rs: Float64[np.ndarray, "*batch 3 3"]
) -> Float64[np.ndarray, "*batch 3 3"]:
    RS = Rs * scales[..., None, :]
    product: Float64[np.ndarray, "*batch 3 3"] = RS @ np.swapaxes(RS, -1, -2)
    return product


def _checked_scales(
    name: str, value: ArrayLike, shape: tuple[int | str, ...], sizes: dict[str, int] | None = None
) -> Float64[np.ndarray, "*batch 3"]:
    scales = float64_array(name, value, shape, sizes)
    if not np.all(scales >= 0):
        raise ArgumentError(f"{name}{first_index(scales < 0)}: is negative, but a standard deviation is not")
    return scales
