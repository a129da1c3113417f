"""Train blocks on dask.distributed: workers on this machine, or those of a scheduler elsewhere.

A task is a folder and the number of a block; its answer is the name of a file and a digest. Photos and results stay in
folders that every worker sees. Dask unpickles its messages, so anyone who can connect to a scheduler or a worker can
run any program there. The local cluster therefore listens on the loopback interface only.
"""

from __future__ import annotations

import importlib
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError, CheckpointError, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.headroom import shortage
from gsplat_edu.base.text import install_command

FAILURES = 20
"""A block is abandoned after it has lost this many workers. Each new worker resumes from the last checkpoint."""

PATIENCE = 60.0
"""Seconds without a worker or a scheduler after which the command ends."""

WATCH_EVERY = 0.5
"""Seconds between two looks at the cluster."""

AGAIN = "finished blocks and checkpoints are kept: run the same command with --resume to continue"

_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class ClusterOptions:
    """Where blocks are trained.

    Args:
        scheduler: Address of a running scheduler; None starts a cluster on this machine.
        workers: Number of processes of that cluster.
        patience: Seconds to wait for a worker or a lost scheduler.

    Raises:
        ArgumentError: a number is out of range.
    """

    scheduler: str | None = None
    workers: int = 1
    patience: float = PATIENCE

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.workers < 1:
            raise ArgumentError(f"--workers: is {self.workers}, but has to be at least 1")


def run_on_cluster(
    folder: Path,
    numbers: Sequence[int],
    options: ClusterOptions,
    watch: Callable[[], None] = lambda: None,
    say: Callable[[str], None] = lambda sentence: None,
) -> None:
    """Train blocks on a cluster.

    If a worker is lost, another resumes its block from the last checkpoint. If a block fails, the others are still
    trained.

    Args:
        folder: The run in blocks, under the same path on every worker.
        numbers: The blocks, the longest first.
        options: The cluster.
        watch: Called now and then.
        say: Receives sentences for the user.

    Raises:
        ArgumentError: dask.distributed is not installed, or there is no scheduler at the address.
        CheckpointError: a block failed, all workers were lost, or the scheduler was.
    """
    distributed = _distributed()
    with _client(distributed, options, say) as client:
        _wait_for_workers(client, options)
        share = _workers_on_one_host(client)
        futures = {
            number: client.submit(
                _task,
                str(folder.resolve()),
                number,
                share,
                key=f"block {number}",
                pure=False,
                priority=-place,
            )
            for place, number in enumerate(numbers)
        }
        _watch(client, list(futures.values()), options, watch)
        answers = {number: _answer(number, future) for number, future in futures.items()}
    if failed := [f"block {number}: {answer}" for number, answer in answers.items() if answer]:
        raise CheckpointError(f"{failed[0]} ({len(failed)} of {len(numbers)} blocks failed; {AGAIN})")


def _task(folder: str, number: int, share: int) -> dict[str, Any]:
    """Train a block on a worker; return the digest of its scene, or the error in one line."""
    import torch

    from gsplat_edu.blocks.task import train_block

    with _ONE_AT_A_TIME:  # a worker may have several threads, but torch's thread count is set per process
        torch.set_num_threads(max(_processors() // share, 1))
        try:
            # a disconnected worker may still train the block: it finishes it, or frees the lock when it ends
            done = train_block(Path(folder), number, patience=math.inf)
        except SplatError as error:
            return {"error": str(error)}
        except Exception as error:
            if (line := shortage(error)) is not None:
                return {"error": f"ran out of memory ({line})"}
            if isinstance(error, OSError):
                return {"error": described(error)}
            raise
    assert done is not None, "nothing stops a block here"
    return {"sha256": done.sha256}


def _distributed() -> Any:  # noqa: ANN401
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError as error:
        how = install_command("cluster")
        raise ArgumentError(
            f"--workers, --scheduler: {error.name} is not installed; {how}, or omit them"
        ) from None


@contextmanager
def _client(distributed: Any, options: ClusterOptions, say: Callable[[str], None]) -> Iterator[Any]:  # noqa: ANN401
    """Connect to the scheduler, or start a cluster on this machine; close what was opened."""
    import dask

    with dask.config.set({"distributed.scheduler.allowed-failures": FAILURES}), _quiet():
        if options.scheduler is None:
            # the nanny would restart a worker at 95 % of the memory; each process gets its share of the threads
            with (
                distributed.LocalCluster(
                    n_workers=options.workers,
                    threads_per_worker=1,
                    processes=True,
                    host=LOOPBACK,
                    dashboard_address=None,
                    memory_limit=0,
                    silence_logs=50,
                ) as cluster,
                distributed.Client(cluster, set_as_default=False) as client,
            ):
                yield client
            return
        if warning := exposed(options.scheduler):
            say(warning)
        try:
            client = distributed.Client(options.scheduler, timeout=options.patience, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ArgumentError(
                f"--scheduler: no scheduler answers at {options.scheduler} ({str(error)[:80]}); start one with"
                " `dask scheduler`, or correct the address"
            ) from None
        try:
            yield client
        finally:
            client.close(timeout=5)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's tracebacks off the terminal; one line reports each failure."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "distributed.core")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def exposed(address: str) -> str | None:
    """Return a warning if a scheduler is reached over a network without TLS.

    Args:
        address: Its address, such as tcp://10.0.0.5:8786.
    """
    parts = urlsplit(address if "//" in address else f"tcp://{address}")
    if parts.scheme == "tls" or (parts.hostname or "") in (LOOPBACK, "localhost", "::1"):
        return None
    return (
        f"{address}: is not encrypted, and anyone who can connect can run programs on every machine of the cluster; use"
        " it in a network that you trust, or tls:// (docs/SCALE.md)"
    )


def _wait_for_workers(client: Any, options: ClusterOptions) -> None:  # noqa: ANN401
    try:
        client.wait_for_workers(1, timeout=options.patience)
    except TimeoutError:
        raise CheckpointError(
            f"{options.scheduler or 'the local cluster'}: has no workers; start some with `dask worker ADDRESS`,"
            " and run the same command again"
        ) from None


def _workers_on_one_host(client: Any) -> int:  # noqa: ANN401
    """Return the largest number of workers that share a computer."""
    hosts = [str(worker["host"]) for worker in client.scheduler_info(n_workers=-1)["workers"].values()]
    return max((hosts.count(host) for host in set(hosts)), default=1)


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _watch(client: Any, futures: Sequence[Any], options: ClusterOptions, watch: Callable[[], None]) -> None:  # noqa: ANN401
    """Wait until every block is finished or has failed.

    Raises:
        CheckpointError: the scheduler is lost, or there has been no worker for too long.
    """
    place = options.scheduler or "the local cluster"
    alone = time.monotonic()
    while not all(future.status in ("finished", "error") for future in futures):
        time.sleep(WATCH_EVERY)
        watch()
        # A future is "lost" if its worker ended with the result, until another worker computes it again.
        if client.status != "running" or any(future.status == "cancelled" for future in futures):
            raise CheckpointError(f"{place}: the scheduler was lost; {AGAIN}")
        try:
            workers = client.scheduler_info(n_workers=-1)["workers"]
        except (OSError, TimeoutError):
            workers = {}
        if workers:
            alone = time.monotonic()
        elif time.monotonic() - alone > options.patience:
            raise CheckpointError(f"{place}: all workers were lost; start some, and {AGAIN}")


def _answer(number: int, future: Any) -> str | None:  # noqa: ANN401
    """Return the error of a block in one line; None if it is finished."""
    if future.status == "error":
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            return f"{FAILURES + 1} workers were lost while they trained it, perhaps for lack of memory"
        return f"{type(error).__name__}: {error}"
    error = future.result().get("error")
    return None if error is None else str(error)
