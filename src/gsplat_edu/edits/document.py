"""Read an edits file: strictly, so that nothing in it is ignored. `docs/EDITS.md` describes the format."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from gsplat_edu.base.constants import Z_NEAR
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.records import Record, as_json, record_of
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.runs import end_of
from gsplat_edu.edits.stored import MOST_BYTES

FORMAT = "gsplat_edu edits"
VERSION = 1

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
                " `edits_anyway`"
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


class _Document(Record, frozen=True):
    format: str
    version: int
    scene: Identity
    operations: Annotated[list[object], Meta(max_length=ops.MOST_OPERATIONS)]


def _parsed(found: object) -> Edits:
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ArgumentError(f'is no edits file: its "format" has to be "{FORMAT}"')
    version = found.get("version")
    if type(version) is not int or version != VERSION:
        raise ArgumentError(f"version: is {as_json(version)}, but {VERSION} is supported; update gsplat-edu")
    document: _Document = record_of("", found, _Document)
    scene = document.scene
    operations = (_operation(f"operations[{i}]", entry) for i, entry in enumerate(document.operations))
    edits = Edits(scene, tuple(operations))
    for i, operation in enumerate(edits.operations):
        region = operation.region if isinstance(operation, ops.Select) else None
        if isinstance(region, ops.List) and end_of(region.runs) > scene.count:
            raise ArgumentError(
                f"operations[{i}].runs: end at {end_of(region.runs)}, but the scene has {scene.count} splats"
            )
    return edits


def _operation(where: str, entry: object) -> ops.Operation:
    if not isinstance(entry, dict) or entry.get("op") != "select":
        operation: ops.Operation = record_of(where, entry, ops.Operation)
        return operation
    how = record_of(where, entry, _Selecting).how
    region = {key: entry[key] for key in entry if key not in ("op", "how")}
    return ops.Select(how, record_of(where, region, ops.Region))


class _Selecting(Record, frozen=True, forbid_unknown_fields=False):
    how: ops.How
