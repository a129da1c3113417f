"""Gradients of pose and intrinsics, on the kernels of every instruction set and on the dense renderer.

float64 is tested against finite differences on smooth scenes: no rim of a Gaussian is inside the small image, no
alpha is clamped, no colour is floored, no depths swap, and no x/z is near the bound of the Jacobian. On harder
scenes, the backends are compared with each other, because they take the same branches.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, ShapeError
from gsplat_edu.data.procedural import RADIUS, procedural_capture
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from native_scenes import BACKGROUND, SCENES, assert_smooth, smooth_scene
from proofs import proves_gradients

POSE = ("R", "eye", "intrinsics")


def wide_scene():
    """Return a smooth scene with means on both sides of the bounds of x/z and y/z, but none near a bound."""
    scene = smooth_scene(3, n=6)
    means = scene.means.copy()
    means[:, :2] = [(-1.9, 0.1), (0.2, -1.8), (1.9, 1.9), (0.1, 0.2), (-0.3, 1.8), (0.3, -0.2)]
    return dataclasses.replace(scene, means=means, log_scales=scene.log_scales + 0.5)


def clamped(scene, limit):
    """Return which x/z and y/z are clamped; none is within 0.02 of its bound."""
    at = scene.camera.world_to_cam(scene.means)
    bounds = np.array(scene.camera.jacobian_bounds(limit))
    ratio = at[:, :2] / at[:, 2:]
    assert np.abs(ratio[..., None] - bounds).min() > 0.02
    return (ratio < bounds[:, 0]) | (ratio > bounds[:, 1])


def images_of(gaussians, settings, backend):
    def forward(R, eye, intrinsics):
        camera = CameraTensors(R, eye, intrinsics, 9, 11)
        background = torch.tensor(BACKGROUND, dtype=torch.float64)
        out = render(gaussians, camera, settings=settings, background=background, backend=backend)
        return tuple(image for image in (out.image, out.transmittance, out.depth) if image is not None)

    return forward


def check(forward, camera):
    assert proves_gradients(forward, CameraTensors.of(camera).tensors())


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_on_the_kernels(isa, antialiased):
    scene, settings = smooth_scene(0), RenderSettings(antialiased=antialiased)
    assert_smooth(scene, settings)
    check(images_of(scene.gaussians(), settings, "cpu"), scene.camera)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_with_covariances(isa, antialiased):
    scene, settings = smooth_scene(4), RenderSettings(antialiased=antialiased)
    assert_smooth(scene, settings)
    gaussians = scene.gaussians()
    covs, opacities = cov3d_t(gaussians.log_scales, gaussians.quats), gaussians.opacities

    def forward(R, eye, intrinsics):
        camera = CameraTensors(R, eye, intrinsics, 9, 11)
        out = render_covariances(gaussians.means, covs, gaussians.sh0[:, 0], opacities, camera, settings)
        return out.image, out.transmittance, out.depth

    check(forward, scene.camera)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_on_the_dense_renderer(antialiased):
    scene, settings = smooth_scene(1), RenderSettings(antialiased=antialiased)
    assert_smooth(scene, settings)
    check(images_of(scene.gaussians(), settings, "torch"), scene.camera)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_gradcheck_where_the_jacobian_is_clamped(backend):
    """The bounds depend on fx and cx, so the ellipses of Gaussians beside the image do, too."""
    scene, settings = wide_scene(), RenderSettings(jacobian_limit=1.2, depth=False)
    outside = clamped(scene, 1.2)
    assert outside.any(axis=0).all() and not outside.all(axis=0).any()
    assert_smooth(scene, settings)
    check(images_of(scene.gaussians(), settings, backend), scene.camera)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_gradcheck_of_a_twist(backend):
    """A twist away from zero tests the derivative of the exponential of a rotation as well."""
    scene = smooth_scene(2, n=3)
    base = CameraTensors.of(scene.camera)

    def forward(twist):
        return render(scene.gaussians(), base.moved(twist), backend=backend).image

    for values in (torch.zeros(6), torch.tensor([0.3, -0.2, 0.4, 0.1, 0.05, -0.1])):
        assert proves_gradients(forward, [values.double()])


def pose_gradients(scene, backend, dtype=torch.float64, antialiased=False, limit=None):
    """Return the gradients of a random weighting of all images by name, including that of the means."""
    settings = RenderSettings(antialiased=antialiased, jacobian_limit=limit)
    gaussians = scene.gaussians(dtype).trainable()
    camera = CameraTensors.of(scene.camera)
    for tensor in camera.tensors():
        tensor.requires_grad_()
    out = render(gaussians, camera, settings=settings, backend=backend)
    generator = torch.Generator().manual_seed(3)
    loss = sum(
        (t * torch.randn(t.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
        for t in (out.image, out.transmittance, out.depth)
    )
    loss.backward()
    return {name: getattr(camera, name).grad for name in POSE}, gaussians.means.grad


# The dense renderer does not stop tiles: it gives gradients with weights below 1e-4, the kernels none.
@pytest.mark.parametrize("name", [name for name in SCENES if name != "opaque, tiles stop"])
@pytest.mark.parametrize(("antialiased", "limit"), [(False, None), (True, 1.3)])
def test_float64_agrees_with_autograd_through_the_dense_renderer(name, antialiased, limit):
    """The bound is 1e-9 of the largest entry, times the number of Gaussians that add to it."""
    (ours, _), (theirs, _) = (
        pose_gradients(SCENES[name], backend, antialiased=antialiased, limit=limit)
        for backend in ("cpu", "torch")
    )
    for key, gradient in theirs.items():
        scale = len(SCENES[name].means) * (float(gradient.abs().max()) + 1e-9)
        assert float((ours[key] - gradient).abs().max()) <= 1e-9 * scale, key


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["random", "partly behind", "thousands of layers"])
def test_moving_the_camera_is_moving_all_gaussians_back(isa, name, dtype):
    """All formulas depend on mean - eye, so dL/d eye is minus the sum of dL/d mean, up to their rounding."""
    pose, means = pose_gradients(SCENES[name], "cpu", dtype)
    allowed = len(means) * torch.finfo(dtype).eps * means.double().abs().sum(dim=0)
    assert bool(((pose["eye"] + means.double().sum(dim=0)).abs() <= allowed).all())
    assert float(pose["eye"].abs().max()) > 0


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_gradient_does_not_depend_on_threads(set_threads, threads):
    """The sums of several blocks of 3,000 Gaussians are added in a fixed order."""
    set_threads(1)
    alone, _ = pose_gradients(SCENES["thousands of layers"], "cpu", torch.float32)
    set_threads(threads)
    for key, gradient in pose_gradients(SCENES["thousands of layers"], "cpu", torch.float32)[0].items():
        assert torch.equal(gradient, alone[key]), key


def test_the_gradients_of_the_gaussians_do_not_change():
    """A camera of tensors gives the same image and the same gradients of the Gaussians, bit for bit."""
    scene, found = SCENES["random"], []
    for camera in (
        scene.camera,
        CameraTensors.of(scene.camera).moved(torch.zeros(6).double().requires_grad_()),
    ):
        gaussians = scene.gaussians(torch.float32).trainable()
        out = render(gaussians, camera, backend="cpu")
        out.image.square().sum().backward()
        found.append([out.image.detach(), *(tensor.grad for tensor in gaussians.tensors().values())])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_the_gradient_of_an_empty_view_is_zero():
    scene = SCENES["random"]
    behind = dataclasses.replace(scene, means=scene.means - (0, 0, 50))
    pose, _ = pose_gradients(behind, "cpu")
    assert all(not gradient.any() for gradient in pose.values())


def recovered(start, camera_of, gaussians, camera):
    """Minimise the squared difference of two images by L-BFGS, and return the result."""
    truth = render(gaussians, camera, backend="cpu").image
    parameter = start.clone().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [parameter], max_iter=60, tolerance_grad=1e-14, tolerance_change=1e-16, line_search_fn="strong_wolfe"
    )

    def closure():
        optimizer.zero_grad()
        loss = (render(gaussians, camera_of(parameter), backend="cpu").image - truth).square().mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    return parameter.detach()


@pytest.fixture(scope="module")
def seen():
    """Return a camera and the Gaussians before it, float64."""
    views, points, colors = procedural_capture(64, 4, splats=120)
    start = from_points(points, colors, recipe(100, start_opacity=0.6))
    return views[1].camera, start.map(lambda tensor: tensor.detach().double())


def test_a_wrong_pose_is_recovered(seen):
    """The pose is wrong by 2 degrees about an oblique axis and by 2 % of the distance to the scene."""
    camera, gaussians = seen
    axis = torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    turn, shift = np.radians(2.0), 0.02 * RADIUS
    wrong = torch.cat([turn * axis, shift * axis.flip(0)])
    left = recovered(wrong, CameraTensors.of(camera).moved, gaussians, camera)
    assert float(left[:3].norm()) <= 1e-3 * turn and float(left[3:].norm()) <= 1e-3 * shift


def test_a_wrong_focal_length_is_recovered(seen):
    """Only fx is wrong, by 3 %."""
    camera, gaussians = seen
    base = CameraTensors.of(camera)
    others = torch.ones(3, dtype=torch.float64)

    def with_error(error):
        return base.with_intrinsics(base.intrinsics * torch.cat([1 + error, others]))

    left = recovered(torch.tensor([0.03], dtype=torch.float64), with_error, gaussians, camera)
    assert abs(float(left)) <= 1e-3 * 0.03


def test_invalid_cameras(as_shipped):
    good = CameraTensors.of(SCENES["random"].camera)
    R, eye, intrinsics = good.tensors()
    with pytest.raises(ArgumentError, match="R: is torch.float32"):
        CameraTensors(R.float(), eye, intrinsics, 9, 11)
    with pytest.raises(ArgumentError, match="R: is not a rotation"):
        CameraTensors(2 * R, eye, intrinsics, 9, 11)
    with pytest.raises(ArgumentError, match="fx"):
        good.with_intrinsics(-intrinsics)
    with pytest.raises(ShapeError, match="eye"):
        CameraTensors(R, eye[:2], intrinsics, 9, 11)
    with pytest.raises(ShapeError, match="twist"):
        good.moved(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ArgumentError, match="twist: is torch.float32"):
        good.moved(torch.zeros(6))
    with pytest.raises(ArgumentError, match="H"):
        CameraTensors(R, eye, intrinsics, 0, 11)
