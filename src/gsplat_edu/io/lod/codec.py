"""PlayCanvas' streamed SOG: a scene at several levels of detail, in files that a viewer loads on demand.

    FOLDER/lod-meta.json     the tree of regions, and where the splats of each region and level are
    FOLDER/0_0/meta.json ... an unzipped SOG: level 0, the finest, file 0

A file has splats of one level, and those of a leaf of the tree are consecutive, in Morton order. The name lod-meta.json
is fixed; other names come from the list in it. `gsplat_edu.io.lod.levels` makes the levels and their errors.

Boxes enclose the ellipsoids of one standard deviation of all levels, as PlayCanvas' converter does. Axes and values are
those of SOG. A scene read back is its finest level, with the environment (splats that are always drawn) of files of
other programs.

Source: PlayCanvas' specification of streamed SOG, version 1; its splat-transform, for the boxes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import named_failure, written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.edit import joined
from gsplat_edu.io.lod.levels import Branch, Leaf, LodOptions, Node, build_levels, counts_of, leaves_of
from gsplat_edu.io.lod.meta import LodMeta, from_json, rounded, to_json
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.files import META_NAME
from gsplat_edu.scene.gaussians import Gaussians


def read_index(path: Path) -> LodMeta:
    """Read a lod-meta.json.

    Args:
        path: The file.

    Raises:
        SceneFormatError: it is damaged, or of another version.
        OSError: it cannot be read.
    """
    data = read_bytes(path)
    refuse_lfs_pointer(path, data)
    return from_json(path, data)


def read(path: Path) -> Scene:
    """Read the finest level of a streamed SOG, and its environment.

    Args:
        path: The lod-meta.json.

    Returns:
        The scene, float32, in this package's axes.

    Raises:
        SceneFormatError: a file is missing or damaged, or the files do not fit together.
        OSError: a file cannot be read.
    """
    return read_level(path, read_index(path), 0)


def read_level(path: Path, index: LodMeta, level: int) -> Scene:
    """Read one level of a streamed SOG, and its environment.

    Args:
        path: The lod-meta.json.
        index: Its contents.
        level: The level; 0 is the finest.

    Returns:
        The scene, float32, in this package's axes.

    Raises:
        SceneFormatError: as for `read`.
        OSError: a file cannot be read.
    """
    sizes = index.sizes()
    names = [(index.filenames[file], sizes[file]) for file in index.files_of(level)]
    if index.environment is not None:
        names.append((index.environment, -1))
    scenes = []
    for name, size in names:
        file = file_of(path, name)
        try:
            count = sog.read_meta(file).count
            if size not in (-1, count):
                raise SceneFormatError(
                    f"holds {count:,} splats, where the index has {size:,}; get both again"
                )
            scenes.append(sog.read(file))
        except SceneFormatError as error:
            raise SceneFormatError(f"{path}: {name}: {str(error).removeprefix(f'{file}: ')}") from None
    if not scenes:
        raise SceneFormatError(f"{path}: has no splats at level {level}; get it again")
    if len({scene.antialiased for scene in scenes} - {None}) > 1:
        raise SceneFormatError(f"{path}: has files that differ in antialiasing; get it again")
    return joined(scenes)


def file_of(path: Path, name: str) -> Path:
    """Return the file that a lod-meta.json names.

    Args:
        path: The lod-meta.json.
        name: The name, relative to its folder.

    Raises:
        SceneFormatError: there is no such file, or a link leads out of the folder.
    """
    folder = path.resolve().parent
    file = folder / name
    if not file.is_file():
        raise SceneFormatError(f"{path}: {name} is missing; get the whole folder again")
    if not file.resolve().is_relative_to(folder):
        raise SceneFormatError(f"{path}: {name} leads out of its folder; copy the files themselves")
    return path.parent / name


def named_files(path: Path) -> dict[str, Path]:
    """Return all files of a streamed SOG by their name in the folder, lod-meta.json first.

    Args:
        path: The lod-meta.json.

    Raises:
        SceneFormatError: a file is missing or damaged.
        OSError: a file cannot be read.
    """
    index = read_index(path)
    found = {path.name: path}
    for name in (*index.filenames, *([index.environment] if index.environment else [])):
        found[name] = file_of(path, name)
        try:
            images = sog.read_meta(found[name]).images
        except SceneFormatError as error:
            raise SceneFormatError(f"{path}: {name}: {str(error).removeprefix(f'{found[name]}: ')}") from None
        for image in images:
            beside = name.removesuffix(META_NAME) + image
            found[beside] = file_of(path, beside)
    return found


def stored_bytes(path: Path) -> int:
    """Return the size of all files of a streamed SOG, in bytes."""
    return sum(file.stat().st_size for file in named_files(path).values())


def write(path: Path, scene: Scene, options: LodOptions | None = None) -> None:
    """Write a streamed SOG.

    Args:
        path: Its lod-meta.json; the other files are written into folders next to it.
        scene: The scene, in this package's axes.
        options: Sizes of levels and files; None for the usual ones.

    Raises:
        ArgumentError: as for a SOG.
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    options = options or LodOptions()
    scene.gaussians.check_finite()
    write_levels(path, build_levels(scene.gaussians, options), scene, options.chunk)


def write_levels(
    path: Path, root: Node, scene: Scene, chunk: int, on_file: Callable[[int, int], None] | None = None
) -> None:
    """Write the levels of a scene as a streamed SOG; all files under temporary names, then renamed, the index last.

    Args:
        path: Its lod-meta.json.
        root: The tree with the levels.
        scene: The scene, for its metadata.
        chunk: Most splats of a file.
        on_file: Called after each file with the number of splats written so far, and that of all levels.

    Raises:
        ArgumentError: as for a SOG.
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    leaves = leaves_of(root)
    counts = counts_of(leaves)
    files = _files(leaves, chunk)
    tree = _described(root, _placed(files, len(leaves)))
    done = 0
    with ExitStack() as stack:  # exits in reverse order of entering
        aside = stack.enter_context(written_aside(path))
        with named_failure(path):
            aside.write_bytes(to_json(tree, [name for name, _, _ in files], counts))
        for name, level, members in files:
            gaussians = Gaussians.concatenated([leaves[i].levels[level] for i in members])
            for file, data in sog.packed(replace(scene, gaussians=gaussians), sort=False).items():
                place = path.parent / name.removesuffix(META_NAME) / file
                aside = stack.enter_context(written_aside(place))
                with named_failure(place):
                    aside.write_bytes(data)
            done += len(gaussians)
            if on_file is not None:
                on_file(done, sum(counts))


Contents = tuple[str, int, list[int]]
"""A file: its name, its level, and the leaves whose splats it has."""


def _files(leaves: list[Leaf], chunk: int) -> list[Contents]:
    """Distribute the leaves over files, level by level, from left to right."""
    files: list[Contents] = []
    for level in range(len(leaves[0].levels)):
        number, room = 0, 0
        for index, leaf in enumerate(leaves):
            count = len(leaf.levels[level])
            if not number or count > room:
                files.append((f"{level}_{number}/{META_NAME}", level, []))
                number, room = number + 1, chunk
            files[-1][2].append(index)
            room -= count
    return files


def _placed(files: list[Contents], leaves: int) -> list[dict[int, int]]:
    """Return for each leaf the file of each level."""
    placed: list[dict[int, int]] = [{} for _ in range(leaves)]
    for number, (_, level, members) in enumerate(files):
        for index in members:
            placed[index][level] = number
    return placed


def _described(root: Node, placed: list[dict[int, int]]) -> dict[str, Any]:
    """Return the tree as lod-meta.json has it."""
    ends: dict[int, int] = {}
    numbers = iter(range(len(placed)))

    def described(node: Node) -> dict[str, Any]:
        if isinstance(node, Branch):
            children = [described(child) for child in node.children]
            low = np.min([child["bound"]["min"] for child in children], axis=0)
            high = np.max([child["bound"]["max"] for child in children], axis=0)
            return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}
        files = placed[next(numbers)]
        lods = {}
        for level, gaussians in enumerate(node.levels):
            offset = ends.get(files[level], 0)
            lods[str(level)] = {"file": files[level], "offset": offset, "count": len(gaussians)}
            ends[files[level]] = offset + len(gaussians)
        return {
            "bound": {"min": _outward(node.low, -np.inf), "max": _outward(node.high, np.inf)},
            "lods": lods,
            "errors": [rounded(error) for error in node.errors],
        }

    return described(root)


def _outward(corner: Float64[np.ndarray, "3"], side: float) -> list[float]:
    """Round to the digits of the format, away from the inside of the box."""
    rounded_corner = []
    for value in corner.tolist():
        near = rounded(value)
        if (near > value) if side < 0 else (near < value):
            near = rounded(near + math.copysign(abs(value) * 1e-6, side))
        rounded_corner.append(near)
    return rounded_corner
