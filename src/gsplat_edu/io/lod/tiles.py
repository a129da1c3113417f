"""3D Tiles 1.1: a scene as a tree of tiles for Cesium, each a GLB with SPZ of version 2 in it.

    FOLDER/tileset.json      the tree; each tile with its box and geometric error
    FOLDER/tiles/0.glb ...   the splats of a tile

The tree is that of `gsplat_edu.io.lod.levels`. A tile shows all leaves below its node at one level: the finest at
which they have at most as many splats as a leaf may have. Its children replace it (refine: REPLACE). Nodes near the
root whose coarsest level has more have no content.

    geometric error = 16 max e      over the leaves below, e: error of the level shown

By default, Cesium refines tiles whose geometric error exceeds 16 pixels, and thus shows levels whose splats have moved
by about a pixel. Nodes without content have the diagonal of their box, so that they are always refined.

The tileset requires 3DTILES_content_gltf, and of glTF both KHR_gaussian_splatting and its compression_spz_2, which is
how Cesium knows splats. Accessors describe the unpacked values and have no buffer views.

Axes: SPZ and glTF right, up, back; tiles right, forward, up, because glTF's y becomes 3D Tiles' z. CesiumJS takes the
coordinates of the SPZ as they are, and so do we. The draft of the extension would turn them by half a turn about y on
unpacking; a program that does so shows the scene turned about the vertical. The root's transform turns the scene's up
direction to +z and moves it to its origin, in double; if the scene's place on earth is known, it takes the scene to its
place on the globe instead (`on_globe`).

Source: OGC, "3D Tiles 1.1"; Khronos, KHR_gaussian_splatting_compression_spz_2 (draft); CesiumJS' loader, for the axes
and the accessors.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import named_failure, written_aside
from gsplat_edu.io.axes import POSITION_SIGNS, root_transform
from gsplat_edu.io.glb import FLOAT, POINTS
from gsplat_edu.io.glb_container import CHUNK_HEADER, EXTENSION, FILE_HEADER, GENERATOR, SPZ_EXTENSION
from gsplat_edu.io.lod import tiles_reading
from gsplat_edu.io.lod.levels import Leaf, LodOptions, Node, build_levels, leaves_of, level_of
from gsplat_edu.io.lod.meta import rounded
from gsplat_edu.io.lod.tiles_reading import FROM_SCENE, FROM_Y_UP
from gsplat_edu.io.scene import Scene, extras
from gsplat_edu.io.spz import packed_version_2
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.gaussians import Gaussians

CONTENT_EXTENSION = "3DTILES_content_gltf"

PIXELS = 16.0
"""Screen-space error in px beyond which Cesium refines a tile, unless told otherwise."""

UNSIGNED_BYTE = 5121
"""Component type of colours."""


def write(path: Path, scene: Scene, options: LodOptions | None = None) -> None:
    """Write a tileset.

    Args:
        path: Its tileset.json; the tiles are written into a folder next to it.
        scene: The scene, in this package's axes; at least one splat.
        options: Sizes of levels and tiles; None for levels down to one tile.

    Raises:
        ArgumentError: the scene is empty, or as for an SPZ.
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    if not len(scene.gaussians):
        raise ArgumentError("gaussians: are none, but a tileset needs a box around some; keep more splats")
    scene.gaussians.check_finite()
    options = options or tile_options()
    root = build_levels(scene.gaussians, options)
    with ExitStack() as stack:  # exits in reverse order of entering
        aside = stack.enter_context(written_aside(path))
        tiles: list[Gaussians] = []
        tree = _tile(root, options.leaf, tiles)
        for number, gaussians in enumerate(tiles):
            place = path.parent / _name(number)
            tile = stack.enter_context(written_aside(place))
            with named_failure(place):
                tile.write_bytes(glb(replace(scene, gaussians=gaussians)))
        tree["transform"] = _root_matrix(scene)
        with named_failure(path):
            aside.write_bytes(_document(tree, extras(scene.frame)))


def read(path: Path) -> Scene:
    """Read the finest tiles of a tileset; see `gsplat_edu.io.lod.tiles_reading.read`."""
    return tiles_reading.read(path)


def on_globe(scene: Scene) -> Earth:
    """Return the map from a scene's coordinates to earth-centred ones, which is exact in the middle of its splats.

    Args:
        scene: The scene; at least one splat.

    Raises:
        ArgumentError: the scene does not say where on earth it is, or as for `gsplat_edu.scene.earth.converted`.
    """
    if scene.earth is None:
        raise ArgumentError("the scene does not say where on earth it is")
    middle = np.median(scene.gaussians.means.double().numpy(force=True), axis=0)
    return scene.earth.on_globe(middle + scene.origin)


def tile_options(smallest: int | None = None, leaf: int | None = None) -> LodOptions:
    """Return options whose coarsest level fits into one tile, unless told otherwise.

    Args:
        smallest: Most splats of the coarsest level.
        leaf: Most splats of a tile.
    """
    leaf = LodOptions.leaf if leaf is None else leaf
    return LodOptions(smallest=leaf if smallest is None else smallest, leaf=leaf)


def glb(scene: Scene) -> bytes:
    """Return a binary glTF whose splats are an SPZ of version 2.

    Args:
        scene: The scene, in this package's axes; at least one splat.
    """
    packed = packed_version_2(scene)
    body = packed + bytes(-len(packed) % 4)
    described = json.dumps(_gltf(scene.gaussians, len(packed), len(body)), separators=(",", ":")).encode(
        "ascii"
    )
    described += b" " * (-len(described) % 4)
    length = FILE_HEADER.size + 2 * CHUNK_HEADER.size + len(described) + len(body)
    return b"".join(
        [
            FILE_HEADER.pack(b"glTF", 2, length),
            CHUNK_HEADER.pack(len(described), b"JSON") + described,
            CHUNK_HEADER.pack(len(body), b"BIN\0") + body,
        ]
    )


def _gltf(gaussians: Gaussians, packed: int, length: int) -> dict[str, Any]:
    means = gaussians.means.double().numpy(force=True) * POSITION_SIGNS
    count = len(means)

    def accessor(kind: str) -> dict[str, Any]:
        return {"componentType": FLOAT, "count": count, "type": kind}

    accessors = {
        "POSITION": {
            **accessor("VEC3"),
            "min": means.min(axis=0).tolist(),
            "max": means.max(axis=0).tolist(),
        },
        "COLOR_0": {**accessor("VEC4"), "componentType": UNSIGNED_BYTE, "normalized": True},
        f"{EXTENSION}:SCALE": accessor("VEC3"),
        f"{EXTENSION}:ROTATION": accessor("VEC4"),
    }
    for degree in range(1, gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            accessors[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = accessor("VEC3")
    kind = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
        "extensions": {SPZ_EXTENSION: {"bufferView": 0}},
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(accessors)},
        "mode": POINTS,
        "extensions": {EXTENSION: kind},
    }
    return {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION, SPZ_EXTENSION],
        "extensionsRequired": [EXTENSION, SPZ_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": list(accessors.values()),
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": packed}],
        "buffers": [{"byteLength": length}],
    }


def _name(number: int) -> str:
    return f"tiles/{number}.glb"


def _tile(node: Node, most: int, tiles: list[Gaussians]) -> dict[str, Any]:
    """Return a tile and those below it; append their splats to `tiles`."""
    leaves = leaves_of(node)
    low = np.min([leaf.low for leaf in leaves], axis=0)
    high = np.max([leaf.high for leaf in leaves], axis=0)
    level = next(_levels_that_fit(leaves, most), None)
    error = float(np.linalg.norm(high - low))
    if level is not None:
        error = PIXELS * max(leaf.errors[level] for leaf in leaves)
    tile: dict[str, Any] = {"boundingVolume": {"box": _box(low, high)}, "geometricError": rounded(error)}
    tile["refine"] = "REPLACE"
    if level is not None:
        tile["content"] = {"uri": _name(len(tiles))}
        tiles.append(level_of(node, level))
    if level != 0 and not isinstance(node, Leaf):
        tile["children"] = [_tile(child, most, tiles) for child in node.children]
        below = max(child["geometricError"] for child in tile["children"])
        tile["geometricError"] = max(tile["geometricError"], below)
    return tile


def _levels_that_fit(leaves: list[Leaf], most: int) -> Iterator[int]:
    for level in range(len(leaves[0].levels)):
        if sum(len(leaf.levels[level]) for leaf in leaves) <= most:
            yield level


def _box(low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]) -> list[float]:
    """Return centre and half axes of a box in the axes of tiles."""
    (x, y, z), (a, b, c) = (low + high) / 2, (high - low) / 2
    numbers = [x, z, -y, a, 0.0, 0.0, 0.0, c, 0.0, 0.0, 0.0, b]
    return [rounded(float(number)) + 0.0 for number in numbers]


def _root_matrix(scene: Scene) -> list[float]:
    """Return the transform to the globe, or else to z up and the origin: 4 x 4, column by column."""
    matrix = np.eye(4)
    try:
        rows = on_globe(scene).rows
        matrix[:3, :3], matrix[:3, 3] = rows[:, :3] @ FROM_SCENE.T, rows[:, :3] @ scene.origin + rows[:, 3]
    except ArgumentError:
        turn, shift = root_transform(scene.up, scene.origin)
        matrix[:3, :3], matrix[:3, 3] = FROM_Y_UP @ turn @ FROM_Y_UP.T, FROM_Y_UP @ shift
    return [float(number) + 0.0 for number in matrix.T.reshape(-1)]


def _document(tree: dict[str, Any], known: dict[str, Any]) -> bytes:
    used = [EXTENSION, SPZ_EXTENSION]
    *_, a, _, _, _, c, _, _, _, b = tree["boundingVolume"]["box"]
    document = {
        "asset": {"version": "1.1", "generator": GENERATOR, "extras": known},
        "extensionsUsed": [CONTENT_EXTENSION],
        "extensionsRequired": [CONTENT_EXTENSION],
        "extensions": {CONTENT_EXTENSION: {"extensionsUsed": used, "extensionsRequired": used}},
        "geometricError": max(tree["geometricError"], rounded(2 * float(np.linalg.norm([a, b, c])))),
        "root": tree,
    }
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")
