"""The statistics of each Gaussian that a backward pass collects equal sums of the dense formulas over the pixels."""

import functools

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, ShapeError, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch.render import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.train.optimizer import Adam
from native_scenes import SCENES, random, smooth_scene

NAMES = ("absgrad", "weight_sum", "weight_max", "pixels", "error_sum")


@functools.cache
def weights_of(name):
    """Return the weight of every Gaussian in every pixel (N, H, W), rendered with this Gaussian white and the others
    black."""
    scene = SCENES[name]
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    opacities = 1 / (1 + np.exp(-scene.logits))
    draw = functools.partial(render_gaussians, scene.camera, scene.means, covs, extent="exact", stop="tile")
    eye = np.eye(len(scene.means))
    return np.stack([draw(np.repeat(column[:, None], 3, axis=1), opacities)[0][..., 0] for column in eye])


def collected(scene, names, errors=None, dtype=torch.float64, fused=False):
    """Return the statistics of a pass with a random loss, scattered to all Gaussians, and the weights of the loss."""
    gaussians = scene.gaussians(dtype).trainable()
    out = render(gaussians, scene.camera, settings=RenderSettings(depth=False), backend="cpu")
    statistics = out.collect(*names, errors=errors)
    draw = torch.randn(out.image.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    step = out.defer() if fused else None
    (out.image * draw.to(dtype)).sum().backward()
    if fused:
        Adam(gaussians.tensors(), dict.fromkeys(gaussians.tensors(), 1e-3)).step(gaussians.tensors(), step)
    found = {}
    for name, values in statistics().items():
        assert len(values) == len(out.visible)
        found[name] = torch.zeros(len(gaussians), *values.shape[1:], dtype=dtype)
        found[name][out.visible] = values
    return found, draw


@pytest.mark.parametrize(
    "name", ["random", "needles 100:1", "opaque, tiles stop", "17 x 33", "partly behind"]
)
def test_weights_are_those_of_the_reference(isa, name):
    """The bound is 1e-10 of an opaque pixel, for sums times the number of pixels."""
    scene = SCENES[name]
    size = (scene.camera.H, scene.camera.W)
    errors = torch.rand(size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found, _ = collected(scene, NAMES[1:], errors)
    weights = weights_of(name)
    bound = 1e-10 * size[0] * size[1]
    np.testing.assert_allclose(found["weight_sum"], weights.sum(axis=(1, 2)), rtol=0, atol=bound)
    np.testing.assert_allclose(found["weight_max"], weights.max(axis=(1, 2)), rtol=0, atol=1e-10)
    np.testing.assert_array_equal(found["pixels"], (weights > 0).sum(axis=(1, 2)))
    weighed = (weights * errors.numpy()).sum(axis=(1, 2))
    np.testing.assert_allclose(found["error_sum"], weighed, rtol=0, atol=bound)
    assert found["error_sum"].max() > 0.1


def pixel_gradients(scene, draw):
    """Return the sum over the pixels of |d loss / d mean in the image|, by a backward pass of the dense renderer per
    pixel."""
    gaussians = scene.gaussians()
    covs = cov3d_t(gaussians.log_scales, gaussians.quats)
    toward = gaussians.means - torch.tensor(scene.camera.eye)
    colors = eval_sh_t(3, gaussians.sh, toward / toward.norm(dim=-1, keepdim=True))
    means = gaussians.means.clone().requires_grad_()
    out = render_t(means, covs, colors, gaussians.opacities, scene.camera, track_means2d=True)
    sums = torch.zeros(len(means), 2, dtype=torch.float64)
    for pixel in (out.image * draw).sum(dim=2).flatten():
        out.means2d.grad = None
        pixel.backward(retain_graph=True)
        sums[out.visible] += out.means2d.grad.abs()
    return sums


@pytest.mark.parametrize("scene", [smooth_scene(3), random(40, (13, 11), seed=4)], ids=["smooth", "hard"])
def test_absolute_gradients_are_sums_of_each_pixels(isa, scene):
    """The bound is 1e-9 of the largest. A few visible Gaussians get none, because no pixel of theirs is above 1/255."""
    found, draw = collected(scene, ["absgrad"])
    truth = pixel_gradients(scene, draw)
    assert (found["absgrad"] - truth).abs().max() <= 1e-9 * truth.max()
    signed, _ = collected(scene, ["absgrad", "pixels"])
    assert signed["absgrad"].shape == (len(scene.means), 2) and signed["pixels"].max() > 10


def test_the_bits_do_not_depend_on_threads_or_on_the_step_in_the_backward_pass():
    before, found = torch.get_num_threads(), []
    errors = torch.rand(41, 35, generator=torch.Generator().manual_seed(1))
    scene = random(80, (35, 41))
    try:
        for threads, fused in ((1, False), (2, False), (5, False), (2, True)):
            torch.set_num_threads(threads)
            found.append(collected(scene, NAMES, errors, torch.float32, fused)[0])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(values, other[name]) for name, values in found[0].items())


def test_collecting_changes_no_gradient():
    """The images and gradients have the bits of a pass that collects nothing."""
    gradients = []
    for collects in (False, True):
        gaussians = SCENES["random"].gaussians(torch.float32).trainable()
        out = render(gaussians, SCENES["random"].camera, backend="cpu")
        if collects:
            out.collect("weight_sum")
        (out.image.sum() + out.depth.sum()).backward()
        gradients.append({name: tensor.grad for name, tensor in gaussians.tensors().items()})
    assert all(torch.equal(tensor, gradients[1][name]) for name, tensor in gradients[0].items())


def test_wrong_requests_are_named():
    scene = smooth_scene(0)
    out = render(scene.gaussians().trainable(), scene.camera, backend="cpu")
    for names, errors in (
        (("weights",), None),
        ((), None),
        (("error_sum",), None),
        (("pixels",), torch.zeros(9, 11)),
    ):
        with pytest.raises(ArgumentError, match="^collect: "):
            out.collect(*names, errors=errors)
    with pytest.raises(ShapeError, match="^errors"):
        out.collect("error_sum", errors=torch.zeros(11, 9))
    statistics = out.collect("pixels")
    with pytest.raises(ArgumentError, match="call backward on a loss of this image first"):
        statistics()
    dense = render(scene.gaussians(), scene.camera, backend="torch")
    with pytest.raises(ArgumentError, match="only the backends cpu and webgpu"):
        dense.collect("pixels")
