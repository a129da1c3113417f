"""`RenderSettings(stop="pixel")`: images and gradients equal the rule applied to one Gaussian after the other."""

import numpy as np
import pytest
import torch

from gsplat_edu import build_cov3d_batch, quat_to_R_batch
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch.render import project_visible
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_witness import composited

SETTINGS = RenderSettings(stop="pixel", alpha_max=0.999)


def opaque(random_splats, dtype):
    """Return 120 large, opaque Gaussians, in which most pixels stop."""
    means, _, colors, _ = random_splats(120)
    rng = np.random.default_rng(1)
    cov3ds = build_cov3d_batch(rng.uniform(0.05, 0.4, (120, 3)), quat_to_R_batch(rng.normal(size=(120, 4))))
    arrays = (means, cov3ds, colors, rng.uniform(0.7, 1.0, 120), rng.normal(size=(120, 4)))
    return [torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays]


def witness(camera, means, cov3ds, colors, opacities, features):
    screen = project_visible(means, cov3ds, camera, SETTINGS)
    A, m, C = screen.ellipses.unbind(-1)
    conics = torch.stack([A, -A * m, C + A * m * m], dim=-1)
    centers = (screen.means2d + 0.5).expand(camera.H, camera.W, -1, 2)
    channels = torch.cat([colors, features], dim=1)[screen.visible]
    image, T = composited(centers, conics, opacities[screen.visible], channels)
    return image[..., :3], image[..., 3:], T


def losses(image, features, T):
    weights = [
        torch.randn(t.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
        for k, t in enumerate((image, features, T))
    ]
    return sum((w * t.double()).sum() for w, t in zip(weights, (image, features, T), strict=True))


def symmetric(gradient, parameter):
    """Return zeros for no gradient. Both halves of a covariance's gradient are added, because the witness reads only
    one."""
    if gradient is None:
        return torch.zeros_like(parameter)
    return gradient + gradient.mT if gradient.ndim == 3 else gradient


@pytest.mark.parametrize("with_features", [False, True])
def test_pixels_stop_one_by_one(isa, random_splats, random_camera, with_features):
    inputs = opaque(random_splats, torch.float64)
    view = render_covariances(
        *inputs[:4], random_camera, SETTINGS, features=inputs[4] if with_features else None
    )
    features = (
        view.features
        if with_features
        else torch.zeros(random_camera.H, random_camera.W, 4, dtype=torch.float64)
    )
    image, wanted_features, T = witness(random_camera, *inputs)
    left = T.detach()
    assert float(left.min()) > 1e-4 and int((left < 0.05).sum()) > 100
    assert float((view.image - image).detach().abs().max()) < 1e-12
    assert float((view.transmittance - T).detach().abs().max()) < 1e-12
    wanted_features = wanted_features if with_features else features
    assert float((features - wanted_features).detach().abs().max()) < 1e-12
    found = torch.autograd.grad(losses(view.image, features, view.transmittance), inputs, allow_unused=True)
    wanted = torch.autograd.grad(losses(image, wanted_features, T), inputs, allow_unused=True)
    for parameter, f, w in zip(inputs, found, wanted, strict=True):
        error, size = symmetric(f, parameter) - symmetric(w, parameter), symmetric(w, parameter).abs().max()
        assert float(error.abs().max()) <= 1e-9 * max(1.0, float(size))


def test_float_and_double_agree(isa, random_splats, random_camera):
    """In 99 % of the pixels, rounding does not change the stop. Their error is the rounding of 120 products of values
    up to 1, with 16 operations each."""
    views = []
    for dtype in (torch.float32, torch.float64):
        means, cov3ds, colors, opacities, _ = (t.detach() for t in opaque(random_splats, dtype))
        views.append(render_covariances(means, cov3ds, colors, opacities, random_camera, SETTINGS))
    difference = (views[0].image - views[1].image).abs().amax(dim=-1)
    assert float(difference.quantile(0.99)) < 120 * 2.0**-24 * 16


def test_the_same_bits_with_any_number_of_threads(random_splats, random_camera, set_threads):
    found = []
    for threads in (1, 3):
        set_threads(threads)
        inputs = opaque(random_splats, torch.float32)
        view = render_covariances(*inputs[:4], random_camera, SETTINGS, features=inputs[4])
        loss = losses(view.image, view.features, view.transmittance)
        found.append([view.image.detach(), *torch.autograd.grad(loss, inputs)])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_other_backends_refuse_to_stop_pixels(random_camera):
    shapes = {
        "means": (2, 3),
        "quats": (2, 4),
        "log_scales": (2, 3),
        "sh0": (2, 1, 3),
        "sh_rest": (2, 0, 3),
        "logit_opacities": (2,),
    }
    gaussians = Gaussians(**{name: torch.ones(shape) for name, shape in shapes.items()})
    with pytest.raises(ArgumentError, match="^stop: 'pixel' needs a backend .* torch does not; use"):
        render(gaussians, random_camera, settings=SETTINGS, backend="torch")
    with pytest.raises(ArgumentError, match="^stop: is 'box'"):
        RenderSettings(stop="box")
