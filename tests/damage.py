"""Damage to files, at random places, for the fuzzers."""

import json

import numpy as np

from checkpoints import changed_json, spelled


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage some bytes: flip bits, change numbers, or delete, repeat, randomise or truncate pieces."""
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        # half of the damage is in the region of the headers
        reach = len(damaged) if rng.random() < 0.5 else min(len(damaged), 400)
        if reach < 2:
            break
        at = int(rng.integers(0, reach))
        span = min(int(rng.integers(1, 65)), len(damaged) - at)
        match int(rng.integers(0, 7)):
            case 0:
                damaged[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                damaged[at] = int(rng.integers(0, 256))
            case 2:
                damaged[at : at + 4] = rng.choice(
                    [b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f"]
                )
            case 3:
                del damaged[at : at + span]
            case 4:
                damaged[at:at] = damaged[at : at + span]
            case 5:
                damaged[at : at + span] = rng.bytes(span)
            case 6:
                del damaged[at:]
    return bytes(damaged)


def damaged_json(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage bytes of a JSON text, or one of its values."""
    if rng.random() < 0.3:
        raw = bytearray(data)
        for at in rng.integers(0, len(raw), rng.integers(1, 4)):
            raw[at] = int(rng.choice([rng.integers(0, 256), *b'0123456789"[]{},:-./\\']))
        return bytes(raw[: int(rng.integers(0, len(raw)))] if rng.random() < 0.1 else raw)
    return spelled(changed_json(json.loads(data), rng), rng).encode("utf-8", "replace")


def damaged_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace words of a text by numbers that a reader may not expect, or damage its bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(data, rng)
    lines = data.decode().split("\n")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(lines)))
        words = lines[at].split(" ")
        words[int(rng.integers(0, len(words)))] = str(rng.choice(ODD_WORDS))
        lines[at] = " ".join(words)
    return "\n".join(lines).encode()


ODD_WORDS = ("", "nan", "inf", "-inf", "1e400", "-1", "0", "1", "2", "99", "0.5", "1e-320", "3e38", "1e13")
ODD_WORDS += (
    "4294967295",
    "18446744073709551615",
    "18446744073709551616",
    "9" * 400,
    "9" * 5000,
    "1_0",
    "٣",
    "x",
    "#",
)
ODD_WORDS += (
    "PINHOLE",
    "OPENCV",
    "SIMPLE_RADIAL",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
