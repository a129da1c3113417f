"""Describe the machine of a measurement and store the result.

Importing this module puts the repository's root on the path, so that benchmarks can import `lab.captures`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from pathlib import Path
from typing import Any

import torch

from gsplat_edu import _native

sys.path.append(str(Path(__file__).resolve().parents[1]))


def describe() -> dict[str, str | int]:
    """Return the machine and the versions that affect a measurement."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line for line in lines if "model name" in line]
    return {
        "processor": names[0].split(":", 1)[1].strip() if names else platform.processor(),
        "cores": os.cpu_count() or 0,
        "isa": _native.isa(),
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "system": platform.platform(terse=True),
    }


def parser(description: str) -> argparse.ArgumentParser:
    """Return the argument parser of a benchmark."""
    made = argparse.ArgumentParser(description=description)
    add_options(made)
    return made


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options common to all benchmarks."""
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument(
        "--smoke",
        action="store_true",
        help="run everything once at a tiny size as a test; the figures are meaningless",
    )


def report(result: dict[str, Any], out: Path | None) -> None:
    """Print the machine; write everything to `out` if it is given."""
    result = {"hardware": describe(), **result}
    print(", ".join(f"{key}: {value}" for key, value in result["hardware"].items()))
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=2) + "\n")
