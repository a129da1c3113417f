"""The platforms that have a wheel, and how zig is told to compile for each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """A platform.

    Attributes:
        name: Its name on the command line.
        zig: The target for zig, with the oldest system that the module runs on.
        tag: The platform tag of the wheel.
        system: Its name in CMake.
        processor: Its processor in CMake.
        cross_cp311: Whether Python 3.11's headers of this machine serve for it. Without the stable ABI the size of
            operating-system types enters the module; Linux has the same ones on x86-64 and 64-bit ARM.
    """

    name: str
    zig: str
    tag: str
    system: str
    processor: str
    cross_cp311: bool

    @property
    def windows(self) -> bool:
        """Whether modules are DLLs, which need an import library of Python."""
        return self.system == "Windows"

    def linker_flags(self) -> str:
        """Flags of the linker: no symbol table, and Python's symbols from the process that imports the module."""
        return "-s -Wl,-undefined,dynamic_lookup" if self.system == "Darwin" else "-s"


TARGETS = (
    Target("linux-x86_64", "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64", "Linux", "x86_64", True),
    Target("linux-aarch64", "aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64", "Linux", "aarch64", True),
    Target("macos-arm64", "aarch64-macos.13.0", "macosx_13_0_arm64", "Darwin", "arm64", False),
    Target("macos-x86_64", "x86_64-macos.13.0", "macosx_13_0_x86_64", "Darwin", "x86_64", False),
    Target("windows-x86_64", "x86_64-windows-gnu", "win_amd64", "Windows", "AMD64", False),
)

WINDOWS_PYCONFIG = """\
#pragma once
#define MS_WINDOWS
#define MS_WIN32
#define MS_WIN64
#define NT_THREADS
#define HAVE_DYNAMIC_LOADING
#define HAVE_DECLSPEC_DLL
#define HAVE_STDDEF_H 1
#define HAVE_SYS_TYPES_H 1
#define HAVE_WCHAR_H 1
#define WITH_DOC_STRINGS 1
#define SIZEOF_VOID_P 8
#define SIZEOF_SIZE_T 8
#define SIZEOF_TIME_T 8
#define SIZEOF_HKEY 8
#define SIZEOF_SHORT 2
#define SIZEOF_INT 4
#define SIZEOF_LONG 4
#define SIZEOF_LONG_LONG 8
#define SIZEOF_DOUBLE 8
#define SIZEOF_FLOAT 4
#define SIZEOF_WCHAR_T 2
#define ALIGNOF_SIZE_T 8
#define ALIGNOF_MAX_ALIGN_T 8
"""
"""What Python's headers ask of a Windows machine, for modules of the stable ABI: sizes of C types in LLP64."""
