"""Several ranks in one process: threads that exchange real gloo messages over loopback.

Starting Python and torch takes seconds of CPU time per process; a thread takes none. Torch runs on one thread
meanwhile, because its number of threads belongs to the process.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import torch
import torch.distributed as dist

from gsplat_edu.base.errors import ProcessLostError
from gsplat_edu.runs.processes import Processes

MEETING = timedelta(seconds=60)


def together(size: int, work: Callable, patience: float = 30.0) -> list:
    """Call `work(team)` for every rank at once; return the results by rank.

    If some fail, the error of the first that did not only miss another is raised.

    Args:
        size: Number of ranks.
        work: What each does.
        patience: Seconds for which a rank waits for a message. A thread that fails does not close its connections.
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
