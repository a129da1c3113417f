"""Gradients of the native kernels.

Gradients in float64 agree with finite differences and with autograd through the dense renderer. The scenes are
smooth: every alpha is farther above the floor 1/255 than the step can move it (no Gaussian's rim is inside the small
image), no alpha is clamped, no colour is floored, and no depths swap.

float32 is tested against float64. Replaying the forward pass loses digits behind nearly opaque layers: the error of
R / (1 - alpha) is about eps |R0| / (1 - alpha) (native/composite_backward.cpp), so the bound is absolute.
"""

import dataclasses

import pytest
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, SCENES, assert_smooth, camera, smooth_scene
from proofs import proves_gradients

PARAMETERS = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


@pytest.mark.parametrize(("seed", "antialiased"), [(0, False), (1, True)])
def test_gradcheck_of_all_parameters(isa, antialiased, seed):
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
    assert proves_gradients(forward, inputs)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_gradcheck_of_lower_degrees(degree):
    scene = smooth_scene(2, n=3)
    gaussians, settings = scene.gaussians(), RenderSettings(sh_degree=degree)

    def forward(means, sh0, sh_rest):
        moved = dataclasses.replace(gaussians, means=means, sh0=sh0, sh_rest=sh_rest)
        return render(moved, scene.camera, settings=settings, backend="cpu").image

    assert proves_gradients(forward, [gaussians.means, gaussians.sh0, gaussians.sh_rest])


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_of_render_covariances(isa, antialiased):
    """Covariances are perturbed symmetrically, as S = B B' + 0.3 I."""
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
    assert proves_gradients(forward, [background, means, roots, colors, logits])


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


# The dense renderer does not stop tiles: it gives gradients with weights below 1e-4, the kernels none.
@pytest.mark.parametrize("name", [name for name in SCENES if name != "opaque, tiles stop"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_float64_agrees_with_autograd_through_the_dense_renderer(name, antialiased):
    """They agree to 1e-9 of the largest gradient, even at floors, clamps and needles, because both take the same
    branches."""
    ours = gradients(SCENES[name], "cpu", antialiased=antialiased)
    theirs = gradients(SCENES[name], "torch", antialiased=antialiased)
    for key, gradient in theirs.items():
        scale = float(gradient.abs().max()) + 1e-9
        torch.testing.assert_close(
            ours[key], gradient, rtol=0, atol=1e-9 * scale, msg=lambda m, key=key: f"{key}: {m}"
        )


@pytest.mark.parametrize("name", [name for name in SCENES if name != "ties in depth"])
def test_float32_agrees_with_float64(isa, name):
    """The bound is 3e-4 of each parameter's largest gradient. Ties in depth are left out, because rounding decides
    their order.

    R loses eps |R0| / (1 - alpha) at a layer: 1.2e-7 x 100 = 1.2e-5 of R0 behind one clamped at 0.99. A pixel passes
    two such layers before its tile stops, and about twenty fainter ones that lose a tenth of that each. Needles and
    Gaussians close to the camera have conics with ac / det up to about 200. With exponents up to 20 they lose up to
    8 eps x 200 x 20 = 4e-3, which is their bound.
    """
    bound = 4e-3 if name in ("needles 100:1", "partly behind") else 3e-4
    single, double = (gradients(SCENES[name], "cpu", dtype) for dtype in (torch.float32, torch.float64))
    for key, gradient in double.items():
        error = float((single[key].double() - gradient).abs().max())
        assert error < bound * float(gradient.abs().max()), key


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_gradients_do_not_depend_on_threads(set_threads, threads):
    set_threads(1)
    alone = gradients(SCENES["random"], "cpu", torch.float32)
    set_threads(threads)
    for key, gradient in gradients(SCENES["random"], "cpu", torch.float32).items():
        assert torch.equal(gradient, alone[key]), key
