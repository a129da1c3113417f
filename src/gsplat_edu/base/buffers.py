"""Memory for an iteration's large tensors, reused by the next iteration.

A C library's heap handles them badly. A training step makes images and gradients of several megabytes, and between them
small tensors that live longer. glibc (2.36) cuts a 64-byte aligned block out of a larger one; once it is freed, the
hole is too small for the next aligned request of the same size, unless its neighbour is free as well. One small tensor
kept per step is enough to make the process grow by an image in every iteration.

Inside `reused_buffers`, `reusable_tensor` uses its own memory mappings and reuses one only when nothing refers to it
any more: no tensor, no view, nothing saved by autograd. So live tensors are never overwritten. At the end of the block,
all unused memory is returned to the system.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import mmap
import platform
import sys
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

LARGE = 1 << 18
"""Smaller tensors, in bytes, stay in the heap, where others fill the holes that they leave."""

SLACK = 1.25
"""A buffer is reused if it is at most this factor larger than requested; the number of Gaussians changes often."""

HEAP_LIMIT = 1 << 22
"""Request size in bytes from which glibc uses a separate mapping that is unmapped when freed (M_MMAP_THRESHOLD)."""

M_MMAP_THRESHOLD = -3
"""Number of this parameter in mallopt."""


class BufferPool:
    """Memory mappings, in use or waiting for reuse.

    The pool never holds more bytes than the peak in use within the last two spans of `SPAN` requests.
    """

    SPAN = 1024

    def __init__(self) -> None:
        self._waiting: list[mmap.mmap] = []
        # Finalizers append to it from any thread at any time. They must not take a lock: that could deadlock.
        self._returned = deque[mmap.mmap]()
        self._used = self._peak = self._peak_before = self._requests = 0
        self._closed = False

    def take(self, nbytes: int) -> np.ndarray:
        """Return an array of that many bytes; its memory returns to the pool when nothing refers to it any more."""
        self._collect()
        fitting = [block for block in self._waiting if nbytes <= len(block) <= SLACK * nbytes]
        if fitting:
            block = min(fitting, key=len)
            self._waiting.remove(block)
        else:
            self._shrink(nbytes)
            block = mapped_memory(-(-nbytes // mmap.PAGESIZE) * mmap.PAGESIZE)
        self._note(len(block))
        array = np.frombuffer(block, dtype=np.uint8, count=nbytes)
        weakref.finalize(array, self._take_back, block).atexit = False
        return array

    def close(self) -> None:
        """Unmap the waiting memory, and from now on all returned memory."""
        self._closed = True
        self._waiting.clear()
        self._returned.clear()

    def _take_back(self, block: mmap.mmap) -> None:
        if not self._closed:
            self._returned.append(block)

    def _collect(self) -> None:
        while self._returned:
            block = self._returned.popleft()
            self._used -= len(block)
            self._waiting.append(block)

    def _note(self, nbytes: int) -> None:
        self._used += nbytes
        self._peak = max(self._peak, self._used)
        self._requests += 1
        if self._requests % self.SPAN == 0:
            self._peak_before, self._peak = self._peak, self._used
            self._shrink(0)

    def _shrink(self, wanted: int) -> None:
        """Unmap the memory that has waited longest until the request fits below the peak."""
        most = max(self._peak, self._peak_before)
        waiting = sum(map(len, self._waiting))
        while self._waiting and self._used + waiting + wanted > most:
            waiting -= len(self._waiting.pop(0))

    @property
    def nbytes(self) -> int:
        """Mapped bytes: in use and waiting."""
        self._collect()
        return self._used + sum(map(len, self._waiting))


class _Current(threading.local):
    """The pool of this thread, if it is inside `reused_buffers`."""

    pool: BufferPool | None = None


_current = _Current()


@contextlib.contextmanager
def reused_buffers() -> Iterator[None]:
    """Let `reusable_tensor` reuse memory inside the block, in this thread. Nested blocks share one pool.

    From the first block on, for the rest of the process, glibc also maps every other large request separately, so that
        photos that are read again and the temporaries of density control are returned to the system when freed. By
        default glibc raises its threshold for that to the size of the freed memory, up to 32 MiB. Other C libraries are
        left unchanged: musl's threshold is fixed, and macOS keeps large requests out of its small regions.
    """
    _limit_heap()
    before = _current.pool
    pool = _current.pool = before or BufferPool()
    try:
        yield
    finally:
        _current.pool = before
        if before is None:
            pool.close()


def reusable_tensor(shape: Sequence[int], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return an uninitialised, contiguous tensor of a given shape on the device of another tensor.

    Args:
        shape: Its shape.
        like: Provides the device, and the dtype if none is given.
        dtype: Its dtype.
    """
    pool, dtype = _current.pool, dtype or like.dtype
    nbytes = math.prod(shape) * dtype.itemsize
    if pool is None or nbytes < LARGE or like.device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=like.device)
    return torch.from_numpy(pool.take(nbytes)).view(dtype).view(shape)


def mapped_memory(nbytes: int) -> mmap.mmap:
    """Map fresh memory, on Linux in huge pages if the system has them; a forked child gets a copy."""
    if sys.platform == "win32":
        return mmap.mmap(-1, nbytes)
    block = mmap.mmap(-1, nbytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a kernel without huge pages
            block.madvise(mmap.MADV_HUGEPAGE)
    return block


@functools.cache
def _limit_heap() -> None:
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, HEAP_LIMIT)
