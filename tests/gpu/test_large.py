"""Scenes too large for the interpreter, on a real GPU: `pytest -m gpu`."""

import pytest
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, random

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU"),
]
SETTINGS = RenderSettings(background=BACKGROUND, jacobian_limit=1.3)


def gradients(scene, backend, dtype):
    gaussians = scene.gaussians(dtype).to(torch.device("cuda" if backend == "cuda" else "cpu")).trainable()
    out = render(gaussians, scene.camera, settings=SETTINGS, backend=backend)
    weights = torch.randn(out.image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (out.image * weights.to(out.image)).sum().backward()
    found = {name: tensor.grad.double().cpu() for name, tensor in gaussians.tensors().items()}
    return found | {"image": out.image.detach().double().cpu()}


@pytest.mark.parametrize(("count", "size"), [(20_000, (331, 217)), (200_000, (990, 742))])
def test_gradients_match_the_native_kernels_in_float64(count, size):
    """As in test_render.py, but the bound is 1e-3 for 100 times the pairs and hundreds of Gaussians per tile."""
    scene = random(count, size, seed=4)
    scene.log_scales[:] -= 2.0
    ours, truth = gradients(scene, "cuda", torch.float32), gradients(scene, "cpu", torch.float64)
    for name, expected in truth.items():
        assert float((ours[name] - expected).abs().max()) <= 1e-3 * float(expected.abs().max()), name


def test_two_runs_give_the_same_bits():
    scene = random(200_000, (990, 742), seed=4)
    first, second = (gradients(scene, "cuda", torch.float32) for _ in range(2))
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name
