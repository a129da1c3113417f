"""A scene as a tree of regions, each at several levels of detail.

The tree halves the Gaussians by the median along the axis in which most of them are spread, until a region has at most
`leaf` of them; such a region is a leaf. Levels are made leaf by leaf, so a pair never crosses the border of a leaf, and
all levels of a leaf cover the same region. A leaf of n Gaussians has ceil(n / 2^k) at level k. Level 0 is the scene.

The error of a level in a leaf is a length: the distance between its Gaussians and the finest ones that they replace,

    e_k = sqrt(sum_i m_i |mu_i - mu_owner(i)|^2 / sum_i m_i),   m_i: the weights of `gsplat_edu.io.lod.merge`

made non-decreasing over the levels. At a distance d it covers about f e_k / d pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.base.validation import whole_number
from gsplat_edu.io.lod.merge import blobs_of, halved
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.morton import morton_codes

CHUNK = 512 * 1024
"""Most splats of a file."""

LEAF = 32 * 1024
"""Most splats of the finest level in a leaf."""

SMALLEST = 1_000_000
"""The coarsest level has at most this number of splats, which a phone can draw."""

MOST_LEVELS = 32
"""Largest number of halvings."""

INNER = (0.05, 0.95)
"""Quantiles of the coordinates between which the spread of a region is measured, so that stray Gaussians do not
decide."""

CELLS = np.iinfo(np.uint16).max
"""Cells of a leaf's Morton curve along each axis, less one."""


@dataclass(frozen=True)
class LodOptions:
    """How levels are made and stored.

    Args:
        smallest: Levels are added until one has at most this many splats.
        chunk: Most splats of a file.
        leaf: Most splats of the finest level in a leaf; at most `chunk`.

    Raises:
        ArgumentError: a value is not a positive whole number.
    """

    smallest: int = SMALLEST
    chunk: int = CHUNK
    leaf: int = LEAF

    def __post_init__(self) -> None:
        """Check the values; a chunk smaller than a leaf makes the leaves smaller too."""
        for name in ("smallest", "chunk", "leaf"):
            whole_number(name, getattr(self, name), 1)
        object.__setattr__(self, "leaf", min(self.leaf, self.chunk))


@dataclass(frozen=True, eq=False)
class Leaf:
    """A region at all levels of detail.

    Args:
        levels: Gaussians of each level, finest first, each in Morton order.
        errors: Error of each level, world units, ascending from 0.
        low: Smallest coordinates of the region, world units.
        high: Largest coordinates.
    """

    levels: tuple[Gaussians, ...]
    errors: tuple[float, ...]
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Branch:
    """A region with two halves.

    Args:
        children: The halves.
    """

    children: tuple[Node, Node]


Node = Leaf | Branch


def leaves_of(node: Node) -> list[Leaf]:
    """Return the leaves below a node, from left to right."""
    if isinstance(node, Leaf):
        return [node]
    return [leaf for child in node.children for leaf in leaves_of(child)]


def counts_of(leaves: list[Leaf]) -> list[int]:
    """Return the number of Gaussians of each level in some leaves."""
    return [sum(len(leaf.levels[k]) for leaf in leaves) for k in range(len(leaves[0].levels))]


def level_of(node: Node, level: int) -> Gaussians:
    """Return the Gaussians of a level below a node, leaf by leaf."""
    return Gaussians.concatenated([leaf.levels[level] for leaf in leaves_of(node)])


def build_levels(gaussians: Gaussians, options: LodOptions) -> Node:
    """Make the tree of a scene and its levels.

    Args:
        gaussians: N finite Gaussians.
        options: Sizes of levels and leaves.

    Returns:
        The root.
    """
    gaussians = gaussians.map(lambda tensor: tensor.detach().float())
    levels = _number_of_levels(_leaf_sizes(len(gaussians), options.leaf), options.smallest)
    return _built(gaussians, options.leaf, levels)


def with_levels(node: Node, change: dict[int, list[Gaussians]]) -> Node:
    """Return a tree whose leaves have other Gaussians at some levels, for example refined ones.

    Args:
        node: The root.
        change: For each changed level its Gaussians, leaf by leaf, from left to right.

    Returns:
        The new root; the leaves' boxes fit the new Gaussians.
    """
    made = []
    for index, leaf in enumerate(leaves_of(node)):
        given = {k: in_morton_order(parts[index]) for k, parts in change.items()}
        levels = tuple(given.get(k, old) for k, old in enumerate(leaf.levels))
        low, high = bounds(levels)
        made.append(replace(leaf, levels=levels, low=low, high=high))
    return _with_leaves(node, iter(made))


def in_morton_order(gaussians: Gaussians) -> Gaussians:
    """Sort Gaussians along a Morton curve through the box of their means."""
    order = torch.from_numpy(morton_order(gaussians.means.numpy(force=True)))
    return _rows(gaussians, order)


def morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order of points along a Morton curve through their box; points of a cell keep their order.

    Args:
        means: N positions, world units.
    """
    if not len(means):
        return np.arange(0)
    places = means.astype(np.float64)
    low, high = places.min(axis=0), places.max(axis=0)
    cells = (places - low) / np.where(high > low, high - low, 1.0) * CELLS
    return np.argsort(morton_codes(cells.astype(np.uint16)), kind="stable")


def bounds(
    levels: tuple[Gaussians, ...],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Return the box of the ellipsoids of one standard deviation; +-sqrt(Sigma_ii) about a mean is exact.

    Args:
        levels: Gaussians of some levels; the box encloses all of them.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for gaussians in levels:
        if not len(gaussians):
            continue
        blobs = blobs_of(gaussians)
        reach = np.sqrt(np.einsum("nii->ni", blobs.covariances))
        low = np.minimum(low, (blobs.means - reach).min(axis=0))
        high = np.maximum(high, (blobs.means + reach).max(axis=0))
    return (low, high) if np.isfinite(low).all() else (np.zeros(3), np.zeros(3))


def _leaf_sizes(count: int, most: int) -> list[int]:
    if count <= most:
        return [count]
    return _leaf_sizes((count + 1) // 2, most) + _leaf_sizes(count // 2, most)


def _number_of_levels(sizes: list[int], smallest: int) -> int:
    """Return the number of levels with which the last one has at most `smallest` Gaussians, or one in each leaf."""
    levels = 1
    while sum(sizes) > smallest and max(sizes) > 1 and levels < MOST_LEVELS:
        sizes = [(size + 1) // 2 for size in sizes]
        levels += 1
    return levels


def _built(gaussians: Gaussians, most: int, levels: int) -> Node:
    if len(gaussians) <= most:
        return _leaf(gaussians, levels)
    means = gaussians.means.numpy(force=True)
    low, high = np.quantile(means.astype(np.float64), INNER, axis=0)
    order = np.argsort(means[:, int(np.argmax(high - low))], kind="stable")
    middle = (len(means) + 1) // 2
    left, right = (torch.from_numpy(np.sort(part)) for part in (order[:middle], order[middle:]))
    return Branch(
        (_built(_rows(gaussians, left), most, levels), _built(_rows(gaussians, right), most, levels))
    )


def _rows(gaussians: Gaussians, rows: torch.Tensor) -> Gaussians:
    return gaussians.map(lambda tensor: tensor[rows])


def _leaf(gaussians: Gaussians, count: int) -> Leaf:
    """Make the levels of a leaf from its Gaussians."""
    finest = blobs_of(gaussians)
    owners = np.arange(len(gaussians))
    made, errors = [gaussians], [0.0]
    for _ in range(count - 1):
        coarser, moved = halved(made[-1])
        owners = moved[owners]
        apart = finest.means - coarser.means.numpy(force=True)[owners]
        squares = (finest.weights * (apart * apart).sum(axis=1)).sum() / finest.weights.sum()
        made.append(coarser)
        errors.append(max(errors[-1], float(np.sqrt(squares))))
    levels = tuple(in_morton_order(level) for level in made)
    low, high = bounds(levels)
    return Leaf(levels, tuple(errors), low, high)


def _with_leaves(node: Node, leaves: Iterator[Leaf]) -> Node:
    if isinstance(node, Leaf):
        return next(leaves)
    left, right = node.children
    return Branch((_with_leaves(left, leaves), _with_leaves(right, leaves)))
