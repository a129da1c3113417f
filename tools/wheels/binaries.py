"""What a module for Windows or macOS asks of the system that imports it, read from the file.

Those systems are not here: without this check, users would be the first to meet a missing function or library.
On Linux auditwheel reads the same from the ELF file.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

WINDOWS_LIBRARIES = re.compile(r"python3\.dll|kernel32\.dll|api-ms-win-crt-[a-z]+-l1-1-0\.dll")
"""What every Windows has from 10 on, and what a Python brings along."""

MACOS_LIBRARY = "/usr/lib/libSystem.B.dylib"
MACHO_64, DYLIB, UNDEFINED, ANY_LIBRARY = 0xFEEDFACF, 6, 0, 0xFE
SYMTAB, LOAD_DYLIB, CODE_SIGNATURE, BUILD_VERSION = 0x2, 0xC, 0x1D, 0x32


def stable_abi(minor: int) -> set[str]:
    """Return the names of functions and data in the stable ABI of Python 3.`minor`."""
    from abi3info import DATAS, FUNCTIONS

    return {
        symbol.name
        for entries in (FUNCTIONS, DATAS)
        for symbol, entry in entries.items()
        if (entry.added.major, entry.added.minor) <= (3, minor)
    }


def windows_problems(data: bytes, minor: int) -> list[str]:
    """List what a .pyd asks of Windows or of python3.dll that they may lack."""
    import pefile

    file = pefile.PE(data=data)
    found = []
    if file.FILE_HEADER.Machine != pefile.MACHINE_TYPE["IMAGE_FILE_MACHINE_AMD64"]:
        found.append("is not for x86-64")
    for entry in file.DIRECTORY_ENTRY_IMPORT:
        library = entry.dll.decode()
        if not WINDOWS_LIBRARIES.fullmatch(library.lower()):
            found.append(f"imports {library}")
        if library.lower() == "python3.dll":
            names = {symbol.name.decode() for symbol in entry.imports}
            found += [f"{name} is not in python3.dll" for name in sorted(names - stable_abi(minor))]
    table = getattr(file, "DIRECTORY_ENTRY_EXPORT", None)
    exported = {symbol.name for symbol in table.symbols} if table else set()
    return found + ([] if b"PyInit__native" in exported else ["does not export PyInit__native"])


@dataclass
class _MachO:
    kind: int
    libraries: list[str]
    oldest: tuple[int, int]
    signed: bool
    asked: dict[str, int]  # names of other libraries, and the number of the library or ANY_LIBRARY
    offered: set[str]


def _macho(data: bytes) -> _MachO:
    magic, _, _, kind, commands, _ = struct.unpack_from("<6I", data)
    if magic != MACHO_64:
        raise ValueError("it is no 64-bit Mach-O file")
    file = _MachO(kind, [], (0, 0), False, {}, set())
    at = 32
    for _ in range(commands):
        command, size = struct.unpack_from("<2I", data, at)
        if command == LOAD_DYLIB:
            (name,) = struct.unpack_from("<I", data, at + 8)
            file.libraries.append(data[at + name : at + size].split(b"\0", 1)[0].decode())
        elif command == BUILD_VERSION:
            (version,) = struct.unpack_from("<I", data, at + 12)
            file.oldest = (version >> 16, version >> 8 & 255)
        elif command == CODE_SIGNATURE:
            file.signed = True
        elif command == SYMTAB:
            _symbols(data, struct.unpack_from("<4I", data, at + 8), file)
        at += size
    return file


def _symbols(data: bytes, table: tuple[int, ...], file: _MachO) -> None:
    start, count, strings, size = table
    names = data[strings : strings + size]
    for index in range(count):
        name_at, kind, _, more, _ = struct.unpack_from("<IBBHQ", data, start + 16 * index)
        if kind & 0xE0 or not kind & 1:  # of the debugger, or local
            continue
        name = names[name_at:].split(b"\0", 1)[0].decode()
        if kind & 0xE == UNDEFINED:
            file.asked[name] = more >> 8
        else:
            file.offered.add(name)


def system_symbols() -> set[str]:
    """Return the names that libSystem exports on either processor, by the list that zig ships."""
    import ziglang

    text = (Path(ziglang.__file__).parent / "lib" / "libc" / "darwin" / "libSystem.tbd").read_text()
    return set(re.findall(r"[_$\w]+", text))


def macos_problems(data: bytes, minor: int, oldest: tuple[int, int], arm: bool) -> list[str]:
    """List what a module asks of macOS or of Python that they may lack.

    Args:
        data: The module.
        minor: The oldest Python is 3.`minor`.
        oldest: The macOS that the wheel's tag names.
        arm: Whether it is for Apple's own processors, which run signed code only.
    """
    file = _macho(data)
    found = [f"loads {name}" for name in file.libraries if name != MACOS_LIBRARY]
    if file.kind != DYLIB:
        found.append("is no dynamic library")
    if file.oldest > oldest:
        found.append(f"needs macOS {file.oldest[0]}.{file.oldest[1]}")
    if arm and not file.signed:
        found.append("is not signed")
    system, python = system_symbols(), stable_abi(minor)
    for name, library in sorted(file.asked.items()):
        of_python = library in (0, ANY_LIBRARY)
        if (name.removeprefix("_") not in python) if of_python else (name not in system):
            found.append(f"{name} is not in {'the stable ABI' if of_python else 'libSystem'}")
    return found + ([] if "_PyInit__native" in file.offered else ["does not export PyInit__native"])
