"""The validated contents of a lod-meta.json, the index of a streamed SOG.

Source: PlayCanvas' specification of streamed SOG, version 1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.reading import no_number, parse_json
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


@dataclass(frozen=True)
class Run:
    """Consecutive splats of a file.

    Args:
        file: Index of the file.
        offset: Index of the first splat in it.
        count: Number of splats.
    """

    file: int
    offset: int
    count: int


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
        document = parse_json(data, no_number)
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise SceneFormatError(f"{path}: is not JSON ({reason}); get the file again") from None
    if not isinstance(document, dict):
        _refuse(path, "is no object")
    version = document.get("version", VERSION)
    if version != VERSION or isinstance(version, bool):
        raise SceneFormatError(
            f"{path}: is a streamed SOG of another version than {VERSION}; write it again with an older program"
        )
    levels = _whole(path, document.get("lodLevels"), "lodLevels", 1, MOST_LEVELS)
    names = document.get("filenames")
    if not isinstance(names, list):
        _refuse(path, "has no list of filenames")
    filenames = tuple(_name(path, name) for name in names)
    if len(set(filenames)) < len(filenames):
        _refuse(path, "names a file twice")
    environment = document.get("environment")
    meta = LodMeta(
        levels,
        filenames,
        tuple(_regions(path, document.get("tree"), levels, len(filenames))),
        None if environment is None else _name(path, environment),
    )
    _check(path, document, meta)
    return meta


def _refuse(path: Path, what: str) -> NoReturn:
    raise SceneFormatError(f"{path}: {what}; it is damaged, get it again")


def _whole(path: Path, value: object, key: str, low: int, high: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        _refuse(path, f"has no whole number from {low} to {high} in {key}")
    return value


def _name(path: Path, name: object) -> str:
    """Check that a name leads to a meta.json inside the folder."""
    parts = name.split("/") if isinstance(name, str) else []
    if not (1 < len(parts) <= MOST_PARTS and parts[-1] == META_NAME and all(map(NAME.fullmatch, parts))):
        _refuse(path, f"names a file that is not FOLDER/{META_NAME} below its own folder")
    return "/".join(parts)


def _regions(path: Path, tree: object, levels: int, files: int) -> Iterator[Region]:
    """Yield the leaves of the tree from left to right."""
    waiting: list[tuple[object, int]] = [(tree, 1)]
    while waiting:
        node, depth = waiting.pop()
        if not isinstance(node, dict) or depth > DEEPEST:
            _refuse(path, f"has a node that is no object, or more than {DEEPEST} nodes deep")
        children, lods = node.get("children"), node.get("lods")
        if (children is None) == (lods is None):
            _refuse(path, "has a node with neither or both of children and lods")
        if children is None:
            yield _region(path, node, levels, files)
        elif isinstance(children, list) and len(children) == 2:
            waiting += [(children[1], depth + 1), (children[0], depth + 1)]
        else:
            _refuse(path, "has a node whose children are not two")


def _region(path: Path, node: dict[str, Any], levels: int, files: int) -> Region:
    lods, bound = node["lods"], node.get("bound")
    if not isinstance(lods, dict) or not isinstance(bound, dict):
        _refuse(path, "has a leaf without lods or without a bound")
    low, high = (_point(path, bound.get(key)) for key in ("min", "max"))
    if any(a > b for a, b in zip(low, high, strict=True)):
        _refuse(path, "has a leaf whose bound is inside out")
    runs = {}
    known = {str(level): level for level in range(levels)}
    for key, found in lods.items():
        if key not in known or not isinstance(found, dict):
            _refuse(path, f"has a leaf with a level outside 0 to {levels - 1}")
        runs[known[key]] = Run(
            _whole(path, found.get("file"), "file", 0, files - 1),
            _whole(path, found.get("offset"), "offset", 0, MOST_SPLATS),
            _whole(path, found.get("count"), "count", 0, MOST_SPLATS),
        )
    return Region(low, high, dict(sorted(runs.items())), _errors(node.get("errors"), levels))


def _point(path: Path, value: object) -> tuple[float, float, float]:
    if not (isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))):
        _refuse(path, "has a bound without three numbers")
    x, y, z = (float(number) for number in value)
    return x, y, z


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e39


def _errors(value: object, levels: int) -> tuple[float, ...]:
    """Read a leaf's errors; none if another program stores something else there."""
    if not (isinstance(value, list) and len(value) == levels and all(map(_is_number, value))):
        return ()
    found = tuple(float(number) for number in value)
    return found if all(number >= 0 and math.isfinite(number) for number in found) else ()


def _check(path: Path, document: dict[str, Any], meta: LodMeta) -> None:
    """Check that runs do not overlap, a file has one level, and the counts are those of the runs."""
    level_of: dict[int, int] = {}
    runs: dict[int, list[Run]] = {}
    for region in meta.regions:
        for level, run in region.runs.items():
            if level_of.setdefault(run.file, level) != level:
                _refuse(path, f"has splats of two levels in {meta.filenames[run.file]}")
            runs.setdefault(run.file, []).append(run)
    for file, name in enumerate(meta.filenames):
        end = 0
        for run in sorted(runs.get(file, []), key=lambda run: (run.offset, run.count)):
            if run.offset != end:
                _refuse(path, f"has runs in {name} that overlap or leave a gap")
            end += run.count
        if end > MOST_SPLATS:
            _refuse(path, f"has {end:,} splats in {name}, but a file has at most {MOST_SPLATS:,}")
    counts = meta.counts()
    if document.get("counts", counts) != counts or document.get("count", sum(counts)) != sum(counts):
        _refuse(path, "has counts that differ from the sums over its leaves")
