"""A drop-in for gsplat 1.6.0 and 1.5.3: `rasterization`, `rasterization_2dgs` and their steps, on any CPU.

`rasterization` also has the nine arguments that gsplat 1.6.0 has added. There they stand between those of 1.5.3; here
they are keywords only, so that positional calls written for 1.5.3 keep their meaning.

    from gsplat_edu.compat.gsplat import rasterization      # instead of: from gsplat import rasterization

gsplat's `DefaultStrategy` runs on it as it is, its `MCMCStrategy` with `compute_relocation` and
`quat_scale_to_covar_preci` in place of its own, which are CUDA kernels. docs/GSPLAT.md compares the arguments one by
one and lists the differences.

Design. gsplat has three stages, each differentiable: projection and harmonics, then compositing of what they return.
Its strategies call `meta["means2d"].retain_grad()` before the backward pass and read `.grad` and `.absgrad` after it.
So the stages here are the same. Projection and harmonics are native steps of the graph (screen.py), or torch operations
for lenses, degree 4 and other than three channels; usual.py joins them to one step for the usual call.
`meta["means2d"]`, `meta["depths"]` and `meta["opacities"]` are nodes of the graph between them and the image.
Compositing is our native kernels (images.py), whose gradient with respect to a mean on the screen arrives at
`meta["means2d"]` by autograd, per axis and per px. Therefore retain_grad, hooks and losses on these tensors work
without special cases. `absgrad` is a statistic that the kernels collect; hooks
on their inputs add it up, and a hook on the centres assigns the sums to the attribute at the end of each backward pass.

The renderer's own projection is not used: it returns no centres that a graph could pass through. Compositing projects
what is on the screen once more, which `gsplat_edu.render.api.render` need not do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.constants import SH_OFFSET
from gsplat_edu.compat.checks import DEPTH_ONLY, Arguments, RollingShutterType, check_spreads
from gsplat_edu.compat.contributors import (
    accumulate,
    rasterize_contributing_gaussian_ids,
    rasterize_num_contributing_gaussians,
    rasterize_to_indices_in_range,
    rasterize_top_contributing_gaussian_ids,
)
from gsplat_edu.compat.drawn import (
    Drawn,
    colors_of,
    directions,
    drawn_at,
    joined,
    lens_of,
    require_memory_for,
    with_expected_depth,
)
from gsplat_edu.compat.harmonics import (
    evaluate,
    spherical_harmonics,
    spherical_harmonics_l0,
    spherical_harmonics_l1_plus,
)
from gsplat_edu.compat.images import Absgrad, Splats, composite
from gsplat_edu.compat.lenses import cameras_of
from gsplat_edu.compat.parts import compute_relocation, proj, quat_scale_to_covar_preci, world_to_cam
from gsplat_edu.compat.projection import (
    TRIANGLE,
    fully_fused_projection,
    project,
    solids_of,
    with_sparse_gradient,
)
from gsplat_edu.compat.skipping import skipping_bad_gaussians, without_bad_gaussians
from gsplat_edu.compat.stages import stage
from gsplat_edu.compat.surfel_images import rasterize_to_pixels_2dgs
from gsplat_edu.compat.surfels import fully_fused_projection_2dgs, rasterization_2dgs
from gsplat_edu.compat.tiles import isect_offset_encode, isect_tiles, rasterize_to_pixels
from gsplat_edu.compat.usual import image_of, is_usual, project_usual

__all__ = [
    "RollingShutterType",
    "accumulate",
    "compute_relocation",
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "isect_offset_encode",
    "isect_tiles",
    "proj",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_2dgs",
    "rasterize_contributing_gaussian_ids",
    "rasterize_num_contributing_gaussians",
    "rasterize_to_indices_in_range",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "rasterize_top_contributing_gaussian_ids",
    "skipping_bad_gaussians",
    "spherical_harmonics",
    "spherical_harmonics_l0",
    "spherical_harmonics_l1_plus",
    "world_to_cam",
]


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
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
    packed: bool = True,
    tile_size: int | None = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object = None,
    rolling_shutter: object = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    *,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    lidar_coeffs: object = None,
    external_distortion_coeffs: object = None,
    ut_params: object = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: object = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians into C cameras with gsplat's arguments, which `gsplat_edu.compat.checks.Arguments` describes.

    Returns:
        images (..., C, H, W, channels), alphas (..., C, H, W, 1), and `meta`: means2d, radii, depths, conics,
        opacities, gaussian_ids, camera_ids, batch_ids, width, height, n_cameras, n_batches, tile_size, tile_width,
        tile_height; with `extra_signals` also render_extra_signals (..., C, H, W, E).

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite, out of range or not supported.

    Differentiable in: every tensor, those of the cameras and their lenses included.
    """
    return _rasterize(Arguments(**without_bad_gaussians(dict(locals()))))


def _rasterize(a: Arguments) -> tuple[Tensor, Tensor, dict[str, Any]]:
    require_memory_for(a)
    touched: list[Tensor] = []
    if a.sparse_grad:
        shapes = {name: getattr(a, name) for name in ("means", "quats", "scales", "covars")}
        used = {name: tensor for name, tensor in shapes.items() if tensor is not None}
        sparse: Any = {name: with_sparse_gradient(tensor, touched) for name, tensor in used.items()}
        a = a.with_tensors(sparse)
    given = {each.name: getattr(a, each.name) for each in fields(a)}
    tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}

    def geometry(*values: Tensor) -> list[Tensor]:
        return _geometry(a.with_tensors(dict(zip(tensors, values, strict=True))))

    usual = is_usual(a)
    if usual:
        positions, spreads, colors, *found = project_usual(a)
    else:
        positions, spreads, *found = stage(geometry, *tensors.values())
    drawn = drawn_at(positions, a)
    if a.sparse_grad:
        touched.append(drawn.gaussians.bincount().nonzero()[:, 0])
    meta: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if a.packed:
        meta = {"batch_ids": drawn.scenes, "camera_ids": drawn.images % a.C, "gaussian_ids": drawn.gaussians}
    meta |= dict(zip(META, found, strict=True))
    meta |= {"width": a.width, "height": a.height, "tile_size": a.edge}
    meta |= {"n_batches": a.batches, "n_cameras": a.C}
    for name, size in (("tile_width", a.width), ("tile_height", a.height)):
        meta[name] = math.ceil(size / a.edge)
    kept = Absgrad(meta["means2d"]) if a.absgrad else None
    if usual:
        return *image_of(a, positions, spreads, colors, meta, kept), meta
    on_screen = (meta["means2d"] if kept is None else kept.means2d, meta["depths"], meta["opacities"])

    def images(
        means2d: Tensor, depths: Tensor, opacities: Tensor, spreads: Tensor, *values: Tensor
    ) -> list[Tensor]:
        own = a.with_tensors(dict(zip(tensors, values, strict=True)))
        return _images(own, drawn, _OnScreen(means2d, depths, opacities, spreads), kept)

    image, alphas, *signals = stage(images, *on_screen, spreads, *tensors.values())
    if signals:
        meta["render_extra_signals"] = signals[0]
    return image, alphas, meta


META = ("radii", "means2d", "depths", "conics", "opacities")
"""The tensors of `meta` that both stages share."""


class _OnScreen(NamedTuple):
    """Tensors of `meta`, and the spreads of the drawn Gaussians."""

    means2d: Tensor
    depths: Tensor
    opacities: Tensor
    spreads: Float[Tensor, "nnz 3"]


def _geometry(a: Arguments) -> list[Tensor]:
    """Return the positions of the drawn Gaussians in (B C N), their spreads, and the tensors of `META`."""
    triangle = None if a.covars is None else a.covars[..., TRIANGLE[0], TRIANGLE[1]]
    (viewmats, model), Ks = cameras_of(a), a.Ks.reshape(-1, a.C, 3, 3)
    flat, antialiased = a.opacities.reshape(a.batches, a.N), a.rasterize_mode == "antialiased"
    solids = solids_of(a.means, triangle, a.quats, a.scales)
    found = project(solids, viewmats, Ks, lens_of(a), flat, antialiased, model)
    positions = (found.radii > 0).all(dim=-1).flatten().nonzero()[:, 0]
    spreads = joined(found.spreads, 3).index_select(0, positions)
    check_spreads("scales" if a.covars is None else "covars", spreads, positions, (a.batch, a.C, a.N))
    opacities = flat[:, None].expand(-1, a.C, -1)
    if antialiased:
        opacities = opacities * found.compensations
    shared = [found.radii, found.means2d, found.depths, found.conics, opacities]
    if a.packed:
        shared = [joined(field, 3).index_select(0, positions) for field in shared]
    else:
        shared = [field.reshape(*a.batch, a.C, a.N, *field.shape[3:]) for field in shared]
    return [positions, spreads, *shared]


def _images(a: Arguments, drawn: Drawn, on_screen: _OnScreen, kept: Absgrad | None) -> list[Tensor]:
    """Return images, alphas and, if there are any, extra signals."""
    views = _draw(a, drawn, on_screen, kept)
    image, transmittance = (
        (torch.stack(each) if len(each) > 1 else each[0]).view(*a.batch, a.C, *each[0].shape)
        for each in views
    )
    alphas, signals = 1.0 - transmittance[..., None], []
    if a.extra_signals is not None:
        E = a.extra_signals.shape[-1]
        first = image.shape[-1] - E - int(a.render_mode != "RGB")
        signals = [image[..., first : first + E]]
        image = torch.cat([image[..., :first], image[..., first + E :]], dim=-1)
    if a.render_mode.endswith("ED"):
        image = with_expected_depth(image, alphas)
    return [image, alphas, *signals]


def _draw(
    a: Arguments, drawn: Drawn, on_screen: _OnScreen, kept: Absgrad | None
) -> tuple[list[Tensor], list[Tensor]]:
    """Draw every image."""
    *shared, spreads = on_screen
    rows = torch.arange(len(spreads)) if a.packed else drawn.positions  # in the tensors of `meta`
    if not a.packed:
        shared = [joined(each, len(a.batch) + 2).index_select(0, rows) for each in shared]
    means2d, depths, opacities = shared
    with_depth = a.render_mode != "RGB"
    colors = None if a.render_mode in DEPTH_ONLY or a.colors is None else colors_of(a, a.colors, drawn)
    signals = None if a.extra_signals is None else _extra_signals(a, a.extra_signals, drawn)
    backgrounds = None if a.backgrounds is None else joined(a.backgrounds, len(a.batch) + 1)
    if colors is None and signals is None:
        backgrounds = None  # a depth has no background
    images, transmittances = [], []
    tables: dict[str, Any] = {
        "means2d": means2d,
        "spreads": spreads,
        "opacities": opacities,
        "colors": colors,
    }
    tables |= {"depths": depths if with_depth else None, "extra_signals": signals}
    tables |= {"order": depths.detach() + 0.0, "rows": rows}  # no -0
    parts = {name: _parts(each, drawn.ends) for name, each in tables.items() if each is not None}
    for k in range(len(drawn.ends)):
        own: dict[str, Any] = {name: parts[name][k] if name in parts else None for name in tables}
        own_rows = own.pop("rows")
        splats = Splats(**own, background=None if backgrounds is None else backgrounds[k])
        image, transmittance = composite(splats, lens_of(a), None if kept is None else kept.adder(own_rows))
        images.append(image)
        transmittances.append(transmittance)
    return images, transmittances


def _parts(tensor: Tensor, ends: list[int]) -> Sequence[Tensor]:
    """Split the rows of all images; the only one is returned as it is, because a slice costs a copy backward."""
    return [tensor] if len(ends) == 1 else torch.tensor_split(tensor, ends[:-1])


def _extra_signals(a: Arguments, signals: Tensor, drawn: Drawn) -> Float[Tensor, "nnz E"]:
    """Return the extra signals of the drawn Gaussians; gsplat offsets those of harmonics, but has no floor."""
    if a.extra_signals_sh_degree is None:
        row = (drawn.images if a.extra_signals_per_camera else drawn.scenes) * a.N + drawn.gaussians
        return joined(signals, signals.ndim - 1).index_select(0, row)
    rows = (drawn.gaussians, drawn.ends)
    return evaluate(a.extra_signals_sh_degree, directions(a, drawn), signals, rows) + SH_OFFSET
