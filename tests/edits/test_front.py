"""Selections of only what is in front compare depths exactly as the file says, and damage to a file is reported."""

import json
import math

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import ABSENT
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.cells import EditWork
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.front import MOST_CELLS, Front
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.membership import Values, members

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
PICTURE = ops.Picture((0.0, 0.0, 0.0), AXES, 100.0, 100.0, 0.0, 0.0, 100, 80)
"""The point (x, y, z) is at depth z and appears at pixel (100 x / z, 100 y / z)."""


def values_at(means):
    n = len(means)
    return Values(np.array(means, dtype=np.float64), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)))


def seen(u, v, z):
    return (u * z / 100, v * z / 100, z)


def test_a_cell_holds_what_is_at_most_as_deep_as_its_limit():
    front = Front((0.0, 0.0, 20.0, 10.0), 2, 1, (2.0, None))
    region = ops.PictureRectangle(PICTURE, (-5.0, -5.0, 30.0, 30.0), front)
    cases = {
        (4.0, 8.0, 2.0): True,  # on the limit
        (4.0, 8.0, 2.25): False,
        (9.0, 4.0, 0.5): True,
        (12.0, 4.0, 64.0): True,  # a cell without a limit
        (-4.0, 20.0, 2.25): False,  # outside of the bounds: the nearest cell
        (25.0, 4.0, 64.0): True,
    }
    assert members(region, values_at([seen(*place) for place in cases])).tolist() == list(cases.values())


def held_one_by_one(region, means):
    """Membership by the words of docs/EDITS.md, one splat after another, without the shape."""
    front, found = region.front, []
    u0, v0, u1, v1 = front.bounds
    for x, y, z in means.tolist():
        u, v = (100.0 * x) / z + 0.0, (100.0 * y) / z + 0.0
        column = min(max(math.floor((u - u0) * (front.columns / (u1 - u0))), 0), front.columns - 1)
        row = min(max(math.floor((v - v0) * (front.rows / (v1 - v0))), 0), front.rows - 1)
        limit = front.deepest[row * front.columns + column]
        found.append(limit is None or z <= limit)
    return np.array(found)


@pytest.mark.parametrize("seed", range(4))
def test_the_grid_limits_every_shape_of_a_picture(seed):
    rng = np.random.default_rng(seed)
    n, columns, rows = 2000, int(rng.integers(1, 20)), int(rng.integers(1, 20))
    z = rng.uniform(0.5, 4.0, n)
    u, v = rng.uniform(-50, 150, (2, n)).round(int(rng.integers(0, 3)))  # many on borders of cells
    means = np.stack([u * z / 100, v * z / 100, z], axis=1)
    deepest = tuple(
        None if rng.random() < 0.2 else float(depth) for depth in rng.uniform(0.5, 4, columns * rows)
    )
    front = Front((-10.0, -20.5, 110.0, 100.0), columns, rows, deepest)
    corners = tuple(map(tuple, rng.uniform(-40, 140, (9, 2)).tolist()))
    shapes = [
        lambda front: ops.PictureRectangle(PICTURE, (-30.0, -30.0, 120.0, 120.0), front),
        lambda front: ops.Lasso(PICTURE, corners, front),
        lambda front: ops.Brush(PICTURE, 20.0, corners, front),
    ]
    for shape in shapes:
        work, less = EditWork(), EditWork()
        everything = members(shape(ABSENT), values_at(means), less)
        found = members(shape(front), values_at(means), work)
        np.testing.assert_array_equal(found, everything & held_one_by_one(shape(front), means))
        assert 0 < found.sum() < everything.sum()
        assert less.left - work.left == everything.sum(), "one more test for each splat of the shape"


def test_the_comparison_of_depths_counts_as_work():
    front = Front((0.0, 0.0, 20.0, 10.0), 1, 1, (2.0,))
    values = values_at([seen(4.0, 4.0, 1.0)] * 10)
    shape = (PICTURE, (0.0, 0.0, 9.0, 9.0))
    assert members(ops.PictureRectangle(*shape, front), values, EditWork(20)).all()
    with pytest.raises(ArgumentError, match="tests of a splat"):
        members(ops.PictureRectangle(*shape, front), values, EditWork(19))
    assert members(ops.PictureRectangle(*shape), values, EditWork(10)).all()


SCENE = Identity(7, "ab" * 32, (0.0, 0.0, 0.0))
CAMERA = {
    "position": [0, 0, -2], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 100, "fy": 110.5, "cx": 49.5,
    "cy": 39.5, "width": 100, "height": 80,
}  # fmt: skip
SHAPES = {
    "rectangle": {"corners": [1, 2, 3, 4]},
    "lasso": {"points": [[0, 0], [1, 0], [0, 1]]},
    "brush": {"points": [[0, 0]], "radius": 2},
}
FRONT = {"bounds": [1, 2, 3, 4.5], "columns": 2, "rows": 1, "deepest": [1.25, None]}


def region_of(by, **more):
    select = {"op": "select", "how": "add", "by": by, "camera": CAMERA, **SHAPES.get(by, {}), **more}
    content = {
        "format": "gsplat_edu edits", "version": 1, "scene": SCENE.document(), "operations": [select],
    }  # fmt: skip
    return parse_edits(json.dumps(content).encode(), "e.json").operations[0].region


@pytest.mark.parametrize("by", SHAPES)
def test_a_shape_of_a_picture_may_have_a_front(by):
    assert region_of(by).front is ABSENT
    assert region_of(by, front=FRONT).front == Front((1.0, 2.0, 3.0, 4.5), 2, 1, (1.25, None))


BAD = {
    "front: is null, but has to be an object": None,
    "front: is [], but has to be an object": [],
    'front: has an unknown key "depth"': {**FRONT, "depth": 1},
    "front: lacks 'rows'": {key: FRONT[key] for key in FRONT if key != "rows"},
    "front.bounds: u1, v1 must exceed u0, v0": {**FRONT, "bounds": [1, 2, 1.0005, 4]},
    "front.bounds: ": {**FRONT, "bounds": [1, 2, 3]},
    "front.bounds[3]: ": {**FRONT, "bounds": [1, 2, 3, 1e7]},
    "front.columns: is 2.5": {**FRONT, "columns": 2.5},
    "front.rows: is 0": {**FRONT, "rows": 0},
    "front.columns: is 65": {**FRONT, "columns": MOST_CELLS + 1, "deepest": [None] * (MOST_CELLS + 1)},
    "front.deepest: has 3 depths, but 1 rows of 2 columns are 2": {**FRONT, "deepest": [1, 2, 3]},
    "front.deepest[1]: is -1": {**FRONT, "deepest": [1, -1]},
    "front.deepest[0]: is 1e+31": {**FRONT, "deepest": [1e31, 1]},
    'front.deepest[0]: is "1"': {**FRONT, "deepest": ["1", 1]},
    "front.deepest[1]: is true": {**FRONT, "deepest": [1, True]},
}


@pytest.mark.parametrize("message", BAD)
def test_a_damaged_front_is_refused_with_its_place(message):
    with pytest.raises(ArgumentError) as caught:
        region_of("brush", front=BAD[message])
    assert str(caught.value).startswith("e.json: operations[0].front") and message in str(caught.value)


def test_shapes_in_space_have_no_front():
    content = {"op": "select", "how": "add", "by": "sphere", "center": [0, 0, 0], "radius": 1, "front": FRONT}
    file = {"format": "gsplat_edu edits", "version": 1, "scene": SCENE.document(), "operations": [content]}
    with pytest.raises(ArgumentError, match='unknown key "front"'):
        parse_edits(json.dumps(file).encode(), "e.json")
