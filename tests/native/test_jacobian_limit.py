"""Values and gradients with the clamp of x/z and y/z inside the Jacobian, which training on captures uses.

Four Gaussians are outside the enlarged image, one on each side, so every clamp is active for one of them. None is so
near to a bound that a finite difference crosses it.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, build_cov3d_batch, eval_sh, quat_to_R_batch, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, SCENES, Scene, camera
from proofs import proves_gradients

LIMIT = 1.05
SETTINGS = RenderSettings(background=BACKGROUND, jacobian_limit=LIMIT)


def outside_scene() -> Scene:
    """Return five wide Gaussians that cover the whole image, four of them beyond the bounds."""
    rng = np.random.default_rng(5)
    means = np.array([[0.1, 0.1, 0], [2.2, 0, 0.3], [-2.3, 0.1, -0.3], [0.2, 2.0, 0.5], [0.1, -2.1, -0.5]])
    sh = rng.normal(size=(5, 16, 3)) * 0.05
    sh[:, 0] += 0.5
    return Scene(
        camera(11, 9), means, rng.normal(size=(5, 4)), rng.uniform(0.3, 0.6, (5, 3)), sh, np.full(5, 0.8)
    )


def ratios(scene: Scene) -> np.ndarray:
    x, y, z = scene.camera.world_to_cam(scene.means).T
    return np.stack([x / z, y / z])


def test_the_bounds_are_the_enlarged_image():
    cam = Camera(np.eye(3), (0, 0, 0), fx=50.0, fy=40.0, cx=20.3, cy=16.8, H=35, W=41)
    (x_low, x_high), (y_low, y_high) = cam.jacobian_bounds(1.3)
    ends = [cam.fx * x + cam.cx for x in (x_low, x_high)], [cam.fy * y + cam.cy for y in (y_low, y_high)]
    # Columns run from -0.5 to 40.5. Enlarged by 1.3 around their middle, 20, they run from 20 - 26.65 to 20 + 26.65.
    np.testing.assert_allclose(ends[0], (20 - 26.65, 20 + 26.65))
    np.testing.assert_allclose(ends[1], (17 - 22.75, 17 + 22.75))
    centred = Camera(np.eye(3), (0, 0, 0), 50.0, 50.0, 31.5, 31.5, 64, 64)
    np.testing.assert_allclose(centred.jacobian_bounds(1.3)[0], (-1.3 * 0.64, 1.3 * 0.64))
    assert cam.jacobian_bounds(None) == ((-np.inf, np.inf), (-np.inf, np.inf))


@pytest.mark.parametrize("name", ["partly behind", "larger than the image", "outside"])
def test_float64_matches_the_reference(isa, name):
    scene = outside_scene() if name == "outside" else SCENES[name]
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    toward = scene.means - scene.camera.eye
    colors = eval_sh(3, scene.sh, toward / np.linalg.norm(toward, axis=-1, keepdims=True))
    arguments = (scene.camera, scene.means, covs, colors, 1 / (1 + np.exp(-scene.logits)), BACKGROUND)
    truth, _ = render_gaussians(*arguments, extent="exact", stop="tile", jacobian_limit=LIMIT)
    free, _ = render_gaussians(*arguments, extent="exact", stop="tile")
    image = render(scene.gaussians(), scene.camera, settings=SETTINGS, backend="cpu").image.numpy()
    np.testing.assert_allclose(image, truth, rtol=0, atol=1e-12)
    if name != "larger than the image":
        assert np.abs(truth - free).max() > 1e-3, "the clamp changes this scene"


def test_gradcheck(isa):
    scene = outside_scene()
    (x_low, x_high), (y_low, y_high) = scene.camera.jacobian_bounds(LIMIT)
    x, y = ratios(scene)
    clamped = (x < x_low) | (x > x_high) | (y < y_low) | (y > y_high)
    assert clamped.sum() == 4
    assert np.abs(np.stack([x - x_low, x - x_high, y - y_low, y - y_high])).min() > 0.01, (
        "no ratio is near a kink"
    )
    gaussians = scene.gaussians()
    for i in range(len(gaussians)):
        alone = gaussians.map(lambda t, i=i: t[i : i + 1])
        alpha = 1 - render(alone, scene.camera, settings=SETTINGS, backend="cpu").transmittance
        assert alpha.min() > 1.5 / 255 and alpha.max() < 0.95, "neither the floor nor the clamp is near"

    def forward(means, quats, log_scales):
        moved = dataclasses.replace(gaussians, means=means, quats=quats, log_scales=log_scales)
        return render(moved, scene.camera, settings=SETTINGS, backend="cpu").image

    assert proves_gradients(forward, [gaussians.means, gaussians.quats, gaussians.log_scales])


@pytest.mark.parametrize("name", ["partly behind", "outside"])
def test_gradients_agree_with_the_dense_renderer(name):
    scene = outside_scene() if name == "outside" else SCENES[name]
    found = []
    for backend in ("cpu", "torch"):
        gaussians = scene.gaussians().trainable()
        image = render(gaussians, scene.camera, settings=SETTINGS, backend=backend).image
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        (image * weights).sum().backward()
        found.append({key: tensor.grad for key, tensor in gaussians.tensors().items()})
    for key, gradient in found[1].items():
        scale = float(gradient.abs().max()) + 1e-9
        torch.testing.assert_close(found[0][key], gradient, rtol=0, atol=1e-9 * scale)
