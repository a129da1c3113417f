"""A drop-in for gsplat 1.5.3: `rasterization`, `rasterization_2dgs` and the steps they are made of, on any CPU.

`rasterization` also has the nine arguments that gsplat's main branch has added since. There they stand between those of
1.5.3; here they are keywords only, so that positional calls written for 1.5.3 keep their meaning.

    from gsplat_edu.compat.gsplat import rasterization      # instead of: from gsplat import rasterization

gsplat's `DefaultStrategy` runs on it as it is, its `MCMCStrategy` with `compute_relocation` and
`quat_scale_to_covar_preci` in place of its own, which are CUDA kernels. docs/GSPLAT.md compares the arguments one by
one and lists the differences.

Design. gsplat has three stages, each differentiable: projection and harmonics, then compositing of what they return.
Its strategies call `meta["means2d"].retain_grad()` before the backward pass and read `.grad` and `.absgrad` after it.
So the stages here are the same. Projection and harmonics are native steps of the graph (screen.py), or torch operations
for lenses, degree 4 and other than three channels; `meta["means2d"]`, `meta["depths"]` and `meta["opacities"]` are
nodes of the graph between them and the image. Compositing is our native kernels (images.py), whose gradient with
respect to a mean on the screen arrives at `meta["means2d"]` by autograd, per axis and per px. Therefore retain_grad,
hooks and losses on these tensors work without special cases. `absgrad` is a statistic that the kernels collect; a hook
on their input stores it as an attribute after each backward pass.

The renderer's own projection is not used: it returns no centres that a graph could pass through. Compositing projects
what is on the screen once more, which `gsplat_edu.render.api.render` need not do.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.constants import SH_OFFSET
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.compat.checks import DEPTH_ONLY, Arguments, RollingShutterType, check_spreads
from gsplat_edu.compat.drawn import Drawn, colors_of, directions, drawn_at, joined
from gsplat_edu.compat.harmonics import evaluate, spherical_harmonics
from gsplat_edu.compat.images import Splats, absgrad_store, composite
from gsplat_edu.compat.lenses import cameras_of
from gsplat_edu.compat.parts import compute_relocation, proj, quat_scale_to_covar_preci, world_to_cam
from gsplat_edu.compat.projection import TRIANGLE, Lens, fully_fused_projection, project, solids_of
from gsplat_edu.compat.skipping import skipping_bad_gaussians, without_bad_gaussians
from gsplat_edu.compat.surfel_images import rasterize_to_pixels_2dgs
from gsplat_edu.compat.surfels import fully_fused_projection_2dgs, rasterization_2dgs
from gsplat_edu.compat.tiles import isect_offset_encode, isect_tiles, rasterize_to_pixels
from gsplat_edu.render.api import BYTES_PER_PIXEL

__all__ = [
    "RollingShutterType",
    "compute_relocation",
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "isect_offset_encode",
    "isect_tiles",
    "proj",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_2dgs",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "skipping_bad_gaussians",
    "spherical_harmonics",
    "world_to_cam",
]

ALPHA_FLOOR = 1e-10
"""gsplat's lower bound of alpha where it divides the depth by it, for ED."""


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
    tile_size: int = 16,
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
    require_memory(
        f"{a.batches * a.C} images of {a.width}x{a.height} px",
        BYTES_PER_PIXEL * a.batches * a.C * a.width * a.height,
        "render fewer images, or fewer pixels (width, height)",
    )
    lens = Lens(a.width, a.height, a.eps2d, a.near_plane, a.far_plane, a.radius_clip)
    triangle = None if a.covars is None else a.covars[..., TRIANGLE[0], TRIANGLE[1]]
    (viewmats, model), Ks = cameras_of(a), a.Ks.reshape(-1, a.C, 3, 3)
    flat, antialiased = a.opacities.reshape(a.batches, a.N), a.rasterize_mode == "antialiased"
    solids = solids_of(a.means, triangle, a.quats, a.scales)
    found = project(solids, viewmats, Ks, lens, flat, antialiased, model)
    positions = (found.radii > 0).all(dim=-1).flatten().nonzero()[:, 0]
    spreads = joined(found.spreads, 3).index_select(0, positions)
    check_spreads("scales" if a.covars is None else "covars", spreads, positions, (a.batch, a.C, a.N))
    drawn = drawn_at(positions, a)
    opacities = flat[:, None].expand(-1, a.C, -1)
    if antialiased:
        opacities = opacities * found.compensations
    fields = {
        "radii": found.radii,
        "means2d": found.means2d,
        "depths": found.depths,
        "conics": found.conics,
        "opacities": opacities,
    }
    meta: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if a.packed:
        meta = {"batch_ids": drawn.scenes, "camera_ids": drawn.images % a.C, "gaussian_ids": drawn.gaussians}
        meta |= {name: joined(field, 3).index_select(0, positions) for name, field in fields.items()}
    else:
        meta |= {name: field.view(*a.batch, a.C, a.N, *field.shape[3:]) for name, field in fields.items()}
    meta |= {name: getattr(a, name) for name in ("width", "height", "tile_size")}
    meta |= {"n_batches": a.batches, "n_cameras": a.C}
    for name, size in (("tile_width", a.width), ("tile_height", a.height)):
        meta[name] = math.ceil(size / a.tile_size)
    views = _draw(a, lens, drawn, spreads, meta)
    image, transmittance = (torch.stack(each).view(*a.batch, a.C, *each[0].shape) for each in views)
    alphas = 1.0 - transmittance[..., None]
    if a.extra_signals is not None:
        E = a.extra_signals.shape[-1]
        first = image.shape[-1] - E - int(a.render_mode != "RGB")
        meta["render_extra_signals"] = image[..., first : first + E]
        image = torch.cat([image[..., :first], image[..., first + E :]], dim=-1)
    if a.render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=ALPHA_FLOOR)], dim=-1)
    return image, alphas, meta


def _draw(
    a: Arguments,
    lens: Lens,
    drawn: Drawn,
    spreads: Float[Tensor, "nnz 3"],
    meta: dict[str, Any],
) -> tuple[list[Tensor], list[Tensor]]:
    """Draw every image, given the spreads of the drawn Gaussians."""
    own = [meta[name] for name in ("means2d", "depths", "opacities")]
    rows = torch.arange(len(spreads)) if a.packed else drawn.positions  # in the tensors of `meta`
    if not a.packed:
        own = [joined(each, len(a.batch) + 2).index_select(0, rows) for each in own]
    means2d, depths, opacities = own
    with_depth = a.render_mode != "RGB"
    colors = None if a.render_mode in DEPTH_ONLY or a.colors is None else colors_of(a, a.colors, drawn)
    signals = None if a.extra_signals is None else _extra_signals(a, a.extra_signals, drawn)
    backgrounds = None if a.backgrounds is None else joined(a.backgrounds, len(a.batch) + 1)
    if colors is None and signals is None:
        backgrounds = None  # a depth has no background
    images, transmittances = [], []
    for k, (begin, end) in enumerate(zip([0, *drawn.ends], drawn.ends, strict=False)):
        part = slice(begin, end)
        splats = Splats(
            means2d[part],
            spreads[part],
            opacities[part],
            None if colors is None else colors[part],
            depths[part] if with_depth else None,
            None if backgrounds is None else backgrounds[k],
            None if signals is None else signals[part],
            order=depths.detach()[part] + 0.0,  # not -0
        )
        store = absgrad_store(meta["means2d"], rows[part]) if a.absgrad else None
        image, transmittance = composite(splats, lens, store)
        images.append(image)
        transmittances.append(transmittance)
    return images, transmittances


def _extra_signals(a: Arguments, signals: Tensor, drawn: Drawn) -> Float[Tensor, "nnz E"]:
    """Return the extra signals of the drawn Gaussians; gsplat offsets those of harmonics, but has no floor."""
    if a.extra_signals_sh_degree is None:
        row = (drawn.images if a.extra_signals_per_camera else drawn.scenes) * a.N + drawn.gaussians
        return joined(signals, signals.ndim - 1).index_select(0, row)
    rows = (drawn.gaussians, drawn.ends)
    return evaluate(a.extra_signals_sh_degree, directions(a, drawn), signals, rows) + SH_OFFSET
