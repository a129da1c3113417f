"""Processes that share each step of a training: who renders which views, and who moves which Gaussians.

Every process holds all Gaussians. It renders a run of the batch's views, and moves a range of the Gaussians: it gets
the partial sums of their gradients from all processes, completes the sums in the batch's own order, takes Adam's step
with the moments that only it holds, and sends the moved rows to all. Messages only copy, so the bits do not depend on
the number of processes; `gsplat_edu.runs.processes` sends them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.adam import AdamKernel
from gsplat_edu.train.batches import Batch, Gradients, PartialSums, ViewResult
from gsplat_edu.train.optimizer import MOMENTS, Adam, ParameterGroup

PAGE = 256
"""Processes move multiples of this many Gaussians, so that the kernels group them into the same vectors as in one
process."""


@runtime_checkable
class Team(Protocol):
    """The processes of a run.

    Attributes:
        rank: This process, from 0.
        size: Number of processes.
    """

    rank: int
    size: int

    def exchange(self, outgoing: Sequence[Sequence[Tensor]]) -> list[list[Tensor]]:
        """Send a list of tensors to every process, and receive one from each.

        Args:
            outgoing: A list of tensors for each process; the list for this process is returned unchanged.

        Returns:
            The list that each process sent, with the same bits, dtypes and shapes.
        """
        ...


class Alone:
    """A process that shares nothing."""

    rank, size = 0, 1

    def exchange(self, outgoing: Sequence[Sequence[Tensor]]) -> list[list[Tensor]]:
        """Return what it was given."""
        return [list(tensors) for tensors in outgoing]

    def shared(self, value: Any) -> Any:  # noqa: ANN401
        """Return what it was given."""
        return value

    def any(self, flag: bool) -> bool:
        """Return what it was given."""
        return flag


ALONE = Alone()


def places_of(team: Team, batch: int) -> range:
    """Return the places of a batch whose views this process renders: an equal run for each.

    Raises:
        ArgumentError: the batch cannot be shared out equally.
    """
    if batch % team.size:
        raise ArgumentError(
            f"batch: is {batch}, but has to be a multiple of the {team.size} processes, so that each renders equally"
            " many views"
        )
    each = batch // team.size
    return range(team.rank * each, (team.rank + 1) * each)


def rows_of(count: int, rank: int, size: int) -> slice:
    """Return the rows of `count` Gaussians that a process moves: a range of pages."""
    pages = -(-count // PAGE)
    begin, end = (min(PAGE * (part * pages // size), count) for part in (rank, rank + 1))
    return slice(begin, end)


class SharedAdam(Adam):
    """Adam whose moments are shared out: each process holds those of the Gaussians that it moves.

    Parameters that are not per Gaussian are moved by every process, with the same bits. `state`, `follow` and
    `step_shared` exchange messages, so every process has to call them.

    Args:
        parameters: The tensors by name, whole.
        groups: As for `Adam`.
        kernel: As for `Adam`.
        team: The processes.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        groups: Mapping[str, float | ParameterGroup],
        kernel: AdamKernel,
        team: Team,
    ) -> None:
        self._team = team
        self._shared = {
            name
            for name, group in groups.items()
            if not isinstance(group, ParameterGroup) or group.per_gaussian
        }
        super().__init__(self.own(parameters), groups, kernel)
        self._note(parameters)

    def own(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the rows that this process moves, as views of the parameters, and the other parameters whole."""
        return {
            name: tensor.detach()[self._rows(len(tensor))] if name in self._shared else tensor.detach()
            for name, tensor in parameters.items()
        }

    def _rows(self, count: int, rank: int | None = None) -> slice:
        return rows_of(count, self._team.rank if rank is None else rank, self._team.size)

    def _note(self, parameters: Mapping[str, Tensor]) -> None:
        self._count = next((len(parameters[name]) for name in self._shared), 0)

    def outgoing(self, sums: PartialSums) -> list[list[Tensor]]:
        """Return for each process its rows of the partial sums; the first tensor lists the nodes."""
        nodes = torch.tensor(list(sums.nodes), dtype=torch.int64).reshape(-1, 2)
        return [
            [
                nodes,
                *(
                    gradient[self._rows(len(gradient), rank)] if name in self._shared else gradient
                    for gradients in sums.nodes.values()
                    for name, gradient in gradients.items()
                ),
            ]
            for rank in range(self._team.size)
        ]

    @one_thread()
    def summed(self, names: Sequence[str], incoming: Sequence[Sequence[Tensor]], batch: int) -> Gradients:
        """Complete the sums of the rows that this process moves.

        Args:
            names: Names of the parameters, in the order of the messages.
            incoming: The messages to this process that the others made by `outgoing`.
            batch: Number of views of the batch.
        """
        sums = PartialSums(batch)
        for nodes, *tensors in incoming:
            for i, (level, place) in enumerate(nodes.tolist()):
                part = tensors[i * len(names) : (i + 1) * len(names)]
                sums.add((level, place), dict(zip(names, part, strict=True)))
        return sums.total

    @torch.no_grad()
    @one_thread()
    def spread(self, parameters: Mapping[str, Tensor]) -> None:
        """Send the rows that this process moved to all others, and copy theirs in place."""
        names = [name for name in parameters if name in self._shared]
        own = self.own(parameters)
        incoming = self._team.exchange([[own[name] for name in names]] * self._team.size)
        for rank, tensors in enumerate(incoming):
            if rank != self._team.rank:
                for name, rows in zip(names, tensors, strict=True):
                    parameters[name].detach()[self._rows(self._count, rank)] = rows

    @torch.no_grad()
    def forget_rows(self, indices: Int64[Tensor, " S"]) -> None:
        """Set the moments of some Gaussians to zero, as far as this process holds them."""
        rows = self._rows(self._count)
        super().forget_rows(indices[(indices >= rows.start) & (indices < rows.stop)] - rows.start)

    @torch.no_grad()
    def follow(self, origins: Int64[Tensor, " M"]) -> None:
        """Apply a change of the Gaussians to the moments; see `Adam.follow`."""
        mine = origins[self._rows(len(origins))]
        for moments in (self.first, self.second):
            for name in [name for name in moments if name in self._shared]:
                old = self._whole(moments[name])
                rows = torch.where(mine < 0, len(old), mine)
                padded = torch.cat([old, old.new_zeros(1, *old.shape[1:])])
                moments[name] = padded.index_select(0, rows)
        self._count = len(origins)

    def _whole(self, rows: Tensor) -> Tensor:
        """Return the rows of all processes."""
        parts = self._team.exchange([[rows]] * self._team.size)
        return torch.cat([part for (part,) in parts])

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the moments of all Gaussians, and the number of views of the steps taken; see `Adam.state`."""
        own, steps = super().state()
        whole = {
            part: {name: self._whole(t) if name in self._shared else t for name, t in moments.items()}
            for part, moments in own.items()
        }
        return whole, steps

    def load_state(
        self, moments: Mapping[str, Mapping[str, Tensor]], steps: int, parameters: Mapping[str, Tensor]
    ) -> None:
        """Restore what `state` returned: the moments of all Gaussians. This process keeps only its own rows."""
        super().load_state(moments, steps, parameters)
        self._note(parameters)
        for part in MOMENTS:
            kept = getattr(self, part)
            for name in kept:
                if name in self._shared:
                    kept[name] = kept[name][self._rows(self._count)].clone()


@one_thread()
def share_results(team: Team, batch: Batch, sums: Sequence[Sequence[Tensor]]) -> list[list[Tensor]]:
    """Exchange per-view results, together with each process's rows of the partial sums.

    Args:
        team: The processes.
        batch: The views of this process; gets the results of all places.
        sums: For each process a message that goes along.

    Returns:
        The message that each process sent along.
    """
    places = sorted(batch.results)
    indices = torch.tensor([(place, batch.indices[place]) for place in places], dtype=torch.int64).reshape(
        -1, 2
    )
    tensors = [batch.results[place].tensors() for place in places]
    told = [indices, *(tensor for view in tensors for tensor in view)]
    each = len(tensors[0])
    along = []
    for rank, message in enumerate(team.exchange([[*told, *parts] for parts in sums])):
        pairs = message[0].tolist()
        end = 1 + each * len(pairs)
        if rank != team.rank:
            for i, (place, index) in enumerate(pairs):
                batch.results[place] = ViewResult.of(message[1 + i * each : 1 + (i + 1) * each])
                batch.indices[place] = index
        along.append(message[end:])
    return along
