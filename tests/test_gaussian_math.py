import numpy as np
import pytest

from gsplat_edu import (
    Camera,
    build_cov3d,
    build_cov3d_batch,
    project_cov3d,
    quat_to_R,
    quat_to_R_batch,
)

RNG = np.random.default_rng(0)
QUATS = RNG.normal(size=(64, 4))
SCALES = np.exp(RNG.normal(size=(64, 3)) * 0.3 - 2.0)


def product(p, q):
    """Return the Hamilton product of two quaternions (w, x, y, z)."""
    return np.concatenate(
        [[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])]
    )


def test_rotation_matrices_are_orthogonal_with_determinant_one():
    R = quat_to_R_batch(QUATS)
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_rotation_equals_the_sandwich_product():
    for quat, point in zip(QUATS[:8], RNG.normal(size=(8, 3)), strict=True):
        unit = quat / np.linalg.norm(quat)
        rotated = product(product(unit, np.concatenate([[0.0], point])), unit * (1, -1, -1, -1))
        np.testing.assert_allclose(quat_to_R(quat) @ point, rotated[1:], rtol=0, atol=1e-14)


def test_a_quarter_turn_about_z_takes_x_to_y():
    np.testing.assert_allclose(quat_to_R((1, 0, 0, 1)) @ (1, 0, 0), (0, 1, 0), rtol=0, atol=1e-15)


@pytest.mark.parametrize("factor", [-1.0, 3.0, 1e-200, 1e200])
def test_length_and_sign_of_a_quaternion_do_not_matter(factor):
    np.testing.assert_allclose(quat_to_R_batch(QUATS * factor), quat_to_R_batch(QUATS), rtol=0, atol=1e-14)


def test_batches_equal_single_calls():
    Rs = quat_to_R_batch(QUATS)
    cov3ds = build_cov3d_batch(SCALES, Rs)
    for quat, scale, R, cov3d in zip(QUATS, SCALES, Rs, cov3ds, strict=True):
        np.testing.assert_allclose(quat_to_R(quat), R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(build_cov3d(scale, R), cov3d, rtol=0, atol=1e-12)


def test_covariance_has_the_scales_along_the_rotated_axes():
    R = quat_to_R(QUATS[0])
    cov3d = build_cov3d(SCALES[0], R)
    for axis, scale in zip(R.T, SCALES[0], strict=True):
        np.testing.assert_allclose(cov3d @ axis, scale**2 * axis, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(cov3d, cov3d.T)


def test_projection_is_the_covariance_of_the_linearised_pinhole():
    cam = Camera(quat_to_R(QUATS[1]), (0.1, 0.2, 0.3), fx=120, fy=90, cx=5, cy=6, H=8, W=9)
    means_cam = np.array([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0]])
    cov3ds = build_cov3d_batch(SCALES[:2], quat_to_R_batch(QUATS[:2]))
    h = 1e-6  # truncation h² and rounding eps / h of central differences are far below 1e-6 of the values
    for cov3d, mean in zip(cov3ds, means_cam, strict=True):
        step = [np.subtract(*(cam.project(mean + s * e)[:2] for s in (h, -h))) / (2 * h) for e in np.eye(3)]
        JW = np.stack(step, axis=-1) @ cam.R
        np.testing.assert_allclose(project_cov3d(cov3d, mean, cam), JW @ cov3d @ JW.T, rtol=1e-6)
    batch = project_cov3d(cov3ds, means_cam, cam)
    for i in range(2):
        np.testing.assert_allclose(project_cov3d(cov3ds[i], means_cam[i], cam), batch[i], rtol=0, atol=1e-12)
