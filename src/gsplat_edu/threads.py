"""Torch on one thread, where its answer would depend on how many there are.

Torch cuts an elementwise operation into one piece per thread and computes the last few numbers of each piece by
another routine than the others: a sigmoid of 100,001 numbers has other bits on two threads than on one. A product of
matrices is cut up likewise, by torch and by NumPy; torch's can be told.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's operations on one thread inside the block; the kernels' threads are not affected outside it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
