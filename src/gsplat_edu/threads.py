"""Run torch on a single thread where its result would depend on the number of threads.

Torch splits an elementwise operation into one piece per thread and computes the last few numbers of each piece by a
different routine: a sigmoid of 100,001 numbers has other bits on two threads than on one. Matrix products are split
likewise, by torch and by NumPy; torch's can be controlled.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's operations on one thread inside the block; the native kernels are not affected."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
