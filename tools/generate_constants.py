"""Write the kernels' constants from src/gsplat_edu/base/constants.py, so that each is defined once.

    python tools/generate_constants.py

It writes native/constants.h and src/gsplat_edu/engine/constants.wgsl. A test compares the files with this script's
output.
"""

from __future__ import annotations

import math
from pathlib import Path

from gsplat_edu.base import constants as c

ROOT = Path(__file__).resolve().parent.parent
HEADER = ROOT / "native" / "constants.h"
WGSL = ROOT / "src" / "gsplat_edu" / "engine" / "constants.wgsl"
NAMES = (
    "DILATION",
    "DILATION_MAX",
    "THINNEST",
    "ALPHA_MIN",
    "ALPHA_MAX",
    "Z_NEAR",
    "T_STOP",
    "DET_FLOOR",
    "SPLAT_LIMIT",
    "COLOR_LIMIT",
    "RIM_SLACK",
    "C0",
    "C1",
    "C2",
    "C3",
    "SH_OFFSET",
    "SSIM_C1",
    "SSIM_C2",
    "SRGB_OFFSET",
    "NEAR_AXIS",
    "POLE",
)
WGSL_NAMES = (
    *("THINNEST", "ALPHA_MIN", "T_STOP", "DET_FLOOR", "SPLAT_LIMIT_F32", "COLOR_LIMIT", "RIM_SLACK"),
    *("C0", "C1", "C2", "C3", "SH_OFFSET", "SSIM_C1", "SSIM_C2", "NEAR_AXIS_F32", "POLE"),
)
SSIM_TAPS = 6
"""Taps of one half of SSIM's window: the central one and five on one side."""


def header() -> str:
    """Return the text of the header."""
    lines = [
        "// Made by tools/generate_constants.py from src/gsplat_edu/base/constants.py. Do not edit.",
        "// clang-format off",
        "#pragma once",
    ]
    lines += ["", "namespace gsplat {", "", f"constexpr int TILE = {c.TILE};"]
    lines += [_line(name, getattr(c, name)) for name in NAMES]
    lines += [_line(f"LOG2_{name}", math.log2(getattr(c, name))) for name in ("ALPHA_MIN", "ALPHA_MAX")]
    lines.append(_line("SSIM_TAP", ssim_taps()))
    return "\n".join([*lines, "", "}  // namespace gsplat", ""])


def ssim_taps() -> tuple[float, ...]:
    """Return one half of SSIM's window, from its middle."""
    window = [math.exp(-(k**2) / (2 * c.SSIM_SIGMA**2)) for k in range(SSIM_TAPS)]
    total = window[0] + 2 * sum(window[1:])
    return tuple(tap / total for tap in window)


def _line(name: str, value: float | tuple[float, ...]) -> str:
    if isinstance(value, tuple):
        return f"constexpr double {name}[{len(value)}] = {{{', '.join(repr(v) for v in value)}}};"
    return f"constexpr double {name} = {value!r};"


def shader() -> str:
    """Return the text of the WGSL file; entries of a tuple are numbered from 0."""
    lines = [
        "// Made by tools/generate_constants.py from src/gsplat_edu/base/constants.py. Do not edit.",
        "",
        f"const TILE = {c.TILE};",
    ]
    for name in WGSL_NAMES:
        value = getattr(c, name)
        entries = (
            {f"{name}_{k}": v for k, v in enumerate(value)} if isinstance(value, tuple) else {name: value}
        )
        lines += [_wgsl_line(*entry) for entry in entries.items()]
    logarithms = {
        "LOG2_ALPHA_MIN": math.log2(c.ALPHA_MIN),
        "LN2": math.log(2),
        "SQRT_HALF_LOG2E": math.sqrt(math.log2(math.e) / 2),
    }
    lines += [_wgsl_line(*entry) for entry in logarithms.items()]
    lines.append(
        f"const SSIM_TAP = array<f32, {SSIM_TAPS}>({', '.join(f'{tap!r}f' for tap in ssim_taps())});"
    )
    return "\n".join([*lines, ""])


def _wgsl_line(name: str, value: float) -> str:
    return f"const {name} = {value!r}f;"


if __name__ == "__main__":
    HEADER.write_text(header(), encoding="ascii")
    WGSL.write_text(shader(), encoding="ascii")
