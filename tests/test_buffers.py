"""Buffers are reused once no tensor refers to them, and not before."""

import subprocess
import sys
import threading
import weakref
from pathlib import Path

import pytest
import torch

from gsplat_edu.base import buffers
from gsplat_edu.base.buffers import LARGE, reusable_tensor, reused_buffers

SHAPE = (LARGE // 4, 3)
LIKE = torch.zeros(())


def address():
    """Take a buffer, release it, and return its address."""
    return reusable_tensor(SHAPE, LIKE).data_ptr()


def flags(address):
    """Return the flags of the mapping that holds an address (proc_pid_smaps(5))."""
    inside = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        name = line.split(maxsplit=1)[0]
        if not name.endswith(":"):
            first, last = (int(end, 16) for end in name.split("-"))
            inside = first <= address < last
        elif inside and name == "VmFlags:":
            return line.split()[1:]
    return []


@pytest.mark.skipif(
    not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="the system has no huge pages"
)
def test_buffers_ask_for_huge_pages():
    with reused_buffers():
        assert "hg" in flags(reusable_tensor(SHAPE, LIKE).data_ptr())


def test_an_unreferenced_buffer_is_reused():
    with reused_buffers():
        assert address() == address()


@pytest.mark.parametrize(
    "hold",
    [
        lambda tensor: tensor,
        lambda tensor: tensor[5:6, 1],
        lambda tensor: tensor.detach(),
        lambda tensor: tensor.numpy(),
        lambda tensor: (
            torch.ones_like(tensor, requires_grad=True) * tensor
        ).sum(),  # autograd saves the tensor
    ],
)
def test_a_referenced_buffer_is_not_reused(hold):
    with reused_buffers():
        first = reusable_tensor(SHAPE, LIKE).fill_(7.0)
        held, where = hold(first), first.data_ptr()
        del first
        others = [reusable_tensor(SHAPE, LIKE).fill_(1.0) for _ in range(3)]
        assert where not in [other.data_ptr() for other in others]
    del others
    with reused_buffers():
        assert address() != where
    if isinstance(held, torch.Tensor) and held.grad_fn is None:
        assert bool((held == 7.0).all())
    del held


def test_a_tensor_outlives_the_block():
    with reused_buffers():
        image = reusable_tensor(SHAPE, LIKE).fill_(3.0)
    assert bool((image == 3.0).all())


def test_buffers_that_outlive_the_block_are_freed_individually(monkeypatch):
    """A tensor that is kept, such as a displayed render, does not keep the memory of others."""
    made, mapped = [], buffers.mapped_memory
    monkeypatch.setattr(buffers, "mapped_memory", lambda nbytes: made.append(mapped(nbytes)) or made[-1])
    with reused_buffers():
        tensors = [reusable_tensor(SHAPE, LIKE) for _ in range(3)]
        waiting = reusable_tensor(SHAPE, LIKE)
        del waiting
    found = [weakref.ref(block) for block in made]
    made.clear()
    assert [ref() is not None for ref in found] == [True, True, True, False]
    del tensors[1]
    assert [ref() is not None for ref in found] == [True, False, True, False]


def test_small_buffers_and_those_outside_a_block_come_from_torch():
    with reused_buffers():
        assert reusable_tensor((LARGE // 4 - 1,), LIKE).untyped_storage().resizable()
        assert not reusable_tensor((LARGE // 4,), LIKE).untyped_storage().resizable()
    assert reusable_tensor(SHAPE, LIKE).untyped_storage().resizable()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.uint8])
def test_shape_and_dtype(dtype):
    with reused_buffers():
        made = reusable_tensor((300, 1000, 3), LIKE, dtype)
    assert made.shape == (300, 1000, 3) and made.dtype == dtype and made.is_contiguous()
    assert made.data_ptr() % 64 == 0
    assert reusable_tensor((0, 3), LIKE).shape == (0, 3)


def test_nested_blocks_share_buffers_and_threads_do_not():
    with reused_buffers():
        where = address()
        with reused_buffers():
            assert address() == where
        assert address() == where
        seen = []
        thread = threading.Thread(
            target=lambda: seen.append(reusable_tensor(SHAPE, LIKE).untyped_storage().resizable())
        )
        thread.start()
        thread.join()
        assert seen == [True], "a thread outside a block gets its memory from torch"


def test_the_pool_holds_no_more_than_the_peak_in_use():
    """Two buffers at a time have sizes that never recur, so none can be reused, and unused ones are freed."""
    pool = buffers.BufferPool()
    largest = 0
    for i in range(300):
        size = LARGE + 4096 * ((i * 7919) % 500)
        pair = [pool.take(size), pool.take(2 * size)]
        largest = max(largest, sum(-(-a.nbytes // 4096) * 4096 for a in pair))
        del pair
        # a reused buffer may be up to SLACK times as large as requested
        assert pool.nbytes <= buffers.SLACK * largest


def test_unused_buffers_are_freed_in_time():
    pool = buffers.BufferPool()
    many = [pool.take(LARGE) for _ in range(50)]
    del many
    assert pool.nbytes == 50 * LARGE
    for _ in range(2 * pool.SPAN):
        pool.take(LARGE)
    assert pool.nbytes <= 2 * LARGE


@pytest.mark.own_process
@pytest.mark.skipif(sys.platform == "win32", reason="no fork")
def test_a_forked_child_has_its_own_copy():
    code = """
import os, torch
from gsplat_edu.base.buffers import reusable_tensor, reused_buffers
with reused_buffers():
    image = reusable_tensor((1000, 1000), torch.zeros(())).fill_(1.0)
    child = os.fork()
    if child == 0:
        image[:2] = 5.0
        os._exit(0)
    os.waitpid(child, 0)
    assert bool((image == 1.0).all())
"""
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=300)
