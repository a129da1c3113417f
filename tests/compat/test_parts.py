"""`fully_fused_projection` and `spherical_harmonics` against gsplat's torch functions; the signatures."""

import inspect
import itertools
import math

import pytest
import torch

import gsplat_witness
from gsplat_edu.base.errors import ShapeError
from gsplat_edu.compat import gsplat as ours

theirs = pytest.importorskip("gsplat", reason="gsplat is not installed (extra dev)")
W, H = 23, 18
CLOSE = {"rtol": 1e-10, "atol": 1e-10}


@pytest.mark.parametrize("name", ["rasterization", "fully_fused_projection"])
def test_the_signatures_are_gsplats(name):
    """Positions, names and defaults agree; arguments that gsplat 1.6.0 has added are keyword-only."""

    def bare(function):
        return [
            (p.name, p.kind, getattr(p.default, "name", p.default))
            for p in inspect.signature(function).parameters.values()
            if p.kind is not p.KEYWORD_ONLY
        ]

    assert bare(getattr(ours, name)) == bare(getattr(theirs, name))


def test_the_shutters_are_gsplats():
    assert [(s.name, s.value) for s in ours.RollingShutterType] == [
        (s.name, s.value) for s in theirs.RollingShutterType
    ]


def projections(tensors, calc_compensations, covars, **limits):
    t = {name: tensors[name] for name in ("means", "quats", "scales", "viewmats", "Ks")}
    C, _ = gsplat_witness.torch_impl._quat_scale_to_covar_preci(
        t["quats"], t["scales"], True, False, triu=False
    )
    wanted = gsplat_witness.torch_impl._fully_fused_projection(
        t["means"], C, t["viewmats"], t["Ks"], W, H, calc_compensations=calc_compensations, **limits
    )
    six = C[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    shape = (six, None, None) if covars else (None, t["quats"], t["scales"])
    found = ours.fully_fused_projection(
        t["means"], *shape, t["viewmats"], t["Ks"], W, H, calc_compensations=calc_compensations, **limits
    )
    return found, wanted


@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize("limits", [{}, {"eps2d": 0.05, "near_plane": 1.0, "far_plane": 3.0}])
def test_the_projection_is_gsplats(covars, limits):
    tensors = gsplat_witness.scene(count=80)
    found, wanted = projections(tensors, True, covars, **limits)
    drawn = (wanted[0] > 0).all(dim=-1)
    assert torch.equal(found[0], wanted[0]) and found[0].dtype == torch.int32
    assert 10 < int(drawn.sum()) < drawn.numel()
    assert len(found) == len(wanted) == 5
    leaves = [tensors[name] for name in ("means", "quats", "scales", "viewmats", "Ks")]
    # entries of Ks that are used; only gsplat's torch function reads a skew
    used = torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
    for one, other in zip(found[1:], wanted[1:], strict=True):
        torch.testing.assert_close(one[drawn], other[drawn], **CLOSE)
        weights = torch.linspace(-1, 1, one[drawn].numel(), dtype=one.dtype).view(one[drawn].shape)
        of_one, of_other = (
            torch.autograd.grad((x[drawn] * weights).sum(), leaves, retain_graph=True, allow_unused=True)
            for x in (one, other)
        )
        for leaf, both in enumerate(zip(of_one, of_other, strict=True)):
            g, h = (torch.zeros(()) if each is None else each * (used if leaf == 4 else 1) for each in both)
            assert float((g - h).abs().max()) <= 1e-9 * max(1.0, float(h.abs().max()))


def test_packed_projection_lists_gaussians_with_positive_radii():
    tensors = gsplat_witness.scene()
    dense, _ = projections(tensors, False, False)
    t = tensors
    batch, camera, gaussian, indptr, *packed, none = ours.fully_fused_projection(
        t["means"], None, t["quats"], t["scales"], t["viewmats"], t["Ks"], W, H, packed=True
    )
    drawn = (dense[0] > 0).all(dim=-1)
    assert none is None and dense[4] is None
    assert torch.equal(torch.stack([camera, gaussian]), drawn.nonzero().T) and int(batch.max()) == 0
    for one, other in zip(packed, dense[:4], strict=True):
        assert torch.equal(one, other[drawn])
    assert indptr.dtype == torch.int32
    assert [camera[i:j].tolist() for i, j in itertools.pairwise(indptr.tolist())] == [
        [c] * int(own.sum()) for c, own in enumerate(drawn)
    ]


def test_opacities_tighten_the_radii():
    """alpha >= 1/255 holds within sqrt(2 ln(255 o)) standard deviations, at most 3.33 in gsplat."""
    tensors = {name: t.detach() for name, t in gsplat_witness.scene(count=200, cameras=1).items()}
    t, opacities = (
        tensors,
        torch.rand(200, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 0.1,
    )
    args = (t["means"], None, t["quats"], t["scales"], t["viewmats"], t["Ks"], W, H)
    plain, tight = ours.fully_fused_projection(*args), ours.fully_fused_projection(*args, opacities=opacities)
    conics = plain[3][0]
    variances = (
        torch.stack([conics[:, 2], conics[:, 0]], dim=-1)
        / (conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2)[:, None]
    )
    checked = 0
    for i in range(200):
        if not (plain[0][0, i] > 0).all():
            continue
        o = float(opacities[i])
        extent = min(3.33, math.sqrt(2 * math.log(255 * o))) if o >= 1 / 255 else 0.0
        wanted = [math.ceil(extent * math.sqrt(float(v))) for v in variances[i]]
        u, v = plain[1][0, i].tolist()
        inside = u + wanted[0] > 0 and u - wanted[0] < W and v + wanted[1] > 0 and v - wanted[1] < H
        assert tight[0][0, i].tolist() == (wanted if inside else [0, 0]), i
        checked += 1
    assert checked > 50 and int((tight[0] < plain[0]).sum()) > 50


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("K", [16, 25])
def test_the_harmonics_are_gsplats(degree, K):
    g = torch.Generator().manual_seed(degree)
    dirs = torch.randn(2, 30, 3, generator=g, dtype=torch.float64, requires_grad=True)
    coeffs = torch.randn(2, 30, K, 3, generator=g, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 30, 3, generator=g, dtype=torch.float64)
    found = ours.spherical_harmonics(degree, dirs, coeffs)
    wanted = gsplat_witness.torch_impl._spherical_harmonics(degree, dirs, coeffs)
    torch.testing.assert_close(found, wanted, **CLOSE)
    of_found, of_wanted = (
        torch.autograd.grad((x * weights).sum(), [dirs, coeffs], allow_unused=degree == 0)
        for x in (found, wanted)
    )
    for f, w in zip(of_found, of_wanted, strict=True):
        assert (f is None) == (w is None)
        torch.testing.assert_close(f, w, **CLOSE)


def test_masked_harmonics_are_zero_without_gradient():
    dirs = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], requires_grad=True)
    coeffs = torch.ones(2, 4, 3, requires_grad=True)
    colors = ours.spherical_harmonics(1, dirs, coeffs, masks=torch.tensor([True, False]))
    colors.sum().backward()
    assert torch.equal(colors[1], torch.zeros(3)) and float(colors.detach()[0].abs().min()) > 0.1
    assert torch.equal(coeffs.grad[1], torch.zeros(4, 3)) and bool(torch.isfinite(dirs.grad).all())


@pytest.mark.parametrize(
    ("name", "shapes"),
    [("dirs", [(5, 2), (5, 4, 3)]), ("coeffs", [(5, 3), (4, 4, 3)]), ("coeffs", [(5, 3), (5, 3, 3)])],
)
def test_shapes_of_harmonics_are_checked(name, shapes):
    with pytest.raises(ShapeError, match=f"^{name}: "):
        ours.spherical_harmonics(1, *(torch.zeros(shape) for shape in shapes))
    with pytest.raises(ShapeError, match="^masks: "):
        ours.spherical_harmonics(1, torch.zeros(5, 3), torch.zeros(5, 4, 3), torch.ones(4, dtype=torch.bool))
