"""Types of the fields in a run's files. They are checked because users edit these files and exchange them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.validation import LARGEST_WHOLE

Check = Callable[[object], bool]


def _whole(value: object) -> bool:
    return type(value) is int and abs(value) <= LARGEST_WHOLE


def _number(value: object) -> bool:
    return _whole(value) or (type(value) is float and math.isfinite(value))


def _text(value: object) -> bool:
    return isinstance(value, str)


def _texts(value: object) -> bool:
    return isinstance(value, list) and all(map(_text, value))


def _section(value: object) -> bool:
    return isinstance(value, dict)


def _place(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_number, value))


def _numbers(value: object) -> bool:
    return isinstance(value, dict) and all(number is None or _number(number) for number in value.values())


KINDS: Mapping[Check, str] = {
    _whole: "a whole number",
    _number: "a number",
    _text: "text",
    _texts: "a list of texts",
    _section: "an object",
    _numbers: "an object of numbers",
    _place: "three numbers",
}
"""How messages describe the values that each check accepts."""

CONFIG: Mapping[str, Check] = {
    "version": _text,
    "backend": _text,
    "fingerprint": _text,
    "plugins": _section,
    "origin": _place,
    "scale": _section,
    "scale.unit": _text,
    "scale.source": _text,
    "scale.detail": _text,
    "data": _section,
    "train": _section,
    "render": _section,
    "train.iterations": _whole,
    "train.strategy": _text,
    "data.path": _text,
}

LOG: Mapping[str, Check] = {
    "iteration": _whole,
    "num_gaussians": _whole,
    "terms": _numbers,
    **dict.fromkeys(("loss", "psnr", "ssim", "ms", "seconds"), _number),
}

MEASURES = ("psnr", "psnr_8bit", "ssim", "l1", "psnr_fitted")
"""The scores of a split: those of `gsplat_edu.evaluate.metrics.ImageScore`, which imports torch."""

METRICS: Mapping[str, Check] = {
    "iterations": _whole,
    "num_gaussians": _whole,
    "seconds": _number,
    **{
        field: check
        for split in ("test", "train")
        for field, check in {
            split: _section,
            f"{split}.num_images": _whole,
            **dict.fromkeys((f"{split}.{score}" for score in MEASURES), _number),
        }.items()
    },
}


MESH: Mapping[str, Check] = {
    "file": _text,
    "unit": _text,
    "notes": _texts,
    "pictures": _texts,
    "rendered": _texts,
    "size": _place,
    "held_out": _numbers,
    "photos": _numbers,
    "intersections": _numbers,
    "truth": _numbers,
    "left_out": _numbers,
    **dict.fromkeys(("area", "voxel", "certain", "spread", "outside", "filled", "uncovered"), _number),
    **dict.fromkeys(
        ("iterations", "triangles", "vertices", "convex_parts", "volume_bytes", "few_views"), _whole
    ),
    **dict.fromkeys(("parts", "boundary_edges", "holes"), _whole),
}
"""The record of a mesh, as `gsplat_edu.runs.meshes.record_of` collects it."""


def checked(contents: dict[str, Any], fields: Mapping[str, Check], where: str) -> dict[str, Any]:
    """Check the types of the fields that this program reads, and return the contents.

    Args:
        contents: The file's object.
        fields: `CONFIG`, `LOG`, `METRICS` or `MESH`; a dot separates a section from its field. Fields may be missing or
            null.
        where: The file, with the line number for log.jsonl.

    Raises:
        CheckpointError: a field has the wrong type; the message names it.
    """
    for name, check in fields.items():
        section, _, field = name.rpartition(".")
        values = contents.get(section) if section else contents
        value = values.get(field) if isinstance(values, dict) else None
        if value is not None and not check(value):
            said = str(value)[:40] if not isinstance(value, int) or _whole(value) else "a huge number"
            raise CheckpointError(
                f"{where}: {name} is {said}, but has to be {KINDS[check]}; fix or remove the file"
            )
    return contents
