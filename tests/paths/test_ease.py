"""Paths that slow down at their ends or at every view, and cameras that rest at a view."""

import json

import numpy as np
import pytest
from scipy.integrate import quad

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.paths.curve import PathCurve
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath, parsed_path, read_path, write_path
from gsplat_edu.scene.camera import look_at

EYES = [(0, 0, -4), (0.3, -0.2, -3.8), (2.5, -0.5, -2), (3, 0, 1), (0.5, 0.4, 3.5)]
TIMES = (1.0, 1.5, 4.0, 6.2, 8.0)
HOLDS = (0.0, 1.5, 0.0, 0.25, 0.75)


def keyframes(times=(None,) * 5, holds=(0.0,) * 5):
    """Return keyframes around the origin at uneven distances."""
    return tuple(
        Keyframe(np.array(eye, float), look_at(eye, (0.1 * i, 0.1, 0)), 50.0 - 3 * i, time, hold)
        for i, (eye, time, hold) in enumerate(zip(EYES, times, holds, strict=True))
    )


def line(*places, times=None, holds=None, **more):
    """Return a path along the x axis without turns, on which the distance is x."""
    times, holds = times or (None,) * len(places), holds or (0.0,) * len(places)
    made = (
        Keyframe(np.array((x, 0.0, 0.0)), np.eye(3), 50.0, t, h)
        for x, t, h in zip(places, times, holds, strict=True)
    )
    return KeyframePath(tuple(made), False, **more)


def speed(curve, times, dt=1e-5):
    """Return the speed of the centre by central differences, world units per second."""
    after, before = (curve.poses(np.asarray(times) + side * dt / 2)[0] for side in (1, -1))
    return np.linalg.norm(after - before, axis=1) / dt


def test_a_path_of_two_views_starts_and_ends_slowly():
    at = np.linspace(0, 3, 31)
    s = at / 3
    for ease in ("ends", "views"):
        x = PathCurve(line(0.0, 5.0, duration=3.0, ease=ease)).poses(at)[0][:, 0]
        np.testing.assert_allclose(x, 5 * s * s * (3 - 2 * s), atol=1e-12)


@pytest.mark.parametrize("times", [None, (0.0, 1.0, 2.5, 7.0)])
def test_slow_at_every_view_stops_there_and_nowhere_else(times):
    """Between two views, the speed follows the parabola 6 s (1 - s); without times the views keep theirs."""
    places = (0.0, 1.0, 4.0, 9.0)
    curve = PathCurve(line(*places, times=times, ease="views"))
    met = np.array(times or [6 * x / 9 for x in places])
    np.testing.assert_allclose(curve.poses(met)[0][:, 0], places, atol=1e-9)
    for i in range(3):
        at = np.linspace(met[i], met[i + 1], 21)
        s = (at - met[i]) / (met[i + 1] - met[i])
        share = [quad(lambda x: 6 * x * (1 - x), 0, end)[0] for end in s]
        expected = places[i] + (places[i + 1] - places[i]) * np.array(share)
        np.testing.assert_allclose(curve.poses(at)[0][:, 0], expected, atol=2e-3)
        assert speed(curve, at[1:-1]).min() > 0.1
    assert speed(curve, met).max() < 1e-3


@pytest.mark.parametrize("times", [None, TIMES])
def test_slow_at_both_ends_does_not_change_what_lies_between(times):
    plain, eased = (
        PathCurve(KeyframePath(keyframes(times or (None,) * 5), False, ease=e)) for e in (None, "ends")
    )
    assert eased.seconds == plain.seconds and eased.length == plain.length
    places = plain._lengths[::64]
    met = plain._times if times else plain.seconds * places / plain.length
    np.testing.assert_allclose(eased.poses(met)[0], [k.eye for k in keyframes()], atol=1e-9)
    between = np.linspace(met[1], met[-2], 50)
    for one, other in zip(eased.poses(between), plain.poses(between), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    assert speed(eased, met[[0, -1]]).max() < 1e-3 * speed(plain, met[1:2]).max()
    assert speed(plain, met[[0, -1]] + [1e-3, -1e-3]).min() > 0.1, "the plain path starts at once"


@pytest.mark.parametrize("ease", [None, "ends", "views"])
@pytest.mark.parametrize("loop", [False, True])
def test_speed_is_never_negative_and_has_no_jump(ease, loop):
    path = KeyframePath(keyframes(TIMES, HOLDS), loop, 10.0 if loop else None, ease)
    curve = PathCurve(path)
    at = np.linspace(0, curve.seconds - 1e-9, 20001)
    places = curve.place(at)
    assert np.diff(places).min() >= -1e-12
    rates = np.diff(places) / np.diff(at)
    # the acceleration is bounded: 6 times the mean speed over the time of a segment, the shortest of which has 0.5 s
    assert np.abs(np.diff(rates)).max() < 40 * curve.length / curve.seconds * (at[1] - at[0]) / 0.5
    if ease and loop:
        assert max(rates[0], rates[-1]) < 1e-2, "a loop eases at its seam"


def test_a_hold_rests_at_its_view_and_lengthens_the_path():
    curve = PathCurve(KeyframePath(keyframes(TIMES, HOLDS), False))
    assert curve.seconds == 8.0 + 0.75 - 1.0
    for keyframe in keyframes(TIMES, HOLDS):
        during = keyframe.time - 1.0 + np.linspace(0, keyframe.hold, 7)
        eyes, rotations, fovs = curve.poses(during)
        np.testing.assert_allclose(eyes, [keyframe.eye] * 7, atol=1e-9)
        np.testing.assert_allclose(rotations, [keyframe.R] * 7, atol=1e-9)
        np.testing.assert_allclose(fovs, keyframe.fov)
    held = [k.time - 1.0 for k in keyframes(TIMES, HOLDS)]
    assert speed(curve, [held[1] - 1e-3, held[1] + 1.5 + 1e-3]).max() < 0.1, "it stops and starts smoothly"
    assert speed(curve, [held[2]]).min() > 0.3


def test_a_hold_is_two_equal_keyframes():
    """The file of an older version that rests by two equal keyframes moves alike."""
    with_hold = line(0.0, 1.0, 3.0, times=(0.0, 1.0, 4.0), holds=(0.0, 2.0, 0.5))
    twice = line(0.0, 1.0, 1.0, 3.0, 3.0, times=(0.0, 1.0, 3.0, 4.0, 4.5))
    at = np.linspace(0, 4.5, 200)
    np.testing.assert_allclose(PathCurve(with_hold).poses(at)[0], PathCurve(twice).poses(at)[0], atol=1e-12)


def test_files_keep_ease_and_hold_and_older_files_their_bytes(tmp_path):
    path = KeyframePath(keyframes(TIMES, HOLDS), True, 12.0, "views")
    write_path(tmp_path / "path.json", path)
    document = json.loads((tmp_path / "path.json").read_text())
    assert document["ease"] == "views" and [k.get("hold") for k in document["keyframes"]] == [
        *(None, 1.5, None, 0.25, 0.75)
    ]
    again = read_path(tmp_path / "path.json")
    assert again.ease == "views" and [k.hold for k in again.keyframes] == list(HOLDS)
    assert again.placed(np.eye(3), 2.0, (0, 0, 0)).document()["ease"] == "views"
    plain = KeyframePath(keyframes(TIMES), True, 12.0).document()
    assert list(plain) == ["format", "version", "loop", "duration", "keyframes"]
    assert all(list(entry) == ["position", "rotation", "fov", "time"] for entry in plain["keyframes"])


BAD = {
    "ease": (lambda d: d.update(ease="bounce"), 'ease: is "bounce"'),
    "no ease": (lambda d: d.update(ease=None), "ease: is null"),
    "negative": (
        lambda d: d["keyframes"][1].update(hold=-1),
        r"keyframes\[1\].hold: is -1, but has to be a number, at least",
    ),
    "zero": (
        lambda d: d["keyframes"][1].update(hold=0),
        r"keyframes\[1\].hold: is 0, but has to be a number, at least 0.001",
    ),
    "text": (lambda d: d["keyframes"][1].update(hold="2 s"), r"keyframes\[1\].hold: is \"2 s\""),
    "overlap": (
        lambda d: d["keyframes"][1].update(hold=2.5),
        r"keyframes\[2\].time: is 4.0, .* keyframe before, at 1.5, which holds until 4.0",
    ),
    "no times": (
        lambda d: [k.pop("time") for k in d["keyframes"]] and d["keyframes"][0].update(hold=1),
        r"keyframes\[0\].hold: needs a time",
    ),
    "loop": (
        lambda d: (d.update(loop=True, duration=7.5), d["keyframes"][4].update(hold=1)),
        "duration: is 7.5, but a loop with times needs one that is longer than its keyframes, 8.0 s",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_reading_is_strict(name):
    change, says = BAD[name]
    document = KeyframePath(keyframes(TIMES), False).document()
    parsed_path(document)
    change(document)
    with pytest.raises(ArgumentError, match=says):
        parsed_path(document)
