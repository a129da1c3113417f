"""Run torch on a single thread if its result would depend on the number of threads.

Torch splits an elementwise operation into one piece per thread and computes the last few numbers of each piece by a
different routine: a sigmoid of 100,001 numbers has other bits on two threads than on one. Matrix products are split
likewise, by torch and by NumPy; only torch's number of threads can be set.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_outside: ContextVar[int] = ContextVar("_outside", default=0)
"""Torch's number of threads before the outermost `one_thread`; 0 outside of any."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch's operations on one thread inside the block; see `native_threads` for the native kernels."""
    threads = torch.get_num_threads()
    token = _outside.set(_outside.get() or threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _outside.reset(token)


def native_threads() -> int:
    """Return the number of threads for native kernels, whose bits it does not change: torch's outside `one_thread`."""
    return _outside.get() or torch.get_num_threads()
