"""Conversion between the values of an SPZ file and its bytes.

    position       24-bit fixed point with one number of fractional bits per file (version 1: float16)
    opacity        b = 255 o
    colour         b = 38.25 c + 127.5, c the coefficient of degree 0: -3.33 to 3.33
    scale          b = 16 (log s + 10): steps of 6 %
    rotation       three 10-bit components and the index of the largest (versions 1 and 2: x, y, z as a byte each)
    coefficients   b = 128 c + 128 of the higher degrees: -1 to 0.992

Values out of range are clamped before the arithmetic can overflow. Positions are not clamped: the number of fractional
bits must suit all of them.

Source: load-spz.cc and the README of Niantic's spz library.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.io.quantize import unit_quats

MAX_FRACTIONAL_BITS = 24
"""Largest number that Niantic's library accepts."""

LARGEST_FIXED = (1 << 23) - 1
"""Largest signed 24-bit integer."""

COLOR_STEPS = 0.15 * 255.0
"""Byte steps per unit of the coefficient of degree 0."""

LARGEST_SMALL = 511 * np.sqrt(2.0)
"""Steps per unit of a quaternion's three smaller components; none exceeds sqrt(1/2), which is stored as 511."""

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of (x, y, z, w) that are stored, by the index of the omitted one."""

DEGREE_1 = 3
"""SH coefficients per channel of degree 1."""

SH_KEPT = (SH_MAX_DEGREE + 1) ** 2 - 1
"""SH coefficients per channel that are read; degree 4 of versions 3 and 4 is dropped."""


def read_half(data: UInt8[np.ndarray, "N 6"]) -> Float32[np.ndarray, "N 3"]:
    """Decode the positions of version 1."""
    with np.errstate(invalid="ignore"):  # signalling NaNs; `read_scene` checks for NaN
        positions: Float32[np.ndarray, "N 3"] = np.ascontiguousarray(data).view("<f2").astype(np.float32)
    return positions


def read_fixed(data: UInt8[np.ndarray, "N 9"], bits: int) -> Float32[np.ndarray, "N 3"]:
    """Decode 24-bit positions with the given number of fractional bits, exactly."""
    padded = np.zeros((len(data), 3, 4), dtype=np.uint8)
    padded[:, :, 1:] = data.reshape(-1, 3, 3)
    fixed = padded.view("<i4")[:, :, 0] >> 8  # an arithmetic shift keeps the sign
    positions: Float32[np.ndarray, "N 3"] = (fixed * 2.0**-bits).astype(np.float32)
    return positions


def fractional_bits(positions: Float[np.ndarray, "N 3"]) -> int | None:
    """Return the largest number of fractional bits with which all positions fit; None if there is none."""
    largest = float(np.abs(positions).max(initial=0.0))
    for bits in range(MAX_FRACTIONAL_BITS, -1, -1):
        if np.rint(largest * 2.0**bits) <= LARGEST_FIXED:
            return bits
    return None


def bits_for(step: float, log_scales: Float[np.ndarray, "N 3"]) -> int:
    """Return the fewest fractional bits whose step is at most a fraction of the median scale; 0 to 24.

    Args:
        step: The fraction, above 0.
        log_scales: (N, 3) logarithms of scales, N at least 1.
    """
    wanted = -(np.log2(step) + float(np.median(log_scales)) / np.log(2.0))
    return int(np.clip(np.ceil(wanted), 0, MAX_FRACTIONAL_BITS))


def write_fixed(positions: Float[np.ndarray, "N 3"], bits: int) -> UInt8[np.ndarray, "N 9"]:
    """Encode positions as 24-bit integers with the given number of fractional bits."""
    fixed = np.rint(positions.astype(np.float64) * 2.0**bits).astype("<i4")
    return np.ascontiguousarray(fixed[:, :, None].view(np.uint8)[:, :, :3]).reshape(-1, 9)


def read_first_three(data: UInt8[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 4"]:
    """Decode rotations of versions 1 and 2 to quaternions (w, x, y, z) with w >= 0."""
    xyz = data / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def write_first_three(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 3"]:
    """Encode quaternions (w, x, y, z) of nonzero length as versions 1 and 2 do: x, y and z of that with w >= 0."""
    unit = unit_quats(quats)
    return _to_bytes(np.where(unit[:, :1] < 0, -unit[:, 1:], unit[:, 1:]) * 127.5 + 127.5)


def read_smallest_three(data: UInt8[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Decode rotations of versions 3 and 4 to quaternions (w, x, y, z) with a positive largest component.

    32 bits, from the highest: 2 for the index of the largest component in (x, y, z, w), then a sign and 9 bits of
        magnitude for each of the others, in order.
    """
    packed = np.ascontiguousarray(data).view("<u4").astype(np.int64)
    fields = packed >> np.array([20, 10, 0])
    small = (fields & 511) / LARGEST_SMALL * np.where(fields & 512, -1.0, 1.0)
    largest = packed >> 30
    quats = np.empty((len(data), 4))
    np.put_along_axis(quats, OTHERS[largest[:, 0]], small, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1, keepdims=True)))
    np.put_along_axis(quats, largest, rest, axis=1)
    return quats[:, [3, 0, 1, 2]].astype(np.float32)


def write_smallest_three(quats: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Encode quaternions (w, x, y, z) of nonzero length in 32 bits; see `read_smallest_three`."""
    unit = unit_quats(quats)[:, [1, 2, 3, 0]]
    largest = np.abs(unit).argmax(axis=1)[:, None]
    small = np.take_along_axis(unit, OTHERS[largest[:, 0]], axis=1)
    negative = (small < 0) != (np.take_along_axis(unit, largest, axis=1) < 0)
    steps = np.minimum(np.floor(np.abs(small) * LARGEST_SMALL + 0.5), 511).astype(np.int64)
    fields: Int64[np.ndarray, "N 3"] = (steps | negative.astype(np.int64) << 9) << np.array([20, 10, 0])
    packed: UInt8[np.ndarray, "N 4"] = (
        ((largest << 30) | fields.sum(axis=1, keepdims=True)).astype("<u4").view(np.uint8)
    )
    return packed


def read_colors(data: UInt8[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 1 3"]:
    """Decode colours to coefficients of degree 0."""
    coefficients: Float32[np.ndarray, "N 1 3"] = ((data - 127.5) / COLOR_STEPS).astype(np.float32)[:, None]
    return coefficients


def write_colors(sh0: Float[np.ndarray, "N 1 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Encode coefficients of degree 0 as colours."""
    return _to_bytes(np.clip(sh0[:, 0], -4, 4).astype(np.float64) * COLOR_STEPS + 127.5)


def read_scales(data: UInt8[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Decode scales to their logarithms, exactly."""
    return data.astype(np.float32) / 16 - 10


def write_scales(log_scales: Float[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Encode logarithms of scales as bytes."""
    return _to_bytes((np.clip(log_scales, -10, 6).astype(np.float64) + 10.0) * 16.0)


def read_harmonics(data: UInt8[np.ndarray, "N B"]) -> Float32[np.ndarray, "N K 3"]:
    """Decode the coefficients of the higher degrees, exactly; degree 4 is dropped."""
    kept = data.reshape(len(data), data.shape[1] // 3, 3)[:, :SH_KEPT]
    return kept.astype(np.float32) / 128 - 1


def write_harmonics(
    sh_rest: Float[np.ndarray, "N K 3"], bits: tuple[int, int] = (8, 8)
) -> UInt8[np.ndarray, "N B"]:
    """Encode the coefficients of the higher degrees as bytes.

    Args:
        sh_rest: (N, K, 3) coefficients.
        bits: Leading bits of a byte that are used, for degree 1 and for the higher degrees; zero stays zero.
    """
    steps = np.full((sh_rest.shape[1], 3), 2.0 ** (8 - bits[1]))
    steps[:DEGREE_1] = 2.0 ** (8 - bits[0])
    flat, units = np.clip(sh_rest.reshape(len(sh_rest), sh_rest.shape[1] * 3), -1, 1), steps.reshape(-1)
    return _to_bytes(np.rint(flat * (128.0 / units)) * units + 128)


def _to_bytes(values: Float[np.ndarray, "N B"]) -> UInt8[np.ndarray, "N B"]:
    clamped: UInt8[np.ndarray, "N B"] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return clamped
