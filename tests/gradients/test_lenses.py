"""Gradients through every projection and shutter: of the Gaussians, the pose, the lens and the motion.

Finite differences are taken on smooth scenes: a few Gaussians ahead of the camera, each wider than a small image, so
that alpha is above its floor and below its clamp at every pixel; no depths swap, and no mean is near the widest angle
or a pole. `tests/native/test_lenses.py` compares the kernels with autograd on scenes with rims.
"""

import itertools

import numpy as np
import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from lens_scenes import CENTRE, LENSES, ROTATION, differentiable, rebuilt, smooth_around
from native_scenes import BACKGROUND

SIZE = (11, 9)


def window(name: str, away: float = 0.0) -> Camera:
    """Return a camera whose small image shows what `smooth_around` has ahead, `away` radians off its optical axis."""
    projection, shutter = LENSES[name]
    W, H = SIZE
    turn = np.array([[np.cos(away), 0, -np.sin(away)], [0, 1, 0], [np.sin(away), 0, np.cos(away)]])
    if projection.kind == "equirectangular":
        panorama = Camera.panorama(ROTATION, CENTRE, H, 2 * H)
        return Camera.posed(turn @ panorama.R, panorama.eye, panorama.intrinsics, shutter)
    focal = {"orthographic": 3.0}.get(projection.kind, 10.0)
    off = {"fisheye": away, "perspective": np.tan(away)}.get(projection.kind, 0.0)
    cx = 0.5 * W + focal * off  # ahead of the world is at -away in the camera
    return Camera(turn, CENTRE, focal, 1.1 * focal, cx, 0.45 * H, H, W).through(projection, shutter)


def images(out):
    return out.image, out.transmittance, out.depth


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize(("name", "first"), [*zip(LENSES, itertools.cycle(["torch", "cpu"]))])
def test_finite_differences(name, first, backend):
    """Of every lens, one backend is antialiased: the compensation depends on the footprint, whatever its lens."""
    antialiased = backend == first
    scene, camera = smooth_around(3), window(name)
    settings = RenderSettings(antialiased=antialiased)
    raw, pose, template = differentiable(scene, camera)
    assert len(render(scene.gaussians(), camera, backend=backend).visible) == 3

    def forward(means, quats, log_scales, *tensors):
        gaussians = Gaussians(means, quats, log_scales, *raw[3:])
        background = torch.tensor(BACKGROUND, dtype=torch.float64)
        given = rebuilt(template, tensors)
        return images(render(gaussians, given, settings=settings, background=background, backend=backend))

    inputs = (*raw[:3], *pose)
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=2e-6, rtol=2e-5, fast_mode=True)


@pytest.mark.parametrize("backend", ["torch", "cpu"])
@pytest.mark.parametrize("away", [1e-7, 0.15, 0.205, 1.7, 2.3])
def test_a_fisheye_near_its_axis_and_past_90_degrees(backend, away):
    """At 0.2 radians the closed form takes over from the series; 2.3 radians are 132 degrees."""
    scene, camera = smooth_around(3), window("fisheye", away)
    raw, pose, template = differentiable(scene, camera)

    def forward(means, log_scales, *tensors):
        gaussians = Gaussians(means, raw[1], log_scales, *raw[3:])
        return images(render(gaussians, rebuilt(template, tensors), backend=backend))

    inputs = (raw[0], raw[2], *pose)
    assert len(render(scene.gaussians(), camera, backend=backend).visible) == 3
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=2e-6, rtol=2e-5, fast_mode=True)
