"""The validated contents of a lod-meta.json, the index of a streamed SOG.

Source: PlayCanvas' specification of streamed SOG, version 1.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.records import ABSENT, Absent, Record, as_json, record_of
from gsplat_edu.io.sog.files import META_NAME
from gsplat_edu.io.sog.meta import GENERATOR, MOST_SPLATS, NAME

LOD_META = "lod-meta.json"
"""The file's fixed name."""

VERSION = 1

META_LIMIT = 32 << 20
"""Largest lod-meta.json in bytes; a leaf takes about 300."""

DEEPEST = 64
"""Most nodes from the root to a leaf; a tree of 10^9 splats by medians has 15."""

MOST_LEVELS = 64
"""Most levels of detail."""

MOST_PARTS = 8
"""Most folders in a file name, plus one."""

DIGITS = 7
"""Significant digits of numbers that are not whole."""


_Count = Annotated[int, Meta(ge=0, le=MOST_SPLATS)]
_Coordinate = Annotated[float, Meta(ge=-1e39, le=1e39)]
_Name = Annotated[
    str,
    Meta(
        pattern=rf"^({NAME.pattern}/){{1,{MOST_PARTS - 1}}}{re.escape(META_NAME)}\Z"
        rf"(?#FOLDER/{META_NAME} below its own folder)"
    ),
]


class _Part(Record, frozen=True, forbid_unknown_fields=False):
    """A part of a lod-meta.json, in which other programs may store more."""


class Run(_Part, frozen=True):
    """Consecutive splats of a file.

    Args:
        file: Index of the file.
        offset: Index of the first splat in it.
        count: Number of splats.
    """

    file: Annotated[int, Meta(ge=0)]
    offset: _Count
    count: _Count


class _Bound(_Part, frozen=True):
    min: tuple[_Coordinate, _Coordinate, _Coordinate]
    max: tuple[_Coordinate, _Coordinate, _Coordinate]


class _Node(_Part, frozen=True):
    bound: Any = None
    children: tuple[Any, Any] | None = None
    lods: dict[str, Any] | None = None
    errors: Any = None


class _Document(_Part, frozen=True):
    levels: Annotated[int, Meta(ge=1, le=MOST_LEVELS)] = field(name="lodLevels")
    filenames: tuple[_Name, ...]
    tree: Any = None
    environment: _Name | None = None
    counts: list[int] | Absent = ABSENT
    count: int | Absent = ABSENT


@dataclass(frozen=True)
class Region:
    """A leaf of the tree.

    Args:
        low: Smallest coordinates of its box.
        high: Largest coordinates.
        runs: Its splats by level; a level without splats is missing.
        errors: Error of each level; empty if there are none.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    runs: dict[int, Run]
    errors: tuple[float, ...] = ()


@dataclass(frozen=True)
class LodMeta:
    """The contents of a lod-meta.json.

    Args:
        levels: Number of levels.
        filenames: The meta.json of each file, relative to the folder, with forward slashes.
        regions: The leaves of the tree, from left to right.
        environment: The meta.json of splats that belong to no level and are always drawn; None for none.
    """

    levels: int
    filenames: tuple[str, ...]
    regions: tuple[Region, ...]
    environment: str | None = None

    def counts(self) -> list[int]:
        """Return the number of splats of each level."""
        return [
            sum(region.runs[level].count for region in self.regions if level in region.runs)
            for level in range(self.levels)
        ]

    def files_of(self, level: int) -> list[int]:
        """Return the indices of the files of a level, in order."""
        return sorted({region.runs[level].file for region in self.regions if level in region.runs})

    def sizes(self) -> list[int]:
        """Return the number of splats that the runs take in each file."""
        sizes = [0] * len(self.filenames)
        for region in self.regions:
            for run in region.runs.values():
                sizes[run.file] += run.count
        return sizes


def to_json(tree: dict[str, Any], filenames: Sequence[str], counts: Sequence[int]) -> bytes:
    """Write a lod-meta.json; equal trees give equal bytes.

    Args:
        tree: The root, as the specification describes it.
        filenames: The meta.json of each file.
        counts: Number of splats of each level.
    """
    document = {
        "version": VERSION,
        "asset": {"generator": GENERATOR},
        "count": sum(counts),
        "counts": list(counts),
        "lodLevels": len(counts),
        "lodErrors": True,
        "filenames": list(filenames),
        "tree": tree,
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")


def rounded(value: float) -> float:
    """Round to the digits that the specification allows."""
    return float(f"{value:.{DIGITS}g}")


def from_json(path: Path, data: bytes) -> LodMeta:
    """Read a lod-meta.json.

    Args:
        path: The file's name for messages.
        data: Its bytes.

    Raises:
        SceneFormatError: it is not a lod-meta.json of version 1, or its parts contradict one another.
    """
    if len(data) > META_LIMIT:
        raise SceneFormatError(
            f"{path}: has {len(data):,} bytes, too many for the index of a scene; check its name"
        )
    try:
        document = parse_json(data, strict=True)
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise SceneFormatError(f"{path}: is not JSON ({reason}); get the file again") from None
    version = document.get("version", VERSION) if isinstance(document, dict) else VERSION
    if version != VERSION or isinstance(version, bool):
        raise SceneFormatError(
            f"{path}: is a streamed SOG of another version than {VERSION}; write it again with an older program"
        )
    try:
        return _read(record_of("", document, _Document))
    except ArgumentError as error:
        raise SceneFormatError(f"{path}: is damaged ({error}); get it again") from None


def _read(document: _Document) -> LodMeta:
    filenames = document.filenames
    if len(set(filenames)) < len(filenames):
        raise ArgumentError("filenames: names a file twice")
    regions = tuple(_regions(document.tree, document.levels, len(filenames)))
    meta = LodMeta(document.levels, filenames, regions, document.environment)
    _check_runs(meta)
    counts = meta.counts()
    if document.counts not in (ABSENT, counts) or document.count not in (ABSENT, sum(counts)):
        raise ArgumentError("counts: differ from the sums over its leaves")
    return meta


def _regions(tree: object, levels: int, files: int) -> Iterator[Region]:
    """Yield the leaves of the tree from left to right."""
    waiting: list[tuple[object, int]] = [(tree, 1)]
    while waiting:
        entry, depth = waiting.pop()
        if depth > DEEPEST:
            raise ArgumentError(f"tree: is more than {DEEPEST} nodes deep")
        node: _Node = record_of("node", entry, _Node)
        if (node.children is None) == (node.lods is None):
            raise ArgumentError("node: has neither or both of children and lods")
        if node.lods is not None:
            yield _region(node, node.lods, levels, files)
        waiting += [(child, depth + 1) for child in reversed(node.children or ())]


def _region(leaf: _Node, lods: dict[str, Any], levels: int, files: int) -> Region:
    bound: _Bound = record_of("node.bound", leaf.bound, _Bound)
    if any(a > b for a, b in zip(bound.min, bound.max, strict=True)):
        raise ArgumentError("node.bound: is inside out")
    runs = {}
    known = {str(level): level for level in range(levels)}
    for key, entry in lods.items():
        if key not in known:
            raise ArgumentError(f"node.lods: has a level outside 0 to {levels - 1}")
        runs[known[key]] = run = record_of(f"node.lods.{key}", entry, Run)
        if run.file >= files:
            raise ArgumentError(f"node.lods.{key}.file: is {as_json(run.file)}, but there are {files} files")
    return Region(bound.min, bound.max, dict(sorted(runs.items())), _errors(leaf.errors, levels))


def _errors(value: object, levels: int) -> tuple[float, ...]:
    """Read a leaf's errors; none if another program stores something else there."""
    try:
        errors: tuple[float, ...] = record_of("", value, tuple[Annotated[float, Meta(ge=0.0, le=1e39)], ...])
    except ArgumentError:
        return ()
    return errors if len(errors) == levels else ()


def _check_runs(meta: LodMeta) -> None:
    """Check that runs do not overlap, and a file has one level."""
    level_of: dict[int, int] = {}
    runs: dict[int, list[Run]] = {}
    for region in meta.regions:
        for level, run in region.runs.items():
            if level_of.setdefault(run.file, level) != level:
                raise ArgumentError(f"has splats of two levels in {meta.filenames[run.file]}")
            runs.setdefault(run.file, []).append(run)
    for file, name in enumerate(meta.filenames):
        end = 0
        for run in sorted(runs.get(file, []), key=lambda run: (run.offset, run.count)):
            if run.offset != end:
                raise ArgumentError(f"has runs in {name} that overlap or leave a gap")
            end += run.count
        if end > MOST_SPLATS:
            raise ArgumentError(f"has {end:,} splats in {name}, but a file has at most {MOST_SPLATS:,}")
