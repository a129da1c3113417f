"""Every field of an edits file is read, and damage is reported in one line that names its place."""

import json
import math

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.document import empty_document, parse_edits, read_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.stored import MOST_BYTES

SCENE = Identity(7, "ab" * 32, (1.0, 2.5, -3.0))
EYE = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
CAMERA = {
    "position": [0, 0, -2], "rotation": EYE, "fx": 100, "fy": 110.5, "cx": 49.5, "cy": 39.5, "width": 100, "height": 80,
}  # fmt: skip
BOX = {"center": [0, 0, 0], "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "half": [1, 2, 3]}
VIEW = {"position": [0, 0, -2], "rotation": EYE, "fov": 50.0}
PATH = {"format": "gsplat_edu path", "version": 1, "loop": False, "keyframes": [VIEW, VIEW]}
FRONT = {"bounds": [1, 2, 3.5, 4], "columns": 2, "rows": 1, "deepest": [0.5, 3]}


def select(by, **fields):
    return {"op": "select", "how": "replace", "by": by, **fields}


EVERY = [
    select("rectangle", camera=CAMERA, corners=[1, 2, 3.5, 4]),
    select("lasso", camera=CAMERA, points=[[0, 0], [1, 0], [0, 1]]),
    select("brush", camera=CAMERA, radius=2, points=[[5, 5]]),
    select("sphere", center=[1, 2, 3], radius=0.5),
    select("box", **BOX),
    select("color", low=[-1, -1, -1], high=[1, 1, 1]),
    select("opacity", low=-2),
    select("size", low=-5, high=-1),
    select("all"),
    *({"op": op} for op in ("deselect", "invert", "delete", "hide", "show")),
    {"op": "crop", **BOX},
    {"op": "move", "rotation": BOX["rotation"], "translation": [1, 2, 3], "center": [4, 5, 6]},
    {"op": "upright", "points": [[0, 0, 0], [1, 0, 0], [0, 0, 1]]},
    {"op": "scale", "points": [[0, 0, 0], [2, 0, 0]], "length": 1, "unit": "m"},
    {"op": "start", **VIEW, "pivot": [0, 0, 0]},
    {"op": "view", "name": "Tür <b>", **VIEW},
    {"op": "view", "name": "step", **VIEW, "text": "One <b>line</b>.\nAnother one."},
    {"op": "order_views", "names": ["step", "Tür <b>", "none"]},
    {"op": "remove_view", "name": "Tür <b>"},
    {"op": "path", "path": PATH},
    {"op": "path", "path": None},
    {"op": "measure", "points": [[0, 0, 0], [2, 0, 0]], "note": ""},
    select("rectangle", camera=CAMERA, corners=[1, 2, 3.5, 4], front=FRONT),
    select("distance", center=[1, 2, 3], low=0.5, high=2),
    select("list", reason="seen by nobody", runs=[0, 2, 5, 1]),
    {"op": "grow", "radius": 0.25},
    {"op": "shrink", "radius": 0.5},
]


def document(*operations):
    scene = SCENE.document()
    return {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": list(operations)}


def parsed(content):
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    return parse_edits(text, "e.json")


def refused(content):
    with pytest.raises(ArgumentError) as caught:
        parsed(content)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("e.json: ")
    return str(caught.value).removeprefix("e.json: ")


def test_every_operation_is_read():
    edits = parsed(document(*EVERY))
    assert edits.scene == SCENE
    assert len(edits.operations) == len(EVERY)
    regions = [operation.region for operation in edits.operations[:9]]
    assert regions[3] == ops.Sphere((1.0, 2.0, 3.0), 0.5)
    assert regions[4] == ops.Box(
        (0.0,) * 3, ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (1.0, 2.0, 3.0)
    )
    assert regions[6:] == [ops.Opacity(-2.0), ops.Size(-5.0, -1.0), ops.Everything()]
    rows = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert edits.operations[15] == ops.Move(rows, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert edits.operations[17] == ops.Scale(((0.0,) * 3, (2.0, 0.0, 0.0)), 1.0, "m")
    assert edits.operations[19].name == "Tür <b>"
    assert edits.operations[-4:-2] == (
        ops.Select("replace", ops.Distance((1.0, 2.0, 3.0), 0.5, 2.0)),
        ops.Select("replace", ops.List("seen by nobody", (0, 2, 5, 1))),
    )
    assert edits.operations[-2:] == (ops.Grow(0.25), ops.Shrink(0.5))


def test_an_empty_document_is_read_back():
    edits = parsed(empty_document(SCENE).encode())
    assert edits.scene == SCENE and edits.operations == ()


def test_every_missing_and_every_unknown_field_is_named():
    for index, operation in enumerate(EVERY):
        for key in operation:
            less = {name: value for name, value in operation.items() if name != key}
            ranged = operation.get("by") in ("size", "distance") and key in ("low", "high")
            if ranged or key in ("text", "front"):
                continue  # optional: an end of an interval, a step of a tour, a selection of what is in front
            assert f"operations[{index}]: lacks '{key}'" in refused(document(*EVERY[:index], less))
        more = {**operation, "extra": 1}
        assert f'operations[{index}]: has an unknown key "extra"' in refused(document(*EVERY[:index], more))


def numbers_in(value, place=()):
    """Return the places of all numbers in a document."""
    if isinstance(value, bool):
        return []
    if isinstance(value, int | float):
        return [place]
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    return [found for key, entry in entries for found in numbers_in(entry, (*place, key))]


def replaced(value, place, other):
    value = json.loads(json.dumps(value))  # a deep copy
    inside = value
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = other
    return value


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e200, "1", None, True, [], 10**400])
def test_anything_but_a_finite_number_in_place_of_a_number_is_refused(wrong):
    whole = document(*EVERY)
    places = numbers_in(whole)
    assert len(places) > 150
    for place in places:
        if wrong is None and "deepest" in place:
            continue  # no limit
        message = refused(replaced(whole, place, wrong))
        names = [str(key) for key in place if not isinstance(key, int)]
        assert names[-1] in message or "is not JSON" in message, (place, message)
        if place[0] == "operations" and "thousands" not in message:
            assert f"operations[{place[1]}]" in message, (place, message)


@pytest.mark.parametrize(
    ("operation", "says"),
    [
        ({"op": "paint"}, 'operations[0].op: is "paint", but has to be one of '),
        ({}, "operations[0]: lacks 'op'"),
        (5, "operations[0]: is 5, but has to be an object"),
        (select("magic"), 'operations[0].by: is "magic"'),
        ({**select("all"), "how": "xor"}, 'operations[0].how: is "xor"'),
        (select("opacity"), "operations[0]: lacks 'low' and 'high'"),
        (select("sphere", center=[0, 0, 0], radius=0), "operations[0].radius: is 0, but has to be a number, at least"),
        (select("sphere", center=[0, 0], radius=1), "operations[0].center: is [0, 0], but has to have 3 entries"),
        (select("lasso", camera=CAMERA, points=[[0, 0], [1, 1]]), "but has to have at least 3 and at most"),
        (select("brush", camera=CAMERA, radius=1, points=[]), "points: is [], but has to have at least 1 and at most"),
        (select("rectangle", camera=CAMERA, corners=[3, 0, 1, 1]), "corners: u0, v0 must not exceed u1, v1"),
        (
            select("lasso", camera=CAMERA, points=[[0, 0]] * (ops.MOST_POINTS + 1)),
            "but has to have at least 3 and at most 20,000 entries",
        ),
        (select("box", **{**BOX, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}), "rotation: is not a rotation"),
        (select("rectangle", camera={**CAMERA, "fx": 0}, corners=[0, 0, 1, 1]), "operations[0].camera.fx: is 0"),
        (select("rectangle", camera={**CAMERA, "width": 0.5}, corners=[0, 0, 1, 1]), "camera.width: is 0.5"),
        ({"op": "upright", "points": [[0, 0, 0], [1, 1, 1], [2, 2, 2]]}, "points: lie on one line"),
        ({"op": "upright", "points": [[0, 0, 0], [0, 0, 0], [2, 2, 2]]}, "points: lie on one line"),
        ({"op": "scale", "points": [[1, 1, 1]] * 2, "length": 1, "unit": "m"}, "points: are 0 apart"),
        ({"op": "scale", "points": [[0] * 3, [1] * 3], "length": 1, "unit": "ft"}, 'unit: is "ft"'),
        ({"op": "view", "name": "", **VIEW}, "operations[0].name: is"),
        ({"op": "view", "name": "a\nb", **VIEW}, "free of control characters"),
        ({"op": "view", "name": "a", **VIEW, "fov": 0}, "operations[0].fov: is 0"),
        ({"op": "view", "name": "a", **VIEW, "text": 3}, "operations[0].text: is 3"),
        ({"op": "view", "name": "a", **VIEW, "text": "a" * 2001}, "operations[0].text: is"),
        ({"op": "view", "name": "a", **VIEW, "text": "a\tb"}, "free of control characters"),
        ({"op": "remove_view", "name": "a", "text": ""}, "unknown"),
        ({"op": "order_views", "names": "a"}, "operations[0].names: is"),
        ({"op": "order_views", "names": ["a", 3]}, "operations[0].names[1]: is 3"),
        ({"op": "order_views", "names": ["a", "b", "a"]}, 'operations[0].names[2]: is "a" again'),
        ({"op": "path", "path": {**PATH, "ease": "slow"}}, 'operations[0].path.ease: is "slow"'),
        ({"op": "grow", "radius": 0}, "operations[0].radius: is 0, but has to be a number, at least"),
        (select("distance", center=[0, 0, 0]), "operations[0]: lacks 'low' and 'high'"),
        (select("distance", center=[0, 0, 0], low=-1), "operations[0].low: is -1, but has to be a number, at least 0"),
        (select("list", reason="a\nb", runs=[]), "operations[0].reason: "),
        (select("list", reason="", runs=[0]), "operations[0].runs: has 1 numbers, but has to have a start and a"),
        (select("list", reason="", runs=[0, 0]), "operations[0].runs[1]: is 0, but has to be at least 1"),
        (select("list", reason="", runs=[-1, 1]), "operations[0].runs[0]: is -1, but has to be a whole number"),
        (select("list", reason="", runs=[0, 1.0]), "operations[0].runs[1]: is 1.0, but has to be a whole number"),
        (select("list", reason="", runs=[2, 1, 0, 1]), "operations[0].runs[2]: is 0, but the run before ends at 3"),
        (select("list", reason="", runs=[0, 1, 1, 1]), "operations[0].runs[2]: is 1, but the run before ends at 1"),
        (select("list", reason="", runs=[5, 3]), "operations[0].runs: end at 8, but the scene has 7 splats"),
        ({"op": "path", "path": {**PATH, "keyframes": [VIEW]}}, "operations[0].path.keyframes: has 1"),
    ],
)  # fmt: skip
def test_a_wrong_operation_is_named(operation, says):
    assert says in refused(document(operation))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"\xff\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"[]", "is no edits file"),
        (b'{"format": "gsplat_edu path"}', "is no edits file"),
        (b" " * (MOST_BYTES + 1), "has more than 67,108,864 bytes"),
        ({**document(), "version": 2}, "version: is 2, but 1 is supported"),
        ({**document(), "version": True}, "version: is true"),
        ({**document(), "more": 1}, 'has an unknown key "more"'),
        ({**document(), "operations": {}}, "operations: is {}, but has to be a list"),
        ({**document(), "scene": {**SCENE.document(), "sha256": "AB" * 32}}, "scene.sha256: is"),
        ({**document(), "scene": {**SCENE.document(), "count": -1}}, "scene.count: is -1"),
    ],
)
def test_a_wrong_file_is_named(content, says):
    assert says in refused(content)


def test_cutting_a_file_anywhere_is_one_line(tmp_path):
    whole = json.dumps(document(*EVERY)).encode()
    for length in np.random.default_rng(0).integers(0, len(whole), 60):
        (tmp_path / "cut.json").write_bytes(whole[:length])
        with pytest.raises(ArgumentError, match=r"cut\.json: is no"):
            read_edits(tmp_path / "cut.json")


def test_another_scene_is_refused_in_one_line_unless_positions_suffice():
    places = parsed(document(select("sphere", center=[0, 0, 0], radius=1), {"op": "delete"}))
    values = parsed(document({"op": "invert"}, select("opacity", low=0)))
    listed = parsed(document(select("list", reason="", runs=[0, 1])))
    other = Identity(8, "cd" * 32, SCENE.origin)
    places.check_scene(SCENE, "e.json")
    for scene, says in (
        (other, "of 7 splats, this one has 8"),
        (Identity(7, "cd" * 32, SCENE.origin), "SHA-256 abababab, not cdcdcdcd"),
        (Identity(7, SCENE.sha256, (0.0, 2.5, -3.0)), r"with the origin \[1.0, 2.5, -3.0\]"),
    ):
        with pytest.raises(ArgumentError, match=f"^e.json: was made for another scene .*{says}"):
            places.check_scene(scene, "e.json")
    places.check_scene(other, "e.json", anyway=True)
    with pytest.raises(ArgumentError, match=r"operations\[1\] selects by opacity, which does not carry over"):
        values.check_scene(other, "e.json", anyway=True)
    with pytest.raises(ArgumentError, match=r"operations\[0\] selects by list, which does not carry over"):
        listed.check_scene(other, "e.json", anyway=True)
