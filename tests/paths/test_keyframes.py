"""The file of a camera path is written and read back, and every mistake in it is one line."""

import json

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath, evenly_chosen, read_path, write_path
from gsplat_edu.scene.camera import Camera, look_at

EYES = [(0.0, 0.0, -4.0), (2.5, -0.5, -2.0), (3.0, 0.0, 1.0)]


def path_of(times=(None, None, None), loop=False, duration=None):
    frames = [Keyframe(np.array(e), look_at(e, (0, 0, 0)), 50.0, t) for e, t in zip(EYES, times, strict=True)]
    return KeyframePath(tuple(frames), loop, duration)


@pytest.mark.parametrize(
    "path",
    [
        path_of(),
        path_of(loop=True),
        path_of(duration=3.5),
        path_of((0.5, 1.0, 4.0)),
        path_of((-1.0, 1.0, 4.0), True, 9.0),
    ],
)
def test_a_path_is_read_back_to_the_bit(path, tmp_path):
    write_path(tmp_path / "new" / "path.json", path)
    found = read_path(tmp_path / "new" / "path.json")
    assert (found.loop, found.duration, found.seconds) == (path.loop, path.duration, path.seconds)
    for one, other in zip(found.keyframes, path.keyframes, strict=True):
        np.testing.assert_array_equal(one.eye, other.eye)
        np.testing.assert_array_equal(one.R, other.R)
        assert (one.fov, one.time) == (other.fov, other.time)


def test_the_file_has_positions_and_rotations_as_in_cameras_json_and_the_captures_coordinates(tmp_path):
    origin = (500000.0, -64.0, 8.0)
    write_path(tmp_path / "path.json", path_of(), origin)
    document = json.loads((tmp_path / "path.json").read_text())
    assert {key: document[key] for key in ("format", "version", "loop")} == {
        "format": "gsplat_edu path",
        "version": 1,
        "loop": False,
    }
    entry = document["keyframes"][1]
    assert entry["position"] == [500002.5, -64.5, 6.0] and list(entry) == ["position", "rotation", "fov"]
    np.testing.assert_array_equal(np.array(entry["rotation"])[:, 2], look_at(EYES[1], (0, 0, 0))[2])
    np.testing.assert_array_equal(read_path(tmp_path / "path.json", origin).keyframes[1].eye, EYES[1])


def test_a_path_moves_with_its_scene():
    """A camera of the moved path sees a moved point where the original one sees the original point."""
    turn = look_at((0, 0, 0), (1, 2, 3))
    before, after = path_of().keyframes[1], path_of().placed(turn, 2.5, (1, -2, 3)).keyframes[1]
    point = np.array([0.3, -0.2, 0.7])
    seen, seen_after = (
        Camera(k.R, k.eye, 50, 50, 20, 20, 40, 40).project(k.R @ (p - k.eye))
        for k, p in ((before, point), (after, 2.5 * turn @ point + (1, -2, 3)))
    )
    np.testing.assert_allclose(seen_after, np.array(seen) * (1, 1, 2.5), rtol=1e-12)


def test_a_camera_becomes_a_keyframe_with_its_vertical_field_of_view():
    camera = Camera(look_at(EYES[0], (0, 0, 0)), EYES[0], 80, 24, 32, 24, 48, 64)
    assert Keyframe.of_camera(camera).fov == pytest.approx(90.0)


def test_cameras_are_chosen_from_the_first_to_the_last():
    cameras = [Camera(np.eye(3), (i, 0, 0), 9, 9, 4, 4, 8, 8) for i in range(10)]
    assert [c.eye[0] for c in evenly_chosen(cameras, 4)] == [0, 3, 6, 9]
    assert len(evenly_chosen(cameras, 10)) == len(evenly_chosen(cameras, 99)) == 10


def changed(change):
    """Return the text of a valid file after a change of its document."""
    document = path_of().document()
    change(document)
    return json.dumps(document)


def frame(**values):
    """Return a change that sets fields of the second keyframe."""
    return changed(lambda document: document["keyframes"][1].update(values))


def timed(*times, loop=False, duration=None):
    """Return the text of a file whose keyframes have these times; None omits a time."""

    def change(document):
        document["loop"] = loop
        for entry, time in zip(document["keyframes"], times, strict=True):
            entry.update({} if time is None else {"time": time})
        document.update({} if duration is None else {"duration": duration})

    return changed(change)


UNIT = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]

BAD = {
    "text": ("not json", "is not JSON (Expecting value"),
    "binary": ("\udcff", "is not JSON ('utf-8' codec"),
    "list": ("[]", 'is not a camera path: its "format" has to be "gsplat_edu path"'),
    "other": ('{"format": "nerfstudio"}', 'is not a camera path: its "format"'),
    "version": (changed(lambda d: d.update(version=2)), "version: is 2, but has to be one of 1"),
    "no version": (changed(lambda d: d.pop("version")), "lacks 'version'"),
    "true version": (changed(lambda d: d.update(version=True)), "version: is true, but has to be"),
    "no loop": (changed(lambda d: d.pop("loop")), "lacks 'loop'"),
    "loop": (changed(lambda d: d.update(loop=1)), "loop: is 1, but has to be true or false"),
    "unknown": (changed(lambda d: d.update(fps=30)), 'has an unknown key "fps"'),
    "no keyframes": (changed(lambda d: d.pop("keyframes")), "lacks 'keyframes'"),
    "keyframes": (changed(lambda d: d.update(keyframes={})), "keyframes: is {}, but has to be a list"),
    "one": (
        changed(lambda d: d.update(keyframes=d["keyframes"][:1])),
        "keyframes: has 1, but a path needs at least 2",
    ),
    "number": (changed(lambda d: d.update(keyframes=[1, 2])), "keyframes[0]: is 1, but has to be an object"),
    "no fov": (changed(lambda d: d["keyframes"][1].pop("fov")), "keyframes[1]: lacks 'fov'"),
    "misspelt": (
        frame(tiem=1.0),
        'keyframes[1]: has an unknown key "tiem"; known are position, rotation, fov, time, hold',
    ),
    "NaN": (frame(fov=float("nan")), "is not JSON (NaN is not valid JSON)"),
    "huge": (
        frame(fov=0).replace('"fov": 0', '"fov": 1e999'),
        "keyframes[1].fov: is Infinity, but has to be a number, at least -1e+300 and at most 1e+300",
    ),
    "digits": (frame(fov=10**400), "keyframes[1].fov: is 1000"),
    "fov": (frame(fov=180), "keyframes[1].fov: is 180.0, but has to be between 0.01 and 179 degrees"),
    "fov text": (frame(fov="50"), 'keyframes[1].fov: is "50", but has to be a number'),
    "position": (frame(position=[1, 2]), "keyframes[1].position: is [1, 2], but has to have 3 entries"),
    "entry": (frame(position=[1, 2, None]), "keyframes[1].position[2]: is null, but has to be a number"),
    "bool": (frame(position=[1, 2, True]), "keyframes[1].position[2]: is true, but has to be a number"),
    "far": (frame(position=[1, 2, 1e31]), "keyframes[1].position: is beyond 1e+30"),
    "quaternion": (
        frame(rotation=[1, 0, 0, 0]),
        "keyframes[1].rotation: is [1, 0, 0, 0], but has to have 3 entries",
    ),
    "row": (
        frame(rotation=[[1, 0, 0], [0, 1, 0], [0, 0]]),
        "keyframes[1].rotation[2]: is [0, 0], but has to have 3 entries",
    ),
    "zero": (frame(rotation=[[0, 0, 0]] * 3), "keyframes[1].rotation: is not a rotation"),
    "mirror": (frame(rotation=[[-1, 0, 0], *UNIT[1:]]), "keyframes[1].rotation: is not a rotation"),
    "large": (frame(rotation=[[1e300] * 3] * 3), "keyframes[1].rotation: is not a rotation"),
    "some times": (timed(0, None, 2), "keyframes: some have a time and some have none"),
    "same time": (
        timed(0, 1, 1),
        "keyframes[2].time: is 1.0, but has to be at least 0.001 s after the keyframe before",
    ),
    "back": (timed(0, 3, 2), "keyframes[2].time: is 2.0, but has to be at least 0.001 s after"),
    "late": (timed(0, 1, 1e7), "keyframes[2].time: is 10000000.0, but has to be within 1e+06 seconds of 0"),
    "duration": (
        changed(lambda d: d.update(duration=0)),
        "duration: is 0.0, but has to be between 0.001 and 1e+06",
    ),
    "long": (changed(lambda d: d.update(duration="4 s")), 'duration: is "4 s", but has to be a number'),
    "both": (timed(0, 1, 2, duration=2), "duration: follows from the keyframes' times; remove it"),
    "no way back": (
        timed(0, 1, 2, loop=True),
        "duration: is None, but a loop with times needs one that is longer",
    ),
    "short": (
        timed(0, 1, 2, loop=True, duration=2),
        "duration: is 2.0, but a loop with times needs one that is longer",
    ),
    "deep": ("[" * 100000, "is not JSON (nested too deeply)"),
}


@pytest.mark.parametrize("name", BAD)
def test_every_mistake_is_one_line_that_names_the_file(name, tmp_path):
    text, says = BAD[name]
    file = tmp_path / "path.json"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ArgumentError) as found:
        read_path(file)
    message = str(found.value)
    assert message.startswith(f"{file}: {says}") and "\n" not in message and len(message) < 300
