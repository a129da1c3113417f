"""Checks of a wheel before anyone installs it: its tag is true, it is small, it names no folder of the machine."""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

from wheels.binaries import macos_problems, windows_problems
from wheels.pack import record_line

MAX_BYTES = 10_000_000
ROOT = Path(__file__).resolve().parents[2]


def own_folders() -> list[str]:
    """Return the folders of this machine that a wheel must not name."""
    home = str(Path.home())
    folders = [str(ROOT), str(Path(sys.prefix).resolve()), sysconfig.get_paths()["include"]]
    return folders + ([home] if len(home) > 5 else [])


def named_folders(wheel: Path) -> list[str]:
    """List "file: folder" for every folder of this machine that a file of a wheel names."""
    found = []
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            data = archive.read(name)
            found += [f"{name}: {folder}" for folder in own_folders() if folder.encode() in data]
            if name.endswith((".so", ".pyd")):
                parts = re.findall(rb"(?:/tmp|/home|/var/folders)/[\w./-]{3,}", data)
                found += [f"{name}: {part.decode()}" for part in parts]
    return found


def wrong_hashes(wheel: Path) -> list[str]:
    """List the files of a wheel that differ from its RECORD, or are missing there."""
    with zipfile.ZipFile(wheel) as archive:
        (record,) = (name for name in archive.namelist() if name.endswith(".dist-info/RECORD"))
        stated = set(archive.read(record).decode().splitlines())
        lines = {name: record_line(name, archive.read(name)) for name in archive.namelist()}
    lines[record] = f"{record},,"
    return [name for name, line in lines.items() if line not in stated]


def foreign_imports(wheel: Path) -> list[str]:
    """List what the module of a wheel for Windows or macOS asks for that its system may lack."""
    if "-macosx_" not in wheel.name and "-win_" not in wheel.name:
        return []
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if re.fullmatch(r"gsplat_edu/_native[^/]*\.(so|pyd)", n))
        data = archive.read(name)
    minor = int(re.findall(r"-cp3(\d+)-", wheel.name)[0])
    if "-win_" in wheel.name:
        return [f"{name}: {line}" for line in windows_problems(data, minor)]
    major, lesser, processor = re.findall(r"macosx_(\d+)_(\d+)_(\w+)", wheel.stem)[0]
    found = macos_problems(data, minor, (int(major), int(lesser)), processor == "arm64")
    return [f"{name}: {line}" for line in found]


def audit(wheel: Path) -> list[str]:
    """Check the symbols of a wheel's module; return what is wrong.

    auditwheel finds the oldest glibc for Linux, abi3audit the symbols outside the stable ABI, for every system. For
    Windows and macOS, what the module imports is compared with what those systems and Python offer.
    """
    found = foreign_imports(wheel)
    folder = Path(sys.executable).parent
    if "manylinux" in wheel.name:
        done = subprocess.run(
            [folder / "auditwheel", "show", wheel], capture_output=True, text=True, check=False
        )
        policies = re.findall(r"manylinux_2_\d+_\w+", done.stdout)
        tag = wheel.stem.rsplit("-", 1)[1]
        if done.returncode or not policies:
            found.append(f"auditwheel: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
        elif _glibc(policies[0]) > _glibc(tag):
            found.append(f"auditwheel: it is {policies[0]}, but its tag says {tag}")
    if "abi3" in wheel.name:
        done = subprocess.run(
            [folder / "abi3audit", "--strict", "--summary", wheel],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            found.append(f"abi3audit: {(done.stdout + done.stderr).strip()}")
    return found


def _glibc(tag: str) -> int:
    return int(tag.split("_")[2])


def problems(wheel: Path) -> list[str]:
    """Return every reason why a wheel may not be given away; none if it may."""
    found = audit(wheel)
    if wheel.stat().st_size > MAX_BYTES:
        found.append(f"it has {wheel.stat().st_size} bytes, at most {MAX_BYTES}")
    found += [f"names a folder of this machine: {line}" for line in named_folders(wheel)]
    found += [f"differs from RECORD: {name}" for name in wrong_hashes(wheel)]
    return found
