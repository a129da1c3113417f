"""Types of the fields in a run's files. They are checked because users edit these files and exchange them."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.records import LARGEST_NUMBER, record_of
from gsplat_edu.base.validation import LARGEST_WHOLE
from gsplat_edu.evaluate.verdict import MEASURES

Whole = Annotated[int, Meta(ge=-LARGEST_WHOLE, le=LARGEST_WHOLE)]
Number = Whole | Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Numbers = dict[str, Number | None]
Place = tuple[Number, Number, Number]


def _fields(**kinds: Any) -> Any:  # noqa: ANN401
    """Return the type of an object whose fields have these types; each may be missing or null, and others may exist."""
    return msgspec.defstruct("Fields", [(name, kind | None, None) for name, kind in kinds.items()])


CONFIG = _fields(
    version=str,
    backend=str,
    fingerprint=str,
    plugins=dict[str, str],
    digests=dict[str, str],
    origin=Place,
    scale=_fields(unit=str, source=str, detail=str, earth=str),
    data=_fields(path=str),
    train=_fields(iterations=Whole, strategy=str),
    photos=_fields(unposed=Whole, gap=tuple[str, str], hole=bool),
    render=dict[str, Any],
)

LOG = _fields(
    iteration=Whole,
    num_gaussians=Whole,
    terms=Numbers,
    **dict.fromkeys(("loss", "psnr", "ssim", "ms", "seconds"), Number),
)

_SPLIT = _fields(num_images=Whole, **dict.fromkeys(MEASURES, Number))

METRICS = _fields(
    iterations=Whole,
    num_gaussians=Whole,
    seconds=Number,
    test=_SPLIT,
    train=_SPLIT,
    full_length=Whole,
    usual=dict[str, Whole],
    blurred=list[str],
)

MESH = _fields(
    file=str,
    unit=str,
    size=Place,
    **dict.fromkeys(("notes", "pictures", "rendered"), list[str]),
    **dict.fromkeys(("held_out", "photos", "intersections", "truth", "left_out"), Numbers),
    **dict.fromkeys(("area", "voxel", "certain", "spread", "outside", "filled", "uncovered"), Number),
    **dict.fromkeys(
        ("iterations", "triangles", "vertices", "convex_parts", "volume_bytes", "few_views"), Whole
    ),
    **dict.fromkeys(("parts", "boundary_edges", "holes"), Whole),
)
"""The record of a mesh, as `gsplat_edu.runs.meshes.record_of` collects it."""


def checked(contents: dict[str, Any], fields: Any, where: str) -> dict[str, Any]:  # noqa: ANN401
    """Check the types of the fields that this program reads, and return the contents.

    Args:
        contents: The file's object.
        fields: `CONFIG`, `LOG`, `METRICS` or `MESH`.
        where: The file, with the line number for log.jsonl.

    Raises:
        CheckpointError: a field has the wrong type; the message names it.
    """
    try:
        record_of("", contents, fields)
    except ArgumentError as error:
        raise CheckpointError(f"{where}: {error}; fix or remove the file") from None
    return contents
