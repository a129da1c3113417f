"""Checks of a checkpoint's contents before any of them is used.

Each check raises an `ArgumentError` that names the entry. A checkpoint may be damaged, belong to another run, or be
malicious.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError

GENERATOR_LAYOUT = "<QiiQ"
"""Start of a torch CPU generator's state: seed, numbers left before the next block, whether seeded, next index."""

GENERATOR_BLOCK = 624
"""Numbers in a block of the Mersenne Twister."""

GENERATOR_FLAGS = 5052
"""Offset of the state's last flag, a C++ bool: whether a normal number is cached."""


def check_entries(name: str, given: object, names: Sequence[str]) -> dict[str, Any]:
    """Check that a value is an object with exactly these entries, and return it."""
    if not isinstance(given, dict):
        raise ArgumentError(f"{name}: has to be an object, got {type(given).__name__}")
    if missing := sorted(set(names) - set(given)):
        raise ArgumentError(f"{name}: {missing[0]} is missing")
    if unknown := sorted(set(given) - set(names)):
        raise ArgumentError(f"{name}: {unknown[0][:60]!r} is unknown")
    return given


def check_tensor_kind(name: str, given: Tensor, dtype: torch.dtype, shape: Sequence[int]) -> None:
    """Check that a tensor has this dtype and shape."""
    if given.dtype != dtype or tuple(given.shape) != tuple(shape):
        raise ArgumentError(
            f"{name}: is {given.dtype} of shape {tuple(given.shape)}, but has to be {dtype} of shape {tuple(shape)}"
        )


def check_not_negative(name: str, given: Tensor) -> None:
    """Check that no entry is below zero; NaN passes."""
    if bool((given < 0).any()):
        raise ArgumentError(f"{name}: holds negative numbers")


def check_statistics(tensors: Mapping[str, Tensor], like: Tensor) -> None:
    """Check that per-Gaussian sums and maxima have this tensor's dtype and shape and are not negative."""
    for name, tensor in tensors.items():
        check_tensor_kind(f"density.{name}", tensor, like.dtype, like.shape)
        check_not_negative(f"density.{name}", tensor)


def check_torch_generator(name: str, state: Tensor, generator: torch.Generator) -> None:
    """Check a state of torch's CPU generator.

    torch checks each number of the state, but not that they are consistent: if a state claims more remaining numbers
    than there are, torch reads past the end of its buffer.
    """
    check_tensor_kind(name, state, torch.uint8, generator.get_state().shape)
    data = state.contiguous().numpy().tobytes()
    _, left, seeded, following = struct.unpack_from(GENERATOR_LAYOUT, data)
    fresh = (left, following) == (1, 0)
    agree = 1 <= left <= GENERATOR_BLOCK and left + following == GENERATOR_BLOCK + 1
    if seeded != 1 or not (fresh or agree) or data[GENERATOR_FLAGS] > 1:
        raise ArgumentError(f"{name}: is not the state of a generator")


def check_numpy_generator(name: str, state: object, generator: np.random.Generator) -> None:
    """Check a state of NumPy's PCG64, the generator that `default_rng` creates."""
    kind = generator.bit_generator.state["bit_generator"]
    given = check_entries(name, state, ("bit_generator", "state", "has_uint32", "uinteger"))
    if given["bit_generator"] != kind:
        raise ArgumentError(f"{name}: bit_generator has to be {kind}")
    numbers = check_entries(f"{name}: state", given["state"], ("state", "inc"))
    for part in ("state", "inc"):
        check_whole(f"{name}: state: {part}", numbers[part], 2**128 - 1)
    if numbers["inc"] % 2 == 0:
        raise ArgumentError(f"{name}: state: inc has to be odd")
    check_whole(f"{name}: has_uint32", given["has_uint32"], 1)
    check_whole(f"{name}: uinteger", given["uinteger"], 2**32 - 1)


def check_whole(name: str, given: object, most: int) -> int:
    """Check a whole number from 0 to `most`. The message omits it, since it may have thousands of digits."""
    if type(given) is not int or not 0 <= given <= most:
        raise ArgumentError(f"{name}: has to be a whole number from 0 to {most}")
    return given


def check_flag(name: str, given: object) -> bool:
    """Check that a value is true or false."""
    if not isinstance(given, bool):
        raise ArgumentError(f"{name}: has to be true or false")
    return given
