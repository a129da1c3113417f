"""`rasterization` against gsplat's own functions, the NumPy reference and finite differences."""

import gc
import math
import weakref

import numpy as np
import pytest
import torch

import gsplat_witness
from gsplat_edu import Camera, render_gaussians
from gsplat_edu.compat.gsplat import rasterization
from proofs import proves_gradients

W, H = 23, 18
EXACT = 1e-9
"""Bound in float64, relative to the largest entry: the two sides differ in rounding only, and the longest chain of
operations, 40 Gaussians with a matrix inverse, loses fewer than seven of sixteen digits."""


def render(tensors, **options):
    return rasterization(**tensors, width=W, height=H, **options)


def assert_close(found, wanted, bound=EXACT):
    assert found.shape == wanted.shape
    found, wanted = found.detach(), wanted.detach()
    assert float((found - wanted).abs().max()) <= bound * max(1.0, float(wanted.abs().max()))


def weights_like(*tensors, seed=5):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t.dtype) for t in tensors]


def gradients(tensors, *outputs):
    """Return the gradients of a weighted sum, with equal weights for outputs of equal shapes."""
    loss = sum((w * o).sum() for w, o in zip(weights_like(*outputs), outputs, strict=True))
    named = {name: t for name, t in tensors.items() if t is not None and t.requires_grad}
    found = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
    return {
        name: torch.zeros_like(t) if g is None else g
        for (name, t), g in zip(named.items(), found, strict=True)
    }


def assert_same_gradients(tensors, mine, theirs):
    found, wanted = gradients(tensors, *mine), gradients(tensors, *theirs)
    for key in wanted:
        # gsplat's torch functions skew the means, but not the Jacobian; its kernels and ours do not read those entries.
        used = torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]]) if key == "Ks" else 1
        assert_close(found[key], wanted[key] * used)
    return wanted


CASES = {
    "harmonics": {"sh_degree": 3},
    "degree 1, antialiased, packed": {"sh_degree": 1, "rasterize_mode": "antialiased", "packed": True},
    "depth": {"render_mode": "D"},
    "expected depth": {"render_mode": "ED", "packed": True},
    "colour and depth": {"render_mode": "RGB+D", "sh_degree": 2},
    "colour and expected depth": {"render_mode": "RGB+ED", "rasterize_mode": "antialiased"},
    "other dilation and planes": {"eps2d": 0.1, "near_plane": 1.5, "far_plane": 3.0},
    "wide dilation": {"eps2d": 1.0, "rasterize_mode": "antialiased"},
}


@pytest.mark.parametrize("name", CASES)
def test_images_and_gradients_are_gsplats(name):
    options = {"packed": False} | CASES[name]
    tensors = gsplat_witness.scene()
    if "sh_degree" not in options:
        tensors["colors"] = tensors["colors"][:, 0].detach().requires_grad_()
    images, alphas, _ = render(tensors, **options)
    limits = {key: options[key] for key in ("eps2d", "near_plane", "far_plane") if key in options}
    wanted = gsplat_witness.rendered(
        tensors,
        W,
        H,
        options.get("sh_degree"),
        options.get("rasterize_mode") == "antialiased",
        options.get("render_mode", "RGB"),
        **limits,
    )
    assert_close(images, wanted[0])
    assert_close(alphas, wanted[1])
    theirs = assert_same_gradients(tensors, (images, alphas), wanted[:2])
    assert float(theirs["viewmats"].abs().max()) > 1 and float(theirs["Ks"].abs().max()) > 1


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("eps2d", [0.0, 0.1, 0.3, 1.0])
def test_dilations_of_thin_gaussians_are_gsplats(eps2d, antialiased):
    """The Gaussians are needles, whose determinants became negative if eps2d was added as a difference from 0.3."""
    tensors = gsplat_witness.scene()
    tensors["colors"] = tensors["colors"][:, 0].detach().requires_grad_()
    with torch.no_grad():
        tensors["scales"][:, 1:] *= 0.1
    mode = "antialiased" if antialiased else "classic"
    images, alphas, _ = render(tensors, packed=False, eps2d=eps2d, rasterize_mode=mode)
    wanted = gsplat_witness.rendered(tensors, W, H, antialiased=antialiased, eps2d=eps2d)
    assert_close(images, wanted[0])
    assert_close(alphas, wanted[1])
    assert_same_gradients(tensors, (images, alphas), wanted[:2])


@pytest.mark.parametrize(("eps2d", "wanted"), [(0.0, 0.5459), (0.1, 0.5712), (0.3, 0.6126), (1.0, 0.7009)])
def test_alpha_beside_a_thin_gaussian_is_the_formula(eps2d, wanted):
    """One pixel right of a Gaussian of 1.0 x 0.2 px and opacity 0.9, alpha is 0.9 exp(-1 / (2 (1 + eps2d)))."""
    one = lambda *values: torch.tensor([values], dtype=torch.float64)  # noqa: E731
    K = torch.tensor([[[1.0, 0, 5.5], [0, 1, 5.5], [0, 0, 1]]], dtype=torch.float64)
    view, opacity = torch.eye(4, dtype=torch.float64)[None], one(0.9)[0]
    thin = (one(0.0, 0, 1), one(1.0, 0, 0, 0), one(1.0, 0.2, 0.1), opacity, one(1.0, 1, 1), view, K)
    alpha = rasterization(*thin, 11, 11, eps2d=eps2d)[1][0, ..., 0]
    assert abs(float(alpha[5, 6]) - 0.9 * math.exp(-0.5 / (1 + eps2d))) < 1e-12
    assert abs(float(alpha[5, 6]) - wanted) < 1e-4
    down = 0.9 * math.exp(-0.5 / (0.04 + eps2d))
    assert abs(float(alpha[6, 5]) - (down if down >= 1 / 255 else 0.0)) < 1e-12


def test_a_pixel_stops_at_the_same_gaussian_as_in_gsplat():
    """Behind opaque layers, a pixel stops before the Gaussian that would take its transmittance to 1e-4."""
    tensors = gsplat_witness.scene(count=60)
    tensors["colors"] = tensors["colors"][:, 0].detach().requires_grad_()
    tensors["opacities"] = torch.full((60,), 1.0, dtype=torch.float64, requires_grad=True)
    tensors["scales"] = tensors["scales"].detach() + 0.3
    images, alphas, _ = render(tensors, packed=False)
    wanted = gsplat_witness.rendered(tensors, W, H)
    left = 1.0 - wanted[1].detach()
    assert float(left.min()) > 1e-4 and float(left.min()) < 0.05  # pixels have stopped above 1e-4
    assert_close(images, wanted[0])
    assert_close(alphas, wanted[1])
    assert_same_gradients(tensors, (images, alphas), wanted[:2])


@pytest.mark.parametrize("channels", [1, 2, 7, 32, 71])
@pytest.mark.parametrize("per_camera", [False, True])
def test_any_number_of_channels(channels, per_camera):
    tensors = gsplat_witness.scene()
    g = torch.Generator().manual_seed(1)
    shape = (2, 40, channels) if per_camera else (40, channels)
    tensors["colors"] = torch.randn(shape, generator=g, dtype=torch.float64, requires_grad=True)
    tensors["backgrounds"] = torch.randn(2, channels, generator=g, dtype=torch.float64, requires_grad=True)
    images, alphas, _ = render(tensors, render_mode="RGB+D")
    wanted = gsplat_witness.rendered(tensors, W, H, mode="RGB+D")
    assert_close(images, wanted[0])
    assert_same_gradients(tensors, (images, alphas), wanted[:2])


def test_covariances_take_the_place_of_quaternions_and_scales():
    tensors = gsplat_witness.scene()
    tensors["colors"] = tensors["colors"][:, 0].detach().requires_grad_()
    g = torch.Generator().manual_seed(2)
    root = 0.3 * torch.randn(40, 3, 3, generator=g, dtype=torch.float64)
    upper = (root @ root.mT).triu().requires_grad_()
    images, _, _ = render(tensors | {"quats": None, "scales": None}, covars=upper)
    symmetric = upper + upper.triu(1).mT
    wanted = gsplat_witness.rendered(tensors | {"covars": symmetric}, W, H)
    assert_close(images, wanted[0])
    found = torch.autograd.grad((images * weights_like(images)[0]).sum(), upper)[0]
    expected = torch.autograd.grad((wanted[0] * weights_like(images)[0]).sum(), upper)[0]
    assert_close(found, expected.triu())
    assert float(found.tril(-1).abs().max()) == 0  # only the upper triangle is read


def test_the_numpy_reference_agrees():
    """Opacities are below the clamp of 0.99, and layers are so few that no pixel stops early."""
    tensors = {name: t.detach() for name, t in gsplat_witness.scene(count=25, cameras=1).items()}
    tensors["colors"] = tensors["colors"][:, 0]
    image, alpha, _ = render(tensors)
    M = gsplat_witness.torch_impl._quat_scale_to_matrix(tensors["quats"], tensors["scales"])
    view, K = tensors["viewmats"][0].numpy(), tensors["Ks"][0].numpy()
    eye = -view[:3, :3].T @ view[:3, 3]
    camera = Camera(view[:3, :3], eye, K[0, 0], K[1, 1], K[0, 2] - 0.5, K[1, 2] - 0.5, H, W)
    inputs = [t.numpy() for t in (tensors["means"], M @ M.mT, tensors["colors"], tensors["opacities"])]
    wanted, T = render_gaussians(
        camera,
        *inputs,
        bg=tensors["backgrounds"][0].numpy(),
        z_near=0.01,
        extent="exact",
        stop="none",
        jacobian_limit=1.3,
    )
    assert T.min() > 1e-4
    np.testing.assert_allclose(image[0].numpy(), wanted, atol=EXACT)
    np.testing.assert_allclose(alpha[0, ..., 0].numpy(), 1 - T, atol=EXACT)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("channels", [3, 40])
def test_gradients_of_means_on_the_screen(packed, channels):
    """`means2d.grad` sums the witness's gradients of all pixels, `absgrad` their absolute values."""
    tensors = gsplat_witness.scene()
    g = torch.Generator().manual_seed(4)
    tensors["colors"] = torch.randn(40, channels, generator=g, dtype=torch.float64, requires_grad=True)
    tensors["backgrounds"] = None
    images, alphas, meta = render(tensors, packed=packed, absgrad=True)
    meta["means2d"].retain_grad()
    weights = weights_like(images, alphas)
    ((images * weights[0]).sum() + (alphas * weights[1]).sum()).backward()
    wanted = gsplat_witness.rendered(tensors, W, H)
    each = torch.autograd.grad((wanted[0] * weights[0]).sum() + (wanted[1] * weights[1]).sum(), wanted[3])
    signed, absolute = (torch.stack([f(e).sum(dim=(0, 1)) for e in each]) for f in (torch.clone, torch.abs))
    if packed:
        at = meta["camera_ids"], meta["gaussian_ids"]
        assert int(meta["batch_ids"].max()) == 0
        signed, absolute = signed[at], absolute[at]
    else:
        assert meta["gaussian_ids"] is None
    assert_close(meta["means2d"].grad, signed)
    if (
        channels == 3
    ):  # more channels are rendered in several passes, and absolute values taken of their sum; see docs/GSPLAT.md
        assert_close(meta["means2d"].absgrad, absolute)
    else:
        assert bool((meta["means2d"].absgrad >= absolute * (1 - EXACT) - EXACT).all())


def test_a_loss_on_the_screen_passes_through_the_projection():
    tensors = gsplat_witness.scene()
    _, _, meta = render(tensors, packed=False, sh_degree=0)
    seen = (meta["radii"] > 0).all(dim=-1)
    wanted = gsplat_witness.rendered(tensors, W, H, sh_degree=0)[2]
    for scale in (1.0, -2.0):
        found, expected = (
            torch.autograd.grad((scale * means[seen] ** 2).sum(), tensors["means"], retain_graph=True)[0]
            for means in (meta["means2d"], wanted)
        )
        assert_close(found, expected)


def test_leading_axes_are_scenes():
    scenes = [gsplat_witness.scene(seed=seed) for seed in range(6)]
    stacked = {
        name: torch.stack([s[name] for s in scenes]).view(2, 3, *scenes[0][name].shape) for name in scenes[0]
    }
    options = {"sh_degree": 2, "render_mode": "RGB+D"}
    images, alphas, meta = render(stacked, packed=False, **options)
    assert images.shape == (2, 3, 2, H, W, 4) and alphas.shape == (2, 3, 2, H, W, 1)
    assert meta["n_batches"] == 6 and meta["n_cameras"] == 2 and meta["means2d"].shape == (2, 3, 2, 40, 2)
    packed = render(stacked, packed=True, **options)
    assert torch.equal(packed[0], images)
    for k, one in enumerate(scenes):
        image, alpha, own = render(one, packed=False, **options)
        assert_close(images.flatten(0, 1)[k], image)
        assert_close(alphas.flatten(0, 1)[k], alpha)
        assert torch.equal(meta["radii"].flatten(0, 1)[k], own["radii"])
        rows = packed[2]["batch_ids"] == k
        at = packed[2]["camera_ids"][rows], packed[2]["gaussian_ids"][rows]
        assert_close(packed[2]["depths"][rows], own["depths"][at])


def test_packed_lists_gaussians_with_positive_radii():
    tensors = gsplat_witness.scene()
    dense, packed = (
        render(tensors, packed=p, sh_degree=1, rasterize_mode="antialiased")[2] for p in (False, True)
    )
    drawn = (dense["radii"] > 0).all(dim=-1)
    assert 0 < int(drawn.sum()) < drawn.numel()
    assert torch.equal(torch.stack([packed["camera_ids"], packed["gaussian_ids"]]), drawn.nonzero().T)
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        assert torch.equal(packed[name], dense[name][drawn])


def test_radius_clip_leaves_out_small_gaussians():
    tensors = gsplat_witness.scene()
    all_radii = render(tensors, packed=False, sh_degree=0)[2]["radii"]
    clip = int(all_radii.max()) // 2
    kept = (all_radii > clip).any(dim=-1)[0].nonzero()[:, 0]
    one = {name: t[:1] if name in ("viewmats", "Ks", "backgrounds") else t for name, t in tensors.items()}
    few = {name: t[kept] if name not in ("viewmats", "Ks", "backgrounds") else t for name, t in one.items()}
    assert 0 < len(kept) < int((all_radii[0] > 0).all(-1).sum())
    assert torch.equal(render(one, radius_clip=clip, sh_degree=0)[0], render(few, sh_degree=0)[0])


@pytest.mark.parametrize("count", [0, 1])
def test_an_empty_view_is_background(count):
    tensors = gsplat_witness.scene(count=5)
    tensors |= {
        name: tensors[name][5 - count :].detach().requires_grad_() for name in list(tensors)[:5]
    }  # behind
    images, alphas, meta = render(tensors, sh_degree=3, render_mode="RGB+ED")
    assert float(alphas.detach().abs().max()) == 0 and len(meta["means2d"]) == 0
    assert torch.equal(images[..., :3], tensors["backgrounds"][:, None, None].expand(2, H, W, 3))
    images.sum().backward()
    assert torch.equal(tensors["means"].grad, torch.zeros(count, 3, dtype=torch.float64))


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_finite_differences(rasterize_mode):
    """Colours do not depend on the mode, and are proved once."""
    tensors = gsplat_witness.smooth()
    fixed = {"colors": tensors.pop("colors").detach()} if rasterize_mode == "antialiased" else {}
    names = list(tensors)
    options = fixed | {"sh_degree": 2, "render_mode": "RGB+ED", "rasterize_mode": rasterize_mode}

    def images(*values):
        renders, alphas, meta = rasterization(
            **dict(zip(names, values, strict=True)), width=5, height=4, **options
        )
        assert len(meta["radii"]) == 8
        return renders, alphas

    with torch.no_grad():
        renders, alphas = images(*tensors.values())
    assert float(renders[..., :3].min()) > 0.05 and float(alphas.max()) < 0.999
    assert proves_gradients(images, list(tensors.values()))


def test_float32_agrees_with_float64():
    """Alpha is 2^p with |p| < 8, and about 30 operations lead to p, so p and alpha are off by at most 30 * 8 * 2^-24.
    Four Gaussians make 4 * 240 * 2^-24 = 6e-5 of the largest channel, doubled for its sum."""
    exact = {name: t.detach() for name, t in gsplat_witness.smooth().items()}
    single = {name: t.float() for name, t in exact.items()}
    options = {"sh_degree": 3, "render_mode": "RGB+ED"}
    wanted, found = render(exact, **options)[0], render(single, **options)[0]
    assert found.dtype == torch.float32
    assert float((found - wanted).abs().max()) < 1.2e-4 * float(wanted.abs().max())


def test_absgrad_of_an_empty_view_is_zero():
    tensors = gsplat_witness.scene(count=3)
    tensors["means"] = torch.tensor([[0.0, 0.0, -5.0]], dtype=torch.float64).repeat(3, 1).requires_grad_()
    images, _, meta = render(tensors, sh_degree=0, absgrad=True, packed=False)
    images.sum().backward()
    assert torch.equal(meta["means2d"].absgrad, torch.zeros(2, 3, 2, dtype=torch.float64))


def test_absgrad_is_assigned_by_each_backward_pass():
    """As in gsplat, the attribute exists before, and unlike `.grad` it does not add up."""
    images, _, meta = render(gsplat_witness.scene(), sh_degree=0, absgrad=True)
    meta["means2d"].retain_grad()
    kept = meta["means2d"].absgrad
    assert torch.equal(kept, torch.zeros_like(meta["means2d"]))
    found = []
    for _ in range(2):
        images.square().sum().backward(retain_graph=True)
        found.append((meta["means2d"].grad.clone(), kept.clone()))
    (once, absolute), (twice, again) = found
    assert float(once.abs().max()) > 0 and float(absolute.max()) > 0
    assert_close(twice, 2 * once)
    assert torch.equal(absolute, again) and meta["means2d"].absgrad is kept


def test_no_reference_keeps_an_image_alive():
    """The hook of absgrad is part of the graph. A reference cycle through it would keep images until garbage
    collection."""
    gc.disable()
    try:
        images, alphas, meta = render(gsplat_witness.scene(), sh_degree=0, absgrad=True)
        meta["means2d"].retain_grad()
        images.sum().backward()
        watched = [weakref.ref(images), weakref.ref(alphas), weakref.ref(meta["means2d"])]
        del images, alphas, meta
        assert [ref() is None for ref in watched] == [True] * 3
    finally:
        gc.enable()


def test_the_same_bits_with_any_number_of_threads():
    tensors = {name: t.detach() for name, t in gsplat_witness.scene(count=3000, dtype=torch.float32).items()}
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(render(tensors, sh_degree=3, render_mode="RGB+ED")[:2])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
