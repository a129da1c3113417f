"""The dense torch renderer and the NumPy renderer agree in float64."""

import numpy as np
import pytest
import torch

from gsplat_edu import (
    build_cov3d_batch,
    eval_sh,
    project_cov3d,
    quat_to_R_batch,
    render_gaussians,
    sh_basis,
    sphere_shell,
)
from gsplat_edu.data.synthetic import sphere_cameras
from gsplat_edu.render.torch.render import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import cov3d_t, quat_to_R_t


def tensors(*arrays):
    return [torch.tensor(a) for a in arrays]


def test_rotations_and_covariances():
    rng = np.random.default_rng(9)
    quats, log_scales = rng.normal(size=(64, 4)), rng.normal(size=(64, 3)) * 0.3 - 2.0
    Rs = quat_to_R_batch(quats)
    np.testing.assert_allclose(quat_to_R_t(torch.tensor(quats)).numpy(), Rs, rtol=0, atol=1e-12)
    covs = cov3d_t(*tensors(log_scales, quats)).numpy()
    np.testing.assert_allclose(covs, build_cov3d_batch(np.exp(log_scales), Rs), rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree):
    rng = np.random.default_rng(degree)
    sh, dirs = rng.normal(size=(64, 16, 3)), rng.normal(size=(64, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    colors = eval_sh_t(degree, *tensors(sh, dirs)).numpy()
    np.testing.assert_allclose(colors, eval_sh(degree, sh, dirs), rtol=0, atol=1e-12)
    assert sh_basis(dirs).shape == (64, 16)


def test_camera_8_of_the_chapter():
    """The NumPy renderer's box cuts off tails that the dense renderer keeps, so the images differ a little."""
    cam, shell = sphere_cameras(128)[8], sphere_shell()
    dense = render_t(*tensors(*shell), cam)
    boxed, _ = render_gaussians(cam, *shell)
    difference = np.abs(dense.image.numpy() - boxed)
    assert difference.max() == pytest.approx(2.7565e-4, rel=0.01)
    assert difference.mean() == pytest.approx(7.6515e-9, rel=0.01)

    exact, T = render_gaussians(cam, *shell, extent="exact", stop="none")
    np.testing.assert_allclose(dense.image.numpy(), exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dense.transmittance.numpy(), T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_random_scenes_from_a_random_camera(random_splats, random_camera, seed):
    splats = random_splats(80, seed=seed, scale=0.3)
    dense = render_t(*tensors(*splats), random_camera)
    exact, T = render_gaussians(random_camera, *splats, extent="exact", stop="none")
    np.testing.assert_allclose(dense.image.numpy(), exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dense.transmittance.numpy(), T, rtol=0, atol=1e-12)


def test_ties_in_depth_keep_their_order(random_splats, random_camera):
    means, *rest = random_splats(40, scale=0.3)
    means[:, 2] = 0.0
    dense = render_t(*tensors(means, *rest), random_camera)
    exact, _ = render_gaussians(random_camera, means, *rest, extent="exact", stop="none")
    np.testing.assert_allclose(dense.image.numpy(), exact, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(dense.visible.numpy(), np.arange(40))


@pytest.mark.parametrize("chunk", [1, 7, 79, 80, 1000])
def test_the_chunk_size_changes_only_rounding(random_splats, random_camera, chunk):
    splats = tensors(*random_splats(80, scale=0.3))
    whole, part = (render_t(*splats, random_camera, chunk=c) for c in (80, chunk))
    torch.testing.assert_close(part.image, whole.image, rtol=0, atol=1e-14)
    torch.testing.assert_close(part.transmittance, whole.transmittance, rtol=0, atol=1e-14)


def test_float32_stays_within_rounding(random_splats, random_camera):
    """Bound the error of a float32 image by the conditioning of its computation.

    Cancellation in the determinant gives the conic an error of a few eps times ac / det, which enters the terms of
    the exponent, A dx²/2, C dy²/2 and B dx dy. u and v have errors of a few eps of their size, which the exponent's
    slope multiplies. With 8 eps for "a few", the error of alpha is e = 8 eps (ac / det) (terms + slope max(|u|, |v|))
    alpha. A pixel mixes colours in [0, 1], so the errors of its splats at most add up. An alpha within e of the floor
    may be dropped or kept, which adds 1/255 per splat.
    """
    splats = random_splats(80, scale=0.3)
    double = render_t(*tensors(*splats), random_camera).image
    single = render_t(*(s.float() for s in tensors(*splats)), random_camera).image
    assert single.dtype == torch.float32

    means_cam = random_camera.world_to_cam(splats[0])
    u, v, _ = random_camera.project(means_cam)
    cov2d = project_cov3d(splats[1], means_cam, random_camera) + 0.3 * np.eye(2)
    det = np.linalg.det(cov2d)
    A, B, C = (e[:, None, None] for e in (cov2d[:, 1, 1] / det, -cov2d[:, 0, 1] / det, cov2d[:, 0, 0] / det))
    dx = np.arange(random_camera.W) - u[:, None, None]
    dy = np.arange(random_camera.H)[:, None] - v[:, None, None]
    alpha = splats[3][:, None, None] * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    condition = (cov2d[:, 0, 0] * cov2d[:, 1, 1] / det)[:, None, None]
    terms = 0.5 * (A * dx * dx + C * dy * dy) + np.abs(B * dx * dy)
    slope = np.abs(A * dx + B * dy) + np.abs(B * dx + C * dy)
    terms = terms + slope * np.abs([u, v]).max()
    error = 8 * np.finfo(np.float32).eps * condition * terms * alpha
    drawn = alpha > 0.99 / 255
    near_floor = (np.abs(alpha - 1 / 255) <= error) & drawn
    bound = (error * drawn).sum(axis=0) + near_floor.sum(axis=0) / 255
    difference = (single.double() - double).abs().numpy().max(axis=-1)
    assert (difference <= bound).all()
    assert np.median(bound) < 2e-3, "a wrong formula would exceed the bound"
