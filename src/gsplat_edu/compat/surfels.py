"""gsplat's 2D Gaussian splatting: `rasterization_2dgs`, and the projection of flat Gaussians.

A splat with the axes e and f of its rotation is the plane (a, b) -> mean + a s_x e + b s_y f. Its ray transform in a
camera with the viewmat (R, t) is M = K [s_x R e, s_y R f, R mean + t], with the rows u, v and w. The box around the
image of a² + b² = 1 has, with the product <p, q> = p_1 q_1 + p_2 q_2 - p_3 q_3,

    centre = (<u, w>, <v, w>) / <w, w>,   half size² = centre² - (<u, u>, <v, v>) / <w, w>

Projection and harmonics are torch operations here, compositing is native (surfel_images.py). Source: Huang et al. 2024,
"2D Gaussian Splatting for Geometrically Accurate Radiance Fields"; conventions are gsplat 1.5.3's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import flag, one_of
from gsplat_edu.compat.checks import (
    DEPTH_ONLY,
    ONLY_VALUES,
    Arguments,
    RollingShutterType,
    check_cameras,
    check_limits,
    check_scene,
    check_size,
)
from gsplat_edu.compat.drawn import (
    Drawn,
    colors_of,
    drawn_at,
    joined,
    lens_of,
    require_memory_for,
    with_expected_depth,
)
from gsplat_edu.compat.images import Absgrad
from gsplat_edu.compat.projection import EXTENT
from gsplat_edu.compat.screen import Lens
from gsplat_edu.compat.skipping import without_bad_gaussians
from gsplat_edu.compat.surfel_images import SurfelImages, Surfels, TileLists, composite_surfels, shifted
from gsplat_edu.compat.tiles import isect_offset_encode, isect_tiles
from gsplat_edu.scene.gaussians import quat_to_R_t

PLAIN = ONLY_VALUES | {
    "rasterize_mode": "classic",
    "channel_chunk": 1,
    "camera_model": "pinhole",
    "segmented": False,
    "covars": None,
    "with_ut": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "rolling_shutter": RollingShutterType.GLOBAL,
    "viewmats_rs": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
}
"""Values of the arguments of `rasterization` that `rasterization_2dgs` does not have."""

LEAST_VARIANCE = 1e-4
"""gsplat's lower bound of the squared half size of a splat's box, px²."""

MOST_RADIUS = float(2**31 - 128)
"""Largest radius, px: the largest int32 that float32 holds."""


class ProjectedSurfels(NamedTuple):
    """N flat Gaussians of B batches in C cameras each. Where a radius is 0, the other entries mean nothing."""

    radii: Int32[Tensor, "B C N 2"]
    means2d: Float[Tensor, "B C N 2"]
    depths: Float[Tensor, "B C N"]
    ray_transforms: Float[Tensor, "B C N 3 3"]
    normals: Float[Tensor, "B C N 3"]


def project_surfels(
    means: Float[Tensor, "*B N 3"],
    quats: Float[Tensor, "*B N 4"],
    scales: Float[Tensor, "*B N 3"],
    cameras: tuple[Float[Tensor, "*B C 4 4"], Float[Tensor, "*B C 3 3"]],
    lens: Lens,
) -> ProjectedSurfels:
    """Project every flat Gaussian into every camera of its batch, in float64; return the dtype of the means.

    Args:
        means: Centres, world units.
        quats: Quaternions (w, x, y, z) of any length but 0.
        scales: Standard deviations, world units; the third has no effect.
        cameras: viewmats and Ks; the skew is not read.
        lens: Size of the image and limits.

    Differentiable in: means, quats, scales, cameras. The side that a normal faces is a constant.
    """
    viewmats, Ks = (joined(matrix, matrix.ndim - 3).double() for matrix in cameras)
    shape = (len(viewmats), 1, means.shape[-2])
    turn, shift = viewmats[:, :, None, :3, :3], viewmats[:, :, None, :3, 3]
    points = means.reshape(*shape, 3).double() @ viewmats[..., :3, :3].mT + shift
    axes = turn @ quat_to_R_t(quats.reshape(-1, 4).double()).view(*shape, 3, 3)
    flat = axes[..., :2] * scales.reshape(*shape, 1, 3)[..., :2].double()
    x, y, w = torch.cat([flat, points[..., None]], dim=-1).unbind(-2)
    u, v = (Ks[:, :, None, k, k, None] * row + Ks[:, :, None, k, 2, None] * w for k, row in enumerate((x, y)))
    signs = w.new_tensor([1.0, 1.0, -1.0])
    length = (signs * w * w).sum(dim=-1, keepdim=True)
    seen = length != 0
    weights = torch.where(seen, signs / torch.where(seen, length, 1.0), 0.0)
    centre = torch.stack([(weights * row * w).sum(dim=-1) for row in (u, v)], dim=-1)
    squares = torch.stack([(weights * row * row).sum(dim=-1) for row in (u, v)], dim=-1).detach()
    depths, normals = points[..., 2], axes[..., 2]
    away = (normals.detach() * points.detach()).sum(dim=-1, keepdim=True) >= 0
    drawable = seen[..., 0] & (depths > lens.near) & (depths < lens.far)
    fields = (centre, depths, torch.stack([u, v, w], dim=-2), torch.where(away, -normals, normals))
    return ProjectedSurfels(
        _radii(centre.detach(), squares, drawable, lens), *(each.to(means.dtype) for each in fields)
    )


def _radii(
    centre: Float[Tensor, "B C N 2"], squares: Float[Tensor, "B C N 2"], drawable: Tensor, lens: Lens
) -> Int32[Tensor, "B C N 2"]:
    """Return the half sizes of the boxes, px, rounded up; 0 for splats that are not drawn."""
    radii = torch.ceil(EXTENT * (centre * centre - squares).clamp(min=LEAST_VARIANCE).sqrt())
    meets = ((centre + radii > 0) & (centre - radii < centre.new_tensor([lens.width, lens.height]))).all(
        dim=-1
    )
    drawn = drawable & meets & (radii > lens.radius_clip).any(dim=-1)
    return torch.where(drawn[..., None], radii.clamp(max=MOST_RADIUS), 0.0).to(torch.int32)


def _check_dense(sparse_grad: object) -> None:
    """Refuse sparse gradients."""
    if flag("sparse_grad", sparse_grad):
        raise ArgumentError("sparse_grad: is True, but 2D Gaussians have dense gradients only; pass False")


def fully_fused_projection_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
) -> tuple[Tensor, ...]:
    """Project flat Gaussians as gsplat 1.5.3's function of this name does, with the values of `rasterization_2dgs`.

    Returns:
        radii (int32), means2d, depths, ray_transforms and normals, of shape (..., C, N, ...); packed: batch_ids,
        camera_ids and gaussian_ids, then the same of the splats with positive radii only, (nnz, ...).

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or not supported.

    Differentiable in: means, quats, scales, viewmats, Ks.
    """
    _check_dense(sparse_grad)
    check_size(width, height)
    check_limits(near_plane, far_plane, radius_clip, eps2d)
    named: dict[str, Tensor | None] = {"means": means, "quats": quats, "scales": scales, "opacities": None}
    batch, N = check_scene(named, False)
    C = check_cameras(viewmats, Ks, batch, means)
    lens = Lens(width, height, eps2d, near_plane, far_plane, radius_clip)
    found = project_surfels(means, quats, scales, (viewmats, Ks), lens)
    if not flag("packed", packed):
        return tuple(each.view(*batch, C, N, *each.shape[3:]) for each in found)
    drawn = (found.radii > 0).all(dim=-1)
    return (*drawn.nonzero().unbind(-1), *(each[drawn] for each in found))


def rasterization_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    depth_mode: str = "expected",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """Render flat Gaussians into C cameras with gsplat's arguments.

    `gsplat_edu.compat.checks.Arguments` describes those of `rasterization`. Depths of near_plane and far_plane
    themselves are outside here, the third scale and eps2d have no effect, and tile_size is that of the kernels: like
    gsplat's, they draw a splat in all pixels of the tiles that its box meets.

    distloss has no effect, because the distortion is always computed, but True demands a `render_mode` with a depth.
    depth_mode says which depth makes surf_normals: "expected", that of the image, or "median".

    Returns:
        images (..., C, H, W, channels), alphas (..., C, H, W, 1), and normals (..., C, H, W, 3) in world axes,
        composited and not normalised; surf_normals, those of the depth, of the same shape but without a first axis
        of 1, None unless `render_mode` is RGB+D or RGB+ED; distortions and medians (..., C, H, W, 1) of the last
        channel; `meta`.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite, out of range or not supported.

    Differentiable in: every tensor, those of the cameras included.
    """
    given = {name: value for name, value in locals().items() if name not in ("distloss", "depth_mode")}
    _check_dense(sparse_grad)
    a = Arguments(**without_bad_gaussians(PLAIN | given))
    one_of("depth_mode", depth_mode, ("expected", "median"))
    if flag("distloss", distloss) and a.render_mode == "RGB":
        raise ArgumentError("distloss: needs a depth, but render_mode is 'RGB'; render 'RGB+D' or 'RGB+ED'")
    return _rasterize(a, depth_mode)


def _rasterize(
    a: Arguments, depth_mode: str
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """Render checked arguments."""
    found, meta = _drawn_images(a)
    shape = (*a.batch, a.C, a.height, a.width)
    image, T = found.image.reshape(*shape, found.image.shape[-1]), found.transmittance.view(*shape, 1)
    if a.backgrounds is not None and a.render_mode not in DEPTH_ONLY:
        behind = T * a.backgrounds[..., None, None, :]
        image = image + torch.nn.functional.pad(behind, (0, image.shape[-1] - behind.shape[-1]))
    alphas, medians = 1.0 - T, found.median.view(*shape, 1)
    if a.render_mode.endswith("ED"):
        image = with_expected_depth(image, alphas)
    poses = torch.linalg.inv(a.viewmats)
    surf_normals = None
    if a.render_mode.startswith("RGB+"):
        depths = image[..., -1:] if depth_mode == "expected" else medians
        surf_normals = _normals_of_depths(depths, poses, a.Ks).squeeze(0)
    normals = torch.einsum("...ij,...hwj->...hwi", poses[..., :3, :3], found.normals.reshape(*shape, 3))
    meta["render_distort"] = found.distortion.view(*shape, 1)
    return image, alphas, normals, surf_normals, meta["render_distort"], medians, meta


def _drawn_images(a: Arguments) -> tuple[SurfelImages, dict[str, Any]]:
    """Return the images of all cameras, without backgrounds, and `meta` without the distortion."""
    require_memory_for(a)
    meta, drawn, rows = _projected(a)
    kept = Absgrad(meta["means2d"]) if a.absgrad else None
    used = meta | {"ray_transforms": shifted(meta["ray_transforms"], meta["gradient_2dgs"])}
    used |= {} if kept is None else {"means2d": kept.means2d}
    own = {name: joined(field, meta["depths"].ndim).index_select(0, rows) for name, field in used.items()}
    lists, listed = _lists(a, drawn, own)
    colors = [] if a.render_mode in DEPTH_ONLY or a.colors is None else [colors_of(a, a.colors, drawn)]
    colors += [] if a.render_mode == "RGB" else [own["depths"][:, None]]
    numbers = (own["opacities"], torch.cat(colors, dim=-1), own["normals"])
    store = None if kept is None else kept.adder(rows)
    found = composite_surfels(Surfels(own["means2d"], own["ray_transforms"], *numbers), lists, store)
    ids = (drawn.scenes, drawn.images % a.C, drawn.gaussians) if a.packed else (None, None, None)
    named = dict(zip(("batch_ids", "camera_ids", "gaussian_ids"), ids, strict=True))
    sizes = {"width": a.width, "height": a.height, "tile_size": a.edge}
    return found, meta | listed | named | sizes | {"n_batches": a.batches, "n_cameras": a.C}


def _projected(a: Arguments) -> tuple[dict[str, Any], Drawn, Tensor]:
    """Return the tensors of `meta` that have a row for each splat, which splats are drawn, and their rows."""
    assert a.quats is not None
    assert a.scales is not None
    found = project_surfels(a.means, a.quats, a.scales, (a.viewmats, a.Ks), lens_of(a))
    positions = (found.radii > 0).all(dim=-1).flatten().nonzero()[:, 0]
    fields = found._asdict() | {"opacities": a.opacities.reshape(a.batches, 1, a.N).expand(-1, a.C, -1)}
    if a.packed:
        meta = {name: joined(field, 3).index_select(0, positions) for name, field in fields.items()}
    else:
        meta = {name: field.reshape(*a.batch, a.C, a.N, *field.shape[3:]) for name, field in fields.items()}
    meta["gradient_2dgs"] = torch.zeros_like(meta["means2d"], requires_grad=True)
    return meta, drawn_at(positions, a), torch.arange(len(positions)) if a.packed else positions


def _lists(a: Arguments, drawn: Drawn, own: dict[str, Tensor]) -> tuple[TileLists, dict[str, Any]]:
    """Return the tiles' lists of rows of the drawn splats, `own`, and what `meta` has of them."""
    columns, rows = (math.ceil(size / a.edge) for size in (a.width, a.height))
    images = a.batches * a.C
    tiles, ids, listed = isect_tiles(
        own["means2d"],
        own["radii"],
        own["depths"],
        a.edge,
        columns,
        rows,
        packed=True,
        n_images=images,
        image_ids=drawn.images,
        gaussian_ids=drawn.gaussians,
    )
    offsets = isect_offset_encode(ids, images, columns, rows)
    lists = TileLists(a.width, a.height, a.edge, offsets.long(), listed.long())
    if not a.packed:
        none = tiles.new_zeros(images * a.N)
        tiles = none.index_copy(0, drawn.positions, tiles).view(*a.batch, a.C, a.N)
        listed = drawn.positions[lists.rows].int()
    meta = {"tile_width": columns, "tile_height": rows, "tiles_per_gauss": tiles, "isect_ids": ids}
    meta |= {"flatten_ids": listed, "isect_offsets": offsets.view(*a.batch, a.C, rows, columns)}
    return lists, meta


def _normals_of_depths(depths: Tensor, poses: Tensor, Ks: Tensor) -> Tensor:
    """Return gsplat's normals of depth maps by central differences, zero at the edges of an image.

    Args:
        depths: (..., H, W, 1) z.
        poses: (..., 4, 4) camera to world.
        Ks: (..., 3, 3) intrinsics, px.

    Returns:
        (..., H, W, 3) unit vectors in world axes.
    """
    H, W = depths.shape[-3:-1]
    if min(H, W) < 3:
        return torch.zeros_like(depths).expand(*depths.shape[:-1], 3)
    places = torch.meshgrid(*(torch.arange(n, dtype=depths.dtype) + 0.5 for n in (W, H)), indexing="xy")
    ratios = [(at - Ks[..., k, 2, None, None]) / Ks[..., k, k, None, None] for k, at in enumerate(places)]
    rays = torch.stack([*ratios, torch.ones_like(ratios[0])], dim=-1)
    rays = torch.einsum("...ij,...hwj->...hwi", poses[..., :3, :3], rays)
    points = poses[..., None, None, :3, 3] + depths * rays
    down = points[..., 2:, 1:-1, :] - points[..., :-2, 1:-1, :]
    right = points[..., 1:-1, 2:, :] - points[..., 1:-1, :-2, :]
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right), dim=-1)
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))
