"""Extra signals are weighted like colours, without a floor, and returned in `meta`. Depths need no colours."""

import pytest
import torch

import gsplat_witness
from gsplat_calls import C, N, arguments
from gsplat_edu.compat.gsplat import rasterization, skipping_bad_gaussians
from proofs import proves_gradients

W, H = 23, 18
EXACT = 1e-9
"""Bound in float64, relative to the largest entry; tests/compat/test_rasterization.py derives it."""


def assert_close(found, wanted):
    assert found.shape == wanted.shape
    found, wanted = found.detach(), wanted.detach()
    assert float((found - wanted).abs().max()) <= EXACT * max(1.0, float(wanted.abs().max()))


def normal(*shape, seed=3):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def scene():
    tensors = gsplat_witness.scene()
    tensors["colors"] = tensors["colors"][:, 0].detach().requires_grad_()
    return tensors


def depth_channels(mode):
    return 0 if mode == "RGB" else 1


def render(tensors, signals, **options):
    return rasterization(**tensors, width=W, height=H, extra_signals=signals, **options)


def assert_same_gradients(leaves, mine, theirs):
    """Compare the gradients of the same weighted sum of all outputs."""
    weights = [normal(*output.shape, seed=k) for k, output in enumerate(theirs)]
    found, wanted = (
        torch.autograd.grad(sum((w * o).sum() for w, o in zip(weights, outputs, strict=True)), leaves)
        for outputs in (mine, theirs)
    )
    for one, other in zip(found, wanted, strict=True):
        assert float(other.abs().max()) > 0
        assert_close(one, other)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("mode", ["RGB", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize(("channels", "per_camera"), [(1, False), (5, True), (40, False)])
def test_signals_equal_the_same_channels_rendered_as_colours(channels, per_camera, mode, packed):
    """The witness renders colours and signals, and both backgrounds, as the channels of one image."""
    tensors = scene()
    signals = normal(*((2,) if per_camera else ()), 40, channels).requires_grad_()
    tensors["backgrounds"] = normal(2, 3 + channels, seed=4).requires_grad_()
    images, alphas, meta = render(tensors, signals, render_mode=mode, packed=packed)
    both = torch.cat([tensors["colors"].expand(*signals.shape[:-1], 3), signals], dim=-1)
    wanted, wanted_alphas, *_ = gsplat_witness.rendered(tensors | {"colors": both}, W, H, mode=mode)
    theirs = [
        torch.cat([wanted[..., :3], wanted[..., 3 + channels :]], dim=-1),
        wanted[..., 3 : 3 + channels],
        wanted_alphas,
    ]
    mine = [images, meta["render_extra_signals"], alphas]
    for one, other in zip(mine, theirs, strict=True):
        assert_close(one, other)
    assert images.shape[-1] == 3 + depth_channels(mode)
    names = ("means", "quats", "scales", "opacities", "colors", "backgrounds")
    assert_same_gradients([signals, *(tensors[name] for name in names)], mine, theirs)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics_of_signals_are_offset_but_have_no_floor(degree):
    """gsplat's polynomials in torch take three channels, so six channels take two calls."""
    tensors = scene() | {"backgrounds": None}
    coefficients = (3 * normal(40, 16, 6)).requires_grad_()
    images, _, meta = render(tensors, coefficients, extra_signals_sh_degree=degree)
    eyes = torch.inverse(tensors["viewmats"])[:, :3, 3]
    directions = tensors["means"][None] - eyes[:, None]
    values = torch.cat(
        [
            gsplat_witness.torch_impl._spherical_harmonics(degree, directions, part.expand(2, 40, 16, 3))
            for part in (coefficients[..., :3], coefficients[..., 3:])
        ],
        dim=-1,
    )
    both = torch.cat([tensors["colors"].expand(2, 40, 3), values + 0.5], dim=-1)
    wanted = gsplat_witness.rendered(tensors | {"colors": both}, W, H)[0]
    assert float((values + 0.5).detach().min()) < -0.5 and float(wanted.detach().min()) < 0
    mine, theirs = [images, meta["render_extra_signals"]], [wanted[..., :3], wanted[..., 3:]]
    for one, other in zip(mine, theirs, strict=True):
        assert_close(one, other)
    assert_same_gradients([coefficients, tensors["means"], tensors["colors"]], mine, theirs)


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depths_need_no_colours(mode):
    tensors = scene()
    plain = rasterization(**tensors, width=W, height=H, render_mode=mode)
    without = tensors | {"colors": None}
    for backgrounds in (tensors["backgrounds"], None, normal(2, 7)):  # backgrounds have no effect on depths
        images, alphas, meta = rasterization(
            **without | {"backgrounds": backgrounds}, width=W, height=H, render_mode=mode
        )
        assert torch.equal(images, plain[0]) and torch.equal(alphas, plain[1])
        assert images.shape == (2, H, W, 1) and "render_extra_signals" not in meta


@pytest.mark.parametrize("mode", ["D", "ED"])
@pytest.mark.parametrize("with_colors", [False, True])
def test_depths_with_signals(mode, with_colors):
    """Backgrounds belong to the signals only, whether or not colours are given, because no colours are returned."""
    tensors = scene()
    signals, behind = normal(40, 4).requires_grad_(), normal(2, 4, seed=4).requires_grad_()
    given = tensors | {"backgrounds": behind} | ({} if with_colors else {"colors": None})
    images, alphas, meta = render(given, signals, render_mode=mode)
    colored = tensors | {"backgrounds": behind, "colors": signals}
    wanted = gsplat_witness.rendered(colored, W, H, mode=f"RGB+{mode}")
    mine = [images, meta["render_extra_signals"], alphas]
    theirs = [wanted[0][..., 4:], wanted[0][..., :4], wanted[1]]
    for one, other in zip(mine, theirs, strict=True):
        assert_close(one, other)
    assert_same_gradients([signals, behind, tensors["means"], tensors["opacities"]], mine, theirs)


def test_signals_may_be_larger_than_colours():
    """Colours beyond 1e6 are refused, because the kernels skip such Gaussians. Signals are features, without this
    limit."""
    tensors = scene() | {"backgrounds": None}
    signals = normal(40, 2)
    small = render(tensors, signals)[2]["render_extra_signals"]
    large = render(tensors, 1e8 * signals)[2]["render_extra_signals"]
    assert float(large.detach().abs().max()) > 1e7
    assert_close(large / 1e8, small)


def test_scenes_share_coefficients_but_not_channels():
    scenes = [scene() for _ in range(2)]
    scenes[1]["means"] = scenes[1]["means"].detach() + 0.1
    stacked = {name: torch.stack([each[name] for each in scenes]) for name in scenes[0]} | {
        "backgrounds": None
    }
    channels, coefficients = normal(2, 40, 3), normal(40, 4, 3)
    for signals, degree in ((channels, None), (coefficients, 1)):
        found = render(stacked, signals, extra_signals_sh_degree=degree)[2]["render_extra_signals"]
        assert found.shape == (2, 2, H, W, 3)
        for k, one in enumerate(scenes):
            own = signals[k] if degree is None else signals
            alone = render(one | {"backgrounds": None}, own, extra_signals_sh_degree=degree)[2]
            assert_close(found[k], alone["render_extra_signals"])


def test_finite_differences():
    """Renders are smooth in all inputs: the four Gaussians of `gsplat_witness.smooth` are above 1/255 and below the
    clamps in every pixel and keep their order, colours are above their floor, and signals have no floor."""
    tensors = gsplat_witness.smooth()
    tensors["colors"] = tensors["colors"].detach()[:, :4].requires_grad_()  # those of the degree
    tensors |= {"backgrounds": normal(2, 6).requires_grad_()}
    tensors["extra_signals"] = (0.1 * normal(4, 4, 3)).requires_grad_()
    names, leaves = list(tensors), list(tensors.values())
    options = {"sh_degree": 1, "extra_signals_sh_degree": 1, "render_mode": "RGB+ED"}

    def outputs(*values):
        images, alphas, meta = rasterization(
            **dict(zip(names, values, strict=True)), width=4, height=3, **options
        )
        assert len(meta["radii"]) == 8
        return images, alphas, meta["render_extra_signals"]

    with torch.no_grad():
        tensors["backgrounds"][:, :3] = 0.5
        images, alphas, _ = outputs(*leaves)
    assert float(images[..., :3].min()) > 0.05 and float(alphas.max()) < 0.999
    assert proves_gradients(outputs, leaves)


@pytest.mark.parametrize("kind", ["channels", "per camera", "coefficients"])
def test_a_bad_signal_can_be_skipped_with_its_gaussian(kind):
    shape = {"channels": (N, 2), "per camera": (C, N, 2), "coefficients": (N, 4, 2)}[kind]
    options = {"extra_signals_sh_degree": 1} if kind == "coefficients" else {}
    signals = normal(*shape).float()
    one = signals.clone()
    at = (1, 2) if kind == "per camera" else 2
    one[at] = float("nan")
    with skipping_bad_gaussians():
        images, alphas, meta = rasterization(**arguments(), extra_signals=one, **options)
    dim = (torch.arange(N) != 2).float() * 0.7
    clear = rasterization(**arguments(opacities=dim), extra_signals=signals, **options)
    assert torch.equal(images, clear[0]) and torch.equal(alphas, clear[1])
    assert torch.equal(meta["render_extra_signals"], clear[2]["render_extra_signals"])
    assert 2 not in meta["gaussian_ids"].tolist()
