"""Scan and sort against NumPy, exactly: they compute with whole numbers.

Sizes are around those of a run (8 keys), a block (1,024) and a block of block sums (1,024 x 1,024). Buffers begin with
noise, so that nothing relies on zeros.
"""

import numpy as np
import pytest

from gsplat_edu.engine import host
from gsplat_edu.engine.check import sort_and_scan
from gsplat_edu.engine.passes import LIMITS, Program, sort

LIVE, SPARE, TOTAL = 0, 1, 2
SIZES = (0, 1, 7, 8, 9, 1023, 1024, 1025, 8191, 8193, 2**16 - 1, 2**16, 2**16 + 1, 10**5)


def program(bits):
    parts = sort_and_scan()
    if bits == 32:
        return parts
    return Program(parts.buffers, {"sort": sort("keys", "values", "spare", "keys", LIVE, bits, SPARE)})


def allocated(device, capacity, bits=32):
    return device.allocate(program(bits), {"keys": capacity, "live": 3}, poison=True)


def sorted_on(memory, keys):
    memory.write("live", np.array([len(keys), 0, 0], dtype=np.uint32))
    memory.write("keys", keys)
    memory.write("values", np.arange(len(keys), dtype=np.uint32))
    found = memory.play("sort", read=("keys", "values"))
    return found["keys"][: len(keys)], found["values"][: len(keys)]


def keys_of(kind, count, bits=32):
    rng = np.random.default_rng(count)
    keys = rng.integers(0, 2**bits, count, dtype=np.uint32)
    if kind == "equal":
        keys[:] = 0xFFFFFFFF >> (32 - bits)
    if kind in ("sorted", "reversed"):
        keys.sort()
    if kind == "reversed":
        keys = keys[::-1].copy()
    if kind == "few":
        keys %= 3
    return keys


@pytest.mark.parametrize("kind", ["random", "equal", "sorted", "reversed", "few"])
@pytest.mark.parametrize("count", SIZES)
def test_sort_is_numpy_s_stable_one(device, count, kind):
    keys = keys_of(kind, count)
    ours, values = sorted_on(allocated(device, count), keys)
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(ours, keys[order])
    np.testing.assert_array_equal(values, order)


@pytest.mark.parametrize("kind", ["random", "equal"])
def test_a_million(device, kind):
    keys = keys_of(kind, 10**6)
    if kind == "random":
        keys[::3] = 12345
    memory = allocated(device, len(keys))
    ours, values = sorted_on(memory, keys)
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(ours, keys[order])
    np.testing.assert_array_equal(values, order)
    again = sorted_on(memory, keys)
    np.testing.assert_array_equal(ours, again[0])
    np.testing.assert_array_equal(values, again[1])


@pytest.mark.parametrize("bits", [1, 4, 5, 8, 9, 17])
def test_only_the_bits_asked_for_are_compared(device, bits):
    """Keys and values end where they began, whatever the number of digits."""
    keys = keys_of("random", 3000, bits)
    ours, values = sorted_on(allocated(device, 3000, bits), keys)
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(ours, keys[order])
    np.testing.assert_array_equal(values, order)


@pytest.mark.parametrize("count", [0, 1, 1000, 1024, 3000])
def test_fewer_keys_than_there_is_room_for(device, count):
    memory = allocated(device, 5000)
    keys = keys_of("random", count)
    ours, values = sorted_on(memory, keys)
    order = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(ours, keys[order])
    np.testing.assert_array_equal(values, order)


@pytest.mark.parametrize("count", [*SIZES, 10**6, 2**20 - 1, 2**20 + 1025])
def test_scan_is_numpy_s_sum(device, count):
    numbers = keys_of("random", count) >> 20
    memory = allocated(device, count)
    memory.write("numbers", numbers)
    found = memory.play("scan", read=("numbers", "live"))
    sums = np.concatenate([[0], np.cumsum(numbers, dtype=np.uint64)])
    assert sums[-1] < 2**32
    np.testing.assert_array_equal(found["numbers"][:count], sums[:-1])
    assert found["live"][TOTAL] == sums[-1]


@pytest.mark.parametrize("count", [2, 1025, 3 * 2**20])
def test_a_sum_that_does_not_fit_stays_at_the_largest_number(device, count):
    numbers = np.full(count, 2**31 + 5, dtype=np.uint32)
    memory = allocated(device, count)
    memory.write("numbers", numbers)
    found = memory.play("scan", read=("numbers", "live"))
    assert found["numbers"][:2].tolist() == [0, 2**31 + 5]
    assert (found["numbers"][2:count] == 2**32 - 1).all() and found["live"][TOTAL] == 2**32 - 1


def test_workgroups_beyond_a_dimension_continue_in_the_next(device):
    """As if a dimension took 7 workgroups: 30 blocks are 5 rows, the last of which has workgroups without a block."""
    folded = host.Device(limits=LIMITS, most_groups=7)
    keys = keys_of("few", 30 * 1024 - 5)
    memory = allocated(folded, len(keys))
    _, values = sorted_on(memory, keys)
    np.testing.assert_array_equal(values, np.argsort(keys, kind="stable"))
    memory.write("numbers", keys)
    found = memory.play("scan", read=("numbers", "live"))
    np.testing.assert_array_equal(found["numbers"][1:], np.cumsum(keys)[:-1])
    assert found["live"][TOTAL] == keys.sum()
