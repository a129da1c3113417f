"""Several ranks in one process: threads that exchange real gloo messages over loopback.

Starting Python and torch takes seconds of CPU time per process; a thread takes none. Torch runs on one thread
meanwhile, because its number of threads belongs to the process.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import torch
import torch.distributed as dist

from gsplat_edu.runs.processes import Processes

PATIENCE = timedelta(seconds=60)


def together(size: int, work: Callable) -> list:
    """Call `work(team)` for every rank at once; return the results by rank. The first error is raised."""
    store, before = dist.HashStore(), torch.get_num_threads()
    everyone = threading.Barrier(size)

    def one(rank: int):
        group = dist.ProcessGroupGloo(store, rank, size, PATIENCE)
        everyone.wait()
        try:
            return work(Processes(rank, size, group))
        except BaseException:
            group.abort()  # so that the others do not wait for this rank
            raise

    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(size) as pool:
            return [found.result() for found in [pool.submit(one, rank) for rank in range(size)]]
    finally:
        torch.set_num_threads(before)
