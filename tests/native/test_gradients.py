"""Gradients of the native kernels.

In double, against finite differences and against autograd through the dense renderer. The scenes are smooth,
and each check says why: every alpha that is drawn stays away from the floor 1/255 by more than the step can move
it (the Gaussians are so wide, and the images so small, that none of them reaches its rim), no alpha is clamped,
no colour is floored, no depths swap.

In float, against double. Replaying the forward pass loses digits behind nearly opaque layers: the error of
R / (1 - alpha) is about eps |R0| / (1 - alpha) (native/composite_backward.cpp), so it is bounded absolutely.
"""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.cpu import render_covariances
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, SCENES, Scene, camera

PARAMETERS = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


def smooth_scene(seed: int, n: int = 5) -> Scene:
    """A few Gaussians, each wider than the image: alpha is far above the floor at every pixel."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(n, 16, 3)) * 0.05
    sh[:, 0] += 0.5
    return Scene(
        camera(11, 9),
        means=np.stack([*rng.uniform(-0.3, 0.3, (2, n)), np.linspace(-0.5, 0.5, n)], axis=1),
        quats=rng.normal(size=(n, 4)),
        log_scales=rng.uniform(-0.6, 0.2, (n, 3)),
        sh=sh,
        logits=rng.uniform(-0.5, 1.0, n),
    )


def assert_smooth(scene: Scene, settings: RenderSettings) -> None:
    gaussians = scene.gaussians()
    depths = np.sort(scene.camera.world_to_cam(scene.means)[:, 2])
    assert np.diff(depths).min() > 1e-3, "no depths swap"
    for i in range(len(gaussians)):
        alone = gaussians.map(lambda t, i=i: t[i : i + 1])
        alpha = 1 - render(alone, scene.camera, settings=settings, backend="cpu").transmittance
        assert alpha.min() > 1.5 / 255 and alpha.max() < 0.95, "neither the floor nor the clamp is near"
        assert render(alone, scene.camera, settings=RenderSettings(), backend="cpu").image.min() > 0.0
    assert len(render(gaussians, scene.camera, backend="cpu").visible) == len(gaussians)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_gradcheck_of_everything(isa, antialiased, seed):
    scene = smooth_scene(seed)
    settings = RenderSettings(antialiased=antialiased)
    assert_smooth(scene, settings)
    gaussians = scene.gaussians()

    def forward(background, *tensors):
        moved = dataclasses.replace(gaussians, **dict(zip(PARAMETERS, tensors, strict=True)))
        out = render(moved, scene.camera, settings=settings, background=background, backend="cpu")
        return out.image, out.transmittance, out.depth

    inputs = [
        torch.tensor(BACKGROUND, dtype=torch.float64),
        *(gaussians.tensors()[name] for name in PARAMETERS),
    ]
    assert torch.autograd.gradcheck(
        forward, [t.requires_grad_() for t in inputs], eps=1e-6, atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck_of_lower_degrees(degree):
    scene = smooth_scene(2, n=3)
    gaussians, settings = scene.gaussians(), RenderSettings(sh_degree=degree)

    def forward(means, sh0, sh_rest):
        moved = dataclasses.replace(gaussians, means=means, sh0=sh0, sh_rest=sh_rest)
        return render(moved, scene.camera, settings=settings, backend="cpu").image

    inputs = [t.requires_grad_() for t in (gaussians.means, gaussians.sh0, gaussians.sh_rest)]
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_of_the_lower_door(isa, antialiased):
    """Covariances are moved along symmetric directions: S = B B' + 0.1 I."""
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    means = torch.stack(
        [0.2 * draw(4), 0.2 * draw(4), torch.linspace(-0.4, 0.4, 4, dtype=torch.float64)], dim=1
    )
    roots, colors, logits = 0.4 * draw(4, 3, 3), draw(4, 3), 0.5 * draw(4)

    settings = RenderSettings(antialiased=antialiased)

    def forward(background, means, roots, colors, logits):
        covs = roots @ roots.mT + 0.3 * torch.eye(3, dtype=torch.float64)
        opacities = torch.sigmoid(logits)
        out = render_covariances(means, covs, colors, opacities, camera(11, 9), settings, background)
        return out.image, out.transmittance, out.depth

    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    inputs = [t.requires_grad_() for t in (background, means, roots, colors, logits)]
    assert torch.autograd.gradcheck(forward, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def gradients(scene, backend, dtype=torch.float64, antialiased=False):
    settings = RenderSettings(antialiased=antialiased)
    gaussians = scene.gaussians(dtype).trainable()
    background = torch.tensor(BACKGROUND, dtype=dtype, requires_grad=True)
    out = render(gaussians, scene.camera, settings=settings, background=background, backend=backend)
    generator = torch.Generator().manual_seed(3)
    loss = sum(
        (t * torch.randn(t.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
        for t in (out.image, out.transmittance, out.depth)
    )
    loss.backward()
    norms = torch.zeros(len(gaussians), dtype=dtype)
    norms[out.visible] = out.means2d_grad_norms()
    found = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    return found | {"background": background.grad, "means2d": norms}


# Where a tile stops, the dense renderer goes on: what lies behind has weights below 1e-4 there, and no gradient
# here.
@pytest.mark.parametrize("name", [name for name in SCENES if name != "opaque, tiles stop"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_double_agrees_with_autograd_through_the_dense_renderer(name, antialiased):
    """Floors, clamps and needles included: both take the same branches. To 1e-9 of the largest gradient."""
    ours = gradients(SCENES[name], "cpu", antialiased=antialiased)
    theirs = gradients(SCENES[name], "torch", antialiased=antialiased)
    for key, gradient in theirs.items():
        scale = float(gradient.abs().max()) + 1e-9
        torch.testing.assert_close(
            ours[key], gradient, rtol=0, atol=1e-9 * scale, msg=lambda m, key=key: f"{key}: {m}"
        )


@pytest.mark.parametrize("name", [name for name in SCENES if name != "ties in depth"])
def test_float_agrees_with_double(isa, name):
    """Absolute: 3e-4 of the parameter's largest gradient. Ties are left out: rounding decides who is nearer.

    R loses eps |R0| / (1 - alpha) at a layer, 1.2e-7 x 100 = 1.2e-5 of R0 behind the clamp of 0.99; a pixel lets two
    such layers through before its tile stops, and some twenty fainter ones with a tenth of that each. Needles, and
    what passes close by the camera, have conics with ac / det up to some 200: 8 eps times that times exponents of
    up to 20 is 4e-3, which is what they get.
    """
    bound = 4e-3 if name in ("needles 100:1", "partly behind") else 3e-4
    single, double = (gradients(SCENES[name], "cpu", dtype) for dtype in (torch.float32, torch.float64))
    for key, gradient in double.items():
        error = float((single[key].double() - gradient).abs().max())
        assert error < bound * float(gradient.abs().max()), key


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_change_no_bit(set_threads, threads):
    set_threads(1)
    alone = gradients(SCENES["random"], "cpu", torch.float32)
    set_threads(threads)
    for key, gradient in gradients(SCENES["random"], "cpu", torch.float32).items():
        assert torch.equal(gradient, alone[key]), key
