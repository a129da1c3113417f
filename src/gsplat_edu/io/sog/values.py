"""Conversion between a SOG's values without codebook and bytes.

    position   v = sign(x) log(1 + |x|); 65535 (v - low) / (high - low), 16 bits a coordinate in two bytes
    rotation   the three smaller of (w, x, y, z), 255 (q / sqrt 2 + 1/2), and 252 + the index of the largest

Source: PlayCanvas' specification of SOG, sections 3.1 and 3.2.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16

STEPS = 65_535
"""Steps from the lowest to the highest value of a coordinate."""

FIRST_TAG = 252
"""Alpha of a rotation in which w is the largest component."""

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of (w, x, y, z) that are stored, by the index of the omitted one."""

LARGEST_LOG = float(np.log1p(np.finfo(np.float32).max)) + 1e-9
"""Logarithm of the largest float32 position, plus a margin too small to round to infinity."""

Range = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]
"""Lowest and highest logarithm of each coordinate."""


def positions_to_steps(means: Float32[np.ndarray, "N 3"]) -> tuple[UInt16[np.ndarray, "N 3"], Range]:
    """Quantise positions between the lowest and the highest value of each coordinate.

    Args:
        means: N positions, world units.

    Returns:
        The steps and their range; zeros if there are no positions.
    """
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = (logs.min(axis=0), logs.max(axis=0)) if len(logs) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, high - low, 1.0)
    steps = np.floor(STEPS * (logs - low) / width + 0.5).astype(np.uint16)
    return steps, (low, high)


def steps_to_positions(steps: UInt16[np.ndarray, "N 3"], span: Range) -> Float32[np.ndarray, "N 3"]:
    """Convert steps of a range, whose ends are within +-`LARGEST_LOG`, to positions, world units."""
    low, high = span
    logs = low + (high - low) * (steps / STEPS)
    return (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)


def quats_to_pixels(quats: Float32[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Encode quaternions (w, x, y, z) of nonzero length as pixels."""
    scaled = quats.astype(np.float64)  # whose squares neither overflow nor underflow
    unit = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)[:, None]
    unit *= np.where(np.take_along_axis(unit, largest, axis=1) < 0, -1.0, 1.0)
    small = np.take_along_axis(unit, OTHERS[largest[:, 0]], axis=1)
    stored = np.floor(255.0 * (small / np.sqrt(2.0) + 0.5) + 0.5)
    return np.concatenate([stored, FIRST_TAG + largest], axis=1).astype(np.uint8)


def pixels_to_quats(pixels: UInt8[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Decode pixels, whose alpha is 252 to 255, to quaternions (w, x, y, z) with a positive largest component."""
    small = (pixels[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    largest = pixels[:, 3:].astype(np.int64) - FIRST_TAG
    quats = np.empty((len(pixels), 4))
    np.put_along_axis(quats, OTHERS[largest[:, 0]], small, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1, keepdims=True)))
    np.put_along_axis(quats, largest, rest, axis=1)
    return quats.astype(np.float32)
