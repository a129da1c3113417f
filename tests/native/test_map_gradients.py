"""Gradients of the differentiable maps agree with finite differences, on every instruction set and the dense
renderer. The scene is smooth: no rim of a Gaussian is inside the small image, no alpha is clamped, no depths swap,
and no shortest axis is nearly as long as another or perpendicular to the view.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.planes import facing_normals
from gsplat_edu.render.settings import RenderSettings
from native_scenes import assert_smooth, smooth_scene

NAMES = ("alpha", "depth", "expected-depth", "planar-depth", "normal", "distortion")


def check(name, backend):
    scene = smooth_scene(6)
    assert_smooth(scene, RenderSettings())
    scales = np.sort(scene.log_scales, axis=1)
    base = scene.gaussians()
    toward = (base.means - torch.tensor(scene.camera.eye)) * facing_normals(base, scene.camera)
    assert (scales[:, 1] - scales[:, 0]).min() > 1e-3 and toward.sum(dim=1).abs().min() > 1e-2

    def forward(means, quats, log_scales, logit_opacities):
        parts = {"means": means, "quats": quats, "log_scales": log_scales, "logit_opacities": logit_opacities}
        return render_maps(dataclasses.replace(base, **parts), scene.camera, [name], backend=backend)[0][name]

    inputs = (base.means, base.quats, base.log_scales, base.logit_opacities)
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    # random directions, because hundreds of outputs one by one would take seconds on the dense renderer
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize("name", NAMES)
def test_on_the_kernels(isa, name):
    check(name, "cpu")


@pytest.mark.parametrize("name", NAMES)
def test_on_the_dense_renderer(name):
    check(name, "torch")
