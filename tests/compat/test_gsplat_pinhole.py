"""What gsplat's own tests check for the pinhole, on the CPU: our functions against its torch implementation.

Its wheel does not carry its tests. These cover the same functions: covariances and their inverses, cameras, projection
(with covariances or quaternions, packed or not), tiles, compositing by tiles, harmonics and relocation. Values and
gradients in float64; 1e-9 of the largest entry, as in test_rasterization.py: both sides compute the same formulas in
another order, and the longest chain loses fewer than seven of sixteen digits.
"""

import math

import pytest
import torch

import gsplat_witness
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat import gsplat as compat

theirs = gsplat_witness.torch_impl
W, H = 23, 18


def assert_close(found, wanted, bound=1e-9):
    assert found.shape == wanted.shape
    found, wanted = found.detach(), wanted.detach()
    assert float((found - wanted).abs().max()) <= bound * max(1.0, float(wanted.abs().max()))


def assert_same_gradients(inputs, found, wanted, used=None):
    draw = torch.Generator().manual_seed(1)
    weights = [torch.randn(t.shape, generator=draw, dtype=torch.float64) for t in wanted]
    gradients = [
        torch.autograd.grad(sum((w * o).sum() for w, o in zip(weights, out, strict=True)), inputs)
        for out in (found, wanted)
    ]
    for k, (mine, other) in enumerate(zip(*gradients, strict=True)):
        assert float(other.abs().max()) > 0
        assert_close(mine, other * (used or {}).get(k, 1))


@pytest.mark.parametrize("triu", [False, True])
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_quat_scale_to_covar_preci(triu, batch):
    g = torch.Generator().manual_seed(0)
    quats = torch.randn(*batch, 20, 4, generator=g, dtype=torch.float64).requires_grad_()
    scales = (0.1 + torch.rand(*batch, 20, 3, generator=g, dtype=torch.float64)).requires_grad_()
    found = compat.quat_scale_to_covar_preci(quats, scales, triu=triu)
    wanted = theirs._quat_scale_to_covar_preci(quats, scales, triu=triu)
    for mine, other in zip(found, wanted, strict=True):
        assert_close(mine, other)
    assert_same_gradients((quats, scales), found, wanted)
    assert compat.quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None
    assert compat.quat_scale_to_covar_preci(quats, scales, compute_covar=False)[0] is None
    with pytest.raises(ArgumentError, match=r"^scales\[.*0\]: is 0, which has no inverse"):
        compat.quat_scale_to_covar_preci(quats, scales * 0)


def camera_axes():
    tensors = gsplat_witness.scene()
    with torch.no_grad():
        covars, _ = theirs._quat_scale_to_covar_preci(tensors["quats"], tensors["scales"])
    return tensors, covars.requires_grad_()


def test_world_to_cam():
    tensors, covars = camera_axes()
    inputs = (tensors["means"], covars, tensors["viewmats"])
    found, wanted = compat.world_to_cam(*inputs), theirs._world_to_cam(*inputs)
    for mine, other in zip(found, wanted, strict=True):
        assert_close(mine, other)
    assert_same_gradients(inputs, found, wanted)


def test_proj():
    tensors, covars = camera_axes()
    with torch.no_grad():
        means, turned = theirs._world_to_cam(tensors["means"], covars, tensors["viewmats"])
        keep = (means[..., 2] > 0.1).all(dim=0)
        means, turned = means[:, keep], turned[:, keep]
    inputs = (means.requires_grad_(), turned.requires_grad_(), tensors["Ks"])
    found, wanted = compat.proj(*inputs, W, H), theirs._persp_proj(*inputs, W, H)
    for mine, other in zip(found, wanted, strict=True):
        assert_close(mine, other)
    # gsplat's torch functions skew the means, but its kernels and ours do not read those entries
    skew = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
    assert_same_gradients(inputs, found, wanted, {2: skew})
    with pytest.raises(ArgumentError, match="^camera_model: is 'ftheta'"):
        compat.proj(*inputs, W, H, camera_model="ftheta")


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("compensated", [False, True])
def test_projection(fused, compensated):
    """Quaternions and scales give the fused projection. Rows with a positive radius on both sides are compared."""
    tensors, covars = camera_axes()
    upper = covars.detach()[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].requires_grad_()
    cameras = (tensors["viewmats"], tensors["Ks"], W, H)
    if fused:
        given = (tensors["means"], None, tensors["quats"], tensors["scales"])
        solid, inputs = theirs._quat_scale_to_covar_preci(given[2], given[3])[0], given[::2] + given[3:]
    else:
        given = (tensors["means"], upper, None, None)
        solid, inputs = upper[..., [[0, 1, 2], [1, 3, 4], [2, 4, 5]]], given[:2]
    found = compat.fully_fused_projection(*given, *cameras, calc_compensations=compensated)
    wanted = theirs._fully_fused_projection(tensors["means"], solid, *cameras, calc_compensations=compensated)
    seen = (found[0] > 0).all(dim=-1) & (wanted[0] > 0).all(dim=-1)
    assert int(seen.sum()) > 40 and torch.equal(found[0][seen], wanted[0][seen].int())
    pairs = [(f[seen], w[seen]) for f, w in zip(found[1:], wanted[1:], strict=True) if f is not None]
    assert len(pairs) == 3 + compensated
    for mine, other in pairs:
        assert_close(mine, other)
    skew = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)
    inputs = (*inputs, tensors["viewmats"], tensors["Ks"])
    assert_same_gradients(inputs, *zip(*pairs, strict=True), {len(inputs) - 1: skew})
    packed = compat.fully_fused_projection(*given, *cameras, packed=True, calc_compensations=compensated)
    for mine, whole in zip(packed[4:], found, strict=True):
        assert whole is None or torch.equal(mine, whole[packed[1], packed[2]])


def projected(seed=0, tight=False):
    tensors = gsplat_witness.scene(seed=seed)
    opacities = tensors["opacities"] if tight else None
    radii, means2d, depths, conics, _ = compat.fully_fused_projection(
        *(
            tensors["means"],
            None,
            tensors["quats"],
            tensors["scales"],
            tensors["viewmats"],
            tensors["Ks"],
            W,
            H,
        ),
        opacities=opacities,
    )
    return tensors, radii, means2d.detach(), depths.detach(), conics.detach()


@pytest.mark.parametrize("sort", [False, True])
@pytest.mark.parametrize("tile", [4, 16])
def test_isect(sort, tile):
    _, radii, means2d, depths, _ = projected()
    grid = math.ceil(W / tile), math.ceil(H / tile)
    means2d = (
        means2d.float().double()
    )  # gsplat's torch function divides in the given dtype, its kernels in float32
    found = compat.isect_tiles(means2d, radii, depths, tile, *grid, sort=sort)
    wanted = theirs._isect_tiles(means2d, radii, depths.float(), tile, *grid, sort=sort)
    for mine, other in zip(found, wanted, strict=True):
        assert mine.dtype == other.dtype and torch.equal(mine, other)
    order = torch.sort(found[1]).values
    offsets = compat.isect_offset_encode(order, 2, *grid)
    assert torch.equal(offsets, theirs._isect_offset_encode(order, 2, *grid))
    drawn = (radii > 0).all(dim=-1)
    images, ids = drawn.nonzero().unbind(-1)
    packed = compat.isect_tiles(
        *(means2d[drawn], radii[drawn], depths[drawn], tile, *grid),
        sort=sort, packed=True, n_images=2, image_ids=images, gaussian_ids=ids,
    )  # fmt: skip
    assert torch.equal(packed[1], found[1])


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("tile", "channels"), [(4, 3), (16, 40)])
def test_rasterize_to_pixels(tile, channels, packed):
    """The witness applies the compositing rules at every pixel to the same projected Gaussians."""
    tensors, radii, means2d, depths, conics = projected()
    g = torch.Generator().manual_seed(3)
    draw = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)  # noqa: E731
    opacities = tensors["opacities"].detach().repeat(2, 1)
    given = [means2d, conics, draw(2, 40, channels), opacities]
    drawn, grid = (radii > 0).all(dim=-1), (math.ceil(W / tile), math.ceil(H / tile))
    options = {}
    lists = (means2d, radii, depths)
    if packed:
        given, lists = ([t[drawn] for t in each] for each in (given, lists))
        images, ids = drawn.nonzero().unbind(-1)
        options = {"packed": True, "n_images": 2, "image_ids": images, "gaussian_ids": ids}
    _, ids, rows = compat.isect_tiles(*lists, tile, *grid, **options)
    offsets = compat.isect_offset_encode(ids, 2, *grid)
    inputs = [t.clone().requires_grad_() for t in (*given, draw(2, channels))]
    found = compat.rasterize_to_pixels(
        *inputs[:4], W, H, tile, offsets, rows, backgrounds=inputs[4], packed=packed, absgrad=True
    )
    images = []
    for c in range(2):
        own = (options["image_ids"] == c).nonzero()[:, 0] if packed else drawn[c].nonzero()[:, 0]
        at = lambda t, own=own, c=c: t[own] if packed else t[c, own]  # noqa: E731
        order = torch.argsort(at(lists[2]), stable=True)
        means, conic, color, opacity = (at(t)[order] for t in inputs[:4])
        images.append(
            gsplat_witness.composited(means.expand(H, W, -1, 2), conic, opacity, color, inputs[4][c])
        )
    wanted = torch.stack([image for image, _ in images]), 1.0 - torch.stack([T for _, T in images])[..., None]
    for mine, other in zip(found, wanted, strict=True):
        assert_close(mine, other)
    assert_same_gradients(inputs, found, wanted)
    assert inputs[0].absgrad.shape == inputs[0].shape and float(inputs[0].absgrad.min()) >= 0


def test_masked_tiles_show_the_background():
    _, radii, means2d, depths, conics = projected()
    _, ids, rows = compat.isect_tiles(means2d, radii, depths, 16, 2, 2)
    offsets = compat.isect_offset_encode(ids, 2, 2, 2)
    colors, opacities = (
        torch.ones(2, 40, 1, dtype=torch.float64),
        torch.full((2, 40), 0.9, dtype=torch.float64),
    )
    masks = torch.tensor([[[True, False], [True, True]]]).repeat(2, 1, 1)
    given = (means2d, conics, colors, opacities, W, H, 16, offsets, rows)
    behind = torch.full((2, 1), 0.25, dtype=torch.float64)
    whole, _ = compat.rasterize_to_pixels(*given, backgrounds=behind)
    image, alpha = compat.rasterize_to_pixels(*given, backgrounds=behind, masks=masks)
    assert bool((image[:, :16, 16:] == 0.25).all()) and float(alpha[:, :16, 16:].max()) == 0.0
    assert torch.equal(image[:, 16:], whole[:, 16:]) and torch.equal(image[:, :, :16], whole[:, :, :16])
    assert float((whole[:, :16, 16:] - 0.25).abs().max()) > 0.1


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_sh(degree):
    g = torch.Generator().manual_seed(0)
    dirs = torch.randn(30, 3, generator=g, dtype=torch.float64).requires_grad_()
    coeffs = torch.randn(30, 25, 3, generator=g, dtype=torch.float64).requires_grad_()
    found = compat.spherical_harmonics(degree, dirs, coeffs)
    wanted = theirs._spherical_harmonics(degree, dirs, coeffs)
    assert_close(found, wanted)
    if degree:
        assert_same_gradients((dirs, coeffs), [found], [wanted])


def test_rasterization_takes_degree_4():
    tensors = gsplat_witness.scene()
    g = torch.Generator().manual_seed(5)
    tensors["colors"] = (0.4 * torch.randn(40, 25, 3, generator=g, dtype=torch.float64)).requires_grad_()
    images, _, _ = compat.rasterization(**tensors, width=W, height=H, sh_degree=4)
    assert_close(images, gsplat_witness.rendered(tensors, W, H, 4)[0])


def relocated(o, n, least):
    """Evaluate equation 9 of the MCMC paper term by term, after gsplat 1.6.0's clamp of the new opacity."""
    new = min(max(1 - (1 - o) ** (1 / n), least), 1 - 2**-23)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
        for i in range(1, n + 1)
        for k in range(i)
    )
    return new, o / total


@pytest.mark.parametrize("least", [0.0, 0.005, 0.05])
def test_relocation(least):
    """Terms of the sum cancel. The largest is below 300 times the sum, so rounding is below 300 * 2^-53 < 1e-12.

    The clamp of opacity 1 leaves n = 1 only: the terms of n = 51 would be 1e14 times the sum.
    """
    binoms = torch.tensor(
        [[float(math.comb(n, k)) for k in range(51)] for n in range(51)], dtype=torch.float64
    )
    cases = [(o, n) for o in (0.01, 0.3, 0.9) for n in (1, 2, 7, 51)] + [(1.0, 1)]
    opacities = torch.tensor([o for o, _ in cases], dtype=torch.float64)
    scales, ratios = torch.rand(len(cases), 3, dtype=torch.float64), torch.tensor([n for _, n in cases])
    found, moved = compat.compute_relocation(opacities, scales, ratios, binoms, min_opacity=least)
    for k, (o, n) in enumerate(cases):
        new, factor = relocated(o, n, least)
        assert abs(float(found[k]) - new) < 1e-12
        assert_close(moved[k], scales[k] * factor, 1e-11)
    if least == 0.005:
        assert torch.equal(compat.compute_relocation(opacities, scales, ratios, binoms)[1], moved)
    column, with_column = compat.compute_relocation(
        opacities[:, None], scales, ratios, binoms, min_opacity=least
    )
    assert torch.equal(column, found[:, None]) and torch.equal(with_column, moved)  # splatfacto's opacities
    with pytest.raises(ArgumentError, match="^min_opacity: "):
        compat.compute_relocation(opacities, scales, ratios, binoms, min_opacity=1.5)
    clamped = compat.compute_relocation(opacities, scales, ratios * 0 + 1000, binoms)
    assert_close(clamped[0], compat.compute_relocation(opacities, scales, ratios * 0 + 51, binoms)[0])
    assert int(ratios.max()) == 51
