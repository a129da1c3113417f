"""Which Gaussians contribute to which pixels, by gsplat's rules, and compositing of such pairs by torch.

All but `accumulate` go through the lists of tiles that `isect_tiles` and `isect_offset_encode` make, in float64. A
Gaussian contributes to a pixel if its alpha there is at least 1/255, unless it, or one before it, would take the
transmittance to 1e-4 or below.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_edu.base.constants import ALPHA_MIN, T_STOP
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.compat.checks import MOST_PIXELS, check_size, expect, real_tensor
from gsplat_edu.compat.images import SETTINGS
from gsplat_edu.compat.tiles import Tiles, checked_lists, ids_outside, whole_numbers
from gsplat_edu.scene.gaussians import check_tensor


class _Tile(NamedTuple):
    """P pixels and the M Gaussians of their list, near to far."""

    pixels: Tensor
    """(P,) image times H W plus row-major place."""
    gaussians: Tensor
    """(M,) rows of packed inputs, else indices in the image."""
    hits: Tensor
    """(P, M) whether a Gaussian contributes."""
    weights: Tensor
    """(P, M) alpha times the transmittance before it."""
    left: Tensor
    """(P,) transmittance behind the last one."""


def _tiles(
    a: Tiles, transmittances: Tensor | None = None, batches: tuple[int, int | None] = (0, None)
) -> Iterator[_Tile]:
    """Yield every tile; `batches` is the range of a list that counts, in tile_size² Gaussians."""
    starts, rows, edge = a.isect_offsets.flatten().tolist(), a.flatten_ids, a.tile_size
    tiles_y, tiles_x = a.isect_offsets.shape[-2:]
    means2d, conics = a.means2d.detach().reshape(-1, 2).double(), a.conics.detach().reshape(-1, 3).double()
    opacities = a.opacities.detach().reshape(-1).double()
    flat = None if transmittances is None else transmittances.detach().double().flatten()
    for tile, (begin, end) in enumerate(zip(starts, [*starts[1:], len(rows)], strict=True)):
        image, place = divmod(tile, tiles_x * tiles_y)
        top, left = place // tiles_x * edge, place % tiles_x * edge
        y, x = (
            each.flatten()
            for each in torch.meshgrid(
                torch.arange(top, min(top + edge, a.image_height)),
                torch.arange(left, min(left + edge, a.image_width)),
                indexing="ij",
            )
        )
        stop = end if batches[1] is None else min(end, begin + batches[1] * edge**2)
        own = rows[begin + batches[0] * edge**2 : stop]
        pixels = (image * a.image_height + y) * a.image_width + x
        dx, dy = (at[:, None] + 0.5 - means2d[own, k] for k, at in enumerate((x, y)))
        sigma = 0.5 * (conics[own, 0] * dx * dx + conics[own, 2] * dy * dy) + conics[own, 1] * dx * dy
        alpha = (opacities[own] * torch.exp(-sigma)).clamp(max=SETTINGS.alpha_max)
        valid = (sigma >= 0) & (alpha >= ALPHA_MIN)
        first = torch.ones(len(pixels), 1, dtype=torch.float64) if flat is None else flat[pixels][:, None]
        T = torch.cat([first, 1.0 - torch.where(valid, alpha, 0.0)], dim=1).cumprod(dim=1)
        hits = valid & (T[:, 1:] > T_STOP)
        # The transmittance falls from left to right: the last one above the limit is the smallest of these.
        behind = torch.where(hits, T[:, 1:], first).amin(dim=1) if len(own) else first[:, 0]
        indices = own if a.packed else own % max(a.means2d.shape[-2], 1)
        yield _Tile(pixels, indices, hits, alpha * T[:, :-1], behind)


def _lists(offsets: str, **given: Any) -> Tiles:  # noqa: ANN401
    """Check the arguments that all functions of this module share; `offsets` is the name of one of them."""
    means2d = real_tensor("means2d", given["means2d"])
    packed = means2d.ndim == 2
    expect("opacities", given["opacities"], tuple(means2d.shape[:-1]), means2d, "means2d")
    rest = {"colors": given["opacities"][..., None], "backgrounds": None, "masks": None, "absgrad": False}
    return Tiles(**checked_lists({"conics": (3,)}, offsets, **given, **rest, packed=packed))


def _shape(a: Tiles, *tail: int) -> tuple[int, ...]:
    """Return the shape of images."""
    return (*a.isect_offsets.shape[:-2], a.image_height, a.image_width, *tail)


@torch.no_grad()
def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the pairs of pixels and Gaussians that contribute, as gsplat's function of this name does.

    Args:
        range_start: First batch of tile_size² Gaussians of each tile's list to look at.
        range_end: Batch before which to stop.
        transmittances: (..., height, width) transmittance that the batches before have left.
        means2d: (..., N, 2) centres, px.
        conics: (..., N, 3) inverses of the dilated covariances, xx, xy, yy, per px².
        opacities: (..., N) 0 to 1.
        image_width: Width, px.
        image_height: Height, px.
        tile_size: Edge of a tile, px.
        isect_offsets: (..., tile_height, tile_width) where each tile's list begins.
        flatten_ids: (n,) rows of the inputs, tile after tile, each near to far.

    Returns:
        int64 (M,) Gaussians, pixels (row-major) and images, by image, then pixel, then near to far.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.
    """
    lists: dict[str, Any] = {"isect_offsets": isect_offsets, "flatten_ids": flatten_ids}
    lists |= {"image_width": image_width, "image_height": image_height, "tile_size": tile_size}
    a = _lists("isect_offsets", means2d=means2d, conics=conics, opacities=opacities, **lists)
    if a.packed:
        raise ShapeError(f"means2d: has shape {tuple(means2d.shape)}, but has to be (..., N, 2), not packed")
    expect("transmittances", transmittances, _shape(a), means2d, "means2d")
    batches = (whole_number("range_start", range_start, 0), whole_number("range_end", range_end, 0))
    gaussians, pixels = [], []
    for tile in _tiles(a, transmittances, batches):
        p, k = tile.hits.nonzero().unbind(-1)
        gaussians.append(tile.gaussians[k])
        pixels.append(tile.pixels[p])
    flat, order = torch.sort(torch.cat(pixels), stable=True)
    size = image_width * image_height
    return torch.cat(gaussians)[order], flat % size, flat // size


@torch.no_grad()
def rasterize_num_contributing_gaussians(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor]:
    """Count the Gaussians that contribute to each pixel.

    The arguments are those of `rasterize_to_pixels`; inputs of one axis before the last are packed.

    Returns:
        int32 (..., height, width) counts, and alphas of that shape.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.
    """
    lists: dict[str, Any] = {"isect_offsets": tile_offsets, "flatten_ids": flatten_ids}
    lists |= {"image_width": image_width, "image_height": image_height, "tile_size": tile_size}
    a = _lists("tile_offsets", means2d=means2d, conics=conics, opacities=opacities, **lists)
    counts = torch.zeros(math.prod(_shape(a)), dtype=torch.int32)
    alphas = torch.zeros(len(counts), dtype=torch.float64)
    for tile in _tiles(a):
        counts[tile.pixels] = tile.hits.sum(dim=1, dtype=torch.int32)
        alphas[tile.pixels] = 1.0 - tile.left
    return counts.view(_shape(a)), alphas.view(_shape(a)).to(means2d.dtype)


@torch.no_grad()
def rasterize_contributing_gaussian_ids(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    num_contributing_gaussians: Tensor,
) -> tuple[Tensor, Tensor]:
    """List the Gaussians that contribute to each pixel, near to far, and their weights alpha T.

    The arguments are those of `rasterize_to_pixels`, and int32 (..., height, width) `num_contributing_gaussians`, whose
    largest entry is K. Inputs of one axis before the last are packed.

    Returns:
        int32 (..., height, width, K) indices in the image (packed: rows), -1 behind the last, and weights, 0 there.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.
    """
    lists: dict[str, Any] = {"isect_offsets": tile_offsets, "flatten_ids": flatten_ids}
    lists |= {"image_width": image_width, "image_height": image_height, "tile_size": tile_size}
    a = _lists("tile_offsets", means2d=means2d, conics=conics, opacities=opacities, **lists)
    counts = whole_numbers("num_contributing_gaussians", num_contributing_gaussians)
    if tuple(counts.shape) != _shape(a):
        raise ShapeError(
            f"num_contributing_gaussians: has shape {tuple(counts.shape)}, but has to be {_shape(a)}"
        )
    return _picked(a, int(counts.max()) if counts.numel() else 0, None)


@torch.no_grad()
def rasterize_top_contributing_gaussian_ids(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    tile_offsets: Tensor,
    flatten_ids: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    num_depth_samples: int,
) -> tuple[Tensor, Tensor]:
    """List the `num_depth_samples` Gaussians with the largest weights alpha T at each pixel, near to far.

    Of equal weights the nearer one is taken. The arguments, results and errors are otherwise those of
    `rasterize_contributing_gaussian_ids`.
    """
    lists: dict[str, Any] = {"isect_offsets": tile_offsets, "flatten_ids": flatten_ids}
    lists |= {"image_width": image_width, "image_height": image_height, "tile_size": tile_size}
    a = _lists("tile_offsets", means2d=means2d, conics=conics, opacities=opacities, **lists)
    most = whole_number("num_depth_samples", num_depth_samples, 1, MOST_PIXELS)
    return _picked(a, most, most)


def _picked(a: Tiles, columns: int, strongest: int | None) -> tuple[Tensor, Tensor]:
    """Return ids and weights of each pixel's first `columns` contributors, or of its strongest ones."""
    pixels = math.prod(_shape(a))
    ids = torch.full((pixels, columns), -1, dtype=torch.int32)
    weights = torch.zeros(pixels, columns, dtype=torch.float64)
    for tile in _tiles(a):
        hits = tile.hits
        if strongest is not None:
            order = torch.argsort(torch.where(hits, tile.weights, 0.0), dim=1, descending=True, stable=True)
            hits = hits & torch.zeros_like(hits).scatter(1, order[:, :strongest], True)
        rank = hits.cumsum(dim=1) - 1
        p, k = (hits & (rank < columns)).nonzero().unbind(-1)
        place = tile.pixels[p], rank[p, k]
        ids[place] = tile.gaussians[k].int()
        weights[place] = tile.weights[p, k]
    return ids.view(_shape(a, columns)), weights.view(_shape(a, columns)).to(a.means2d.dtype)


def accumulate(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    gaussian_ids: Tensor,
    pixel_ids: Tensor,
    image_ids: Tensor,
    image_width: int,
    image_height: int,
) -> tuple[Tensor, Tensor]:
    """Composite pairs of pixels and Gaussians, such as those of `rasterize_to_indices_in_range`, by torch operations.

    Args:
        means2d: (..., N, 2) centres, px.
        conics: (..., N, 3) inverses of the dilated covariances, xx, xy, yy, per px².
        opacities: (..., N) 0 to 1.
        colors: (..., N, D) numbers to composite.
        gaussian_ids: (M,) Gaussian of each pair; the pairs of a pixel are near to far.
        pixel_ids: (M,) pixel of each pair, row-major.
        image_ids: (M,) image of each pair.
        image_width: Width, px.
        image_height: Height, px.

    Returns:
        (..., height, width, D) images and (..., height, width, 1) alphas.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.

    Differentiable in: means2d, conics, opacities, colors.
    """
    real_tensor("means2d", means2d)
    check_size(image_width, image_height, "image_width", "image_height")
    leading = tuple(means2d.shape[:-1])
    check_tensor("colors", colors, ("...",), {})
    D = colors.shape[-1] if colors.ndim else 0
    named = {"means2d": (means2d, 2), "conics": (conics, 3), "colors": (colors, D)}
    for name, (tensor, size) in named.items():
        expect(name, tensor, (*leading, size), means2d, "means2d")
    expect("opacities", opacities, leading, means2d, "means2d")
    N, images, size = leading[-1] if leading else 0, math.prod(leading[:-1]), image_width * image_height
    ids = {"gaussian_ids": gaussian_ids, "pixel_ids": pixel_ids, "image_ids": image_ids}
    gaussians, pixels, screens = _checked_ids(ids, (N, size, images))
    rows = screens * N + gaussians
    u, v = means2d.reshape(-1, 2).index_select(0, rows).unbind(-1)
    A, B, C = conics.reshape(-1, 3).index_select(0, rows).unbind(-1)
    dx, dy = pixels % image_width + 0.5 - u, pixels // image_width + 0.5 - v
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    bright = opacities.reshape(-1).index_select(0, rows)
    alpha = (bright * torch.exp(-sigma)).clamp(max=SETTINGS.alpha_max)
    places = screens * size + pixels
    weights = alpha * _before(alpha, places)
    shown = weights[:, None] * torch.nn.functional.pad(
        colors.reshape(-1, D).index_select(0, rows), (0, 1), value=1.0
    )
    total = shown.new_zeros(images * size, D + 1).index_add(0, places, shown)
    total = total.view(*leading[:-1], image_height, image_width, D + 1)
    return total[..., :D], total[..., D:]


def _checked_ids(ids: dict[str, Tensor], counts: tuple[int, ...]) -> Iterator[Tensor]:
    """Yield ids, all of one length, as int64."""
    for (name, given), count in zip(ids.items(), counts, strict=True):
        found = whole_numbers(name, given)
        if found.ndim != 1 or len(found) != len(ids["gaussian_ids"]):
            raise ShapeError(f"{name}: has shape {tuple(found.shape)}, but all ids have to be (M,)")
        if ids_outside(found, count):
            raise ArgumentError(f"{name}: has to be from 0 to {count - 1}")
        yield found


def _before(alpha: Tensor, places: Tensor) -> Tensor:
    """Return the transmittance before each pair: the product of 1 - alpha of the pairs before it at its place."""
    order = torch.argsort(places, stable=True)
    _, run, counts = torch.unique_consecutive(places[order], return_inverse=True, return_counts=True)
    rank = torch.arange(len(places)) - (counts.cumsum(0) - counts)[run]
    columns = int(counts.max()) if len(counts) else 0
    cell = torch.zeros_like(places)
    cell[order] = run * (columns + 1) + rank
    passed = alpha.new_ones(len(counts) * (columns + 1)).index_copy(0, cell + 1, 1.0 - alpha)
    return passed.view(-1, columns + 1).cumprod(dim=1).flatten().index_select(0, cell)
