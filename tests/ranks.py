"""Several ranks in one process: threads that exchange gloo messages over loopback. Starting Python and torch takes
seconds of CPU time per process, starting a thread none. Torch runs on one thread meanwhile, because its number of
threads is the process's.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import torch
import torch.distributed as dist

from gsplat_edu.base.errors import ProcessLostError
from gsplat_edu.runs.processes import Processes

MEETING = timedelta(seconds=180)


def together(size: int, work: Callable, patience: float = 120.0) -> list:
    """Call `work(team)` for all ranks at the same time; return the results by rank. If ranks fail, raise the error of
    the first one that did not fail because another rank was missing.

    Args:
        size: Number of ranks.
        work: Called for each rank.
        patience: Seconds for which a rank waits for a message, because a thread that fails does not close its
        connections.
    """
    store, before = dist.HashStore(), torch.get_num_threads()

    def one(rank: int):
        group = dist.ProcessGroupGloo(store, rank, size, MEETING)
        return work(Processes(rank, size, group, timedelta(seconds=patience)))

    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(size) as pool:
            ranks = [pool.submit(one, rank) for rank in range(size)]
            errors = [error for error in (found.exception() for found in ranks) if error is not None]
            for error in sorted(errors, key=lambda error: isinstance(error, ProcessLostError)):
                raise error
            return [found.result() for found in ranks]
    finally:
        torch.set_num_threads(before)
