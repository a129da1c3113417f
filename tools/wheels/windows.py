"""What a module for Windows is compiled and linked with: Python's headers and the import library of python3.dll."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from wheels.targets import WINDOWS_PYCONFIG


def stable_symbols(minor: int) -> list[str]:
    """Return the lines of a .def file for what python3.dll of Python 3.`minor` exports: the stable ABI."""
    from abi3info import DATAS, FUNCTIONS

    def there(entry: object) -> bool:
        macro = getattr(entry, "ifdef", None)
        version = getattr(entry, "added")  # noqa: B009 - abi3info's classes share no base
        return (macro is None or bool(macro.windows is True)) and (version.major, version.minor) <= (3, minor)

    functions = {symbol.name for symbol, entry in FUNCTIONS.items() if there(entry)}
    data = {symbol.name for symbol, entry in DATAS.items() if there(entry)}
    return sorted({*functions, *(f"{name} DATA" for name in data)})


def windows_python(folder: Path, include: Path, minor: int) -> list[str]:
    """Write Python's headers for Windows and import libraries; return CMake's options for them.

    The headers are those of this machine's Python but for pyconfig.h. Only the stable ABI can be linked: a function
    outside it is an undefined symbol, as Windows would find at import.

    Args:
        folder: The folder to write to; what it held is removed.
        include: Headers of CPython 3.`minor` of this machine.
        minor: The minor version of that Python.

    Raises:
        RuntimeError: If zig's dlltool fails; the message is its own.
    """
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(include, folder / "include")
    (folder / "include" / "pyconfig.h").write_text(WINDOWS_PYCONFIG)
    definition = folder / "python3.def"
    lines = [f"    {line}" for line in stable_symbols(minor)]
    definition.write_text("\n".join(["LIBRARY python3.dll", "EXPORTS", *lines, ""]))
    sabi = folder / "libpython3.a"
    words = [sys.executable, "-m", "ziglang", "dlltool", "-m", "i386:x86-64", "-d", definition, "-l", sabi]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"dlltool: {done.stderr.strip() or done.returncode}")
    # CMake wants a library of the full version too and reads the version off its name; the module never links it.
    full = folder / f"libpython3{minor}.a"
    shutil.copyfile(sabi, full)
    for name in ("python3.dll", f"python3{minor}.dll"):
        # Empty: CMake takes a library without a DLL beside it for a static one, and adds this machine's own libraries.
        (folder / name).touch()
    return [
        f"-DPython_INCLUDE_DIR={folder / 'include'}",
        f"-DPython_LIBRARY={full}",
        f"-DPython_SABI_LIBRARY={sabi}",
    ]
