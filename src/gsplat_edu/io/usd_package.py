"""USDZ, the package of USD, and usd-core, the library that reads and writes USD's binary layers.

A USDZ is a ZIP archive without compression, whose files begin at multiples of 64 bytes, so that programs map them into
memory. Its first file is the layer that a program opens.

Source: Pixar, "Usdz File Format Specification".
"""

from __future__ import annotations

import importlib.util
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.text import install_command

ALIGNMENT = 64
"""A file's content begins at a multiple of this, bytes."""

LOCAL_HEADER = 30
"""Bytes of the header before a file's name, in a ZIP archive."""

PADDING = struct.Struct("<HH")
"""Header of a field of zeros before a file's content: an identifier that no program assigns, and their number."""

PADDING_ID = 0x1986

EARLIEST = (1980, 1, 1, 0, 0, 0)
"""Time of the files in the package: constant, so that the same content gives the same bytes."""

LARGEST = (1 << 31) - 1
"""Bytes that `zipfile` writes without the extensions of ZIP that USDZ excludes: 2 GiB."""


def require_usd(what: str) -> None:
    """Check that usd-core is there.

    Args:
        what: What needs it, as the beginning of the message.

    Raises:
        ArgumentError: it is not installed.
    """
    if importlib.util.find_spec("pxr") is None:
        raise ArgumentError(f"{what}: needs usd-core, which is not installed: {install_command('usd')}")


def write_package(
    path: Path, files: Iterable[tuple[str, Iterable[bytes]]], advice: str, most: int = LARGEST
) -> None:
    """Write an uncompressed archive of files, each aligned by a field of zeros in its header.

    Args:
        path: Output file; parent folders are created.
        files: Name and content, in pieces, of each file.
        advice: What to do if they do not fit, for the message.
        most: Most bytes of the package.

    Raises:
        ArgumentError: the package would exceed 2 GiB.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    offset = 0
    with (
        written_aside(path) as aside,
        zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED, allowZip64=False) as archive,
    ):
        for name, pieces in files:
            entry = zipfile.ZipInfo(name, EARLIEST)
            entry.create_system = 0  # otherwise it would say on which system it was written
            offset += LOCAL_HEADER + len(name) + PADDING.size
            zeros = -offset % ALIGNMENT
            entry.extra = PADDING.pack(PADDING_ID, zeros) + bytes(zeros)
            offset += zeros
            with archive.open(entry, "w") as file:
                for piece in pieces:
                    offset += len(piece)
                    if offset > most - len(name) - (1 << 10):  # leaves room for the directory
                        raise ArgumentError(f"{path}: does not fit into the 2 GiB of a USDZ; {advice}")
                    file.write(piece)
