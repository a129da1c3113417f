"""gsplat's lists of tiles, and its `rasterize_to_pixels`, which composites by them.

`rasterization` makes lists of its own inside the kernels and is much faster.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import flag, whole_number
from gsplat_edu.compat.checks import MOST_PIXELS, check_size, expect, real_tensor
from gsplat_edu.compat.images import Splats, absgrad_store, composite
from gsplat_edu.compat.projection import Lens
from gsplat_edu.scene.gaussians import check_tensor

WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
"""Dtypes of ids."""

DEPTH_BITS = 32
"""Bits of an intersection's id that hold the depth, as float32."""


@torch.no_grad()
def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """List the pairs of Gaussians and tiles that their boxes meet, as gsplat's function of this name does.

    Args:
        means2d: (..., N, 2) centres, px; packed (nnz, 2).
        radii: (..., N, 2) half sizes of the boxes, px; a Gaussian with one of 0 has no tiles.
        depths: (..., N) depths.
        tile_size: Edge of a tile, px.
        tile_width: Tiles in a row.
        tile_height: Tiles in a column.
        sort: Whether to sort the pairs by image, tile and depth; ties keep the order of the Gaussians.
        segmented: No effect: it selects a sort in gsplat.
        packed: Whether the inputs are (nnz, ...).
        n_images: Number of images, with `packed`.
        image_ids: (nnz,) image of each row, with `packed`.
        gaussian_ids: Not read; gsplat asks for it with `packed`.

    Returns:
        int32 (..., N) tiles of each Gaussian; int64 ids, image | tile | 32 bits of the depth; int32 rows of the inputs.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.
    """
    real_tensor("means2d", means2d)
    flag("sort", sort), flag("segmented", segmented)
    leading = tuple(means2d.shape[:-1])
    expect("means2d", means2d, (*leading, 2), means2d)
    for name, tensor, shape in (("radii", radii, (*leading, 2)), ("depths", depths, leading)):
        check_tensor(name, tensor, ("...",), {})
        if tuple(tensor.shape) != shape:
            raise ShapeError(f"{name}: has shape {tuple(tensor.shape)}, but has to be {shape}")
    sizes = {"tile_size": tile_size, "tile_width": tile_width, "tile_height": tile_height}
    for name, size in sizes.items():
        whole_number(name, size, 1, MOST_PIXELS)
    images, count = _images(leading, flag("packed", packed), n_images, image_ids, gaussian_ids)
    bits = _tile_bits(tile_width, tile_height, count)
    tiles, rows, places = _boxes(means2d.reshape(-1, 2), radii.reshape(-1, 2), sizes)
    deep = depths.reshape(-1).float().view(torch.int32).long() & (2**DEPTH_BITS - 1)
    ids = ((images[rows] << bits | places) << DEPTH_BITS) | deep[rows]
    if sort:
        ids, order = torch.sort(ids, stable=True)
        rows = rows[order]
    return tiles.view(leading).int(), ids, rows.int()


def _boxes(means2d: Tensor, radii: Tensor, sizes: dict[str, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the number of tiles that each box meets, and of each pair the row of the box and the tile's number."""
    limits = torch.tensor([sizes["tile_width"], sizes["tile_height"]], dtype=torch.float64)
    centre, half = means2d.double() / sizes["tile_size"], radii.double() / sizes["tile_size"]
    low = torch.minimum(torch.floor(centre - half).clamp(min=0), limits).long()
    high = torch.minimum(torch.ceil(centre + half).clamp(min=0), limits).long()
    spans = (high - low) * (half > 0).all(dim=-1, keepdim=True)
    tiles = spans.prod(dim=-1)
    rows = torch.repeat_interleave(torch.arange(len(tiles)), tiles)
    place = torch.arange(len(rows)) - (tiles.cumsum(0) - tiles)[rows]  # of the tile among those of its box
    columns = spans[rows, 0]
    x, y = low[rows, 0] + place % columns, low[rows, 1] + place // columns
    return tiles, rows, y * sizes["tile_width"] + x


def _images(
    leading: tuple[int, ...],
    packed: bool,
    n_images: int | None,
    image_ids: Tensor | None,
    gaussian_ids: Tensor | None,
) -> tuple[Tensor, int]:
    """Return the image of each row, and the number of images."""
    if not packed:
        count = math.prod(leading[:-1])
        return torch.arange(count).repeat_interleave(leading[-1] if leading else 1), count
    count = whole_number("n_images", n_images, 1, MOST_PIXELS)
    for name, given in (("image_ids", image_ids), ("gaussian_ids", gaussian_ids)):
        ids = whole_numbers(name, given)
        if tuple(ids.shape) != leading:
            raise ShapeError(f"{name}: has shape {tuple(ids.shape)}, but has to be {leading}")
    images = whole_numbers("image_ids", image_ids)
    if ids_outside(images, count):
        raise ArgumentError(f"image_ids: has to be from 0 to {count - 1}, n_images less one")
    return images, count


def whole_numbers(name: str, tensor: object) -> Tensor:
    """Return a tensor of whole numbers as int64."""
    if not isinstance(tensor, Tensor) or tensor.dtype not in WHOLE or tensor.device.type != "cpu":
        raise ArgumentError(f"{name}: has to be a tensor of whole numbers on the CPU")
    return tensor.long()


def ids_outside(ids: Tensor, count: int) -> bool:
    """Return whether a number is not from 0 to count - 1."""
    return bool(((ids < 0) | (ids >= count)).any())


def _tile_bits(tile_width: int, tile_height: int, images: int) -> int:
    """Return the bits for a tile's number; image, tile and depth have to fit 63 bits."""
    bits = (tile_width * tile_height).bit_length()
    if bits + images.bit_length() + DEPTH_BITS > 63:
        raise ArgumentError(
            "tile_width: times tile_height and the number of images do not fit an id of 64 bits"
        )
    return bits


@torch.no_grad()
def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return where the pairs of each tile begin in a sorted list of ids from `isect_tiles`.

    Returns:
        int32 (n_images, tile_height, tile_width).

    Raises:
        ShapeError: the ids have more than one axis.
        ArgumentError: an argument is of another type or out of range.
    """
    check_tensor("isect_ids", isect_ids, ("n",), {})
    if isect_ids.dtype != torch.int64:
        raise ArgumentError(f"isect_ids: is {isect_ids.dtype}, but has to be torch.int64")
    for name, size in (("n_images", n_images), ("tile_width", tile_width), ("tile_height", tile_height)):
        whole_number(name, size, 1, MOST_PIXELS)
    bits = _tile_bits(tile_width, tile_height, n_images)
    image, tile = torch.arange(n_images)[:, None], torch.arange(tile_width * tile_height)
    keys = (image << bits | tile).flatten()
    found = torch.searchsorted(isect_ids >> DEPTH_BITS, keys)
    return found.view(n_images, tile_height, tile_width).int()


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Composite projected Gaussians by lists of tiles, as gsplat's function of this name does.

    Every tile is a call of the kernels with the Gaussians of its list, in its order: about a millisecond each.

    Args:
        means2d: (..., N, 2) centres, px; packed (nnz, 2).
        conics: (..., N, 3) inverses of the dilated covariances, xx, xy, yy, per px².
        colors: (..., N, D) numbers to composite.
        opacities: (..., N) 0 to 1.
        image_width: Width, px.
        image_height: Height, px.
        tile_size: Edge of a tile, px.
        isect_offsets: (..., tile_height, tile_width) where each tile's list begins.
        flatten_ids: (n,) rows of the inputs, tile after tile, each near to far.
        backgrounds: (..., D) colours behind everything.
        masks: (..., tile_height, tile_width) booleans; a tile with False shows the background only, alpha 0.
        packed: Whether the inputs are (nnz, ...).
        absgrad: Whether the backward pass sets `means2d.absgrad`.

    Returns:
        (..., height, width, D) images and (..., height, width, 1) alphas.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range, or a listed conic is not positive definite.

    Differentiable in: means2d, conics, colors, opacities, backgrounds.
    """
    return _composited(_Tiles(**checked_lists({"conics": (3,)}, **locals())))


class _Tiles(NamedTuple):
    """Checked arguments of `rasterize_to_pixels`."""

    means2d: Tensor
    conics: Tensor
    colors: Tensor
    opacities: Tensor
    image_width: int
    image_height: int
    tile_size: int
    isect_offsets: Tensor
    flatten_ids: Tensor
    backgrounds: Tensor | None
    masks: Tensor | None
    packed: bool
    absgrad: bool


def _composited(a: _Tiles) -> tuple[Tensor, Tensor]:
    """Composite tile after tile, and join them."""
    starts, rows, D = a.isect_offsets.flatten().tolist(), a.flatten_ids, a.colors.shape[-1]
    rows_of_tiles, tiles_x = a.isect_offsets.shape[-2:]
    lens = Lens(a.tile_size, a.tile_size, 0.0, 0.0, math.inf, 0.0)
    means2d, colors, opacities = a.means2d.reshape(-1, 2), a.colors.reshape(-1, D), a.opacities.reshape(-1)
    spreads = _covariances(a.conics.reshape(-1, 3), rows)
    images, alphas = [], []
    for tile, (begin, end) in enumerate(zip(starts, [*starts[1:], len(rows)], strict=True)):
        image, place = divmod(tile, tiles_x * rows_of_tiles)
        corner = means2d.new_tensor([place % tiles_x, place // tiles_x]) * a.tile_size
        drawn = a.masks is None or bool(a.masks.flatten()[tile])
        own = rows[begin:end] if drawn else rows[:0]
        behind = None if a.backgrounds is None else a.backgrounds.reshape(-1, D)[image]
        splats = Splats(means2d[own] - corner, spreads[own], opacities[own], colors[own], None, behind)
        shown, T = composite(splats, lens, absgrad_store(a.means2d, own) if a.absgrad else None)
        images.append(shown)
        alphas.append(1.0 - T[..., None])
    shape = (*a.isect_offsets.shape[:-2], a.image_height, a.image_width)
    grid, size = (rows_of_tiles, tiles_x), (a.image_height, a.image_width)
    joined = [_assembled(each, grid, size).view(*shape, each[0].shape[-1]) for each in (images, alphas)]
    return joined[0], joined[1]


def _assembled(tiles: list[Tensor], grid: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Join the tiles of all images, row by row, and cut what is outside: (I, height, width, channels)."""
    (rows, columns), (edge, _, channels) = grid, tiles[0].shape
    joined = torch.stack(tiles).view(-1, rows, columns, edge, edge, channels).transpose(2, 3)
    return joined.reshape(-1, rows * edge, columns * edge, channels)[:, : size[0], : size[1]]


def _covariances(conics: Tensor, rows: Tensor) -> Tensor:
    """Return (M, 3) xx, xy, yy of the inverses, float64; 1, 0, 1 for rows that no list has."""
    A, B, C = conics.double().unbind(-1)
    det = A * C - B * B
    listed = torch.zeros_like(det, dtype=torch.bool)
    listed[rows] = True
    if bool((wrong := listed & ~((det > 0) & (A > 0))).any()):
        raise ArgumentError(
            f"conics[{int(wrong.nonzero()[0, 0])}]: is not positive definite, but in a tile's list"
        )
    det = torch.where(listed, det, 1.0)
    one = torch.where(listed, 0.0, 1.0)
    parts = (
        torch.where(listed, C, 0.0) / det + one,
        torch.where(listed, -B, 0.0) / det,
        torch.where(listed, A, 0.0) / det + one,
    )
    return torch.stack(parts, dim=-1)


def checked_lists(tails: dict[str, tuple[int, ...]], **a: Any) -> dict[str, Any]:  # noqa: ANN401
    """Check the arguments of a rasteriser by lists; return them with int64 lists.

    Args:
        tails: Last axes of the arguments that only this rasteriser has, which begin with those of `means2d`.
        a: The arguments.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or out of range.
    """
    means2d, packed = real_tensor("means2d", a["means2d"]), flag("packed", a["packed"])
    flag("absgrad", a["absgrad"])
    check_size(a["image_width"], a["image_height"], "image_width", "image_height")
    edge = whole_number("tile_size", a["tile_size"], 1, 2**15)
    leading = tuple(means2d.shape[:-1])
    expect("means2d", means2d, (*leading, 2), means2d)
    check_tensor("colors", a["colors"], ("...",), {})
    D = a["colors"].shape[-1] if a["colors"].ndim else 0
    for name, tail in (tails | {"colors": (max(D, 1),), "opacities": ()}).items():
        expect(name, a[name], (*leading, *tail), means2d, "means2d")
    offsets, rows = (whole_numbers(name, a[name]) for name in ("isect_offsets", "flatten_ids"))
    images = tuple(offsets.shape[:-2]) if packed else leading[:-1]
    if offsets.ndim < 2 or tuple(offsets.shape[:-2]) != images:
        raise ShapeError(
            f"isect_offsets: has shape {tuple(offsets.shape)}, but has to be {(*images, 'rows', 'columns')}"
        )
    if offsets.shape[-2] * edge < a["image_height"] or offsets.shape[-1] * edge < a["image_width"]:
        raise ShapeError(
            f"isect_offsets: has {tuple(offsets.shape[-2:])} tiles, which do not cover the image"
        )
    if rows.ndim != 1 or ids_outside(rows, math.prod(leading)):
        raise ArgumentError(f"flatten_ids: has to hold rows of the inputs, 0 to {math.prod(leading) - 1}")
    flat = offsets.flatten()
    if bool((flat.diff() < 0).any()) or ids_outside(flat, len(rows) + 1) or (len(flat) and int(flat[0])):
        raise ArgumentError(
            f"isect_offsets: has to grow from 0 to at most {len(rows)}, the length of flatten_ids"
        )
    if a["backgrounds"] is not None:
        expect("backgrounds", a["backgrounds"], (*images, D), means2d, "means2d")
    masks = a["masks"]
    if masks is not None:
        check_tensor("masks", masks, ("...",), {})
        if masks.dtype != torch.bool or masks.shape != offsets.shape:
            raise ShapeError(
                f"masks: has to be torch.bool of shape {tuple(offsets.shape)}, got {tuple(masks.shape)}"
            )
    return a | {"isect_offsets": offsets, "flatten_ids": rows}
