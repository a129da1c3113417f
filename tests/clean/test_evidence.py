"""The evidence equals brute force: the NumPy reference's weights, and renders without one splat."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.clean.evidence import FAINT, MOST_OPAQUE, REDRAWN_EVERY, gather, peak_weights
from gsplat_edu.render.api import render
from gsplat_edu.render.numpy_reference import render_gaussians
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussian_math import build_cov3d_batch, quat_to_R_batch
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

from .conftest import CPU

CAMERA = Camera(np.eye(3), (0.1, -0.05, -3.0), fx=50.0, fy=45.0, cx=20.3, cy=16.8, H=35, W=41)

SETTINGS = RenderSettings(depth=False, median_depth=True, sh_degree=0)

COUNT, REPEATS = 20, 100


@pytest.fixture(scope="module")
def scene():
    """Twenty large, half transparent float64 splats. None reaches the clamp of alpha, and no tile stops early."""
    rng = np.random.default_rng(5)
    return Gaussians(
        means=torch.tensor(
            np.column_stack([rng.uniform(-0.6, 0.6, (COUNT, 2)), rng.permutation(COUNT) / COUNT])
        ),
        quats=torch.tensor(rng.normal(size=(COUNT, 4))),
        log_scales=torch.tensor(np.log(rng.uniform(0.05, 0.2, (COUNT, 3)))),
        sh0=torch.tensor(rng.uniform(-0.5, 0.5, (COUNT, 1, 3)) / C0),
        sh_rest=torch.zeros(COUNT, 0, 3, dtype=torch.float64),
        logit_opacities=torch.tensor(rng.uniform(-1.0, 0.5, COUNT)),
    )


@pytest.fixture(scope="module")
def photo():
    """A photo that the scene does not resemble, so that both terms of the change matter."""
    return np.random.default_rng(6).integers(0, 256, (CAMERA.H, CAMERA.W, 3), dtype=np.uint8)


def reference_weights(gaussians) -> np.ndarray:
    """Return (N, H, W) weights: the reference's images of one white splat among black ones."""
    values = {name: tensor.numpy() for name, tensor in gaussians.tensors().items()}
    cov3ds = build_cov3d_batch(np.exp(values["log_scales"]), quat_to_R_batch(values["quats"]))
    opacities = 1 / (1 + np.exp(-values["logit_opacities"]))
    weights = []
    for i in range(len(opacities)):
        white = np.zeros((len(opacities), 3))
        white[i] = 1.0
        drawn, _ = render_gaussians(CAMERA, values["means"], cov3ds, white, opacities, extent="exact")
        weights.append(drawn[..., 0])
    return np.stack(weights)


def squared_error(gaussians, photo, mask=None) -> float:
    image = render(gaussians, CAMERA, settings=SETTINGS, backend="cpu").image.clamp(0, 1).numpy()
    squares = np.square(image - photo / 255.0)
    return float((squares if mask is None else squares[mask]).sum())


def without(gaussians, i) -> Gaussians:
    return gaussians.map(lambda tensor: torch.cat([tensor[:i], tensor[i + 1 :]]))


def test_weights_and_gaps_are_those_of_the_reference(scene, photo):
    """The float64 kernels and the reference differ by rounding only, at most 1e-9 of a sum over 1,435 pixels."""
    found = gather(scene, [View(CAMERA, photo)], SETTINGS, CPU)
    weights = reference_weights(scene)
    np.testing.assert_allclose(found.weight, weights.sum(axis=(1, 2)), rtol=1e-9)
    np.testing.assert_allclose(found.peak, weights.max(axis=(1, 2)), rtol=1e-6)  # peak is float32
    transmittance = 1.0 - np.cumsum(weights[np.argsort(scene.means[:, 2].numpy())], axis=0)
    ordered = np.sort(scene.means[:, 2].numpy()) + 3.0
    passed = transmittance < 0.5
    depth = np.where(passed.any(axis=0), ordered[passed.argmax(axis=0)], np.inf)
    z = scene.means[:, 2].numpy() + 3.0
    gaps = [
        np.average(np.where(passed.any(axis=0), 1.0 - z[i] / depth, 0.0), weights=weights[i])
        for i in range(COUNT)
    ]
    np.testing.assert_allclose(found.gap, gaps, atol=1e-9)


def test_the_gain_is_the_change_of_the_error_without_the_splat(scene, photo):
    """The render stays within 0 to 1, so no pixel is clamped.

    The square term is a mean over random signs. A sum of random signs has a square of mean S and standard deviation
    at most sqrt(2) S, so the mean of 100 views is off by 0.14 S at one sigma; 5 sigma are allowed.
    """
    found = gather(scene, [View(CAMERA, photo)] * REPEATS, SETTINGS, CPU)
    whole = squared_error(scene, photo)
    assert found.error == pytest.approx(REPEATS * whole)
    full = render(scene, CAMERA, settings=SETTINGS, backend="cpu").image
    for i in range(COUNT):
        rest = without(scene, i)
        square = float((render(rest, CAMERA, settings=SETTINGS, backend="cpu").image - full).square().sum())
        change = whole - squared_error(rest, photo)
        assert found.gain[i] / REPEATS == pytest.approx(change, abs=5 * 0.1415 * square + 1e-6)


def test_the_gain_of_a_removed_splat_is_that_of_adding_it(scene, photo):
    """Drawn at 0.02, a splat ends where alpha is 1/255. That core holds 80 % of the linear and 96 % of the square
    term."""
    removed = np.zeros(COUNT, dtype=bool)
    removed[7] = True
    found = gather(scene, [View(CAMERA, photo)] * (REDRAWN_EVERY * REPEATS), SETTINGS, CPU, removed)
    present, absent = squared_error(scene, photo), squared_error(without(scene, 7), photo)
    images = [render(g, CAMERA, settings=SETTINGS, backend="cpu").image for g in (scene, without(scene, 7))]
    square = float((images[0] - images[1]).square().sum())
    linear = present - absent - square
    assert found.weight[7] > 0
    allowed = 0.25 * abs(linear) + 0.04 * square + 5 * 0.1415 * square
    assert found.gain[7] / REPEATS == pytest.approx(present - absent, abs=allowed)
    assert FAINT < MOST_OPAQUE


def test_masked_pixels_are_no_evidence(scene, photo):
    mask = np.zeros((CAMERA.H, CAMERA.W), dtype=bool)
    mask[:, :20] = True
    other = photo.copy()
    other[~mask] = 255 - other[~mask]
    one, two = (gather(scene, [View(CAMERA, image, mask=mask)], SETTINGS, CPU) for image in (photo, other))
    for field in dataclasses.fields(one):
        assert np.array_equal(getattr(one, field.name), getattr(two, field.name)), field.name
    weights = reference_weights(scene)
    np.testing.assert_allclose(one.weight, weights.sum(axis=(1, 2)), rtol=1e-9)  # masked pixels included
    np.testing.assert_allclose(one.peak, weights.max(axis=(1, 2)), rtol=1e-6)
    assert one.error == pytest.approx(squared_error(scene, photo, mask))


def test_peak_weights_equal_the_peaks_of_the_evidence(scene, photo):
    found = gather(scene, [View(CAMERA, photo)], SETTINGS, CPU)
    np.testing.assert_allclose(
        peak_weights(scene, [View(CAMERA, photo)], SETTINGS, CPU), found.peak, rtol=1e-6
    )
