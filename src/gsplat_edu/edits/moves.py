"""Move the selected splats: the same means, to the bit, as in the page (`viewer/web/edit_move.js`).

Later selections depend on the means, so these are computed like memberships: from float32 numbers as float64, by + and
* in the written order, then rounded to float32. Rotations and harmonics decide no selection; they are turned by
`gsplat_edu.io.edit.Similarity`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from gsplat_edu.edits import operations as ops
from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Moved:
    """An operation and the splats that it moved.

    Args:
        move: The operation.
        rows: Indices of the splats.
    """

    move: ops.Move
    rows: Int64[np.ndarray, " M"]


def move_means(move: ops.Move, means: Float64[np.ndarray, "N 3"], selected: Bool[np.ndarray, " N"]) -> Moved:
    """Move the means of the selected splats, in place.

    x' = (((r0 a + r1 b) + r2 c) + center) + translation,  (a, b, c) = mean - center

    Args:
        move: The operation.
        means: World units, float32 numbers as float64, before and after.
        selected: Which splats move.
    """
    rows = np.flatnonzero(selected)
    with np.errstate(all="ignore"):  # infinite splats
        a, b, c = (means[rows, i] - move.center[i] for i in range(3))
        for i, (r0, r1, r2) in enumerate(move.rotation):
            moved = (((r0 * a + r1 * b) + r2 * c) + move.center[i]) + move.translation[i]
            means[rows, i] = moved.astype(np.float32)
    return Moved(move, rows)


def similarity_of(move: ops.Move) -> Similarity:
    """Return an operation as a transform, with an exactly orthonormal rotation."""
    R = Rotation.from_matrix(np.array(move.rotation)).as_matrix()
    center = np.array(move.center)
    return Similarity(R, 1.0, center + np.array(move.translation) - R @ center)


def moved_gaussians(
    gaussians: Gaussians, moves: Sequence[Moved], means: Float64[np.ndarray, "N 3"]
) -> Gaussians:
    """Return N splats after some moves, with turned rotations and harmonics.

    Args:
        gaussians: The splats before.
        moves: In order.
        means: Their means afterwards, from `move_means`.

    Returns:
        The splats; the same object if no splat was moved.
    """
    some = [moved for moved in moves if len(moved.rows)]
    if not some:
        return gaussians
    there = torch.from_numpy(means).to(gaussians.means)
    copies = {name: getattr(gaussians, name).clone() for name in ("means", "quats", "sh_rest")}
    result = replace(gaussians, **copies)
    for moved in some:
        rows = torch.from_numpy(moved.rows).to(there.device)
        result.means[rows] = there[rows]
        R = similarity_of(moved.move).R
        part = result.map(lambda tensor, rows=rows: tensor[rows])  # type: ignore[misc]
        turned = Similarity(R, 1.0, np.zeros(3)).gaussians(part)
        result.quats[rows], result.sh_rest[rows] = turned.quats, turned.sh_rest
    return result
