"""Memory for the large tensors of an iteration, reused by the next one.

A C library's heap is a poor place for them. A step of training makes images and gradients of several megabytes, and
between them small tensors that live longer. glibc (2.36) cuts a 64-byte aligned block out of a larger one; once it is
freed, the hole is too small for the next aligned request of the same size, unless its neighbour is free as well. One
small tensor kept per step is enough, and the process grows by an image in every iteration.

Inside `reused_buffers`, `reusable_tensor` maps memory of its own instead and hands it out again once nothing refers to
it: not the tensor, not a view of it, not what autograd saved. Nobody's tensor is ever written over. When the block
ends, the system gets everything back that is not in use.
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
"""Tensors smaller than this, in bytes, stay in the heap: other small ones fill the holes that they leave."""

SLACK = 1.25
"""A buffer is reused if it is at most this many times as large as requested; the number of Gaussians changes often."""

HEAP_LIMIT = 1 << 22
"""Bytes from which glibc maps a request separately and unmaps it when it is freed (M_MMAP_THRESHOLD)."""

M_MMAP_THRESHOLD = -3
"""mallopt's number for it."""


class _Pool:
    """Mappings, those in use and those waiting for the next request.

    It never holds more bytes than were in use at once within the last two spans of `SPAN` requests.
    """

    SPAN = 1024

    def __init__(self) -> None:
        self._waiting: list[mmap.mmap] = []
        # Finalizers append to it from any thread and at any moment; waiting for a lock, they could wait for themselves.
        self._returned = deque[mmap.mmap]()
        self._used = self._peak = self._peak_before = self._requests = 0
        self._closed = False

    def take(self, nbytes: int) -> np.ndarray:
        """Return an array of that many bytes, whose memory comes back when nothing refers to it any more."""
        self._collect()
        fitting = [block for block in self._waiting if nbytes <= len(block) <= SLACK * nbytes]
        if fitting:
            block = min(fitting, key=len)
            self._waiting.remove(block)
        else:
            self._shrink(nbytes)
            block = _mapped(-(-nbytes // mmap.PAGESIZE) * mmap.PAGESIZE)
        self._note(len(block))
        array = np.frombuffer(block, dtype=np.uint8, count=nbytes)
        weakref.finalize(array, self._take_back, block).atexit = False
        return array

    def close(self) -> None:
        """Unmap what is waiting now, and from now on whatever comes back."""
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
        """Unmap those that have waited longest until what is wanted fits below the peak."""
        most = max(self._peak, self._peak_before)
        waiting = sum(map(len, self._waiting))
        while self._waiting and self._used + waiting + wanted > most:
            waiting -= len(self._waiting.pop(0))

    @property
    def nbytes(self) -> int:
        """Bytes mapped: in use and waiting."""
        self._collect()
        return self._used + sum(map(len, self._waiting))


class _Current(threading.local):
    """The pool of this thread, if it is inside `reused_buffers`."""

    pool: _Pool | None = None


_current = _Current()


@contextlib.contextmanager
def reused_buffers() -> Iterator[None]:
    """Let `reusable_tensor` reuse memory inside the block, in this thread. Nested blocks share one pool.

    From the first block on, glibc maps every other large request separately too, for as long as the process runs:
    photos that are read again and the work of density control go back to the system when they are freed. By default
    glibc raises its limit for that to the size of whatever was freed, up to 32 MiB. Other C libraries are left as
    they are: musl's limit is fixed, and macOS keeps large requests out of its small regions.
    """
    _limit_heap()
    before = _current.pool
    pool = _current.pool = before or _Pool()
    try:
        yield
    finally:
        _current.pool = before
        if before is None:
            pool.close()


def reusable_tensor(shape: Sequence[int], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return an uninitialised tensor of a shape, contiguous, on another's device.

    Args:
        shape: Its shape.
        like: Decides the device, and the dtype where none is given.
        dtype: Its dtype.
    """
    pool, dtype = _current.pool, dtype or like.dtype
    nbytes = math.prod(shape) * dtype.itemsize
    if pool is None or nbytes < LARGE or like.device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=like.device)
    return torch.from_numpy(pool.take(nbytes)).view(dtype).view(shape)


def _mapped(nbytes: int) -> mmap.mmap:
    """Map fresh memory; a forked child gets a copy of it."""
    if sys.platform == "win32":
        return mmap.mmap(-1, nbytes)
    return mmap.mmap(-1, nbytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


@functools.cache
def _limit_heap() -> None:
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, HEAP_LIMIT)
