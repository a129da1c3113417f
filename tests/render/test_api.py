"""render() with raw parameters equals a chain of the NumPy functions."""

import numpy as np
import pytest
import torch

from gsplat_edu import (
    ArgumentError,
    BackendUnavailableError,
    Camera,
    Scene,
    build_cov3d_batch,
    eval_sh,
    quat_to_R_batch,
    render_gaussians,
)
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians

BACKGROUND = (0.2, 0.5, 0.9)


def scene(count=30, rest=15, dtype=torch.float64) -> Gaussians:
    generator = torch.Generator().manual_seed(5)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype)

    return Gaussians(
        means=0.5 * draw(count, 3),
        quats=draw(count, 4),
        log_scales=0.4 * draw(count, 3) - 1.8,
        sh0=draw(count, 1, 3),
        sh_rest=0.4 * draw(count, rest, 3),
        logit_opacities=draw(count),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_image_matches_the_reference(random_camera, degree):
    """Colours follow from the direction from the camera to the mean. The image matches the reference up to rounding."""
    gaussians = scene()
    raw = {name: tensor.numpy() for name, tensor in gaussians.tensors().items()}
    toward = raw["means"] - random_camera.eye
    colors = eval_sh(
        degree,
        np.concatenate([raw["sh0"], raw["sh_rest"]], axis=1),
        toward / np.linalg.norm(toward, axis=-1, keepdims=True),
    )
    expected, T = render_gaussians(
        random_camera,
        raw["means"],
        build_cov3d_batch(np.exp(raw["log_scales"]), quat_to_R_batch(raw["quats"])),
        colors,
        1 / (1 + np.exp(-raw["logit_opacities"])),
        bg=BACKGROUND,
        extent="exact",
        stop="none",
    )
    settings = RenderSettings(background=BACKGROUND, sh_degree=degree)
    out = render(gaussians, random_camera, settings=settings, backend="torch")
    np.testing.assert_allclose(out.image.numpy(), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(out.transmittance.numpy(), T, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.sort(out.visible.numpy()), np.arange(30))


def test_the_stored_degree_limits_the_rendered_one(random_camera):
    gaussians = scene(rest=3)
    full, same = (render(gaussians, random_camera, settings=RenderSettings(sh_degree=d)) for d in (3, 1))
    assert gaussians.sh_degree == 1 and torch.equal(full.image, same.image)


def test_auto_uses_the_cpu_and_unknown_backends_are_refused(random_camera):
    gaussians = scene(3)
    assert torch.equal(
        render(gaussians, random_camera).image, render(gaussians, random_camera, backend="cpu").image
    )
    with pytest.raises(BackendUnavailableError, match="'metal'.*auto"):
        render(gaussians, random_camera, backend="metal")


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities"])
def test_a_value_that_is_not_finite_is_refused_by_parameter_name(random_camera, name):
    gaussians = scene(4)
    gaussians.tensors()[name].view(4, -1)[2, 0] = float("nan")
    with pytest.raises(ArgumentError, match=rf"^{name}\[2"):
        render(gaussians, random_camera, backend="torch")


def test_a_scene_instead_of_gaussians_is_told_what_to_give(as_shipped, random_camera):
    with pytest.raises(ArgumentError, match=r"^gaussians: is a Scene; give its Gaussians, \.gaussians$"):
        render(Scene(scene()), random_camera)
    with pytest.raises(ArgumentError, match="^gaussians: is .* but has to be of type Gaussians$"):
        render("scene.ply", random_camera)


def test_a_camera_of_other_matrices_never_guesses_half_a_pixel():
    K = np.array([[75.0, 0, 32], [0, 75, 32], [0, 0, 1]])
    with pytest.raises(TypeError, match="first_pixel"):
        Camera.from_viewmat(np.eye(4), K, 64, 64)
    for first in (0.0, 0.5):
        camera = Camera.from_viewmat(np.eye(4), K, 64, 64, first_pixel=first)
        assert (camera.cx, camera.cy) == (32 - first, 32 - first)
