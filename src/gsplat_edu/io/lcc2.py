"""LCC2 of XGRIDS: a tree of levels of detail over files of other formats; the finest level is read.

    NAME.lcc2       JSON: "root", whose "splatFiles" are paths of PLYs, SPZs and SOGs. Each node has its "child" nodes
                    and in "data", "3dgs": which file, the first splat in it, and how many
    data/3dgs/*     the files; one may have the splats of several nodes

The leaves of the tree are the finest level. The root's "env" names a file with the background, which is always drawn.
Values and axes of all files are those of LCC, those of an SPZ too.

Source: XGRIDS' white paper on LCC2 0.0.3 (github.com/xgrids/LCC2Whitepaper): "Data Organization Format originated from
XGRIDS"; splat-transform 3.7 (MIT licence), for the axes in an SPZ.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, field

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.base.records import record_of
from gsplat_edu.io import ply, spz
from gsplat_edu.io.lcc import finest, read_document
from gsplat_edu.io.lod.codec import file_of
from gsplat_edu.io.lod.meta import DEEPEST, MOST_PARTS
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.meta import MOST_SPLATS, NAME

SUFFIXES = (".ply", ".spz", ".sog")
"""Of the files that an LCC2 names."""

DRAFT = "total_splats"
"""A field that only drafts of LCC2 have."""

_Count = Annotated[int, Meta(ge=0, le=MOST_SPLATS)]
_Index = Annotated[int, Meta(ge=0)]
_Name = Annotated[
    str,
    Meta(pattern=rf"^({NAME.pattern}/){{0,{MOST_PARTS - 1}}}{NAME.pattern}\Z(?#a path below its folder)"),
]


class Run(Struct, frozen=True):
    """Consecutive splats of a file.

    Args:
        name: Index of the file.
        start: Index of the first splat in it.
        count: Number of splats.
    """

    name: _Index
    start: _Count
    count: _Count


class _Environment(Struct, frozen=True):
    name: _Index


class _Data(Struct, frozen=True):
    splats: Run | None = field(default=None, name="3dgs")
    env: _Environment | None = None


class _Node(Struct, frozen=True):
    data: _Data | None = None
    child: dict[str, Any] | list[Any] | None = None


class _Root(_Node, frozen=True, kw_only=True):
    files: list[_Name] = field(name="splatFiles")


class _Document(Struct, frozen=True):
    root: _Root


def read(path: Path) -> Scene:
    """Read the finest level of an LCC2, and its environment.

    Args:
        path: The .lcc2.

    Returns:
        The scene, float32: file by file in the order of the leaves, the environment last.

    Raises:
        SceneFormatError: a file is missing or damaged, or the files do not fit together.
        OSError: a file cannot be read.
    """
    root = _root(path)
    runs: dict[int, list[Run]] = {}
    try:
        for run in _leaves(root):
            runs.setdefault(run.name, []).append(run)
        scenes = [_taken(path, root, file, parts) for file, parts in runs.items()]
        if root.data is not None and root.data.env is not None and root.data.env.name not in runs:
            scenes.append(_file(path, root, root.data.env.name))
        return finest(path, scenes)
    except ArgumentError as error:
        raise SceneFormatError(f"{path}: is damaged ({error}); get it again") from None


def files_of(path: Path) -> list[Path]:
    """Return the files of an LCC2 with splats, the .lcc2 first.

    Raises:
        SceneFormatError: it is damaged, or a file is missing.
        OSError: it cannot be read.
    """
    return [path, *(file_of(path, name) for name in _root(path).files)]


def _root(path: Path) -> _Root:
    """Read the root of the tree."""
    document = read_document(path)
    if isinstance(document, dict) and DRAFT in document:
        raise SceneFormatError(f"{path}: is a draft of LCC2; export the scene again with a newer program")
    try:
        root: _Root = record_of("", document, _Document).root
    except ArgumentError as error:
        raise SceneFormatError(f"{path}: is damaged ({error}); get it again") from None
    return root


def _leaves(root: _Root) -> Iterator[Run]:
    """Yield the splats of the leaves of a tree, from left to right."""
    waiting: list[tuple[_Node, int]] = [(root, 1)]
    while waiting:
        node, depth = waiting.pop()
        if depth > DEEPEST:
            raise ArgumentError(f"root: is more than {DEEPEST} nodes deep")
        below = list(node.child.values() if isinstance(node.child, dict) else node.child or ())
        waiting += [(record_of("child", child, _Node), depth + 1) for child in reversed(below)]
        if not below and node.data is not None and node.data.splats is not None:
            yield node.data.splats


def _taken(path: Path, root: _Root, file: int, runs: list[Run]) -> Scene:
    """Read the splats of some leaves from their file."""
    scene = _file(path, root, file)
    end = 0
    for run in sorted(runs, key=lambda run: (run.start, run.count)):
        if run.start < end:
            raise ArgumentError(f"{root.files[file]}: two leaves have the same splats")
        end = run.start + run.count
    if end > len(scene.gaussians):
        raise ArgumentError(f"{root.files[file]}: has fewer splats than its leaves")
    rows = np.concatenate([np.arange(run.start, run.start + run.count) for run in runs])
    return Scene(scene.gaussians[rows], scene.antialiased)


def _file(path: Path, root: _Root, index: int) -> Scene:
    """Read a file of splats, in LCC's axes."""
    if index >= len(root.files):
        raise ArgumentError(f"name: is {index}, but there are {len(root.files)} files")
    name = root.files[index]
    file, suffix = file_of(path, name), Path(name).suffix.lower()
    try:
        if suffix == ".spz":
            scene = spz.in_own_axes(file, read_bytes(file))
        elif suffix in SUFFIXES:
            scene = ply.read(file) if suffix == ".ply" else sog.read(file)
        else:
            raise ArgumentError(f"{name}: must end in {', '.join(SUFFIXES)}")
    except SceneFormatError as error:
        raise SceneFormatError(f"{path}: {name}: {str(error).removeprefix(f'{file}: ')}") from None
    return Scene(scene.gaussians, scene.antialiased)
