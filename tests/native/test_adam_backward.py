"""Adam in the backward pass gives the bits of storing gradients and calling Adam, over several steps."""

import numpy as np
import pytest
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.optimizer import Adam, ParameterGroup
from native_scenes import random

GROUPS = {
    "means": ParameterGroup(lambda iteration: 1e-3 / (1 + iteration)),
    "quats": ParameterGroup(2e-3, eps=1e-15),
    "log_scales": ParameterGroup(3e-3, betas=(0.8, 0.99)),
    "sh0": 4e-3,
    "sh_rest": ParameterGroup(5e-4, eps=1e-12, betas=(0.9, 0.95)),
    "logit_opacities": 6e-3,
}


def scene_with(count, degree, dtype, seed=0):
    """Return Gaussians with a few outside the view, behind the camera or not finite, and their camera."""
    scene = random(count, (120, 90), seed=seed)
    raw = scene.gaussians(dtype)
    aside = raw.means + torch.tensor(scene.camera.R[0], dtype=dtype) * 1e3
    means = torch.where(torch.arange(count)[:, None] % 5 == 2, aside, raw.means)
    means[1::97], means[2::101, 2] = float("nan"), -50.0
    rest = raw.sh_rest[:, : (degree + 1) ** 2 - 1].clone()
    return Gaussians(**raw.tensors() | {"means": means, "sh_rest": rest}), scene.camera


def train(raw, camera, *, fused, steps=4, settings=None, regularised=True):
    """Take steps; return all parameters and moments."""
    gaussians = raw.trainable()
    optimizer, found = Adam(gaussians.tensors(), GROUPS), {}
    for step in range(steps):
        settings = settings or RenderSettings(background=(0.1, 0.4, 0.8), sh_degree=min(step, 3), depth=False)
        output = render(gaussians, camera, settings=settings, backend="cpu")
        take = output.defer() if fused else None
        loss = output.image.square().sum() + 0.3 * output.transmittance.sum()
        if regularised:
            loss = loss + gaussians.opacities.sum() + gaussians.scales.sum()
        loss.backward()
        assert (gaussians.means.grad is None) == fused
        optimizer.schedule(step)
        optimizer.step(gaussians.tensors(), take)
        found[f"norms {step}"] = output.means2d_grad_norms()
    moments, _ = optimizer.state()
    for part, tensors in {"raw": gaussians.tensors(), **moments}.items():
        found |= {f"{part} {name}": tensor.detach() for name, tensor in tensors.items()}
    return found


def check_same(found, expected):
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        bits = torch.int32 if tensor.dtype == torch.float32 else torch.int64
        assert torch.equal(tensor.view(bits), found[name].view(bits)), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_bits_are_those_of_two_steps(isa, dtype, degree):
    """700 Gaussians are two full blocks and a part of a third."""
    raw, camera = scene_with(700, degree, dtype)
    expected = train(raw, camera, fused=False)
    check_same(train(raw, camera, fused=True), expected)
    moved = expected["raw means"] != raw.means
    assert moved[raw.means.isfinite().all(dim=1)].any() and not moved[raw.means.isfinite()].all()


@pytest.mark.parametrize("count", [1, 63, 255, 256, 257])
def test_any_number_of_gaussians(isa, count):
    raw, camera = scene_with(count, 3, torch.float32, seed=count)
    for regularised in (False, True):
        both = [train(raw, camera, fused=fused, regularised=regularised) for fused in (True, False)]
        check_same(*both)


def test_antialiasing_and_depth():
    raw, camera = scene_with(300, 3, torch.float32)
    settings = RenderSettings(antialiased=True)
    check_same(*(train(raw, camera, fused=fused, settings=settings) for fused in (True, False)))


def test_moments_decay_if_no_gaussian_is_in_view():
    """Moments decay as they do with stored gradients of zero."""
    raw, camera = scene_with(300, 3, torch.float32)
    gone = raw.map(torch.clone)
    gone.means[:] = raw.means + torch.tensor(camera.R[0], dtype=torch.float32) * 1e3
    check_same(*(train(gone, camera, fused=fused) for fused in (True, False)))


def test_threads_do_not_change_the_bits(set_threads):
    raw, camera = scene_with(12_000, 3, torch.float32)
    set_threads(1)
    expected = train(raw, camera, fused=False)
    for threads in (1, 2, 5):
        set_threads(threads)
        check_same(train(raw, camera, fused=True), expected)


@pytest.mark.parametrize("seed", range(10))
def test_poisoned_parameters(seed):
    raw, camera = scene_with(300, 3, torch.float32, seed)
    rng = np.random.default_rng(seed)
    poisons = torch.tensor([float("nan"), float("inf"), -float("inf"), 1e-42, 3e38, -3e38, 0.0])
    for tensor in raw.tensors().values():
        flat = tensor.view(-1)
        victims = torch.tensor(rng.choice(len(flat), 30, replace=False))
        flat[victims] = poisons[torch.tensor(rng.integers(len(poisons), size=30))]
    check_same(*(train(raw, camera, fused=fused, regularised=False) for fused in (True, False)))
