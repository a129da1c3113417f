"""Images of projected 2D Gaussians by lists of tiles: the native kernels `surfels` and `surfels_backward`.

A ray transform M, with the rows u, v and w, takes a point (a, b, 1) of the splat's plane, in standard deviations, to a
homogeneous pixel. The ray through the pixel (x, y) is the intersection of the planes x w - u and y w - v, so that it
meets the splat at c = (x w - u) x (y w - v) = x (v x w) + y (w x u) + u x v. The kernels get these three products, for
x and y less a reference point near the splat, where their terms do not cancel, and scaled, because only ratios of c
count.
native/surfels.cpp has the other formulas. Source: Huang et al. 2024, "2D Gaussian Splatting".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.validation import flag
from gsplat_edu.compat.images import absgrad_store
from gsplat_edu.compat.tiles import checked_lists
from gsplat_edu.ops.kernels import kernel, native_array

RECORD = 14
"""Numbers of a splat that the kernels read: lines, centre less reference point, opacity, reference point."""

CENTRE = slice(12, 14)
"""Where a gradient of the records has the sums of |dL/du| and |dL/dv| of the centre."""

TINY = 1e-300
"""Least scale of lines, for splats without an area, whose lines are all zero."""


class Surfels(NamedTuple):
    """M projected 2D Gaussians."""

    means2d: Float[Tensor, "M 2"]
    transforms: Float[Tensor, "M 3 3"]
    opacities: Float[Tensor, " M"]
    colors: Float[Tensor, "M D"]
    normals: Float[Tensor, "M 3"]


class TileLists(NamedTuple):
    """Which of them each tile of I images has, near to far."""

    width: int
    height: int
    tile_size: int
    begin: Int64[Tensor, "images rows columns"]
    rows: Int64[Tensor, " pairs"]


class SurfelImages(NamedTuple):
    """Images without a background. Distortion and median are of the last colour."""

    image: Float[Tensor, "images H W D"]
    transmittance: Float[Tensor, "images H W"]
    normals: Float[Tensor, "images H W 3"]
    distortion: Float[Tensor, "images H W"]
    median: Float[Tensor, "images H W"]


def composite_surfels(
    surfels: Surfels, lists: TileLists, absgrad: Callable[[Tensor, Tensor], None] | None
) -> SurfelImages:
    """Composite colours and normals.

    Args:
        surfels: The Gaussians.
        lists: The lists of the tiles.
        absgrad: Receives, in each backward pass, rows and their sums over pixels of |dL/du| and |dL/dv|, per px.

    Returns:
        The images; differentiable in every tensor of the Gaussians.
    """
    channels = torch.cat([surfels.colors, surfels.normals], dim=-1)
    arguments = (_records(surfels, lists), channels, lists, absgrad)
    image, *others = _Composite.apply(*arguments)  # type: ignore[no-untyped-call]
    D = surfels.colors.shape[-1]
    return SurfelImages(image[..., :D], others[0], image[..., D:], *others[1:])


def _records(surfels: Surfels, lists: TileLists) -> Float[Tensor, "M 14"]:
    """Return what the kernels read of each splat, computed in float64."""
    centre = surfels.means2d.double()
    size = centre.new_tensor([lists.width, lists.height])
    reference = torch.minimum(centre.detach().clamp(min=0.0), size).floor() + 0.5
    M = surfels.transforms.double()
    w = M[:, 2]
    u, v = (M[:, k] - reference[:, k, None] * w for k in (0, 1))
    crosses = (torch.linalg.cross(v, w), torch.linalg.cross(w, u), torch.linalg.cross(u, v))
    lines = torch.cat(crosses, dim=-1)
    lines = lines / lines.detach().abs().amax(dim=-1, keepdim=True).clamp(min=TINY)
    parts = [lines, centre - reference, surfels.opacities.double()[:, None], reference]
    return torch.cat(parts, dim=-1).to(surfels.means2d.dtype)


@first_derivative_only("the image of 2D Gaussians", "gsplat's functions in torch")
class _Composite(torch.autograd.Function):
    """The native kernels."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        records: Tensor,
        channels: Tensor,
        lists: TileLists,
        absgrad: Callable[[Tensor, Tensor], None] | None,
    ) -> tuple[Tensor, ...]:
        shape = (lists.begin.shape[0], lists.height, lists.width)
        given = {
            "records": records.detach().contiguous(),
            "channels": channels.detach().contiguous(),
            "tile_begin": torch.cat([lists.begin.flatten(), torch.tensor([len(lists.rows)])]),
            "rows": lists.rows.contiguous(),
        }
        shown = {"image": records.new_empty(*shape, channels.shape[1])}
        shown |= {name: records.new_empty(shape) for name in ("transmittance", "distortion", "median")}
        kept = {"median_places": torch.empty(shape, dtype=torch.int64)}
        kept["done"] = torch.empty(lists.begin.numel(), dtype=torch.int64)
        arrays = given | shown | kept
        kernel("surfels_f", records.dtype)(**_arguments(arrays, lists))
        ctx.save_for_backward(*arrays.values())
        ctx.names, ctx.lists, ctx.absgrad = list(arrays), lists, absgrad
        return tuple(shown.values())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        arrays = dict(zip(ctx.names, ctx.saved_tensors, strict=True))
        names = ("grad_image", "grad_transmittance", "grad_distortion", "grad_median")
        arrays |= {name: g.contiguous() for name, g in zip(names, gradients, strict=True)}
        records, channels = arrays["records"], arrays["channels"]
        out = records.new_empty(len(records), RECORD + channels.shape[1])
        kernel("surfels_backward_f", records.dtype)(**_arguments(arrays | {"out": out}, ctx.lists))
        if ctx.absgrad is not None:
            ctx.absgrad(torch.arange(len(out)), out[:, CENTRE])
        return out[:, :RECORD], out[:, RECORD:], None, None


def _arguments(arrays: dict[str, Tensor], lists: TileLists) -> dict[str, Any]:
    """Return the arguments of both kernels; the last channels are the normal."""
    return {
        **{name: native_array(array) for name, array in arrays.items()},
        "depth": arrays["channels"].shape[1] - 4,
        "edge": lists.tile_size,
        "tiles_y": lists.begin.shape[1],
        "tiles_x": lists.begin.shape[2],
        "threads": torch.get_num_threads(),
    }


def shifted(transforms: Float[Tensor, "*M 3 3"], densify: Float[Tensor, "*M 2"]) -> Float[Tensor, "*M 3 3"]:
    """Return the transforms; `densify` gets the gradient for a move of a splat along the image plane, per px."""
    shift = (densify - densify.detach()) * transforms[..., 2, 2, None].detach()
    return transforms + torch.nn.functional.pad(shift[..., None], (2, 0, 0, 1))


def rasterize_to_pixels_2dgs(
    means2d: Tensor,
    ray_transforms: Tensor,
    colors: Tensor,
    opacities: Tensor,
    normals: Tensor,
    densify: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Composite projected 2D Gaussians by lists of tiles, as gsplat's function of this name does.

    Args:
        means2d: (..., N, 2) centres of the images of the splats, px; packed (nnz, 2).
        ray_transforms: (..., N, 3, 3) from a splat's plane, in standard deviations, to homogeneous px.
        colors: (..., N, D) numbers to composite. Distortion and median are of the last, as a rule the depth.
        opacities: (..., N) 0 to 1.
        normals: (..., N, 3) normals in camera axes.
        densify: (..., N, 2) any numbers; they get the gradient for a move of a splat along the image plane, per px.
        image_width: Width, px.
        image_height: Height, px.
        tile_size: Edge of a tile, px.
        isect_offsets: (..., tile_height, tile_width) where each tile's list begins.
        flatten_ids: (n,) rows of the inputs, tile after tile, each near to far.
        backgrounds: (..., D) colours behind everything.
        masks: (..., tile_height, tile_width) booleans; a tile with False shows the background only, zero otherwise.
        packed: Whether the inputs are (nnz, ...).
        absgrad: Whether the backward pass sets `means2d.absgrad`.
        distloss: No effect: the distortion is always computed.

    Returns:
        (..., height, width, D) images, (..., height, width, 1) alphas, (..., height, width, 3) normals,
        (..., height, width, 1) distortions and medians.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.

    Differentiable in: means2d, ray_transforms, colors, opacities, normals, backgrounds.
    """
    flag("distloss", distloss)
    a = checked_lists({"ray_transforms": (3, 3), "normals": (3,), "densify": (2,)}, **locals())
    return _composited(a)


def _composited(a: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Composite checked arguments."""
    means2d, offsets, rows, D = a["means2d"], a["isect_offsets"], a["flatten_ids"], a["colors"].shape[-1]
    begin = offsets.reshape(-1, *offsets.shape[-2:])
    if a["masks"] is not None:
        begin, rows = _without(a["masks"], begin, rows)
    surfels = Surfels(
        means2d.reshape(-1, 2),
        shifted(a["ray_transforms"], a["densify"]).reshape(-1, 3, 3),
        a["opacities"].reshape(-1),
        a["colors"].reshape(-1, D),
        a["normals"].reshape(-1, 3),
    )
    lists = TileLists(a["image_width"], a["image_height"], a["tile_size"], begin, rows)
    store = absgrad_store(means2d, torch.arange(len(surfels.means2d))) if a["absgrad"] else None
    found = composite_surfels(surfels, lists, store)
    T, image = found.transmittance[..., None], found.image
    if a["backgrounds"] is not None:
        image = image + T * a["backgrounds"].reshape(-1, 1, 1, D)
    parts = (image, 1.0 - T, found.normals, found.distortion[..., None], found.median[..., None])
    image, alphas, normals, distortions, medians = (
        part.reshape(*offsets.shape[:-2], *part.shape[1:]) for part in parts
    )
    return image, alphas, normals, distortions, medians


def _without(masks: Tensor, begin: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lists without the entries of masked tiles."""
    lengths = torch.cat([begin.flatten(), torch.tensor([len(rows)])]).diff()
    kept = lengths * masks.flatten()
    return (kept.cumsum(0) - kept).view(begin.shape), rows[masks.flatten().repeat_interleave(lengths)]
