"""`RenderSettings.dilation` on every backend: images agree with the NumPy reference, gradients with finite
differences. Tolerances are those of test_parity.py (1e-12 in float64) and test_gradients.py. Gaussians thinner than 1
px have steeper alphas, but with standard deviations of at least 0.1 px, an error of 1e-15 in a distance changes alpha
by less than 1e-13. The scenes are that thick, except in the tests of thin Gaussians.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.base.constants import DET_FLOOR, THINNEST
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussian_math import opacity_compensation
from gsplat_edu.scene.gaussians import Gaussians
from native_scenes import BACKGROUND, SCENES, camera, smooth_scene
from proofs import proves_gradients

DILATIONS = (0.0, 0.1, 0.3, 1.0)
PARAMETERS = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


def settings_of(dilation, antialiased=False):
    return RenderSettings(background=BACKGROUND, dilation=dilation, antialiased=antialiased)


def images(scene, backend, settings):
    with torch.no_grad():
        out = render(scene.gaussians(), scene.camera, settings=settings, backend=backend)
    return [t.numpy() for t in (out.image, out.transmittance, out.depth)]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dilation", DILATIONS)
@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_images_match_the_reference(backend, dilation, antialiased):
    scene = SCENES["random"]
    found = images(scene, backend, settings_of(dilation, antialiased))
    wanted = scene.truth(antialiased=antialiased, dilation=dilation)
    # The dense backend does not stop tiles. No tile stops in this scene.
    for ours, truth in zip(found, wanted, strict=True):
        np.testing.assert_allclose(ours, truth, rtol=0, atol=1e-12)


def test_every_instruction_set_takes_the_dilation(isa):
    scene = SCENES["random"]
    for ours, truth in zip(images(scene, "cpu", settings_of(0.1)), scene.truth(dilation=0.1), strict=True):
        np.testing.assert_allclose(ours, truth, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("backend", "dilation", "antialiased"),
    [
        *(("cpu", dilation, antialiased) for dilation in (0.0, 0.1, 1.0) for antialiased in (False, True)),
        *(("torch", 0.0, True), ("torch", 0.1, False), ("torch", 1.0, True)),
    ],
)
def test_gradcheck(backend, dilation, antialiased):
    """The Gaussians are wider than the image, so every alpha is smooth with any dilation.

    The next test compares the backends in the cases that are left out here.
    """
    scene, settings = smooth_scene(0, n=3), settings_of(dilation, antialiased)
    gaussians = scene.gaussians()

    def forward(*tensors):
        moved = dataclasses.replace(gaussians, **dict(zip(PARAMETERS, tensors, strict=True)))
        out = render(moved, scene.camera, settings=settings, backend=backend)
        return out.image, out.transmittance, out.depth

    assert proves_gradients(forward, [gaussians.tensors()[name] for name in PARAMETERS])


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("dilation", [0.0, 0.1, 1.0])
def test_gradients_of_small_gaussians_agree_with_the_dense_backend(dilation, antialiased):
    """Autograd through the dense renderer agrees to 1e-9 of the largest gradient, as in test_gradients.py."""
    found = []
    for backend in ("cpu", "torch"):
        gaussians = SCENES["random"].gaussians().trainable()
        settings = settings_of(dilation, antialiased)
        out = render(gaussians, SCENES["random"].camera, settings=settings, backend=backend)
        draw = torch.Generator().manual_seed(3)
        weights = torch.randn(out.image.shape, generator=draw, dtype=torch.float64)
        ((out.image * weights).sum() + out.depth.square().sum()).backward()
        found.append({name: tensor.grad for name, tensor in gaussians.tensors().items()})
    for name, ours in found[0].items():
        largest = float(found[1][name].abs().max())
        assert largest > 0
        torch.testing.assert_close(ours, found[1][name], rtol=0, atol=1e-9 * largest)


@pytest.mark.parametrize("dilation", [0.0, 0.1, 1.0])
def test_gradcheck_of_render_covariances(dilation):
    draw = torch.Generator().manual_seed(0)
    roots = 0.4 * torch.randn(3, 3, 3, generator=draw, dtype=torch.float64)
    means = torch.stack(
        [*(0.2 * torch.randn(2, 3, generator=draw, dtype=torch.float64)), torch.arange(3.0) / 4], 1
    )
    settings = settings_of(dilation, antialiased=True)

    def forward(means, roots):
        covs = roots @ roots.mT + 0.3 * torch.eye(3, dtype=torch.float64)
        colors, opacities = torch.eye(3, dtype=torch.float64), torch.full((3,), 0.6, dtype=torch.float64)
        return render_covariances(means, covs, colors, opacities, camera(11, 9), settings).image

    assert proves_gradients(forward, [means.double(), roots])


def flat_gaussian(widths, dtype=torch.float64):
    """Return a Gaussian at (5, 5) px of these standard deviations, px, with opacity 0.9, and its camera."""
    one = lambda *values: torch.tensor([values], dtype=dtype)  # noqa: E731
    scales = torch.tensor([[*widths, 1.0]], dtype=dtype)
    scene = Gaussians(
        means=one(5.0, 5.0, 1.0),
        quats=one(1.0, 0.0, 0.0, 0.0),
        log_scales=scales.log(),
        sh0=torch.ones(1, 1, 3, dtype=dtype),
        sh_rest=torch.zeros(1, 0, 3, dtype=dtype),
        logit_opacities=torch.logit(one(0.9)[0]),
    )
    return scene, Camera(np.eye(3), np.zeros(3), 1.0, 1.0, 0.0, 0.0, 11, 11)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("dilation", DILATIONS)
def test_alpha_follows_the_formula(backend, dilation):
    """A Gaussian of 1.0 x 0.2 px is on the optical axis, where its scale along z has no effect."""
    scene, view = flat_gaussian((1.0, 0.2))
    view = dataclasses.replace(
        view, eye=np.array([5.0, 5.0, 0.0]), cx=5.0, cy=5.0
    )  # the mean is on the optical axis
    out = render(scene, view, settings=RenderSettings(dilation=dilation), backend=backend)
    for dx, dy in ((1, 0), (0, 1), (2, 0)):
        wanted = 0.9 * math.exp(-0.5 * (dx * dx / (1.0 + dilation) + dy * dy / (0.04 + dilation)))
        wanted = 0.0 if wanted < 1 / 255 else wanted
        assert abs(float(out.alpha[5 + dy, 5 + dx]) - wanted) < 1e-12


THIN = {
    "a line": (2.0, 0.0),
    "a point": (0.0, 0.0),
    "thinner than 1/1000 px": (2.0, 0.9e-3),
    "thicker than 1/1000 px": (2.0, 1.1e-3),
}


@pytest.mark.parametrize("name", THIN)
@pytest.mark.parametrize("backend", ["numpy", "cpu", "torch", "covariances"])
def test_thin_gaussians_are_not_drawn_without_dilation(name, backend):
    """Gaussians with det <= 1e-6 px² trace have zero gradients, and their neighbours have those they have alone."""
    thin, view = flat_gaussian(THIN[name])
    view = dataclasses.replace(view, eye=np.array([5.0, 5.0, 0.0]), cx=5.0, cy=5.0)
    drawn = name.startswith("thicker")
    settings = RenderSettings(dilation=0.0, antialiased=True)
    if backend == "numpy":
        covs = build_cov3d_batch(np.exp(thin.log_scales.numpy()), quat_to_R_batch(thin.quats.numpy()))
        image, _ = render_gaussians(view, thin.means, covs, [[1, 1, 1]], [0.9], extent="exact", dilation=0.0)
        assert (image.max() > 0.8) == drawn
        return
    wide, _ = flat_gaussian((1.5, 1.0))
    if backend == "covariances":
        covs = torch.cat([torch.diag_embed(torch.exp(2 * each.log_scales)) for each in (thin, wide)])
        inputs = [torch.cat([each.means for each in (thin, wide)]), covs]
        inputs = [t.requires_grad_() for t in inputs]
        colors, opacities = torch.ones(2, 3, dtype=torch.float64), torch.full((2,), 0.9, dtype=torch.float64)
        out = render_covariances(*inputs, colors, opacities, view, settings)
    else:
        both = Gaussians(**{k: torch.cat([t, wide.tensors()[k]]) for k, t in thin.tensors().items()})
        floor = torch.finfo(torch.float64).min / 4  # a finite logarithm whose exponential is 0
        both = dataclasses.replace(both, log_scales=both.log_scales.clamp(min=floor)).trainable()
        out = render(both, view, settings=settings, backend=backend)
        inputs = list(both.tensors().values())
    assert (0 in out.visible) == drawn and 1 in out.visible
    out.image.square().sum().backward()
    for tensor in inputs:
        assert bool(torch.isfinite(tensor.grad).all())
        assert drawn or float(tensor.grad[0].abs().sum()) == 0
    assert any(float(tensor.grad[1].abs().sum()) > 0 for tensor in inputs)


def test_the_default_dilation_leaves_no_gaussian_out():
    """det = det0 + d (a0 + c0) + d² > THINNEST (a0 + c0 + 2 d) for every Gaussian if d > 2 THINNEST."""
    for dilation in (0.3, 2.1 * THINNEST):
        for spread in (0.0, 1e-9, 1.0, 1e9):
            assert dilation * spread + dilation**2 > THINNEST * (spread + 2 * dilation)


def test_the_compensation_uses_the_dilation():
    flat = np.array([[2.0, 0.3], [0.3, 0.7]])
    det = np.linalg.det(flat)
    for dilation in DILATIONS:
        wanted = math.sqrt(det / np.linalg.det(flat + dilation * np.eye(2)))
        assert abs(opacity_compensation(flat, dilation) - wanted) < 1e-15
    assert opacity_compensation(np.zeros((2, 2)), 0.0) == math.sqrt(DET_FLOOR / DET_FLOOR)
    with pytest.raises(ArgumentError, match="^dilation: is -1"):
        opacity_compensation(flat, -1.0)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("wrong", [-0.1, math.nan, math.inf, 2.0**40, "x", None])
def test_dilations_out_of_range_are_named(wrong):
    with pytest.raises(ArgumentError, match="^dilation: "):
        RenderSettings(dilation=wrong)
    with pytest.raises(ArgumentError, match="^dilation: "):
        render_gaussians(camera(3, 3), [[0, 0, 1]], [np.eye(3)], [[1, 1, 1]], [0.5], dilation=wrong)


def test_the_largest_dilation_is_finite_in_float32():
    gaussians = SCENES["random"].gaussians(torch.float32).trainable()
    out = render(gaussians, SCENES["random"].camera, settings=settings_of(1e6), backend="cpu")
    out.image.sum().backward()
    assert all(bool(torch.isfinite(t.grad).all()) for t in gaussians.tensors().values())
    assert float(out.alpha.detach().min()) > 0.99
