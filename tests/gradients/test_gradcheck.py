"""Autograd of the dense renderer agrees with finite differences in float64. The scenes are smooth, and each test
asserts why: there is no alpha floor (finite differences fail at a jump), no alpha reaches the clamp at 0.99, no
colour reaches the floor at 0, and no two splats swap places in depth under the step of 1e-6.
"""

import pytest
import torch

from gsplat_edu import C0, Camera
from gsplat_edu.render.torch.render import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import cov3d_t
from proofs import proves_gradients

CAMERA = Camera.looking_at(eye=[0, 0, -3], target=[0, 0, 0], fx=16, fy=16, H=16, W=16)


def leaves(seed, *shapes):
    generator = torch.Generator().manual_seed(seed)
    return [0.3 * torch.randn(*s, generator=generator, dtype=torch.float64) for s in shapes]


def scene(seed):
    """The chapter's tiny scene: four splats around the origin, seen from three units away."""
    means, log_scales, quats, sh0, logits = leaves(seed, (4, 3), (4, 3), (4, 4), (4, 3), (4,))
    quats = quats / 3 + torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    return [means, log_scales - 1.0, quats, sh0, logits]


def assert_smooth(means, color, logits):
    depths = torch.sort(means[:, 2]).values
    assert depths.diff().min() > 1e-3, "no depths swap under the step"
    assert torch.sigmoid(logits).max() < 0.95, "no alpha is clamped"
    assert color.min() > 0.01, "no colour is floored"


def test_the_tiny_scene_of_the_chapter():
    inputs = scene(0)
    assert_smooth(inputs[0], C0 * inputs[3] + 0.5, inputs[4])

    def forward(means, log_scales, quats, sh0, logits):
        colors = torch.clamp(C0 * sh0 + 0.5, min=0.0)
        cov3ds, opacities = cov3d_t(log_scales, quats), torch.sigmoid(logits)
        return render_t(means, cov3ds, colors, opacities, CAMERA, alpha_min=0.0, chunk=3).image

    assert proves_gradients(forward, inputs)


def test_image_and_transmittance_with_view_dependent_colour():
    means, log_scales, quats, _, logits = scene(1)
    (sh,) = leaves(2, (4, 16, 3))
    eye = torch.tensor(CAMERA.eye)

    def color_of(means, sh):
        return eval_sh_t(3, sh, (means - eye) / (means - eye).norm(dim=-1, keepdim=True))

    sh = sh / 3
    assert_smooth(means, color_of(means, sh), logits)

    def forward(means, log_scales, quats, sh, logits):
        out = render_t(
            means,
            cov3d_t(log_scales, quats),
            color_of(means, sh),
            torch.sigmoid(logits),
            CAMERA,
            alpha_min=0.0,
            chunk=3,
        )
        return out.image, out.transmittance

    assert proves_gradients(forward, [means, log_scales, quats, sh, logits])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree):
    sh, dirs = leaves(degree, (5, 16, 3), (5, 3))
    sh = sh / 3
    dirs = dirs / dirs.norm(dim=-1, keepdim=True)
    assert eval_sh_t(degree, sh, dirs).min() > 0.01, "no colour is floored"
    inputs = [t.requires_grad_() for t in (sh, dirs)]
    assert torch.autograd.gradcheck(lambda sh, dirs: eval_sh_t(degree, sh, dirs), inputs, eps=1e-6, atol=1e-7)


def test_the_floor_stops_the_gradient_of_colour():
    sh = torch.full((1, 1, 3), -2.0, dtype=torch.float64, requires_grad=True)  # C0 * -2 + 0.5 < 0
    eval_sh_t(0, sh, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)).sum().backward()
    assert (sh.grad == 0).all()
