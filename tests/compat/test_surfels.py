"""`rasterization_2dgs` and its steps against gsplat's functions, its rules at every pixel, and finite differences."""

import gc
import inspect
import weakref

import pytest
import torch

import gsplat_witness
import surfel_witness
from gsplat_calls import C, N, arguments
from gsplat_edu import _native
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.compat.gsplat import (
    fully_fused_projection_2dgs,
    isect_offset_encode,
    isect_tiles,
    rasterization_2dgs,
    rasterize_to_pixels_2dgs,
    skipping_bad_gaussians,
)
from proofs import proves_gradients
from surfel_witness import NAMES

W, H = 23, 18
EXACT = 1e-9
"""Bound in float64, relative to the largest entry: the two sides differ in rounding only, and the longest chain of
operations, 40 splats with a matrix inverse, loses fewer than seven of sixteen digits."""


def assert_close(found, wanted, bound=EXACT):
    assert found.shape == wanted.shape
    found, wanted = found.detach(), wanted.detach()
    assert float((found - wanted).abs().max()) <= bound * max(1.0, float(wanted.abs().max()))


def scene(seed=0, per_camera=False, degree=None):
    """Return 40 splats before two cameras. Two of them are opaque, and one is narrower than a pixel."""
    t = gsplat_witness.scene(seed=seed)
    if degree is None:
        g = torch.Generator().manual_seed(seed + 7)
        shape = (2, 40, 5) if per_camera else (40, 5)
        t["colors"] = torch.rand(shape, generator=g, dtype=torch.float64).requires_grad_()
        t["backgrounds"] = torch.rand(2, 5, generator=g, dtype=torch.float64).requires_grad_()
    with torch.no_grad():
        t["opacities"][:2] = 1.0
        t["scales"][2] = 1e-4
    return t


def smooth():
    """Return few wide splats that face the cameras, so that the low-pass filter widens none of them.

    All alphas are above 1/255 and below 0.999, no pixel ends, and no T is within a step of 1/2.
    """
    t = gsplat_witness.smooth()
    with torch.no_grad():
        t["quats"] = torch.tensor(
            [[3.0, 0.3, 0.2, 1.0], [2.0, -0.3, 0.1, 0.4], [3.0, 0.2, -0.5, 0.3], [1, 0, 0, 2]]
        )
    return {name: tensor.detach().double().requires_grad_() for name, tensor in t.items()}


def weighted(outputs):
    """Return a sum of all outputs with random weights, the same for outputs of the same shapes."""
    g = torch.Generator().manual_seed(5)
    present = [o for o in outputs if o is not None]
    return sum((torch.randn(o.shape, generator=g, dtype=torch.float64).to(o) * o).sum() for o in present)


def gradients(tensors, outputs, *nodes):
    wanted = [*tensors.values(), *nodes]
    found = torch.autograd.grad(weighted(outputs), wanted, allow_unused=True, retain_graph=True)
    return [torch.zeros_like(t) if g is None else g for t, g in zip(wanted, found, strict=True)]


CASES = {
    "colours of five channels": ("RGB", {}, {}),
    "harmonics": ("RGB", {"sh_degree": 3}, {}),
    "depth": ("D", {}, {}),
    "expected depth, packed": ("ED", {}, {"packed": True}),
    "colours and depth": ("RGB+D", {"depth_mode": "median"}, {"eps2d": 5.0}),
    "colours and expected depth, packed": ("RGB+ED", {}, {"packed": True}),
    "small tiles": ("RGB+ED", {"tile_size": 5}, {}),
    "a tile larger than the image": ("RGB+D", {"tile_size": 40}, {"distloss": True}),
    "limits": ("RGB", {"near_plane": 1.8, "far_plane": 3.0, "radius_clip": 3.0}, {}),
}
"""render_mode, arguments that the witness has as well, and others."""

NO_SKEW = torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
"""Entries of K that gsplat's kernels and ours read; its torch functions multiply by all."""


@pytest.mark.parametrize("case", CASES)
def test_values_and_gradients_match_gsplat(case):
    mode, shared, options = CASES[case]
    t = scene(degree=shared.get("sh_degree"))
    theirs, nodes = surfel_witness.rendered(t, W, H, mode, **shared)
    *mine, meta = rasterization_2dgs(**t, width=W, height=H, render_mode=mode, **shared, **options)
    for name, found, wanted in zip(NAMES, mine, theirs, strict=True):
        assert (found is None) == (wanted is None), name
        if wanted is not None:
            assert float(wanted.detach().abs().max()) > 0
            assert_close(found, wanted)
    for name, own, his in zip(t, gradients(t, mine), gradients(t, theirs), strict=True):
        assert_close(own, his * NO_SKEW if name == "Ks" else his)
        assert bool((his != 0).any()) or (name in ("colors", "backgrounds") and mode in ("D", "ED"))
    drawn = (nodes["radii"] > 0).all(-1)
    assert torch.equal(meta["radii"], nodes["radii"][drawn] if options.get("packed") else nodes["radii"])


def test_each_output_has_the_gradient_of_gsplat():
    t = scene()
    theirs, _ = surfel_witness.rendered(t, W, H, "RGB+ED", depth_mode="median")
    mine = rasterization_2dgs(**t, width=W, height=H, render_mode="RGB+ED", depth_mode="median")
    for k in range(len(NAMES)):
        for found, wanted in zip(gradients(t, mine[k : k + 1]), gradients(t, theirs[k : k + 1]), strict=True):
            assert_close(found, wanted * NO_SKEW if found.shape[-2:] == (3, 3) else wanted)


@pytest.mark.parametrize("packed", [False, True])
def test_what_strategies_read(packed):
    t = scene()
    theirs, nodes = surfel_witness.rendered(t, W, H, "RGB+D")
    *mine, meta = rasterization_2dgs(**t, width=W, height=H, render_mode="RGB+D", absgrad=True, packed=packed)
    for name in ("means2d", "ray_transforms"):
        meta[name].retain_grad()
    weighted(mine).backward()
    alone, *of_pixels = gradients({}, theirs, nodes["used"], *nodes["of_pixels"])
    drawn = (nodes["radii"] > 0).all(-1)
    rows = drawn if packed else torch.ones_like(drawn)
    sums = torch.stack([g.sum((0, 1)) for g in of_pixels])[rows]
    absolute = torch.stack([g.abs().sum((0, 1)) for g in of_pixels])[rows]
    assert_close(meta["means2d"].grad, sums.view(meta["means2d"].shape))
    assert_close(meta["means2d"].absgrad, absolute.view(meta["means2d"].shape))
    # gsplat's statistic for densification: the third entries of two rows of the gradient, times the depth.
    depths = nodes["transforms"][..., 2, 2, None]
    wanted = (alone[..., :2, 2] * depths)[rows].view(meta["gradient_2dgs"].shape)
    assert float(wanted.detach().abs().max()) > 0.1
    assert_close(meta["gradient_2dgs"].grad, wanted)
    assert_close(meta["ray_transforms"].grad, alone[rows].view(meta["ray_transforms"].shape))


def test_the_statistic_is_the_gradient_for_a_move_along_the_image_plane():
    """A px at the depth z is z / f wide. The first camera is not turned, and no splat is narrower than the filter."""
    t = {name: tensor.detach() for name, tensor in smooth().items()}
    t["colors"], t["means"] = t["colors"][:, 0], t["means"].clone().requires_grad_()
    one = {name: t[name][:1] for name in ("viewmats", "Ks", "backgrounds")}
    *images, meta = rasterization_2dgs(**t | one, width=W, height=H)
    weighted(images).backward()
    per_unit = one["Ks"][0, (0, 1), (0, 1)] / meta["depths"][0, :, None]
    assert_close(meta["gradient_2dgs"].grad[0] * per_unit, t["means"].grad[:, :2])


def lists_of(t, size, tile_size):
    """Return the projection of the scene's splats in its first camera, with the lists of its tiles."""
    width, height = size
    radii, *projected = fully_fused_projection_2dgs(
        *(t[name].detach() for name in ("means", "quats", "scales")),
        t["viewmats"].detach()[:1],
        t["Ks"].detach()[:1],
        *size,
    )
    tiles = (-(-width // tile_size), -(-height // tile_size))
    _, ids, rows = isect_tiles(projected[0], radii, projected[1], tile_size, *tiles)
    return projected, isect_offset_encode(ids, 1, *tiles), rows


@pytest.mark.parametrize("scale", [1.5, 1e-3])
def test_gradcheck_of_compositing(scale):
    """The scene is smooth: see `smooth`. At each pixel the filter widens either no splat, or all of them."""
    t = smooth()
    narrow = scale < 1
    size = (3, 3) if narrow else (W, H)
    with torch.no_grad():
        t["scales"] *= scale / 1.5
        if narrow:  # 0.02 px wide, all within 0.3 px of the middle of an image of 3 px
            t["means"] = torch.tensor([[0.01, 0, 2], [0, 0.02, 2.5], [0.02, 0.01, 3], [0, 0, 3.5]]).double()
            t["Ks"] = torch.tensor([[8.0, 0, 1.62], [0, 8, 1.41], [0, 0, 1]]).double().repeat(2, 1, 1)
            t["viewmats"] = torch.eye(4).double().repeat(2, 1, 1)
    (means2d, depths, transforms, normals), offsets, rows = lists_of(t, size, 16)
    assert len(rows) == 4 * offsets.numel()
    colors = torch.cat([t["colors"].detach()[None, :, 0], depths[..., None]], dim=-1)
    background = torch.tensor([[0.1, 0.2, 0.3, 0.0]]).double()
    inputs = (means2d, transforms, colors, t["opacities"].detach()[None], normals)

    def images(means2d, transforms, colors, opacities, normals, background):
        still = torch.zeros_like(means2d)
        lists = (16, offsets, rows, background)
        return rasterize_to_pixels_2dgs(means2d, transforms, colors, opacities, normals, still, *size, *lists)

    shown = images(*inputs, background)
    assert float(shown[1].min()) > 0.03
    assert proves_gradients(images, (*inputs, background))
    leaves = [each.clone().requires_grad_() for each in inputs]
    of_centres, of_transforms = torch.autograd.grad(weighted(images(*leaves, background)), leaves[:2])
    assert bool((of_centres if not narrow else of_transforms).any()) is False
    assert bool((of_transforms if not narrow else of_centres).any()) is True


def test_gradcheck_of_the_whole():
    """The scene is smooth: see `smooth`. No splat turns its other side to a camera within a step."""
    t = smooth()
    t["colors"] = t["colors"].detach()[:, :4]
    names = list(t)

    def images(*tensors):
        given = dict(zip(names, tensors, strict=True))
        return rasterization_2dgs(**given, width=W, height=H, render_mode="RGB+ED", sh_degree=1)[:6]

    # A difference of a normal of depths is a quotient of small ones: it loses two digits more.
    assert proves_gradients(images, list(t.values()), atol=1e-5, rtol=1e-4)


def many(dtype=torch.float32, count=1000):
    g = torch.Generator().manual_seed(3)
    t = {
        "means": torch.randn(count, 3, generator=g, dtype=torch.float64),
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64),
        "scales": 0.15 * torch.rand(count, 3, generator=g, dtype=torch.float64),
        "opacities": torch.rand(count, generator=g, dtype=torch.float64),
        "colors": torch.rand(count, 3, generator=g, dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None].clone(),
        "Ks": torch.tensor([[[90.0, 0, 50.3], [0, 90, 34.7], [0, 0, 1]]], dtype=torch.float64),
    }
    t["viewmats"][:, 2, 3] = 4.0
    return {name: tensor.to(dtype).requires_grad_() for name, tensor in t.items()}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_bits_do_not_depend_on_threads(dtype):
    t, before, seen = many(dtype), torch.get_num_threads(), []
    scene_only = [t[name] for name in ("means", "quats", "scales", "opacities", "colors")]
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            *images, _ = rasterization_2dgs(**t, width=100, height=70, render_mode="RGB+ED")
            seen.append([*images, *torch.autograd.grad(weighted(images), scene_only)])
    finally:
        torch.set_num_threads(before)
    for other in seen[1:]:
        assert all(torch.equal(a, b) for a, b in zip(seen[0], other, strict=True))


@pytest.mark.parametrize("isa", _native.isas())
def test_every_instruction_set_gives_the_image(isa):
    t, before = scene(), _native.isa()
    wanted, _ = surfel_witness.rendered(t, W, H, "RGB+ED")
    try:
        _native.choose_isa(isa)
        *mine, _ = rasterization_2dgs(**t, width=W, height=H, render_mode="RGB+ED")
        found = gradients(t, mine)
    finally:
        _native.choose_isa(before)
    for own, his in zip(mine, wanted, strict=True):
        assert_close(own, his)
    for own, his in zip(found, gradients(t, wanted), strict=True):
        assert_close(
            own, his * (torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]]) if own.shape[-2:] == (3, 3) else 1)
        )


@pytest.mark.parametrize("isa", _native.isas())
def test_what_earlier_calls_left_in_memory_has_no_effect(isa):
    """Rows of a tile end before those of its planes in memory, which the kernels reuse; here NaN is left there."""
    t, before, threads = many(torch.float64), _native.isa(), torch.get_num_threads()
    nan = torch.full((16, 16, 110), float("nan"), dtype=torch.float64)  # as much memory as the render's
    plane = {name: nan[None, ..., 0].clone() for name in ("transmittance", "distortion", "median")}
    lists = {
        "tile_begin": torch.tensor([0, 0]),
        "rows": torch.zeros(0, dtype=torch.int64),
        "done": torch.tensor([0]),
    }
    numbers = {"depth": 0, "edge": 16, "tiles_x": 1, "tiles_y": 1, "threads": threads}
    try:
        _native.choose_isa(isa)
        seen = []
        for _ in range(2):
            image = rasterization_2dgs(**t, width=39, height=37, tile_size=36)[0]
            seen += [image, *torch.autograd.grad(image.sum(), [t["means"], t["colors"]])]
            _native.surfels_backward_f64(
                **plane | lists | numbers | {f"grad_{name}": array for name, array in plane.items()},
                records=torch.ones(1, 14, dtype=torch.float64),
                channels=nan[0, :1].contiguous(),
                image=nan[None],
                grad_image=nan[None],
                median_places=torch.zeros(1, 16, 16, dtype=torch.int64),
                out=torch.empty(1, 124, dtype=torch.float64),
            )
    finally:
        _native.choose_isa(before)
    assert all(torch.equal(a, b) for a, b in zip(seen[:3], seen[3:], strict=True))


def test_float32_is_near_float64():
    """A rounding of 2^-24 in s, which is below 11 where a splat is drawn, changes alpha by less than 11 / 2 times as
    much; the kernels' exponential adds 2.4e-7. With ten operations before s the sum stays below 4e-6 per splat, and the
    weights of a pixel sum to 1. The scene is smooth, so that no pixel decides otherwise about a splat."""
    exact = {name: tensor.detach() for name, tensor in smooth().items()}
    exact["colors"] = exact["colors"][:, 0]
    exact = {name: tensor.float().double() for name, tensor in exact.items()}
    rounded = {name: tensor.float() for name, tensor in exact.items()}
    wanted = rasterization_2dgs(**exact, width=W, height=H)
    found = rasterization_2dgs(**rounded, width=W, height=H)
    for k in (0, 1, 2, 5):
        assert found[k].dtype == torch.float32
        assert_close(found[k].double(), wanted[k], 4e-6)


def test_batches_are_the_scenes_one_by_one():
    scenes = [scene(seed) for seed in (0, 1)]
    joined = {name: torch.stack([s[name].detach() for s in scenes]) for name in scenes[0]}
    together = rasterization_2dgs(**joined, width=W, height=H, render_mode="RGB+D")
    for k, one in enumerate(scenes):
        alone = rasterization_2dgs(**one, width=W, height=H, render_mode="RGB+D")
        assert all(torch.equal(a[k], b) for a, b in zip(together[:6], alone[:6], strict=True))
    assert together[6]["isect_offsets"].shape == (2, 2, 2, 2)


def test_colours_per_camera():
    t = scene(per_camera=True)
    theirs, _ = surfel_witness.rendered(t, W, H)
    assert_close(rasterization_2dgs(**t, width=W, height=H)[0], theirs[0])


@pytest.mark.parametrize("packed", [False, True])
def test_projection_and_lists(packed):
    t = scene()
    limits = {"near_plane": 1.0, "far_plane": 3.0}
    theirs = surfel_witness.projected(t, W, H, **limits)
    cameras = (t["viewmats"], t["Ks"], W, H)
    mine = fully_fused_projection_2dgs(t["means"], t["quats"], t["scales"], *cameras, packed=packed, **limits)
    drawn = (theirs[0] > 0).all(-1)
    if packed:
        *ids, radii, means2d, depths, transforms, normals = mine
        assert torch.equal(torch.stack(ids, dim=-1), drawn[None].nonzero())
        theirs = [each[drawn] for each in theirs]
        mine = (radii, means2d, depths, transforms, normals)
    for found, wanted in zip(mine, theirs, strict=True):
        assert_close(found.double(), wanted.double())
    *_, meta = rasterization_2dgs(**t, width=W, height=H, packed=packed, tile_size=8, **limits)
    splats = (meta["means2d"], meta["radii"], meta["depths"])
    more = {
        "packed": True,
        "n_images": 2,
        "image_ids": meta["camera_ids"],
        "gaussian_ids": meta["gaussian_ids"],
    }
    tiles, ids, rows = isect_tiles(*splats, 8, 3, 3, **(more if packed else {}))
    assert torch.equal(meta["tiles_per_gauss"], tiles)
    assert torch.equal(meta["isect_ids"], ids)
    assert torch.equal(meta["flatten_ids"], rows)
    assert torch.equal(meta["isect_offsets"], isect_offset_encode(ids, 2, 3, 3))


def test_masked_tiles_show_the_background():
    t = smooth()
    (means2d, depths, transforms, normals), offsets, rows = lists_of(t, (W, H), 8)
    splats = (
        means2d,
        transforms,
        depths[..., None],
        t["opacities"][None],
        normals,
        torch.zeros_like(means2d),
    )
    masks = torch.ones(offsets.shape, dtype=torch.bool)
    masks[0, 1, 1] = False
    background = torch.full((1, 1), 0.25).double()
    whole, cut = (
        rasterize_to_pixels_2dgs(*splats, W, H, 8, offsets, rows, background, each) for each in (None, masks)
    )
    inside = torch.zeros(1, H, W, dtype=torch.bool)
    inside[0, 8:16, 8:16] = True
    for a, b in zip(whole, cut, strict=True):
        assert torch.equal(a[~inside], b[~inside])
    assert bool((cut[0][inside] == 0.25).all())
    assert all(bool((each[inside] == 0).all()) for each in cut[1:])


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_draw(count):
    t = many(count=count)
    t["means"] = (t["means"].detach() - torch.tensor([0.0, 0.0, 90.0])).requires_grad_()
    background = torch.tensor([[0.2, 0.4, 0.6]])
    for packed in (False, True):
        image, alphas, *_, meta = rasterization_2dgs(
            **t, width=9, height=7, backgrounds=background, packed=packed, render_mode="RGB+ED"
        )
        assert torch.equal(image[..., :3], background.expand(1, 7, 9, 3))
        assert not bool(alphas.any())
        image.sum().backward()
        assert len(meta["flatten_ids"]) == 0


def test_normals_of_depths_need_three_pixels():
    t = many()
    for size in ((1, 5), (5, 2), (2, 2)):
        *_, surf_normals, _, _, meta = rasterization_2dgs(
            **t, width=size[0], height=size[1], render_mode="RGB+D"
        )
        assert surf_normals.shape == (size[1], size[0], 3)
        assert not bool(surf_normals.any())
        assert len(meta["flatten_ids"]) > 0


def test_bad_gaussians_are_skipped_on_request():
    t = {name: tensor.detach().clone() for name, tensor in many().items()}
    without = {name: tensor[1:] if len(tensor) == 1000 else tensor for name, tensor in t.items()}
    t["scales"][0] = float("nan")
    with pytest.raises(ArgumentError, match=r"^scales\[0, 0\]: "):
        rasterization_2dgs(**t, width=20, height=20)
    with skipping_bad_gaussians():
        found = rasterization_2dgs(**t, width=20, height=20)
    for a, b in zip(found[:3], rasterization_2dgs(**without, width=20, height=20)[:3], strict=True):
        assert torch.equal(a, b)


def test_a_render_is_freed():
    t = many()
    *images, meta = rasterization_2dgs(**t, width=20, height=20, absgrad=True)
    images[0].sum().backward()
    gc.disable()
    try:
        watched = weakref.ref(meta["means2d"])
        del images, meta
        assert watched() is None
    finally:
        gc.enable()


def test_second_derivatives_are_refused():
    t = many()
    image = rasterization_2dgs(**t, width=20, height=20)[0]
    with pytest.raises(ArgumentError, match="first derivatives only"):
        torch.autograd.grad(image.sum(), t["means"], create_graph=True)


def test_the_signatures_are_those_of_gsplat():
    gsplat = pytest.importorskip("gsplat")
    for mine in (rasterization_2dgs, fully_fused_projection_2dgs, rasterize_to_pixels_2dgs):
        theirs = inspect.signature(getattr(gsplat, mine.__name__)).parameters
        own = inspect.signature(mine).parameters
        assert [(name, p.default) for name, p in own.items()] == [
            (name, p.default) for name, p in theirs.items()
        ]


BAD = {
    "means": torch.zeros(N, 2),
    "quats": torch.zeros(N, 4),
    "scales": torch.full((N, 3), float("nan")),
    "opacities": torch.ones(N, 1),
    "colors": torch.ones(N + 1, 3),
    "viewmats": torch.eye(4),
    "Ks": torch.eye(3, dtype=torch.float64).repeat(C, 1, 1),
    "width": 0,
    "height": 2.5,
    "near_plane": -1.0,
    "far_plane": float("nan"),
    "radius_clip": -1.0,
    "eps2d": -0.1,
    "sh_degree": 5,
    "packed": "yes",
    "tile_size": 0,
    "backgrounds": torch.zeros(C, 4),
    "render_mode": "depth",
    "sparse_grad": True,
    "absgrad": 2,
    "distloss": True,
    "depth_mode": "mean",
}


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("name", BAD)
def test_a_bad_argument_is_named(name):
    assert list(BAD) == list(inspect.signature(rasterization_2dgs).parameters)
    with pytest.raises((ArgumentError, ShapeError), match=rf"^{name}\b") as caught:
        rasterization_2dgs(**arguments(**{name: BAD[name]}))
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ray_transforms", torch.zeros(1, 4, 3, 2)),
        ("normals", torch.zeros(1, 4, 2)),
        ("densify", torch.zeros(1, 4, 3)),
        ("masks", torch.ones(1, 3, 3)),
        ("distloss", "yes"),
    ],
)
def test_a_bad_argument_of_the_rasteriser_is_named(name, value):
    t = smooth()
    (means2d, depths, transforms, normals), offsets, rows = lists_of(t, (W, H), 8)
    value = value.double() if isinstance(value, torch.Tensor) else value
    given = {
        "means2d": means2d,
        "ray_transforms": transforms,
        "colors": depths[..., None],
        "opacities": t["opacities"][None],
        "normals": normals,
        "densify": torch.zeros_like(means2d),
        "image_width": W,
        "image_height": H,
        "tile_size": 8,
        "isect_offsets": offsets,
        "flatten_ids": rows,
    }
    with pytest.raises(ArgumentError, match=f"^{name}: "):
        rasterize_to_pixels_2dgs(**given | {name: value})
