"""Build a wheel a second time, from a copy of the checkout in another folder, and compare the files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from wheels.pack import epoch

ROOT = Path(__file__).resolve().parents[2]

SOURCES = ("CMakeLists.txt", "LICENSE", "README.md", "native", "pyproject.toml", "src", "tools")
"""What a wheel is made from."""


def differences(first: Path, second: Path) -> list[str]:
    """List what differs between two wheels: files of one, files with other bytes, or else the way they are packed."""
    if first.read_bytes() == second.read_bytes():
        return []
    with zipfile.ZipFile(first) as one, zipfile.ZipFile(second) as other:
        names, others = set(one.namelist()), set(other.namelist())
        found = [name for name in sorted(names & others) if one.read(name) != other.read(name)]
    return sorted(names ^ others) + found or ["the order, the times or the compression of the files"]


def built_again(target: str) -> tuple[tempfile.TemporaryDirectory[str], list[Path]]:
    """Build the wheels of a target in a temporary folder, with no cache of zig's.

    Args:
        target: Name of the target.

    Returns:
        The folder, which is removed when it is closed, and the wheels in it.

    Raises:
        RuntimeError: the build failed; the message is its output.
    """
    made = tempfile.TemporaryDirectory(prefix="gsplat-edu-built-again-")
    copy = Path(made.name) / "another" / "checkout"
    copy.mkdir(parents=True)
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copyfile(ROOT / name, copy / name)
    caches = {f"ZIG_{kind}_CACHE_DIR": str(copy.parent / kind) for kind in ("GLOBAL", "LOCAL")}
    env = os.environ | caches | {"SOURCE_DATE_EPOCH": str(epoch())}
    words = [sys.executable, copy / "tools" / "build_wheels.py", "--targets", target]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        text = done.stdout + done.stderr
        made.cleanup()
        raise RuntimeError(text.strip())
    return made, sorted((copy / "dist").glob("*.whl"))


def unrepeated(target: str, out: Path) -> list[str]:
    """Build the wheels of a target again; return what differs from those in `out`, one line per wheel.

    Raises:
        RuntimeError: the second build failed.
    """
    made, wheels = built_again(target)
    with made:
        found = {wheel.name: differences(out / wheel.name, wheel) for wheel in wheels}
    return [f"{name}: {', '.join(names)}" for name, names in found.items() if names]
