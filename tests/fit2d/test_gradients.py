"""Gradients equal finite differences where the image is smooth, and autograd where it is not."""

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, ShapeError
from gsplat_edu.base.constants import ALPHA_MAX
from gsplat_edu.fit2d.gradients import backward_2d, squared_error
from gsplat_edu.fit2d.splats import PER_SPLAT, Splats2D, render_2d
from gsplat_edu.render.torch.render import render_t

NUDGE = np.finfo(np.float64).eps ** (1 / 3)


def moved(splats, name, index, step):
    arrays = {key: array.copy() for key, array in splats.arrays().items()}
    arrays[name][index] += step
    return Splats2D(**arrays)


@pytest.mark.parametrize("name", PER_SPLAT)
def test_every_parameter_against_central_differences(smooth, name):
    """With h = eps^(1/3) and L < 1, the truncation h² |L'''| / 6 and the rounding eps |L| / h are below eps^(2/3)."""
    splats, height, width, background = smooth
    target = np.random.default_rng(1).uniform(size=(height, width, 3))

    def loss(changed):
        return squared_error(render_2d(changed, height, width, background).image, target)[0]

    rendered = render_2d(splats, height, width, background)
    derived = backward_2d(rendered, squared_error(rendered.image, target)[1]).arrays()[name]
    measured = np.empty_like(derived)
    for index in np.ndindex(measured.shape):
        there, back = (loss(moved(splats, name, index, sign * NUDGE)) for sign in (1, -1))
        measured[index] = (there - back) / (2 * NUDGE)
    assert loss(splats) < 1
    assert np.abs(derived).min() > 100 * NUDGE**2, "no gradient is too small to measure"
    assert np.abs(derived - measured).max() < NUDGE**2


def lifted(splats, height, width):
    """Place 2D splats in front of a camera as flat Gaussians, parallel to the image and ordered by depth."""
    count, focal = len(splats["angles"]), 40.0
    z = torch.linspace(2.0, 5.0, count, dtype=torch.float64)
    camera = Camera.looking_at((0, 0, 0), (0, 0, 1), focal, focal, height, width)
    middle = torch.tensor([width / 2, height / 2], dtype=torch.float64)
    means = torch.cat([(splats["means"] - middle) * z[:, None] / focal, z[:, None]], dim=1)
    c, s = torch.cos(splats["angles"]), torch.sin(splats["angles"])
    R = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    M = R * torch.exp(splats["log_scales"])[:, None, :] * (z / focal)[:, None, None]
    covariances = torch.nn.functional.pad(M @ M.mT, (0, 1, 0, 1))
    return camera, means, covariances, splats["colors"], torch.sigmoid(splats["logit_opacities"])


def test_floor_and_clamp_against_autograd_through_the_dense_renderer(rough):
    height, width, background = 37, 43, (0.3, 0.1, 0.6)
    rendered = render_2d(rough, height, width, background)
    assert any((f.alpha == ALPHA_MAX).any() for f in rendered.footprints)
    target = np.random.default_rng(2).uniform(size=(height, width, 3))
    grad_image = squared_error(rendered.image, target)[1]

    leaves = {name: torch.tensor(array, requires_grad=True) for name, array in rough.arrays().items()}
    camera, *arguments = lifted(leaves, height, width)
    out = render_t(*arguments, camera)
    image = out.image + out.transmittance[..., None] * torch.tensor(background, dtype=torch.float64)
    assert np.abs(image.detach().numpy() - rendered.image).max() < 1e-12
    image.backward(torch.tensor(grad_image))
    for name, derived in backward_2d(rendered, grad_image).arrays().items():
        expected = leaves[name].grad.numpy()
        assert np.abs(derived - expected).max() < 1e-11 * np.abs(expected).max(), name


def test_the_squared_error_and_its_gradient_follow_the_equation():
    rng = np.random.default_rng(3)
    image, target = rng.uniform(size=(2, 5, 7, 3))
    error, slope = squared_error(image, target)
    assert np.isclose(error, ((image - target) ** 2).sum() / 105, rtol=1e-14)
    assert np.allclose(slope, 2 * (image - target) / 105, rtol=1e-14)


def test_a_splat_that_reaches_no_pixel_has_no_gradient():
    faint = Splats2D(
        means=np.array([[3.0, 3.0], [500.0, 3.0], [3.0, 3.0]]),
        log_scales=np.zeros((3, 2)),
        angles=np.zeros(3),
        colors=np.ones((3, 3)),
        logit_opacities=np.array([-9.0, 2.0, 0.0]),
    )
    gradients = backward_2d(render_2d(faint, 8, 8), np.ones((8, 8, 3)))
    for array in gradients.arrays().values():
        assert not array[:2].any()
    assert gradients.colors[2].all() and gradients.logit_opacities[2] != 0


def test_no_splats_give_the_background_and_no_gradients():
    none = Splats2D(**{name: np.zeros((0, *shape)) for name, shape in PER_SPLAT.items()})
    rendered = render_2d(none, 4, 6, (0.1, 0.2, 0.3))
    assert np.array_equal(rendered.image, np.broadcast_to((0.1, 0.2, 0.3), (4, 6, 3)))
    assert len(backward_2d(rendered, np.ones((4, 6, 3)))) == 0


def test_sizes_that_differ_are_named(smooth, as_shipped):
    splats, height, width, background = smooth
    rendered = render_2d(splats, height, width, background)
    with pytest.raises(ShapeError, match="grad_image"):
        backward_2d(rendered, np.zeros((height, width + 1, 3)))
    with pytest.raises(ShapeError, match="target"):
        squared_error(rendered.image, np.zeros((height + 1, width, 3)))
