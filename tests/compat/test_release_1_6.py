"""What gsplat 1.6.0 added to functions of 1.5.3, against gsplat's torch code and definitions."""

import pytest
import torch

import gsplat_witness
from gsplat_calls import C, N, arguments
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.compat import gsplat as ours

DOUBLE = torch.float64


def seen(batch=(), K=16, D=3, seed=0):
    """Means, rigid viewmats and coefficients."""
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=g, dtype=DOUBLE)  # noqa: E731
    viewmats = torch.eye(4, dtype=DOUBLE).repeat(*batch, 2, 1, 1)
    viewmats[..., :3, :3] = torch.linalg.qr(draw(*batch, 2, 3, 3))[0]
    viewmats[..., :3, 3] = draw(*batch, 2, 3)
    return [t.requires_grad_() for t in (draw(*batch, 5, 3), viewmats, draw(5, K, D))]


def directions(means, viewmats):
    """From the centres of the cameras, by solving R x + t = 0."""
    eyes = torch.linalg.solve(viewmats[..., :3, :3], -viewmats[..., :3, 3])
    return means[..., None, :, :] - eyes[..., None, :]


def same_gradients(inputs, found, wanted):
    """Sums of at most 25 terms of order 1 to 10 in another order: 1e-11 is above a thousand roundings."""
    weights = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(9), dtype=DOUBLE)
    torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-11)
    pairs = (
        torch.autograd.grad((out * weights).sum(), inputs, retain_graph=True, allow_unused=True)
        for out in (found, wanted)
    )
    for one, other in zip(*pairs, strict=True):
        assert one is not None and float(one.abs().max()) > 0
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
@pytest.mark.parametrize(("batch", "D"), [((), 3), ((2,), 6)])
def test_harmonics_take_directions_from_cameras(degree, batch, D):
    means, viewmats, coeffs = seen(batch, 25, D)
    dirs = directions(means, viewmats)
    of_three = lambda own: own.expand(*batch, 2, 5, 25, 3)  # noqa: E731
    wanted = torch.cat(
        [
            gsplat_witness.torch_impl._spherical_harmonics(degree, dirs, of_three(own))
            for own in coeffs.split(3, dim=-1)
        ],
        dim=-1,
    )
    found = ours.spherical_harmonics(degree, means, viewmats, coeffs)
    torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-11)
    # -R' t and the solution differ off the rotations: gradients of viewmats do as well, those of the others do not
    same_gradients([means, coeffs], found, wanted)
    named = {"means": means, "viewmats": viewmats, "coeffs": coeffs}
    for again in (
        ours.spherical_harmonics(degrees_to_use=degree, **named),
        ours.spherical_harmonics(degree, means, viewmats, coeffs=coeffs),
        ours.spherical_harmonics(degree, dirs, coeffs),
        ours.spherical_harmonics(degree, dirs, coeffs=coeffs),
    ):
        torch.testing.assert_close(again, found, rtol=1e-11, atol=1e-11)
    parts = ours.spherical_harmonics_l0(coeffs[:, :1]) + ours.spherical_harmonics_l1_plus(
        degree, means, viewmats, coeffs[:, 1:]
    )
    same_gradients([means, viewmats, coeffs], parts, found)


def test_gradients_of_cameras_through_harmonics():
    """The harmonics are smooth where no mean is at a camera's centre."""
    means, viewmats, coeffs = seen()
    later = viewmats.detach().clone().requires_grad_()
    assert float(directions(means, viewmats).detach().norm(dim=-1).min()) > 0.1
    assert torch.autograd.gradcheck(
        lambda *given: ours.spherical_harmonics(3, *given[:3], viewmats_rs=given[3]),
        (means, viewmats, coeffs, later),
    )


def test_packed_and_masked_harmonics():
    means, viewmats, coeffs = seen((2,))
    dense = ours.spherical_harmonics(2, means, viewmats, coeffs)
    masks = torch.rand(2, 2, 5, generator=torch.Generator().manual_seed(1)) < 0.6
    masked = ours.spherical_harmonics(2, means, viewmats, coeffs, masks)
    assert torch.equal(masked, torch.where(masks[..., None], dense, 0.0)) and not bool(masks.all())
    batch, camera, gaussian = ids = masks.nonzero().unbind(-1)
    packed = ours.spherical_harmonics(2, means, viewmats, coeffs[gaussian], None, *ids)
    torch.testing.assert_close(packed, dense[batch, camera, gaussian], rtol=1e-13, atol=1e-13)
    with pytest.raises(ArgumentError, match="^camera_ids: has to be from 0 to 1"):
        ours.spherical_harmonics(2, means, viewmats, coeffs[gaussian], None, batch, camera + 1, gaussian)
    with pytest.raises(ShapeError, match="^gaussian_ids: has shape"):
        ours.spherical_harmonics(2, means, viewmats, coeffs[gaussian], None, batch, camera, gaussian[1:])
    with pytest.raises(ShapeError, match="^shN: "):
        ours.spherical_harmonics_l1_plus(3, means, viewmats, coeffs[:, :14])


def test_a_rolling_shutter_uses_the_mean_of_both_centres():
    means, viewmats, coeffs = seen()
    later = viewmats.detach().clone()
    later[:, :3, 3] += later[:, :3, :3] @ torch.tensor(
        [0.2, -0.4, 0.6], dtype=DOUBLE
    )  # the centre moves by minus that
    found = ours.spherical_harmonics(3, means, viewmats, coeffs, viewmats_rs=later)
    moved = means + torch.tensor([0.1, -0.2, 0.3], dtype=DOUBLE)
    torch.testing.assert_close(
        found, ours.spherical_harmonics(3, moved, viewmats, coeffs), rtol=1e-11, atol=1e-11
    )


def test_half_coefficients_are_computed_with_in_float32():
    means, viewmats, coeffs = (t.detach().float() for t in seen())
    half = coeffs.half().requires_grad_()
    found = ours.spherical_harmonics(3, means, viewmats, half)
    assert found.dtype == torch.float32
    assert torch.equal(found, ours.spherical_harmonics(3, means, viewmats, half.detach().float()))
    assert ours.spherical_harmonics_l0(half[:, :1]).dtype == torch.float32
    found.sum().backward()
    assert half.grad.dtype == torch.float16 and float(half.grad.abs().max()) > 0


def coefficients(D, *lead, K=9):
    g = torch.Generator().manual_seed(3)
    return 0.5 * torch.randn(*lead, N, K, D, generator=g)


@pytest.mark.parametrize("D", [1, 3, 7, 40])
def test_coefficients_of_any_depth(D):
    """Channels are composited independently: three at a time give the same."""
    colors = coefficients(D)
    whole = ours.rasterization(**arguments(colors=colors), sh_degree=2)[0]
    assert whole.shape[-1] == D
    for k in range(0, D, 3):
        part = torch.nn.functional.pad(colors, (0, 3))[..., k : k + 3]
        alone = ours.rasterization(**arguments(colors=part), sh_degree=2)[0]
        # float32: sums of six terms below 1
        torch.testing.assert_close(whole[..., k : k + 3], alone[..., : D - k], rtol=0, atol=1e-6)


def test_coefficients_shared_by_all_scenes():
    names = ("means", "quats", "scales", "opacities", "viewmats", "Ks")
    given = arguments()
    batched = {name: torch.stack([given[name]] * 2) for name in names} | {"width": 16, "height": 12}
    batched["means"][1] += 0.1
    shared = coefficients(4).requires_grad_()
    repeated = shared.detach().repeat(2, 1, 1, 1).requires_grad_()
    images = [ours.rasterization(**batched, colors=c, sh_degree=2)[0] for c in (shared, repeated)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    torch.testing.assert_close(shared.grad, repeated.grad.sum(dim=0), rtol=1e-5, atol=1e-6)
    bad = shared.detach().clone()
    bad[2] = float("nan")
    with ours.skipping_bad_gaussians():
        meta = ours.rasterization(**batched, colors=bad, sh_degree=2)[2]
    assert 2 not in meta["gaussian_ids"].tolist()


def test_half_coefficients_of_rasterization():
    half = coefficients(3).half().requires_grad_()
    image = ours.rasterization(**arguments(colors=half), sh_degree=2)[0]
    assert torch.equal(image, ours.rasterization(**arguments(colors=half.detach().float()), sh_degree=2)[0])
    image.sum().backward()
    assert half.grad.dtype == torch.float16 and float(half.grad.abs().max()) > 0
    with pytest.raises(ArgumentError, match="^colors: is torch.float16"):
        ours.rasterization(**arguments(colors=torch.rand(N, 3).half()))


def test_tile_size_none_is_16():
    plain, given = (ours.rasterization(**arguments(), tile_size=size) for size in (16, None))
    assert torch.equal(plain[0], given[0]) and given[2]["tile_size"] == 16


@pytest.mark.parametrize("mode", ["d", "Ed", "RGB-d", "RGB-Ed"])
def test_distances_along_rays_are_refused(mode):
    with pytest.raises(ArgumentError, match=f"^render_mode: is '{mode}', .* needs with_eval3d; render 'D'"):
        ours.rasterization(**arguments(), render_mode=mode)


@pytest.mark.parametrize("from_covars", [False, True])
def test_sparse_gradients_hold_the_rows_of_the_drawn_gaussians(from_covars):
    given = arguments()
    given["means"][[1, 4]] = torch.tensor([0.0, 0.0, -50.0])  # behind the cameras
    names = ("means", "covars") if from_covars else ("means", "quats", "scales")
    if from_covars:
        given["covars"] = 0.04 * torch.eye(3).repeat(N, 1, 1)
    found = []
    for sparse_grad in (True, False):
        own = given | {name: given[name].clone().requires_grad_() for name in names}
        image, _, meta = ours.rasterization(
            **own | {"colors": coefficients(3)}, sh_degree=2, sparse_grad=sparse_grad
        )
        image.square().sum().backward()
        found.append([own[name].grad for name in names])
    assert sorted(set(meta["gaussian_ids"].tolist())) == [0, 2, 3, 5] and len(meta["gaussian_ids"]) > 4
    for sparse, dense in zip(*found, strict=True):
        assert sparse.layout is torch.sparse_coo and not dense.is_sparse
        assert sparse.coalesce().indices().tolist() == [[0, 2, 3, 5]]
        assert torch.equal(sparse.to_dense(), dense) and float(dense.abs().max()) > 0


def test_sparse_gradients_of_the_projection():
    given = arguments()
    given["means"][3, 2] = -50.0
    names = ("means", "quats", "scales")
    leaves = [given[name].clone().requires_grad_() for name in names]
    means, quats, scales = leaves
    call = (means, None, quats, scales, given["viewmats"], given["Ks"], 16, 12)
    found = ours.fully_fused_projection(*call, packed=True, sparse_grad=True)[5:8]
    wanted = ours.fully_fused_projection(*call, packed=True)[5:8]
    grads = [torch.autograd.grad(sum(t.square().sum() for t in out), leaves) for out in (found, wanted)]
    for sparse, dense in zip(*grads, strict=True):
        assert sparse.is_sparse and 3 not in sparse.indices()[0].tolist()
        assert torch.equal(sparse.to_dense(), dense)
    with pytest.raises(ArgumentError, match="^sparse_grad: is True, which needs packed=True"):
        ours.fully_fused_projection(*call, sparse_grad=True)
    one = {name: t[None] for name, t in arguments().items() if isinstance(t, torch.Tensor)}
    with pytest.raises(ArgumentError, match="^sparse_grad: .* without leading axes"):
        ours.rasterization(**one, width=16, height=12, sparse_grad=True)


def test_sparse_adam_moves_drawn_gaussians_only():
    given = arguments()
    given["means"][1, 2] = -50.0
    means = given["means"].clone().requires_grad_()
    optimizer = torch.optim.SparseAdam([means], lr=0.1)
    ours.rasterization(**given | {"means": means}, sparse_grad=True)[0].square().sum().backward()
    optimizer.step()
    moved = (means.detach() != given["means"]).any(dim=1)
    assert moved.tolist() == [i != 1 for i in range(N)] and C == 2


def splats_on_the_screen():
    """60 ellipses of any direction, and opacities on both sides of 1/255, on two screens of 40 x 30 px."""
    g = torch.Generator().manual_seed(2)
    draw = lambda *shape: torch.rand(*shape, generator=g, dtype=DOUBLE)  # noqa: E731
    means2d = draw(2, 60, 2) * torch.tensor([60.0, 50.0], dtype=DOUBLE) - 10.0
    angle, (a, b) = draw(2, 60) * 3.2, (0.5 + 9.0 * draw(2, 60) ** 3 for _ in range(2))
    R = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], dim=-1).view(2, 60, 2, 2)
    inverse = R @ torch.diag_embed(torch.stack([a, b], dim=-1) ** -2) @ R.mT
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], dim=-1)
    radii = (3.33 * torch.maximum(a, b)).ceil().int()[..., None].expand(2, 60, 2).clone()
    radii[0, :3] = 0
    return means2d, radii, 1.0 + draw(2, 60), conics, draw(2, 60) ** 3


def form(means2d, conics, x, y):
    """The quadratic form of each conic at points."""
    u, v, A, B, C = (t[:, None, None] for t in (*means2d.unbind(-1), *conics.unbind(-1)))
    return A * (x - u) ** 2 + 2 * B * (x - u) * (y - v) + C * (y - v) ** 2


@pytest.mark.parametrize("packed", [False, True])
def test_ellipses_meet_the_listed_tiles(packed):
    """Sampled at k x k points of each tile, corners included, the least value of the form is at most
    (sqrt(q) + r)² where q is the least value, and r the distance to the next point, half a diagonal of the grid,
    in standard deviations of the shorter axis (the square root of a form is a norm)."""
    tile, width, height, k = 8, 5, 4, 17
    means2d, radii, depths, conics, opacities = splats_on_the_screen()
    options = {"conics": conics, "opacities": opacities}
    given = [means2d, radii, depths]
    if packed:
        images = torch.arange(2).repeat_interleave(60)
        given = [t.flatten(0, 1) for t in given]
        options = {name: t.flatten(0, 1) for name, t in options.items()}
        options |= {
            "packed": True,
            "n_images": 2,
            "image_ids": images,
            "gaussian_ids": torch.arange(120) % 60,
        }
    counts, ids, rows = ours.isect_tiles(*given, tile, width, height, **options)
    bits = (width * height).bit_length()
    places = ids >> 32
    assert torch.equal(places >> bits, rows.long() // 60)
    listed = torch.zeros(120, width * height, dtype=torch.bool)
    listed[rows.long(), places & (2**bits - 1)] = True
    assert int(listed.sum()) == len(rows) and torch.equal(listed.sum(dim=1), counts.flatten().long())
    at = torch.linspace(0, tile, k, dtype=DOUBLE)
    levels = (2 * torch.log(255 * opacities.flatten())).clamp(max=3.33**2)
    norms = torch.linalg.eigvalsh(conics.flatten(0, 1)[:, [0, 1, 1, 2]].view(-1, 2, 2))[:, 1].sqrt()
    reach = norms * tile / (k - 1) / 2**0.5
    able = (radii.flatten(0, 1) > 0).all(dim=-1)
    for t in range(width * height):
        x, y = at + t % width * tile, (at + t // width * tile)[:, None]
        least = form(means2d.flatten(0, 1), conics.flatten(0, 1), x, y).flatten(1).min(dim=1).values
        assert bool(listed[able & (least <= levels), t].all())
        assert bool((least.sqrt() <= levels.clamp(min=0).sqrt() + reach)[listed[:, t]].all())
    assert not bool(listed[~able | (levels < 0)].any()) and int((levels < 0).sum()) > 5
    boxes = ours.isect_tiles(*given, tile, width, height, **options | {"conics": None})
    assert len(rows) < 0.8 * len(boxes[1])
    unsorted = ours.isect_tiles(*given, tile, width, height, sort=False, **options)
    assert torch.equal(torch.sort(unsorted[1]).values, ids)


def test_lists_of_ellipses_draw_the_same_image():
    means2d, radii, depths, conics, opacities = splats_on_the_screen()
    colors, images = torch.rand(2, 60, 3, generator=torch.Generator().manual_seed(5), dtype=DOUBLE), []
    for options in ({}, {"conics": conics, "opacities": opacities}):
        _, ids, rows = ours.isect_tiles(means2d, radii, depths, 8, 5, 4, **options)
        offsets = ours.isect_offset_encode(ids, 2, 5, 4)
        images.append(
            ours.rasterize_to_pixels(means2d, conics, colors, opacities, 40, 30, 8, offsets, rows)[0]
        )
    assert torch.equal(*images) and float(images[0].max()) > 0.5


def test_conics_of_tiles_are_checked():
    means2d, radii, depths, conics, opacities = splats_on_the_screen()
    given = (means2d, radii, depths, 8, 5, 4)
    with pytest.raises(ShapeError, match="^conics: has shape"):
        ours.isect_tiles(*given, conics=conics[..., :2], opacities=opacities)
    conics[1, 7, 1] = 100.0
    opacities[1, 7] = 0.5
    with pytest.raises(ArgumentError, match=r"^conics\[67\]: is not positive definite"):
        ours.isect_tiles(*given, conics=conics, opacities=opacities)
