"""Lenses and shutters in the native kernels: every instruction set, any number of threads, and bad arguments."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.ops.kernels import native
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Projection
from lens_scenes import CLAMPED, LENSES, LIMIT, STEPS, around, beyond, differentiable, lens_camera, rebuilt
from native_scenes import BACKGROUND


def images(out):
    return out.image, out.transmittance, out.depth


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", LENSES)
def test_kernels_agree_with_autograd_through_the_dense_renderer(isa, name, antialiased):
    check_against_autograd(around(60, seed=3), lens_camera(name), RenderSettings(antialiased=antialiased))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", CLAMPED)
def test_clamped_kernels_agree_with_autograd(isa, name, antialiased, monkeypatch):
    """Bounds are constants in both. They are narrower than the image."""
    scene, camera = around(60, seed=3), lens_camera(name)
    inner = tuple((0.4 * low, 0.4 * high) for low, high in camera.jacobian_bounds(LIMIT))
    monkeypatch.setattr(Camera, "jacobian_bounds", lambda camera, limit: inner)
    assert beyond(scene, camera).sum() >= 4
    check_against_autograd(scene, camera, RenderSettings(antialiased=antialiased, jacobian_limit=LIMIT))


def check_against_autograd(scene, camera, settings):
    settings = dataclasses.replace(settings, background=BACKGROUND)
    rng = np.random.default_rng(0)
    found = {}
    upstream = None
    for backend in ("torch", "cpu"):
        raw, pose, template = differentiable(scene, camera)
        out = render(Gaussians(*raw), rebuilt(template, pose), settings=settings, backend=backend)
        assert out.transmittance.min() > 1e-3, "no tile stops"
        if upstream is None:
            upstream = [torch.tensor(rng.normal(size=tuple(image.shape))) for image in images(out)]
        torch.autograd.backward(images(out), upstream)
        found[backend] = [tensor.grad for tensor in (*raw, *pose)], len(out.visible)
    assert found["cpu"][1] > 5
    for ours, theirs in zip(found["cpu"][0], found["torch"][0], strict=True):
        scale = theirs.abs().max().clamp(min=1.0)
        # Three steps of Newton's method leave about 1e-9 px, which the two differentiate differently.
        atol = 1e-9 if camera.shutter is None else 1e-8
        torch.testing.assert_close(ours / scale, theirs / scale, rtol=0, atol=atol)


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_coefficients_of_zero_have_a_gradient(as_shipped, kind):
    """From which a lens begins to be learned."""
    scene, found = around(40, seed=3), []
    scene.logits[:] -= 2.0  # no tile stops
    camera = lens_camera("fisheye").through(Projection(kind))
    for backend in ("cpu", "torch"):
        zero = torch.zeros(len(STEPS), dtype=torch.float64, requires_grad=True)
        tensors = dataclasses.replace(CameraTensors.of(camera), coefficients=STEPS * zero)
        out = render(scene.gaussians(), tensors, backend=backend)
        assert out.transmittance.min() > 1e-3
        out.image.square().sum().backward()
        found.append(zero.grad)
    assert (found[1] != 0).all()
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-9 * float(found[1].abs().max()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", LENSES)
def test_the_bits_do_not_depend_on_threads(set_threads, name, dtype):
    scene, camera = around(700, seed=1), lens_camera(name, 90, 74)
    found = []
    for threads in (1, 2, 5):
        set_threads(threads)
        gaussians = scene.gaussians(dtype).map(lambda tensor: tensor.requires_grad_())
        tensors = CameraTensors.of(camera)
        pose = [tensor.requires_grad_() for tensor in tensors.tensors()]
        out = render(gaussians, tensors, backend="cpu")
        (out.image.square().sum() + out.depth.sum()).backward()
        found.append(
            [out.image.detach(), *(t.grad for t in gaussians.tensors().values()), *(t.grad for t in pose)]
        )
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))


def test_float32_is_as_near_to_float64_as_through_a_pinhole():
    scene = around(300, seed=2)
    for name in LENSES:
        camera = lens_camera(name)
        single = render(scene.gaussians(torch.float32), camera, backend="cpu").image
        double = render(scene.gaussians(torch.float64), camera, backend="cpu").image
        assert (single.double() - double).abs().max() < 2e-5, name


def test_a_panorama_turned_by_a_tile_is_its_image_moved_by_a_tile():
    """Also across the seam. Nearer to the poles, splats reach half way round, where tiles see different copies."""
    scene, W = around(400, seed=4), 96
    camera = lens_camera("panorama", W, 48)
    before = render(scene.gaussians(), camera, backend="cpu").image
    for columns in (16, 48, 80):
        angle = 2 * np.pi * columns / W
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        turned = Camera.posed(turn @ camera.R, camera.eye, camera.intrinsics)
        other = render(scene.gaussians(), turned, backend="cpu").image
        moved = torch.roll(before, columns, dims=1)
        np.testing.assert_allclose(other[12:36].numpy(), moved[12:36].numpy(), rtol=0, atol=1e-9)


def test_native_arguments_are_checked(as_shipped):
    camera = lens_camera("opencv")
    values = {**_camera_values(camera)}
    native().Camera(**values)
    for name, value, message in (
        ("lens", 4, "lens"),
        ("coefficients", (np.nan,) * 15, "coefficients"),
        ("coefficients", (0.0,) * 14, "coefficients"),
        ("motion", (np.inf,) * 6, "motion"),
        ("axis", 2, "axis"),
        ("exposure", -0.1, "exposure"),
        ("exposure", np.nan, "exposure"),
        ("widest", "wide", "widest"),
        ("x_bounds", (1.0, -1.0), "x_bounds"),
        ("y_bounds", (0.2, 0.1), "y_bounds"),
        ("y_bounds", (np.nan, 0.1), "y_bounds"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            native().Camera(**values | {name: value})
    with pytest.raises(ValueError, match="distorted"):
        native().Camera(**values | {"lens": 3})


def _camera_values(camera):
    return {
        "R": np.ascontiguousarray(camera.R), "eye": np.ascontiguousarray(camera.eye),
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "x_bounds": (-1.0, 1.0), "y_bounds": (-1.0, 1.0), "H": camera.H, "W": camera.W,
        "lens": 0, "coefficients": camera.coefficients, "distorted": True, "radial_first": False, "widest": 1.0,
        "moving": False, "motion": (0.0,) * 6, "axis": 1, "pace": 0.0, "exposure": 0.0,
    }  # fmt: skip
