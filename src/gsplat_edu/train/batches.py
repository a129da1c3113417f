"""Batches: the results of a step's views, and the fixed tree in which their gradients are summed.

The sum of floating-point numbers depends on its order. Here the order depends on the size of the batch alone, not on
who computes which views: neighbouring places are added in pairs, then neighbouring pairs, and so on. Any run of
neighbouring views yields partial sums of that tree, at most two per level. Combining all partial sums gives the same
bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.train.view_model import Rows

Node = tuple[int, int]
"""A node of the tree: its level, from 0 for the views, and its place within the level."""

Gradients = dict[str, Tensor]
"""A gradient for every parameter that the optimiser moves, by name."""


class PartialSums:
    """The sums of gradients over places of a batch, as nodes of its tree.

    If places are added in order, at most one node per level is stored.

    Args:
        count: Number of views of the batch.

    Attributes:
        nodes: The sums so far, none of which are siblings.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self.nodes: dict[Node, Gradients] = {}

    @one_thread()  # torch's other threads would spin and slow down the kernels' threads
    def add(self, node: Node, gradients: Gradients) -> None:
        """Add a node. Combine it with its sibling if that is stored, and so on up the tree.

        Args:
            node: The node: (0, place) for a view.
            gradients: Its sum; the tensors may be overwritten.
        """
        level, place = node
        while (width := -(-self._count >> level)) > 1:
            sibling = level, place ^ 1
            if sibling[1] < width:
                if sibling not in self.nodes:
                    break
                other = self.nodes.pop(sibling)
                for name in gradients:
                    gradients[name] += other[name]
            level, place = level + 1, place // 2
        self.nodes[level, place] = gradients

    @property
    def total(self) -> Gradients:
        """The sum over all places.

        Raises:
            ArgumentError: a place is missing.
        """
        if len(self.nodes) != 1 or -(-self._count >> next(iter(self.nodes))[0]) > 1:
            raise ArgumentError(f"batch: places of its {self._count} views are missing")
        return next(iter(self.nodes.values()))


@dataclass(frozen=True, eq=False)
class ViewResult:
    """The result of one view of a batch, apart from its gradients.

    Args:
        terms: (T,) the objective's terms, in their order.
        rows: What the view model measured: the view's row of each measured tensor, in their order.
        visible: (M,) as in `RenderOutput`; empty if density control observes nothing.
        radii: (M, 2) likewise.
        norms: (M,) `RenderOutput.means2d_grad_norms`, likewise.
    """

    terms: Float[Tensor, " T"]
    rows: Sequence[Tensor]
    visible: Int64[Tensor, " M"]
    radii: Float[Tensor, "M 2"]
    norms: Float[Tensor, " M"]

    def tensors(self) -> list[Tensor]:
        """Return all tensors; `of` takes them."""
        return [self.terms, self.visible, self.radii, self.norms, *self.rows]

    @classmethod
    def of(cls, tensors: Sequence[Tensor]) -> ViewResult:
        """Make a result from what `tensors` returned."""
        terms, visible, radii, norms, *rows = tensors
        return cls(terms, rows, visible, radii, norms)

    def output(self) -> RenderOutput:
        """Return what density control observes, as a render without an image."""
        empty = self.norms.new_zeros(0, 0)
        image = self.norms.new_zeros(0, 0, 3)
        return RenderOutput(image, empty, None, self.visible, self.radii, None, lambda: self.norms)


@dataclass
class Batch:
    """The views of a step that this process has differentiated.

    Args:
        count: Number of views of the batch.
        learned: The parameters that the optimiser moves, by name.
    """

    count: int
    learned: Mapping[str, Tensor]
    results: dict[int, ViewResult] = field(default_factory=dict)
    indices: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Start without gradients."""
        self.sums = PartialSums(self.count)

    @one_thread()
    def take(
        self, place: int, index: int, terms: Mapping[str, Tensor], rows: Rows, output: RenderOutput | None
    ) -> None:
        """Move a view's gradients out of the parameters' `grad`. A gradient that is absent counts as zeros.

        Args:
            place: The view's place in the batch.
            index: The view's index into the trainer's views.
            terms: () the objective's terms.
            rows: What the view model measured.
            output: The render, for density control; None if it need not observe it later.
        """
        gradients = {}
        for name, parameter in self.learned.items():
            gradients[name] = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parameter.grad = None
        self.sums.add((0, place), gradients)
        stacked = torch.stack([*terms.values()])
        none = stacked.new_zeros(0)
        observed = none.long(), none.new_zeros(0, 2), none
        if output is not None:
            observed = output.visible, output.radii.detach(), output.means2d_grad_norms().detach()
        self.results[place] = ViewResult(stacked, [*rows.values()], *observed)
        self.indices[place] = index

    def store_rows(self, measured: Mapping[str, Tensor]) -> None:
        """Write what was measured at all places into the view model's tensors, in the order of the places."""
        for place in sorted(self.results):
            for tensor, row in zip(measured.values(), self.results[place].rows, strict=True):
                tensor[self.indices[place]] = row

    def mean_terms(self, names: Sequence[str]) -> dict[str, Tensor]:
        """Return the mean of every term over the places, added in order."""
        first, *others = (self.results[place].terms for place in sorted(self.results))
        for terms in others:
            first = first + terms
        return dict(zip(names, (first / len(self.results)).unbind(), strict=True))
