"""What a figure was measured on, and how it is kept."""

from __future__ import annotations

import argparse
import json
import os
import platform
from pathlib import Path
from typing import Any

import torch

from gsplat_edu import _native


def describe() -> dict[str, str | int]:
    """Name the machine and the versions that decide a figure."""
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
    """Make a benchmark's command line."""
    made = argparse.ArgumentParser(description=description)
    add_options(made)
    return made


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what every benchmark takes."""
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument(
        "--smoke",
        action="store_true",
        help="run everything once at a tiny size, to see that it runs; the figures mean nothing",
    )


def report(result: dict[str, Any], out: Path | None) -> None:
    """Print the machine and write everything to a file where one is named."""
    result = {"hardware": describe(), **result}
    print(", ".join(f"{key}: {value}" for key, value in result["hardware"].items()))
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=2) + "\n")
