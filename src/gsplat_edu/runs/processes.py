"""The processes that `torchrun` starts for one training: messages over gloo, and checks that they compute alike.

gloo listens on the network interface of the machine's own name, or on that of GLOO_SOCKET_IFNAME; nothing is encrypted,
and any program that reaches the ports can take part. Use it within a machine or a private network.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.errors import ProcessLostError, SplatError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.ops.kernels import native
from gsplat_edu.train.team import ALONE, Alone

PATIENCE = timedelta(hours=6)
"""How long a process waits for a message: another may be evaluating. A process that ends is noticed at once."""

MEETING = timedelta(minutes=5)
"""How long the processes wait for one another at the start."""

DTYPES = (torch.float32, torch.float64, torch.int64, torch.int32, torch.uint8, torch.bool)
"""Types of tensors in messages, by their number."""

ALIGNED = 8
"""Tensors begin at multiples of this in a message, bytes."""


class Processes:
    """A process and its connections to the others of its run.

    Args:
        rank: This process, from 0.
        size: Number of processes.
        group: A process group of torch with point-to-point messages, gloo's.
        patience: How long to wait for a message.

    Attributes:
        sent: Bytes sent so far.
        waited: Seconds spent on messages so far: packing, sending and waiting.
        worked: Processor seconds of these, of all threads.
    """

    def __init__(self, rank: int, size: int, group: Any, patience: timedelta = PATIENCE) -> None:  # noqa: ANN401
        self.rank, self.size, self._group, self._patience = rank, size, group, patience
        self.sent, self.waited, self.worked = 0, 0.0, 0.0

    def exchange(self, outgoing: Sequence[Sequence[Tensor]]) -> list[list[Tensor]]:
        """Send a list of tensors to every process, and receive one from each; see `Team.exchange`.

        Raises:
            ProcessLostError: another process ended.
        """
        start, processor = time.perf_counter(), time.process_time()
        others = [rank for rank in range(self.size) if rank != self.rank]
        packed = {id(tensors): pack(tensors) for rank, tensors in enumerate(outgoing) if rank in others}
        blobs = {rank: packed[id(outgoing[rank])] for rank in others}
        lengths = {rank: torch.tensor([len(blob)]) for rank, blob in blobs.items()}
        arriving = self._traded({rank: torch.zeros_like(length) for rank, length in lengths.items()}, lengths)
        incoming = self._traded(
            {rank: torch.empty(int(length), dtype=torch.uint8) for rank, length in arriving.items()}, blobs
        )
        self.sent += sum(blob.nbytes + lengths[rank].nbytes for rank, blob in blobs.items())
        self.waited += time.perf_counter() - start
        self.worked += time.process_time() - processor
        return [
            list(outgoing[rank]) if rank == self.rank else unpack(incoming[rank]) for rank in range(self.size)
        ]

    def _traded(self, incoming: dict[int, Tensor], outgoing: dict[int, Tensor]) -> dict[int, Tensor]:
        """Send each process its tensors, and fill the tensors that are received from it."""
        with _named_loss():
            works = [self._group.recv([tensor], rank, 0) for rank, tensor in incoming.items()]
            works += [self._group.send([tensor], rank, 0) for rank, tensor in outgoing.items()]
            for work in works:
                work.wait(self._patience)
        return incoming

    def shared(self, value: Any) -> Any:  # noqa: ANN401
        """Return the value of process 0, which JSON can represent."""
        return self.told(value)[0]

    def told(self, value: Any) -> list[Any]:  # noqa: ANN401
        """Return the values of all processes; JSON must be able to represent each."""
        text = torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)
        return [json.loads(bytes(part.numpy())) for (part,) in self.exchange([[text]] * self.size)]

    def any(self, flag: bool) -> bool:
        """Return whether the flag of any process is true."""
        return any(bool(part) for (part,) in self.exchange([[torch.tensor([flag])]] * self.size))

    def shared_state(
        self, state: tuple[dict[str, Tensor], Any] | None
    ) -> tuple[dict[str, Tensor], Any] | None:
        """Return process 0's tensors and JSON values; None if it passed None."""
        tensors, numbers = ({}, None) if state is None else state
        names, numbers = self.shared([list(tensors), numbers])
        parts = self.exchange([[tensor.contiguous() for tensor in tensors.values()]] * self.size)[0]
        # Copies, because a generator reads its state from the start of the memory that a tensor is part of.
        copies = [part.clone() for part in parts]
        return (dict(zip(names, copies, strict=True)), numbers) if names else None


Member = Alone | Processes


@contextmanager
def joined(size: int) -> Iterator[Member]:
    """Join the processes that `torchrun` started, and check that all compute alike.

    Args:
        size: Their number; with 1 nothing happens.

    Raises:
        SplatError: the processes do not reach one another, or their versions or instruction sets differ.
    """
    if size == 1:
        yield ALONE
        return
    import torch.distributed as dist  # imported here because only shared trainings need it

    try:
        rank = int(os.environ["RANK"])
        hosts = rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
        address, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        table = dist.TCPStore(  # type: ignore[attr-defined]
            address, port, size, is_master=hosts, timeout=MEETING, multi_tenant=True
        )
        store = dist.PrefixStore(_place(), table)  # type: ignore[attr-defined]
        dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=MEETING)
    except (RuntimeError, ValueError) as error:
        raise SplatError(
            f"torchrun: the {size} processes do not reach one another ({_first_line(error)}); GLOO_SOCKET_IFNAME"
            " names the network interface"
        ) from None
    try:
        team = Processes(rank, size, dist.group.WORLD)
        check_alike(team, "compute alike", facts())
        yield team
    finally:
        dist.destroy_process_group()


def _place() -> str:
    """Return the prefix of this start's entries in torchrun's store, which outlives the processes of a failed start."""
    names = ("TORCHELASTIC_RUN_ID", "TORCHELASTIC_RESTART_COUNT")
    return "/".join(["gsplat_edu", *(os.environ.get(name, "") for name in names)])


def facts() -> dict[str, str]:
    """Return the facts about this process that a training's bits depend on, apart from its options."""
    return {
        "version of gsplat-edu": version("gsplat-edu"),
        "version of torch": torch.__version__,
        "instruction set (GSPLAT_EDU_ISA)": native().isa(),
        "instruction set of torch (ATEN_CPU_CAPABILITY)": torch.backends.cpu.get_cpu_capability(),
        "rounding of exponentials and products": _rounding(),
    }


def with_points_of_first(dataset: Dataset, team: Member) -> Dataset:
    """Return the dataset with the start points of process 0, which may have triangulated them."""
    points, colors = torch.from_numpy(dataset.points), torch.from_numpy(dataset.colors)
    measured = torch.tensor([dataset.measured])
    points, colors, measured = team.exchange([[points, colors, measured]] * team.size)[0]
    return replace(dataset, points=points.numpy(), colors=colors.numpy(), measured=bool(measured))


def check_alike(team: Processes, what: str, found: dict[str, str]) -> None:
    """Check that all processes report equal facts.

    Raises:
        SplatError: they did not; the message names the first difference.
    """
    everyone = team.told([socket.gethostname(), found])
    first_host, first = everyone[0]
    for rank, (host, other) in enumerate(everyone):
        for name, value in first.items():
            if other.get(name) != value:
                raise SplatError(
                    f"torchrun: the processes have to {what}: {name}: {value} in process 0 on {first_host}, but"
                    f" {other.get(name)} in process {rank} on {host}; make them equal"
                )


def digest_of(data: bytes) -> str:
    """Return a short digest, for `check_alike`."""
    return hashlib.sha256(data).hexdigest()[:12]


def _rounding() -> str:
    """Return a digest of sample results of the libraries. Processors with one instruction set may round differently."""
    digest, numbers = hashlib.sha256(), np.random.default_rng(0).normal(size=1027)
    matrices = torch.from_numpy(numbers[:999].reshape(111, 3, 3))
    with torch.no_grad():
        for tensor in (torch.from_numpy(numbers), torch.from_numpy(numbers).float()):
            for found in (
                tensor.exp(),
                tensor.sigmoid(),
                tensor.abs().log(),
                tensor.abs().rsqrt(),
                tensor.sum(),
            ):
                digest.update(found.numpy().tobytes())
        for some in (matrices, matrices.float()):
            digest.update((some @ some.mT).numpy().tobytes())
    digest.update(np.exp(numbers).tobytes() + np.sin(numbers).tobytes())
    return digest.hexdigest()[:12]


def pack(tensors: Sequence[Tensor]) -> Tensor:
    """Return tensors as the bytes of one message."""
    head = [len(tensors)]
    for tensor in tensors:
        head += [DTYPES.index(tensor.dtype), tensor.ndim, *tensor.shape]
    parts = [torch.tensor([len(head), *head], dtype=torch.int64).view(torch.uint8)]
    for tensor in tensors:
        flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
        parts += [flat, flat.new_zeros(-len(flat) % ALIGNED)]
    return torch.cat(parts)


def unpack(message: Tensor) -> list[Tensor]:
    """Return the tensors of a message made by `pack`."""
    numbers = message[: len(message) // ALIGNED * ALIGNED].view(torch.int64)
    length = int(numbers[0])
    head = iter(numbers[1 : 1 + length].tolist())
    found, at = [], (1 + length) * ALIGNED
    for _ in range(next(head)):
        dtype, ndim = DTYPES[next(head)], next(head)
        shape = [next(head) for _ in range(ndim)]
        size = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        found.append(message[at : at + size].view(dtype).reshape(shape))
        at += size + -size % ALIGNED
    return found


@contextmanager
def _named_loss() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # what gloo raises
        raise ProcessLostError(
            f"torchrun: another process of this run ended or cannot be reached ({_first_line(error)}); checkpoints are"
            " intact, --resume continues from the last one"
        ) from None


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return lines[0].rpartition("] ")[2].partition(". ")[0] if lines else type(error).__name__
