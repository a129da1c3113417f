"""Read the splats of a 3D Tiles tileset of any program: the finest tiles, in the coordinates of the tileset.

Tiles without children and those that their children add to (refine: ADD) are read; of others, their children, which
replace them. The content of a tile is a binary glTF with splats or another tileset, in the folder of the tileset that
is read, or in one within it. Implicit tiling is refused by name.

Coordinates are those of the tileset, whose z points up, or which are geocentric (ECEF) if the splats lie within
`NEAR_SURFACE` of the ellipsoid; then up is its normal. A tileset of ours is read into the scene's own coordinates.

Source: OGC, "3D Tiles 1.1"; EPSG, WGS 84.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64
from msgspec import Meta, Struct

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.links import is_inside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.records import Number, record_of
from gsplat_edu.base.text import shortened
from gsplat_edu.io import glb_reading
from gsplat_edu.io.axes import POSITION_SIGNS
from gsplat_edu.io.edit import joined
from gsplat_edu.io.glb_container import GENERATOR, refuse
from gsplat_edu.io.node_splats import MOST_ENTRY, moved
from gsplat_edu.io.scene import Scene, read_extras
from gsplat_edu.scene.earth import NEAR_SURFACE, Earth, geodetic, local_axes
from gsplat_edu.scene.frame import Vector

FROM_Y_UP = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))
"""Takes glTF's axes to those of tiles, whose z is glTF's y."""

FROM_SCENE = FROM_Y_UP @ np.diag(POSITION_SIGNS)
"""Takes this package's axes to those of tiles."""

MOST_TILES, MOST_DEPTH = 1 << 16, 256
"""Most tiles of a tileset, with those of further ones, and how deep they lie in one another."""


class Content(Struct, frozen=True):
    """A tile's content."""

    uri: str


class Tile(Struct, frozen=True):
    """A tile; `refine` is that of its parent if it has none."""

    transform: Annotated[list[Number], Meta(min_length=16, max_length=16)] | None = None
    refine: Literal["ADD", "REPLACE", None] = None
    content: Content | None = None
    contents: list[Content] = []
    children: list[Tile] = []
    implicitTiling: Any = None  # noqa: N815


class Tileset(Struct, frozen=True):
    """A tileset.json."""

    asset: dict[str, Any]
    root: Tile


def read(path: Path) -> Scene:
    """Read a tileset.

    Args:
        path: Its tileset.json.

    Returns:
        The scene, float32.

    Raises:
        SceneFormatError: a file is damaged, missing or elsewhere, or has something that is not supported.
        OSError: a file cannot be read.
    """
    tileset = _tileset(path)
    known = tileset.asset.get("extras") if tileset.asset.get("generator") == GENERATOR else None
    try:
        frame = read_extras(known)
    except ValueError as error:
        refuse(path, str(error))
    parts = list(_Tree(path, own=known is not None).parts(tileset))
    if not parts:
        refuse(path, "has no tile with splats")
    try:
        whole = joined(parts)
    except ArgumentError as error:
        refuse(path, str(error).removeprefix("scenes: ").partition(";")[0])
    if known is not None:
        return replace(whole, **frame._asdict())
    middle = np.array(whole.origin) + np.median(whole.gaussians.means.double().numpy(), axis=0)
    up = _up_at(middle)
    return replace(whole, up=up or (0.0, 0.0, 1.0), unit="m", earth=up and Earth.of(np.eye(3), np.zeros(3)))


class _Tree:
    """The tiles of a tileset.

    Args:
        path: The tileset.json.
        own: Whether the splats are read into the coordinates of the scene, which the root's transform moves.
    """

    def __init__(self, path: Path, *, own: bool) -> None:
        self._path, self._own, self._count = path, own, 0

    def parts(self, tileset: Tileset) -> Iterator[Scene]:
        """Yield the splats of each content."""
        outer = np.linalg.inv(_matrix(self._path, tileset.root)) if self._own else np.eye(4)
        yield from self._below(self._path, tileset.root, outer, "REPLACE", 0)

    def _below(
        self, path: Path, tile: Tile, outer: Float64[np.ndarray, "4 4"], refine: str, depth: int
    ) -> Iterator[Scene]:
        """Yield the splats of a tile and of those below it.

        Args:
            path: The tileset.json that has the tile.
            tile: The tile.
            outer: From the coordinates around the tile to those of the result.
            refine: How the tile around it is refined.
            depth: Number of tiles around it.
        """
        self._count += 1
        if self._count > MOST_TILES or depth > MOST_DEPTH:
            refuse(
                self._path, f"has more than {MOST_TILES:,} tiles, or tiles deeper than {MOST_DEPTH} in others"
            )
        if tile.implicitTiling is not None:
            refuse(path, "has implicit tiling, which is not supported; write explicit tiles")
        matrix, own = outer @ _matrix(path, tile), tile.refine or refine
        if not tile.children or own == "ADD":
            for content in [*([tile.content] if tile.content else []), *tile.contents]:
                yield from self._content(self._file(path, content.uri), matrix, own, depth + 1)
        for child in tile.children:
            yield from self._below(path, child, matrix, own, depth + 1)

    def _file(self, path: Path, uri: str) -> Path:
        """Return the file of a tile's content: in the folder of the tileset that is read, or in one within it."""
        file = path.parent / unquote(uri.partition("?")[0])
        if "://" in uri or not is_inside(file, [self._path.parent]):
            refuse(path, f"has a tile {shortened(uri)}, which does not lie below the tileset; copy it there")
        if not file.is_file():
            refuse(path, f"lacks {shortened(uri)}; copy the tileset with all its files")
        return file

    def _content(
        self, file: Path, matrix: Float64[np.ndarray, "4 4"], refine: str, depth: int
    ) -> Iterator[Scene]:
        if file.suffix.lower() == ".json":
            yield from self._below(file, _tileset(file).root, matrix, refine, depth)
            return
        if file.suffix.lower() != ".glb":
            refuse(file, "is no binary glTF; only such tiles can have splats that are read")
        turn = np.eye(4)
        turn[:3, :3] = FROM_SCENE
        move = turn.T @ matrix @ turn if self._own else matrix @ turn
        yield moved(file, glb_reading.read(file), move, np.eye(4))


def _tileset(path: Path) -> Tileset:
    data = read_bytes(path)
    refuse_lfs_pointer(path, data)
    try:
        tileset: Tileset = record_of("", parse_json(data), Tileset)
    except (ArgumentError, ValueError, RecursionError) as error:
        raise SceneFormatError(f"{path}: {error}; it is no tileset of 3D Tiles, or is damaged") from None
    return tileset


def _matrix(path: Path, tile: Tile) -> Float64[np.ndarray, "4 4"]:
    """Return the transform from a tile's coordinates to those around it."""
    matrix = np.eye(4) if tile.transform is None else np.reshape(tile.transform, (4, 4)).T.astype(np.float64)
    if not (np.abs(matrix).max() <= MOST_ENTRY and abs(np.linalg.det(matrix)) > 0):
        refuse(path, "has a tile whose transform is singular or absurdly large")
    return matrix


def _up_at(middle: Float64[np.ndarray, "3"]) -> Vector | None:
    """Return the up direction of splats around a place, the ellipsoid's normal; None far from its surface."""
    latitude, longitude, height = geodetic(middle)
    if abs(height) > NEAR_SURFACE:
        return None
    x, y, z = local_axes(latitude, longitude)[2].tolist()
    return (x, y, z)
