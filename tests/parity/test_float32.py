"""The backends that compute in float32, cuda and webgpu: gradients of everything that a render is differentiable in.

They are compared with the native kernels in float64. Bounds are those of the native float32 kernels (tests/native):
3e-4 of the largest entry of a gradient, or 4e-3 for ill-conditioned conics. They allow for the cancellation in sums of
moments; PRECISION.md has what is measured. Batches of the backend cuda hold 16 Gaussians, so most scenes have tiles
with several; 41 x 35 and 17 x 33 px are not multiples of a tile.
"""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from float32_backends import ILL_CONDITIONED, POISON, POSE, SETTINGS, SMALLER, images_and_gradients
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, random
from parity.conftest import where

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Triton's interpreter computes with NumPy


CASES = [*zip(SMALLER, itertools.cycle([True, False]))]
CASES += [("random", False), ("needles 100:1", True), ("smaller than a pixel", True)]
"""Every second scene is antialiased, and what the compensation changes most is compared with it and without."""


def compare(backend, scene, settings=SETTINGS, bound=3e-4):
    """Compare images and gradients with the native ones; return the gradients, and both outputs."""
    values, gradients, out = images_and_gradients(scene, backend, where(backend), settings)
    truths, expected, oracle = images_and_gradients(scene, "cpu", settings=settings)
    assert abs(out.num_pairs - oracle.num_pairs) <= 2 and len(out.visible) == len(oracle.visible)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    for key, truth in expected.items():
        if not truth.size:  # no harmonics are stored
            continue
        parts = len(scene.means) if key in POSE else 1  # the camera's is a sum over all Gaussians
        assert np.abs(gradients[key] - truth).max() <= parts * bound * np.abs(truth).max(), key
    return gradients, out, oracle


@pytest.mark.parametrize(("name", "antialiased"), CASES)
def test_gradients_match_the_native_kernels_in_float64(backend, name, antialiased):
    """Scenes with ties are included. A camera axis is along z, so depths that are equal in float64 are equal in
    float32."""
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased, jacobian_limit=1.3)
    compare(backend, SMALLER[name], settings, 4e-3 if name in ILL_CONDITIONED else 3e-4)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_sh_degrees(backend, degree):
    compare(backend, SMALLER["random"], dataclasses.replace(SETTINGS, sh_degree=degree))


@pytest.mark.parametrize("dilation", [0.0, 0.1, 1.0])
def test_dilations(backend, dilation):
    """Gaussians of a few pixels, which float32 resolves, and a line, which is not drawn without dilation."""
    scene = random(20, (17, 33), seed=3)
    scene.log_scales[7] = (-1.0, -60.0, -60.0)
    gradients, out, oracle = compare(backend, scene, dataclasses.replace(SETTINGS, dilation=dilation), 4e-3)
    assert set(out.visible.tolist()) == set(oracle.visible.tolist())
    assert (7 in out.visible) == (dilation > 0)
    if dilation == 0:
        assert all(np.all(g[7] == 0) for key, g in gradients.items() if len(g) == 20), gradients.keys()


def test_two_runs_give_the_same_bits(backend):
    scene = SMALLER["opaque, tiles stop"]
    first, second = (images_and_gradients(scene, backend, where(backend))[:2] for _ in range(2))
    for ours, other in zip(first, second, strict=True):
        for key, array in ours.items():
            np.testing.assert_array_equal(array, other[key], err_msg=key)


@pytest.mark.parametrize("kind", ["empty", "behind", "faint", "one"])
def test_almost_empty_scenes(backend, kind):
    device = torch.device(where(backend))
    scene = random(0 if kind == "empty" else 1 if kind == "one" else 9, (17, 33), seed=2)
    gaussians = scene.gaussians(torch.float32).to(device)
    if kind == "behind":
        gaussians.means[:, 2] -= 100.0
    if kind == "faint":
        gaussians.logit_opacities[:] = -9.0
    gaussians = gaussians.trainable()
    out = render(gaussians, scene.camera, settings=SETTINGS, backend=backend)
    out.image.sum().backward()
    assert (out.num_pairs > 0) == (kind == "one") == bool(len(out.visible))
    if kind != "one":
        expected = torch.tensor(BACKGROUND, device=device).expand(33, 17, 3)
        torch.testing.assert_close(out.image.detach(), expected)
        assert all((t.grad == 0).all() for t in gaussians.tensors().values())


def test_bad_gaussians_do_not_affect_others(backend):
    scene = random(20, (17, 33), seed=3)
    good = scene.gaussians(torch.float32).to(torch.device(where(backend)))
    bad, count = good.map(torch.clone), len(POISON)
    for i, (name, value) in enumerate(POISON):
        bad.tensors()[name][7 + i] = value
    rest = lambda t: torch.cat([t[:7], t[7 + count :]])  # noqa: E731
    without, bad = good.map(rest).trainable(), bad.trainable()
    images = [render(g, scene.camera, settings=SETTINGS, backend=backend).image for g in (bad, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for key, tensor in bad.tensors().items():
        assert (tensor.grad[7 : 7 + count] == 0).all(), key
        assert torch.equal(rest(tensor.grad), without.tensors()[key].grad), key


def test_a_mean_far_outside_the_image(backend):
    """A wide Gaussian with its mean 400 px outside the image: moments are shifted far without losing digits."""
    scene = random(4, (41, 35), seed=6)
    scene.means[0, 0] += 25.0
    scene.log_scales[0] = 2.2
    gradients, _, _ = compare(backend, scene)
    assert np.abs(gradients["means"][0]).max() > 0


@pytest.mark.parametrize("rest", [0, 3, 8])
def test_gaussians_that_store_fewer_harmonics(backend, rest):
    scene = random(20, (17, 33), seed=4)
    compare(backend, dataclasses.replace(scene, sh=scene.sh[:, : 1 + rest]))


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_quaternion_of_a_round_gaussian_has_no_gradient(backend, antialiased):
    """Exactly, since Adam turns rounding errors into whole steps; points become round Gaussians."""
    scene = random(30, (41, 35), seed=12, log_scales=np.repeat(np.linspace(-3, -1, 30), 3).reshape(30, 3))
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased)
    _, gradients, _ = images_and_gradients(scene, backend, where(backend), settings)
    assert np.all(gradients["quats"] == 0) and np.all(gradients["log_scales"] != 0)


@pytest.mark.parametrize("channels", [1, 4, 7, 32])
def test_features_and_median_depth(backend, channels):
    """The median depth may differ where the transmittance is within float32 rounding of one half."""
    scene = random(24, (20, 17), seed=channels)
    settings = RenderSettings(median_depth=True, alpha_max=0.97, z_near=0.2)
    found = []
    for one, dtype, device in ((backend, torch.float32, where(backend)), ("cpu", torch.float64, "cpu")):
        gaussians = scene.gaussians(dtype).to(torch.device(device)).trainable()
        generator = torch.Generator().manual_seed(channels)
        features = torch.randn(24, channels, generator=generator, dtype=torch.float64)
        features = features.to(gaussians.means).requires_grad_()
        out = render(gaussians, scene.camera, settings=settings, features=features, backend=one)
        draw = torch.randn(out.features.shape, generator=generator, dtype=torch.float64).to(out.features)
        ((out.features * draw).sum() + out.image.sum() + out.mean_depth.sum()).backward()
        values = {"features": out.features, "image": out.image, "median": out.median_depth}
        gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
        gradients["of features"] = features.grad
        found.append([{k: t.detach().double().cpu() for k, t in d.items()} for d in (values, gradients)])
    (values, gradients), (truths, expected) = found
    for key in ("features", "image"):
        assert (values[key] - truths[key]).abs().max() < 1.1 * max(1.0, truths[key].abs().max()) / 255
        assert (values[key] - truths[key]).abs().median() < 1e-5
    assert ((values["median"] - truths["median"]).abs() > 1e-5).sum() <= 2 and truths["median"].max() > 2
    for key, truth in expected.items():
        assert (gradients[key] - truth).abs().max() <= 3e-4 * truth.abs().max(), key
