"""Features are composited and differentiated like colours, on every backend.

Finite differences are taken on smooth scenes: no rim of a Gaussian is inside the small image, no alpha is clamped,
and no depths swap (`assert_smooth`). On hard scenes, images are compared with the NumPy reference, which renders any
three numbers as a colour, and gradients of the kernels with the dense renderer.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, ShapeError, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import cov3d_t
from native_scenes import SCENES, assert_smooth, smooth_scene

CHANNELS = (1, 3, 7, 32)
HARD = [name for name in SCENES if name != "thousands of layers"]


def features_of(scene, channels, dtype=torch.float64):
    rng = np.random.default_rng(channels)
    return torch.tensor(rng.normal(size=(len(scene.means), channels)), dtype=dtype)


def reference(scene, features):
    """Composite features by the NumPy reference, three at a time."""
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    opacities = 1 / (1 + np.exp(-scene.logits))
    padded = np.pad(features.numpy(), ((0, 0), (0, -features.shape[1] % 3)))
    parts = [
        render_gaussians(
            scene.camera,
            scene.means,
            covs,
            padded[:, k : k + 3],
            opacities,
            extent="exact",
            stop="tile",
        )[0]
        for k in range(0, padded.shape[1], 3)
    ]
    return np.concatenate(parts, axis=2)[..., : features.shape[1]]


@pytest.mark.parametrize("name", HARD)
def test_features_match_the_reference(isa, name):
    """Sums have at most 200 products in float64, and a conic of ratio 100:1 loses 1e4 eps."""
    scene = SCENES[name]
    features = features_of(scene, 7)
    out = render(scene.gaussians(), scene.camera, features=features, backend="cpu")
    assert out.features.shape == (scene.camera.H, scene.camera.W, 7)
    truth = reference(scene, features)
    assert np.abs(out.features.numpy() - truth).max() <= 1e-10 * max(1.0, np.abs(truth).max())


def test_colours_given_as_features_are_the_colours(isa):
    """Over black, both are the same operations in the same order, so float32 has the same bits."""
    scene = SCENES["random"]
    flat = dataclasses.replace(scene, sh=scene.sh * (np.arange(16) == 0)[None, :, None])
    gaussians = flat.gaussians(torch.float32)
    colors = (0.28209479177387814 * gaussians.sh0[:, 0] + 0.5).clamp(min=0)
    covs = cov3d_t(gaussians.log_scales, gaussians.quats)
    out = render_covariances(
        gaussians.means, covs, colors, gaussians.opacities, scene.camera, features=colors.clone()
    )
    assert torch.equal(out.features, out.image)


def random_loss(scene, backend, channels, dtype=torch.float64):
    """Differentiate a random weighting of image, transmittance, depth and features."""
    gaussians = scene.gaussians(dtype).trainable()
    features = features_of(scene, channels, dtype).requires_grad_()
    out = render(gaussians, scene.camera, features=features, backend=backend)
    generator = torch.Generator().manual_seed(7)
    images = (out.image, out.transmittance, out.depth, out.features)
    draws = [torch.randn(t.shape, generator=generator, dtype=torch.float64).to(dtype) for t in images]
    sum((t * draw).sum() for t, draw in zip(images, draws, strict=True)).backward()
    norms = torch.zeros(len(gaussians), dtype=dtype)
    norms[out.visible] = out.means2d_grad_norms()
    found = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    return found | {"features": features.grad, "means2d": norms}


@pytest.mark.parametrize("channels", [3, 32])
@pytest.mark.parametrize("name", [name for name in HARD if name != "opaque, tiles stop"])
def test_gradients_match_the_dense_renderer(isa, name, channels):
    """They agree to 1e-9 of the largest entry, as for colours, because both take the same branches. The opaque scene
    is left out, because only the kernels stop tiles.
    """
    ours, dense = (random_loss(SCENES[name], backend, channels) for backend in ("cpu", "torch"))
    for key, truth in dense.items():
        assert (ours[key] - truth).abs().max() <= 1e-9 * truth.abs().max(), key


@pytest.mark.parametrize("channels", CHANNELS)
def test_gradcheck_on_the_kernels(isa, channels):
    check(smooth_scene(channels), channels, "cpu")


@pytest.mark.parametrize("channels", CHANNELS)
def test_gradcheck_on_the_dense_renderer(channels):
    check(smooth_scene(channels), channels, "torch")


def check(scene, channels, backend):
    assert_smooth(scene, RenderSettings())
    base = scene.gaussians()

    def forward(features, means, quats, logit_opacities):
        moved = dataclasses.replace(base, means=means, quats=quats, logit_opacities=logit_opacities)
        return render(moved, scene.camera, features=features, backend=backend).features

    inputs = (features_of(scene, channels), base.means, base.quats, base.logit_opacities)
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    # random directions, because 32 channels one by one would take minutes
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


def test_the_bits_do_not_depend_on_threads():
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(random_loss(SCENES["random"], "cpu", 7, torch.float32))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(tensor, other[name]) for name, tensor in found[0].items())


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_several_cameras_stack_features(backend):
    scene = smooth_scene(0)
    features = features_of(scene, 2)
    settings = RenderSettings(median_depth=True, depth=False)
    stack = render(
        scene.gaussians(), [scene.camera] * 2, settings=settings, features=features, backend=backend
    )
    assert stack.features.shape == (2, 9, 11, 2) and stack.median_depth.shape == (2, 9, 11)
    assert torch.equal(stack.features[0], stack.features[1])
    plain = render(scene.gaussians(), [scene.camera] * 2, settings=settings, backend=backend)
    assert plain.features is None and plain.views[0].features is None


@pytest.mark.parametrize("backend", ["cpu", "torch"])
@pytest.mark.parametrize("channels", [33, 64, 71])
def test_more_channels_than_a_pass_holds(backend, channels):
    """Images, gradients and statistics of 71 channels equal those of the same channels in several renders."""
    scene, features = SCENES["random"], features_of(SCENES["random"], channels)
    found = []
    for groups in ([features], features.split(32, dim=1)):
        gaussians, leaf = scene.gaussians().trainable(), features.clone().requires_grad_()
        parts = leaf.split([group.shape[1] for group in groups], dim=1)
        outs = [render(gaussians, scene.camera, features=part, backend=backend) for part in parts]
        image = torch.cat([out.features for out in outs], dim=-1)
        collected = outs[0].collect("weight_sum", "absgrad") if backend == "cpu" and len(outs) == 1 else None
        draw = torch.Generator().manual_seed(3)
        weights = torch.randn(image.shape, generator=draw, dtype=torch.float64)
        ((image * weights).sum() + outs[0].image.sum() + outs[0].depth.sum()).backward()
        norms = sum(out.means2d_grad_norms() for out in outs) if backend == "cpu" else None
        found.append((image, leaf.grad, {k: t.grad for k, t in gaussians.tensors().items()}, norms))
        if collected is not None:
            assert float((collected()["weight_sum"] - weights_of(scene)).abs().max()) < 1e-12
            assert float(collected()["absgrad"].sum()) > 0
    (image, grad, parameters, norms), (wanted, wanted_grad, wanted_parameters, wanted_norms) = found
    bound = 1e-12 * channels  # the order of the sums differs
    torch.testing.assert_close(image, wanted, rtol=0, atol=1e-12)
    torch.testing.assert_close(grad, wanted_grad, rtol=0, atol=bound * float(wanted_grad.abs().max()))
    for name, gradient in wanted_parameters.items():
        largest = float(gradient.abs().max())
        torch.testing.assert_close(parameters[name], gradient, rtol=0, atol=bound * largest, msg=name)
    if backend == "cpu":
        torch.testing.assert_close(norms, wanted_norms, rtol=1e-9, atol=1e-9)


def weights_of(scene):
    """Return the sum of w of each visible Gaussian, which is the gradient of a feature of ones."""
    feature = torch.ones(len(scene.means), 1, dtype=torch.float64, requires_grad=True)
    out = render(scene.gaussians(), scene.camera, features=feature, backend="cpu")
    out.features.sum().backward()
    return feature.grad[out.visible, 0]


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_wrong_features_are_named(backend, as_shipped):
    scene = smooth_scene(0)
    wrong = {
        ShapeError: (torch.zeros(4, 2), torch.zeros(5), torch.zeros(5, 0)),
        ArgumentError: (torch.full((5, 2), torch.nan), torch.full((5, 1), torch.inf)),
    }
    for error, values in wrong.items():
        for features in values:
            with pytest.raises(error, match="^features"):
                render(scene.gaussians(), scene.camera, features=features.double(), backend=backend)


def test_features_of_another_dtype_are_refused():
    scene = smooth_scene(0)
    with pytest.raises(ArgumentError, match="^features: are torch.float32"):
        render(scene.gaussians(), scene.camera, features=torch.zeros(5, 2), backend="cpu")


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_an_empty_scene_has_features_of_zero(backend):
    empty = SCENES["random"].gaussians().map(lambda tensor: tensor[:0])
    features = torch.zeros(0, 4, dtype=torch.float64, requires_grad=True)
    out = render(empty.trainable(), SCENES["random"].camera, features=features, backend=backend)
    out.features.sum().backward()
    assert not out.features.any() and features.grad.shape == (0, 4)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_the_clamp_of_alpha_can_be_chosen(isa, backend):
    """At the centre of an opaque Gaussian, alpha is the clamp and the gradient is zero."""
    scene = smooth_scene(0, n=1)
    scene = dataclasses.replace(
        scene, logits=np.full(1, 20.0), means=np.array([[0.0, 0.0, 0.0]]), log_scales=np.full((1, 3), 1.5)
    )
    for clamp in (0.9, 0.99, 0.999):
        gaussians = scene.gaussians().trainable()
        settings = RenderSettings(alpha_max=clamp)
        out = render(gaussians, scene.camera, settings=settings, backend=backend)
        assert out.alpha.max().item() == pytest.approx(clamp, abs=1e-12)
        at = np.unravel_index(out.alpha.argmax().item(), out.alpha.shape)
        out.alpha[at].backward()
        assert not gaussians.logit_opacities.grad.any()
    for wrong in (1.0, 0.0, -1.0):
        with pytest.raises(ArgumentError, match="alpha_max"):
            RenderSettings(alpha_max=wrong)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_the_near_plane_can_be_chosen(backend):
    scene = SCENES["random"]
    depths = np.sort(scene.camera.world_to_cam(scene.means)[:, 2])
    near = (depths[30] + depths[31]) / 2
    out = render(
        scene.gaussians(), scene.camera, settings=RenderSettings(z_near=float(near)), backend=backend
    )
    behind = scene.camera.world_to_cam(scene.means)[:, 2] <= near
    assert behind.sum() == 31 and not behind[out.visible.numpy()].any()
    far = scene.gaussians().map(lambda tensor: tensor[torch.tensor(~behind)])
    assert torch.equal(out.image, render(far, scene.camera, backend=backend).image)
