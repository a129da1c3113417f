"""Apply operations to a scene: the selected, hidden and deleted splats after each, and the remaining scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8

from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.cells import EditWork
from gsplat_edu.edits.membership import Members, Values, members
from gsplat_edu.edits.moves import Moved, move_means, moved_gaussians, similarity_of
from gsplat_edu.edits.neighbours import within_radius
from gsplat_edu.io.edit import IDENTITY, Similarity
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.scene.camera import WORLD_UP
from gsplat_edu.scene.frame import ORIGIN, rotation_between
from gsplat_edu.scene.gaussians import Gaussians

SELECTED, HIDDEN, DELETED = 1, 2, 4
"""States of a splat, one at a time; 0 for none of these."""

Flags = UInt8[np.ndarray, " N"]


@dataclass(frozen=True, eq=False)
class Views:
    """The result of the operations that change no splat.

    Args:
        move: Turns the floor level and scales the scene.
        unit: The unit after `scale`; None if no operation sets it.
        upright: Whether the floor was levelled.
        start: The view in which a page opens.
        named: The named views, in the order in which they were first named, or that of the last `OrderViews`.
        path: The camera path.
        measures: The measured distances.
    """

    move: Similarity
    unit: str | None
    upright: bool
    start: ops.StartView | None
    named: tuple[ops.NamedView, ...]
    path: KeyframePath | None
    measures: tuple[ops.Measure, ...]


def flags_after(operations: Sequence[ops.Operation], gaussians: Gaussians) -> Flags:
    """Return the state of each of N splats after some operations: 0, `SELECTED`, `HIDDEN` or `DELETED`.

    Args:
        operations: In order.
        gaussians: The scene.

    Raises:
        ArgumentError: the operations take more than `MOST_TESTS` tests of a splat.
    """
    return _after(operations, gaussians)[0]


def _after(operations: Sequence[ops.Operation], gaussians: Gaussians) -> tuple[Flags, Values, list[Moved]]:
    """Return the states after some operations, the values with the means that they left, and the moves."""
    flags = np.zeros(len(gaussians), dtype=np.uint8)
    values, work = Values.of(gaussians), EditWork()
    moves: list[Moved] = []
    for operation in operations:
        moved = apply_operation(operation, values, flags, work)
        if moved is not None:
            moves.append(moved)
    return flags, values, moves


def kept_after(operations: Sequence[ops.Operation], gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Return which of N splats are neither hidden nor deleted after some operations."""
    left: Bool[np.ndarray, " N"] = flags_after(operations, gaussians) <= SELECTED
    return left


def edited(scene: Scene, operations: Sequence[ops.Operation]) -> Scene:
    """Return the remaining scene, in its coordinates; the same object if nothing is removed or moved."""
    flags, values, moves = _after(operations, scene.gaussians)
    stays = flags <= SELECTED
    gaussians = moved_gaussians(scene.gaussians, moves, values.means)
    if not stays.all():
        rows = torch.from_numpy(stays).to(gaussians.means.device)
        gaussians = gaussians.map(lambda tensor: tensor[rows])
    return scene if gaussians is scene.gaussians else replace(scene, gaussians=gaussians)


def moved_together(operations: Sequence[ops.Operation], gaussians: Gaussians) -> tuple[Similarity, bool]:
    """Return what the moves of all splats that are left do together, and whether there were moves of some of them only.

    Args:
        operations: In order. Their level floor and scale are not part of the result.
        gaussians: The scene.

    Raises:
        ArgumentError: the operations take more than `MOST_TESTS` tests of a splat.
    """
    together, some = IDENTITY, False
    if not any(isinstance(operation, ops.Move) for operation in operations):
        return together, some
    flags, _, moves = _after(operations, gaussians)
    left = flags <= SELECTED
    for moved in moves:
        number, count = int(left[moved.rows].sum()), int(left.sum())
        some |= 0 < number < count
        if 0 < number == count:
            together = similarity_of(moved.move).after(together)
    return together, some


def views_after(operations: Sequence[ops.Operation]) -> Views:
    """Collect the operations that change no splat; the last one of a kind counts."""
    upright: ops.Upright | None = None
    scale: ops.Scale | None = None
    start: ops.StartView | None = None
    path: KeyframePath | None = None
    named: dict[str, ops.NamedView] = {}
    for operation in operations:
        match operation:
            case ops.Upright():
                upright = operation
            case ops.Scale():
                scale = operation
            case ops.StartView():
                start = operation
            case ops.NamedView(name=name):
                named[name] = operation
            case ops.RemoveView(name):
                named.pop(name, None)
            case ops.OrderViews(names):
                named = {**{name: named[name] for name in names if name in named}, **named}
            case ops.CameraPath(record):
                path = None if record is None else record.path
    move = IDENTITY
    if upright is not None:
        move = Similarity(upright_rotation(upright), 1.0, np.zeros(3))
    if scale is not None:
        apart = float(np.linalg.norm(np.subtract(*scale.points)))
        move = Similarity(np.eye(3), scale.length / apart, np.zeros(3)).after(move)
    measures = tuple(operation for operation in operations if isinstance(operation, ops.Measure))
    unit = None if scale is None else scale.unit
    return Views(move, unit, upright is not None, start, tuple(named.values()), path, measures)


def placed(scene: Scene, views: Views) -> Scene:
    """Return a scene turned and scaled; its up direction and unit are set if an operation sets them.

    A scene that was levelled or scaled has coordinates of its own: its origin is zero.
    """
    if views.move is IDENTITY:
        return scene
    shift = np.eye(4)
    shift[:3, 3] = scene.origin
    earth = None if scene.earth is None else scene.earth.after(shift)
    moved = views.move.scene(replace(scene, origin=ORIGIN, earth=earth))
    moved = replace(moved, gaussians=moved.relative_to(ORIGIN), origin=ORIGIN)
    up = WORLD_UP if views.upright else moved.up
    return replace(moved, up=up, unit=views.unit or moved.unit)


def placed_view(view: Keyframe, move: Similarity) -> Keyframe:
    """Return the view that sees the moved scene as this one sees the scene."""
    return replace(view, eye=move.s * move.R @ view.eye + move.t, R=view.R @ move.R.T)


def upright_rotation(upright: ops.Upright) -> Float64[np.ndarray, "3 3"]:
    """Return the shortest rotation that takes the floor's normal, (b - a) x (c - a), to the world's up direction."""
    a, b, c = np.array(upright.points, dtype=np.float64)
    first, second = (side / np.abs(side).max() for side in (b - a, c - a))
    return rotation_between(np.cross(first, second), WORLD_UP)


def apply_operation(operation: ops.Operation, values: Values, flags: Flags, work: EditWork) -> Moved | None:
    """Apply one operation to states and means, in place; an operation on them counts as one test of each splat.

    Args:
        operation: The operation.
        values: N splats.
        flags: (N,) their states.
        work: Counts the tests.

    Returns:
        The splats that the operation moved; None if it is no `Move`.

    Raises:
        ArgumentError: the work is too much.
    """
    if isinstance(operation, ops.Deselect | ops.Invert | ops.Delete | ops.Hide | ops.Show | ops.Move):
        work.add(len(flags))
    match operation:
        case ops.Select(how, region):
            _select(how, members(region, values, work), flags)
        case ops.Deselect():
            flags[flags == SELECTED] = 0
        case ops.Invert():
            flags[flags <= SELECTED] ^= SELECTED
        case ops.Grow(radius):
            flags[within_radius(values.means, flags == 0, flags == SELECTED, radius, work)] = SELECTED
        case ops.Shrink(radius):
            flags[within_radius(values.means, flags == SELECTED, flags == 0, radius, work)] = 0
        case ops.Delete():
            flags[flags == SELECTED] = DELETED
        case ops.Hide():
            flags[flags == SELECTED] = HIDDEN
        case ops.Show():
            flags[flags == HIDDEN] = 0
        case ops.Crop(center, rotation, half):
            flags[~members(ops.Box(center, rotation, half), values, work)] = DELETED
        case ops.Move():
            return move_means(operation, values.means, flags == SELECTED)
    return None


def _select(how: str, inside: Members, flags: Flags) -> None:
    there, chosen = flags <= SELECTED, flags == SELECTED
    now = {
        ops.REPLACE: inside,
        ops.ADD: chosen | inside,
        ops.SUBTRACT: chosen & ~inside,
        ops.INTERSECT: chosen & inside,
    }[how]
    flags[there] = now[there]
