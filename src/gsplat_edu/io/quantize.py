"""Shared by formats: values as bytes, positive scales, unit quaternions, the most that a file may claim to hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Integer, UInt8

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.validation import first_index

OPACITY_EDGE = 0.25 / 255.0
"""Bytes 0 and 255 decode to opacities this far from 0 and 1 (a quarter of a step), whose logits are finite."""

MAX_EXPANSION = 64
"""A file that claims to contain more than this multiple of its size is rejected; scenes compress to about half."""

SMALL = 1 << 20
"""Bytes that even the smallest file may claim, since test and toy scenes compress very well."""

MIN_SCALE, MAX_SCALE = (float(x) for x in (np.finfo(np.float32).smallest_subnormal, np.finfo(np.float32).max))
"""Scales are clamped to the positive range of float32, so that their logarithms are finite."""


def byte_to_logit(values: Integer[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Convert opacities stored as bytes to finite logits; `logit_to_byte` returns the same bytes.

    Args:
        values: 0 to 255.

    Returns:
        log(o / (1 - o)), with o = values / 255 kept `OPACITY_EDGE` away from 0 and 1.
    """
    opacities = np.clip(values / 255.0, OPACITY_EDGE, 1.0 - OPACITY_EDGE)
    logits: Float32[np.ndarray, "..."] = np.log(opacities / (1.0 - opacities)).astype(np.float32)
    return logits


def logit_to_byte(logits: Float32[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Convert logits to opacities rounded to bytes: floor(255 sigmoid(logit) + 1/2)."""
    with np.errstate(over="ignore"):  # exp overflows to infinity: the opacity is 0
        opacities = 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))
    rounded: UInt8[np.ndarray, "..."] = np.floor(255.0 * opacities + 0.5).astype(np.uint8)
    return rounded


def rounded_bytes(values: Float64[np.ndarray, "N C"]) -> Float64[np.ndarray, "N C"]:
    """Round to the nearest of the values 0 to 255."""
    return np.clip(np.floor(values + 0.5), 0.0, 255.0)


def unit_quats(quats: Float[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Normalise quaternions of nonzero length.

    Raises:
        ArgumentError: a quaternion has zero length.
    """
    largest = np.abs(quats.astype(np.float64)).max(axis=1, keepdims=True, initial=0.0)
    if not largest.all():
        raise ArgumentError(
            f"quats{first_index(largest[:, 0] == 0)}: has zero length, so it is not a rotation; remove the splat"
        )
    scaled = quats / largest  # first, so that the norm neither overflows nor underflows
    units: Float64[np.ndarray, "N 4"] = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    return units


def check_expansion(path: Path, claimed: int, stored: int) -> None:
    """Reject a file that claims an implausible content size, before memory is allocated for it.

    Args:
        path: The file's name for messages.
        claimed: Bytes that its contents would need.
        stored: Size of the file in bytes.

    Raises:
        SceneFormatError: it claims more than `MAX_EXPANSION` times its size, and more than `SMALL`.
    """
    if claimed > max(SMALL, MAX_EXPANSION * stored):
        raise SceneFormatError(
            f"{path}: claims to hold {claimed:,} bytes in a file of {stored:,}; it is damaged, get it again"
        )
