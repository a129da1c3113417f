"""Gradients where the Jacobian of a perspective lens or shutter is clamped: points, shapes, pose, lens and motion.

The scene is smooth: a few Gaussians ahead, each wider than a small image, so that alpha is above its floor and below
its clamp at every pixel. The bounds are constants of a step, and so are they here; x/z and y/z of every mean are at
least `APART` away from them, which is a thousand times what the differences move them by, so that no ratio changes
sides. Some ratios are inside and some beyond on each axis.
"""

import numpy as np
import pytest
import torch

from gradients.test_lenses import images, window
from gsplat_edu import Camera
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from lens_scenes import differentiable, rebuilt, smooth_around
from native_scenes import BACKGROUND

X, Y = (-0.19, 0.16), (-0.09, 0.1)
APART = 1e-3
NAMES = ("opencv", "prism", "pinhole, moving", "opencv, moving up", "pincushion, moving")


@pytest.fixture
def bounds(monkeypatch):
    """Hold bounds that are narrower than the image, so that means are beyond them."""
    monkeypatch.setattr(Camera, "jacobian_bounds", lambda camera, limit: (X, Y))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("name", NAMES)
def test_finite_differences(bounds, name, backend, antialiased):
    scene, camera = smooth_around(5), window(name)
    settings = RenderSettings(antialiased=antialiased, jacobian_limit=1.3)
    raw, pose, template = differentiable(scene, camera)
    for at in (ratios(scene, camera, time) for time in (-0.5, 0.0, 0.5)):
        assert np.abs(at[:, :, None] - np.array([X, Y])).min() > APART
        inside = (at > [X[0], Y[0]]) & (at < [X[1], Y[1]])
        assert inside.any(axis=0).all() and (~inside).any(axis=0).all()
    assert len(render(scene.gaussians(), camera, settings=settings, backend=backend).visible) == 5

    def forward(means, quats, log_scales, *tensors):
        gaussians = Gaussians(means, quats, log_scales, *raw[3:])
        background = torch.tensor(BACKGROUND, dtype=torch.float64)
        given = rebuilt(template, tensors)
        return images(render(gaussians, given, settings=settings, background=background, backend=backend))

    inputs = (*raw[:3], *pose)
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=2e-6, rtol=2e-5, fast_mode=True)


def ratios(scene, camera, time):
    """Return x/z and y/z of the means at a time of the readout."""
    motion = np.zeros(6) if camera.motion is None else np.array(camera.motion)
    h = 0.5 * time * motion[:3]
    p = (scene.means - camera.eye - time * motion[3:]) @ camera.R.T
    once = np.cross(h, p)
    p = p + 2 / (1 + h @ h) * (once + np.cross(h, once))
    return p[:, :2] / p[:, 2:]
