"""Carry the edits of a scene over to a part of it, as `clean --edits` does."""

from __future__ import annotations

import json

import numpy as np
from jaxtyping import Bool

from gsplat_edu.base.reading import parse_json
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.apply import SELECTED, apply_operation
from gsplat_edu.edits.cells import EditWork
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.membership import Values
from gsplat_edu.edits.runs import runs_of
from gsplat_edu.scene.gaussians import Gaussians

REASONS = {"grow": "the selection, grown", "shrink": "the selection, shrunk"}
"""Reasons of the lists that replace these operations."""


def for_part(
    data: bytes, name: str, gaussians: Gaussians, kept: Bool[np.ndarray, " N"], scene: Identity
) -> str:
    """Return the text of an edits file that selects, hides and deletes the same splats of a part of its scene.

    Most operations judge splats one by one, and stay as they are. The result of `grow` and `shrink` depends on
    splats that the part lacks, and the indices of a list change; each of these becomes a list of what is selected after
    it.

    Args:
        data: The content of the edits file.
        name: The file's name for messages.
        gaussians: N splats of its scene.
        kept: (N,) splats of the part, which has them in the same order.
        scene: The part's identity.

    Raises:
        ArgumentError: the content is no edits file of this version, or its operations take too many tests.
    """
    edits, content = parse_edits(data, name), parse_json(data)
    flags, values, work = np.zeros(len(gaussians), dtype=np.uint8), Values.of(gaussians), EditWork()
    entries = []
    for operation, entry in zip(edits.operations, content["operations"], strict=True):
        apply_operation(operation, values, flags, work)
        listed = isinstance(operation, ops.Select) and isinstance(operation.region, ops.List)
        if listed or isinstance(operation, ops.Grow | ops.Shrink):
            runs = runs_of((flags == SELECTED)[kept])
            reason = entry["reason"] if listed else REASONS[entry["op"]]
            entries.append({"op": "select", "how": ops.REPLACE, "by": "list", "reason": reason, "runs": runs})
        else:
            entries.append(entry)
    carried = {**content, "scene": scene.document(), "operations": entries}
    return json.dumps(carried, indent=1, allow_nan=False) + "\n"
