"""Read an edits file: strictly, so that nothing in it is ignored. `docs/EDITS.md` describes the format."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.constants import Z_NEAR
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.json_fields import (
    as_json,
    check_keys,
    checked_choice,
    checked_list,
    checked_numbers,
    checked_object,
    checked_text,
    checked_whole,
    number_within,
    numbers_within,
)
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.front import Front, parsed_front
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.runs import end_of, parsed_runs
from gsplat_edu.edits.stored import MOST_BYTES
from gsplat_edu.paths.keyframes import Keyframe, check_keyframe, parsed_keyframe, parsed_path
from gsplat_edu.scene.camera import ROTATION_TOLERANCE
from gsplat_edu.scene.frame import UNITS

FORMAT = "gsplat_edu edits"
VERSION = 1

MOST_OPERATIONS = 100_000
MOST_POINTS = 20_000
"""Points of a lasso or a stroke."""

FARTHEST = 1e30
"""World units: positions and lengths are at most this, so that their squares stay finite."""

FARTHEST_PIXEL = 1e6
LONGEST_FOCAL = 1e9
LARGEST_RAW = 1e6
"""Logits, log scales and coefficients are compared with at most this."""

SMALLEST = 1e-30
"""Smallest radius, half extent or focal length."""

LONGEST_NAME, LONGEST_NOTE, LONGEST_TEXT = 200, 1000, 2000

LEAST_SINE = 1e-6
"""Sine of the angle between two sides of three floor points, below which they lie on one line."""

NEAR = Z_NEAR
"""World units: splats at this camera depth or closer are not seen in a picture."""


@dataclass(frozen=True)
class Edits:
    """The content of an edits file.

    Args:
        scene: The scene that the edits were made for.
        operations: In the order in which they are applied.
    """

    scene: Identity
    operations: tuple[ops.Operation, ...]

    def check_scene(self, scene: Identity, name: str, anyway: bool = False) -> None:
        """Check that a scene is the one that the edits were made for.

        Args:
            scene: The scene's identity.
            name: Its name and the file's, for messages.
            anyway: Accept another scene if no selection depends on more than positions.

        Raises:
            ArgumentError: it is another one, or its coordinates have another origin.
        """
        difference = self.scene.difference(scene)
        if difference is None:
            return
        if not anyway:
            raise ArgumentError(
                f"{name}: was made for another scene ({difference}); open the scene that it names, or add"
                " --edits-anyway"
            )
        for index, operation in enumerate(self.operations):
            if isinstance(operation, ops.Select) and isinstance(operation.region, ops.BY_VALUE):
                kind = type(operation.region).__name__.lower()
                raise ArgumentError(
                    f"{name}: operations[{index}] selects by {kind}, which does not carry over to another scene"
                    f" ({difference}); remove it, or open the scene that the file names"
                )


def read_edits(path: Path) -> Edits:
    """Read an edits file.

    Args:
        path: The file.

    Raises:
        ArgumentError: it is not one of this version, or a value is invalid; the message names the file and the place.
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        data = file.read(MOST_BYTES + 1)
    return parse_edits(data, str(path))


def parse_edits(data: bytes, name: str) -> Edits:
    """Parse the content of an edits file.

    Args:
        data: The content.
        name: The file's name for messages.

    Raises:
        ArgumentError: it is not one of this version, or a value is invalid; the message names the file and the place.
    """
    if len(data) > MOST_BYTES:
        raise ArgumentError(f"{name}: has more than {MOST_BYTES:,} bytes; that is no edits file")
    try:
        found = parse_json(data)
    except ValueError as error:  # a UnicodeDecodeError is one, too
        raise ArgumentError(f"{name}: is not JSON ({str(error)[:80]}); give an edits file") from None
    try:
        return _parsed(found)
    except ArgumentError as error:
        raise ArgumentError(f"{name}: {error}") from None


def empty_document(scene: Identity) -> str:
    """Return the text of an edits file without operations."""
    content = {"format": FORMAT, "version": VERSION, "scene": scene.document(), "operations": []}
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _parsed(found: object) -> Edits:
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ArgumentError(f'is no edits file: its "format" has to be "{FORMAT}"')
    version = found.get("version")
    if type(version) is not int or version != VERSION:
        raise ArgumentError(f"version: is {as_json(version)}, but {VERSION} is supported; update gsplat-edu")
    check_keys("", found, ("format", "version", "scene", "operations"))
    scene = Identity.of_document("scene", found["scene"])
    entries = checked_list("operations", found["operations"], MOST_OPERATIONS)
    edits = Edits(scene, tuple(_operation(f"operations[{i}]", entry) for i, entry in enumerate(entries)))
    for i, operation in enumerate(edits.operations):
        region = operation.region if isinstance(operation, ops.Select) else None
        if isinstance(region, ops.List) and end_of(region.runs) > scene.count:
            raise ArgumentError(
                f"operations[{i}].runs: end at {end_of(region.runs)}, but the scene has {scene.count} splats"
            )
    return edits


Fields = dict[str, Any]


def _operation(where: str, value: object) -> ops.Operation:
    entry = checked_object(where, value)
    if "op" not in entry:
        raise ArgumentError(f"{where}: lacks 'op'")
    kind = checked_choice(f"{where}.op", entry["op"], tuple(_OPERATIONS))
    keys, parse = _OPERATIONS[kind]
    if kind != "select":
        check_keys(f"{where}: ", entry, ("op", *keys), _OPTIONAL.get(kind, ()))
    return parse(where, entry)


def _select(where: str, entry: Fields) -> ops.Select:
    for key in ("how", "by"):
        if key not in entry:
            raise ArgumentError(f"{where}: lacks {key!r}")
    how = checked_choice(f"{where}.how", entry["how"], ops.HOW)
    by = checked_choice(f"{where}.by", entry["by"], tuple(_REGIONS))
    keys, optional, parse = _REGIONS[by]
    check_keys(f"{where}: ", entry, ("op", "how", "by", *keys), optional)
    return ops.Select(how, parse(where, entry))


def _picture(where: str, value: object) -> ops.Picture:
    entry = checked_object(where, value)
    check_keys(f"{where}: ", entry, ("position", "rotation", "fx", "fy", "cx", "cy", "width", "height"))
    for side in ("width", "height"):
        checked_whole(f"{where}.{side}", entry[side], 1, 65_536)
    fx, fy = (number_within(f"{where}.{key}", entry[key], SMALLEST, LONGEST_FOCAL) for key in ("fx", "fy"))
    cx, cy = (
        number_within(f"{where}.{key}", entry[key], -FARTHEST_PIXEL, FARTHEST_PIXEL) for key in ("cx", "cy")
    )
    return ops.Picture(
        _point(f"{where}.position", entry["position"]),
        _axes(f"{where}.rotation", entry["rotation"]),
        fx,
        fy,
        cx,
        cy,
    )


def _point(where: str, value: object) -> ops.Numbers:
    return numbers_within(where, value, 3, FARTHEST)


def _axes(where: str, value: object) -> tuple[ops.Numbers, ops.Numbers, ops.Numbers]:
    """Return the columns of a rotation that is given by its rows."""
    if not isinstance(value, list) or len(value) != 3:
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be three rows of three numbers")
    rows = np.array([numbers_within(f"{where}[{i}]", row, 3, 2.0) for i, row in enumerate(value)])
    if np.abs(rows @ rows.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rows) < 0:
        raise ArgumentError(
            f"{where}: is not a rotation; its columns must be orthonormal, with determinant 1"
        )
    first, second, third = (tuple(column) for column in rows.T.tolist())
    return first, second, third


def _length(where: str, value: object, most: float = FARTHEST) -> float:
    return number_within(where, value, SMALLEST, most)


def _pixels(where: str, value: object, least: int) -> tuple[ops.Numbers, ...]:
    entries = checked_list(where, value, MOST_POINTS)
    if len(entries) < least:
        raise ArgumentError(f"{where}: has {len(entries)} points, but needs at least {least}")
    return tuple(numbers_within(f"{where}[{i}]", entry, 2, FARTHEST_PIXEL) for i, entry in enumerate(entries))


def _front(where: str, entry: Fields) -> Front | None:
    if "front" not in entry:
        return None
    return parsed_front(f"{where}.front", entry["front"], FARTHEST_PIXEL, FARTHEST)


def _rectangle(where: str, entry: Fields) -> ops.PictureRectangle:
    u0, v0, u1, v1 = numbers_within(f"{where}.corners", entry["corners"], 4, FARTHEST_PIXEL)
    if u0 > u1 or v0 > v1:
        raise ArgumentError(f"{where}.corners: u0, v0 must not exceed u1, v1")
    return ops.PictureRectangle(
        _picture(f"{where}.camera", entry["camera"]), (u0, v0, u1, v1), _front(where, entry)
    )


def _lasso(where: str, entry: Fields) -> ops.Lasso:
    points = _pixels(f"{where}.points", entry["points"], 3)
    return ops.Lasso(_picture(f"{where}.camera", entry["camera"]), points, _front(where, entry))


def _brush(where: str, entry: Fields) -> ops.Brush:
    points = _pixels(f"{where}.points", entry["points"], 1)
    radius = _length(f"{where}.radius", entry["radius"], FARTHEST_PIXEL)
    return ops.Brush(_picture(f"{where}.camera", entry["camera"]), radius, points, _front(where, entry))


def _sphere(where: str, entry: Fields) -> ops.Sphere:
    return ops.Sphere(_point(f"{where}.center", entry["center"]), _length(f"{where}.radius", entry["radius"]))


def _box(where: str, entry: Fields) -> ops.Box:
    half = tuple(
        _length(f"{where}.half[{i}]", x)
        for i, x in enumerate(checked_numbers(f"{where}.half", entry["half"], 3))
    )
    axes = _axes(f"{where}.rotation", entry["rotation"])
    return ops.Box(_point(f"{where}.center", entry["center"]), axes, half)


def _color(where: str, entry: Fields) -> ops.Color:
    low, high = (numbers_within(f"{where}.{key}", entry[key], 3, LARGEST_RAW) for key in ("low", "high"))
    return ops.Color(low, high)


def _distance(where: str, entry: Fields) -> ops.Distance:
    return ops.Distance(_point(f"{where}.center", entry["center"]), *_range(where, entry, 0.0, FARTHEST))


def _list(where: str, entry: Fields) -> ops.List:
    reason = checked_text(f"{where}.reason", entry["reason"], LONGEST_NOTE)
    return ops.List(reason, parsed_runs(f"{where}.runs", entry["runs"]))


def _range(
    where: str, entry: Fields, least: float = -LARGEST_RAW, most: float = LARGEST_RAW
) -> tuple[float | None, float | None]:
    low, high = (
        number_within(f"{where}.{key}", entry[key], least, most) if key in entry else None
        for key in ("low", "high")
    )
    if low is None and high is None:
        raise ArgumentError(f"{where}: lacks 'low' and 'high'; give one of them, or both")
    return low, high


def _move(where: str, entry: Fields) -> ops.Move:
    columns = _axes(f"{where}.rotation", entry["rotation"])
    first, second, third = zip(*columns, strict=True)
    translation, center = (_point(f"{where}.{key}", entry[key]) for key in ("translation", "center"))
    return ops.Move((first, second, third), translation, center)


def _upright(where: str, entry: Fields) -> ops.Upright:
    points = checked_list(f"{where}.points", entry["points"], 3)
    if len(points) != 3:
        raise ArgumentError(f"{where}.points: has {len(points)} points, but has to have 3")
    a, b, c = (_point(f"{where}.points[{i}]", point) for i, point in enumerate(points))
    # scaled first: products of large numbers would overflow
    sides = np.array([np.subtract(b, a), np.subtract(c, a)])
    largest = np.abs(sides).max(axis=1)
    if largest.min() > 0:
        first, second = sides / largest[:, None]
        sine = np.linalg.norm(np.cross(first, second)) / (np.linalg.norm(first) * np.linalg.norm(second))
    if largest.min() == 0 or sine < LEAST_SINE:
        raise ArgumentError(f"{where}.points: lie on one line; give three points that span the floor")
    return ops.Upright((a, b, c))


def _pair(where: str, value: object) -> tuple[ops.Numbers, ops.Numbers]:
    points = checked_list(where, value, 2)
    if len(points) != 2:
        raise ArgumentError(f"{where}: has {len(points)} points, but has to have 2")
    first, second = (_point(f"{where}[{i}]", point) for i, point in enumerate(points))
    return first, second


def _scale(where: str, entry: Fields) -> ops.Scale:
    points = _pair(f"{where}.points", entry["points"])
    apart = float(np.linalg.norm(np.subtract(*points)))
    length = _length(f"{where}.length", entry["length"])
    if apart < SMALLEST or not SMALLEST <= length / apart <= FARTHEST:
        raise ArgumentError(f"{where}.points: are {apart:g} apart, which no scale makes {length:g}")
    return ops.Scale(points, length, checked_choice(f"{where}.unit", entry["unit"], tuple(UNITS)))


VIEW = ("position", "rotation", "fov")


def _view(where: str, entry: Fields) -> Keyframe:
    keyframe = parsed_keyframe(where, {key: entry[key] for key in VIEW})
    try:
        check_keyframe(keyframe)
    except ArgumentError as error:
        raise ArgumentError(f"{where}.{error}") from None
    return keyframe


def _start(where: str, entry: Fields) -> ops.StartView:
    return ops.StartView(_view(where, entry), _point(f"{where}.pivot", entry["pivot"]))


def _name(where: str, entry: Fields) -> str:
    return checked_text(f"{where}.name", entry["name"], LONGEST_NAME, 1)


def _named(where: str, entry: Fields) -> ops.NamedView:
    text = entry.get("text", "")
    lines = text.split("\n") if isinstance(text, str) and len(text) <= LONGEST_TEXT else [text]
    for line in lines:  # only line breaks are allowed of the control characters
        checked_text(f"{where}.text", line, LONGEST_TEXT)
    return ops.NamedView(_name(where, entry), _view(where, entry), text)


def _order(where: str, entry: Fields) -> ops.OrderViews:
    first: dict[str, int] = {}
    entries = checked_list(f"{where}.names", entry["names"], MOST_OPERATIONS)
    names = [checked_text(f"{where}.names[{i}]", name, LONGEST_NAME, 1) for i, name in enumerate(entries)]
    for i, name in enumerate(names):
        if first.setdefault(name, i) != i:
            raise ArgumentError(f"{where}.names[{i}]: is {as_json(name)} again; name each view once")
    return ops.OrderViews(tuple(names))


def _path(where: str, entry: Fields) -> ops.CameraPath:
    if entry["path"] is None:
        return ops.CameraPath(None)
    try:
        return ops.CameraPath(parsed_path(entry["path"]))
    except ArgumentError as error:
        raise ArgumentError(f"{where}.path: {error}") from None


def _measure(where: str, entry: Fields) -> ops.Measure:
    return ops.Measure(
        _pair(f"{where}.points", entry["points"]), checked_text(f"{where}.note", entry["note"], LONGEST_NOTE)
    )


_REGIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...], Callable[[str, Fields], ops.Region]]] = {
    "rectangle": (("camera", "corners"), ("front",), _rectangle),
    "lasso": (("camera", "points"), ("front",), _lasso),
    "brush": (("camera", "radius", "points"), ("front",), _brush),
    "sphere": (("center", "radius"), (), _sphere),
    "box": (("center", "rotation", "half"), (), _box),
    "color": (("low", "high"), (), _color),
    "opacity": ((), ("low", "high"), lambda where, entry: ops.Opacity(*_range(where, entry))),
    "size": ((), ("low", "high"), lambda where, entry: ops.Size(*_range(where, entry))),
    "distance": (("center",), ("low", "high"), _distance),
    "list": (("reason", "runs"), (), _list),
    "all": ((), (), lambda where, entry: ops.Everything()),
}
"""Kinds of selection: needed keys, optional keys, parser."""

_OPERATIONS: dict[str, tuple[tuple[str, ...], Callable[[str, Fields], ops.Operation]]] = {
    "select": ((), _select),
    "deselect": ((), lambda where, entry: ops.Deselect()),
    "invert": ((), lambda where, entry: ops.Invert()),
    "grow": (("radius",), lambda where, entry: ops.Grow(_length(f"{where}.radius", entry["radius"]))),
    "shrink": (("radius",), lambda where, entry: ops.Shrink(_length(f"{where}.radius", entry["radius"]))),
    "delete": ((), lambda where, entry: ops.Delete()),
    "hide": ((), lambda where, entry: ops.Hide()),
    "show": ((), lambda where, entry: ops.Show()),
    "crop": (("center", "rotation", "half"), lambda where, entry: ops.Crop(_box(where, entry))),
    "move": (("rotation", "translation", "center"), _move),
    "upright": (("points",), _upright),
    "scale": (("points", "length", "unit"), _scale),
    "start": ((*VIEW, "pivot"), _start),
    "view": (("name", *VIEW), _named),
    "remove_view": (("name",), lambda where, entry: ops.RemoveView(_name(where, entry))),
    "order_views": (("names",), _order),
    "path": (("path",), _path),
    "measure": (("points", "note"), _measure),
}
"""Kinds of operations: needed keys, parser."""

_OPTIONAL: dict[str, tuple[str, ...]] = {"view": ("text",)}
"""Keys that an operation may lack; `_REGIONS` has those of selections."""
