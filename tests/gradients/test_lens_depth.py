"""Gradients of the term of depth through wide lenses: past 90 degrees, of a panorama, and of a rolling shutter.

Finite differences are taken on the smooth scenes of `test_lenses.py`: alpha is above its floor and below its clamp at
every pixel, and no sample is at a kink of the term.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gradients.test_lenses import window
from gsplat_edu.data.sparse_depth import sparse_depth
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from lens_scenes import differentiable, rebuilt, smooth_around

SETTINGS = RenderSettings(depth=True)
RULES = {"maps": DepthRule(0.7, bend=0.5), "points": DepthRule(0.3, extent=2.5)}
CASES = [("fisheye", 1.7), ("fisheye", 2.3), ("panorama", 0.0), ("panorama", 2.3), ("fisheye, moving", 1.7)]
CASES += [("opencv", 0.0)]


def opaque(n):
    """Return a smooth scene whose alpha is far above the least one that has a depth."""
    scene = smooth_around(n)
    return dataclasses.replace(scene, logits=scene.logits + 1.5)


def samples(camera, gaussians, backend, dtype=torch.float64):
    """Return places between the pixels, and depths that differ from the rendered ones by 5 to 20 percent."""
    rng = np.random.default_rng(0)
    places = torch.tensor(rng.uniform(0, (camera.W - 1, camera.H - 1), (60, 2)), dtype=dtype)
    with torch.no_grad():
        out = render(gaussians, camera, settings=SETTINGS, backend=backend)
    middle = (out.depth / out.alpha)[out.alpha > 0.5].mean()
    off = torch.tensor(rng.uniform(0.1, 0.2, 60) * rng.choice([-1, 1], 60), dtype=dtype)
    weights = torch.tensor(rng.uniform(0.2, 1.0, 60), dtype=dtype)
    return places, middle.to(dtype).cpu() * (1 + off), weights


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(("name", "away"), CASES)
def test_finite_differences(name, away, rule, backend):
    """The gradients in the Gaussians, the pose, the lens and the motion are those of the value."""
    scene, camera = opaque(3), window(name, away)
    raw, pose, template = differentiable(scene, camera)
    given = samples(camera, scene.gaussians(), backend)

    def term(means, quats, log_scales, logits, *tensors):
        gaussians = Gaussians(means, quats, log_scales, logits, *raw[4:])
        out = render(gaussians, rebuilt(template, tensors), settings=SETTINGS, backend=backend)
        return depth_error(out.depth, out.alpha, *given, RULES[rule])

    inputs = (*raw[:4], *pose)
    assert float(term(*inputs).detach()) > 1e-3
    term(*inputs).backward()
    assert float(raw[0].grad.abs().max()) > 1e-3
    assert torch.autograd.gradcheck(term, inputs, eps=1e-6, atol=1e-7, rtol=2e-5, fast_mode=True)


@pytest.mark.parametrize(("name", "away"), CASES)
def test_the_depth_is_that_of_the_samples(name, away):
    """The rendered depth of a small opaque Gaussian is the depth of its mean as `sparse_depth` gives it."""
    scene, camera = opaque(1), window(name, away)
    gaussians = scene.gaussians()
    given = sparse_depth(camera, np.asarray(scene.means))
    out = render(gaussians, camera, settings=SETTINGS, backend="cpu")
    found = (out.depth / out.alpha)[out.alpha > 0]
    assert len(given) == 1 and torch.allclose(
        found, torch.full_like(found, float(given.depths[0])), rtol=1e-6
    )
