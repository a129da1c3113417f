"""Durations and sizes with a unit, as people write them: 1h30m, 4GiB."""

from __future__ import annotations

import re

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.headroom import UNLIMITED

MOST_SECONDS = 1e9
"""Longest plausible duration, s: thirty years."""


def seconds_of(text: str) -> float:
    """Parse a duration such as 90, 90s, 1.5m, 2h or 1h30m.

    Args:
        text: The duration.

    Returns:
        Its seconds, above 0.

    Raises:
        ArgumentError: the text is no duration, or one of more than `MOST_SECONDS`.
    """
    match = re.fullmatch(r"(?:([\d.]+)h)?(?:([\d.]+)m)?(?:([\d.]+)s?)?", text.strip())
    try:
        hours, minutes, seconds = (float(part or 0) for part in match.groups()) if match else (0.0, 0.0, 0.0)
    except ValueError:
        hours = minutes = seconds = 0.0
    total = 3600 * hours + 60 * minutes + seconds
    if not 0 < total <= MOST_SECONDS:
        raise ArgumentError(f"{text!r} is not a duration; examples: 90s, 20m, 1h30m")
    return total


def bytes_of(text: str) -> int:
    """Parse a size such as 4GiB, 500MB or 1e9.

    Args:
        text: The size.

    Returns:
        Its bytes.

    Raises:
        ArgumentError: the text is no size, or one of 2^60 bytes or more.
    """
    match = re.fullmatch(r"([\d.]+(?:e\d+)?)\s*([kmgt]?)(i?)b?", text.strip().lower())
    try:
        number = float(match[1]) if match else -1.0
    except ValueError:
        number = -1.0
    unit = float(1024 if match and match[3] else 1000) ** " kmgt".index((match and match[2]) or " ")
    if not 0 <= number * unit < UNLIMITED:
        raise ArgumentError(f"{text!r} is not a size; examples: 4GiB, 500MB")
    return int(number * unit)
