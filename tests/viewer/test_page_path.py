"""The camera path of a page in a browser: the same motion as in Python, saved views, and the downloaded file."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.evaluate.keyframes import Keyframe, KeyframePath, read_path
from gsplat_edu.evaluate.path_curve import PathCurve
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import look_at
from gsplat_edu.viewer import page
from viewer.handles import until

ORIGIN = (500.0, -64.0, 8.0)

POSES = """([path, times]) => {
  const curve = new PathCurve({ ...path, keyframes: path.keyframes.map(readKeyframe) });
  const poses = times.map((time) => curve.pose(time));
  return { length: curve.length, poses };
}"""

BUTTONS = ("#save-view", "#play", "#download-path")


def keyframe(eye, target=(0.1, 0.2, 0.3), fov=50.0, time=None):
    return Keyframe(np.array(eye, float), look_at(eye, target), fov, time)


def turned(rotvec, eye=(0.0, 0.0, 0.0), time=None):
    return Keyframe(np.array(eye, float), Rotation.from_rotvec(rotvec).as_matrix().T, 60.0, time)


def around(*times, count=5):
    """Return keyframes around zero at uneven distances, with a changing zoom."""
    eyes = [(0, 0, -4), (0.3, -0.2, -3.8), (2.5, -0.5, -2), (3, 0, 1), (0.5, 0.4, 3.5)]
    times = times or (None,) * count
    return tuple(
        keyframe(e, fov=50.0 - 4 * i, time=t) for i, (e, t) in enumerate(zip(eyes, times, strict=False))
    )


def holding(keyframes, *holds):
    """Return keyframes that rest for these seconds."""
    return tuple(replace(keyframe, hold=hold) for keyframe, hold in zip(keyframes, holds, strict=True))


AROUND = around()
PATHS = {
    "open": KeyframePath(AROUND, False),
    "loop": KeyframePath(AROUND, True),
    "two": KeyframePath(AROUND[:2], False, 3.0),
    "there and back": KeyframePath(AROUND[2:4], True),
    "three": KeyframePath(AROUND[1:4], False),
    "times": KeyframePath(around(1.0, 1.5, 4.0, 4.2, 8.0), False),
    "loop with times": KeyframePath(around(-1.0, 1.5, 4.0, 4.2, 8.0), True, 12.0),
    "equal neighbours": KeyframePath((AROUND[0], *AROUND[:3], AROUND[2], AROUND[0]), True),
    "rest": KeyframePath(
        tuple(turned((0, min(i, 1) * 0.5, 0), (i // 2, 0, 0), float(i)) for i in range(4)), False
    ),
    "all equal": KeyframePath(AROUND[:1] * 3, False),
    "full turn on the spot": KeyframePath(tuple(turned((0, i * 2.0944, 0)) for i in range(3)), True),
    "slow at the ends": KeyframePath(AROUND, False, 7.0, "ends"),
    "slow at every view": KeyframePath((*AROUND[:3], AROUND[2], *AROUND[3:]), False, None, "views"),
    "loop slow at every view": KeyframePath(AROUND, True, None, "views"),
    "times, holds, slow at the ends": KeyframePath(
        holding(around(1.0, 1.6, 4.0, 6.2, 8.0), 0.5, 0.0, 0.0, 0.7, 1.5), False, None, "ends"
    ),
    "loop with times and holds": KeyframePath(
        holding(around(-1.0, 1.5, 4.0, 4.2, 8.0), 0.0, 2.0, 0.0, 0.0, 1.0), True, 12.0, "views"
    ),
    "upside down": KeyframePath(
        tuple(turned((3.0 - i * 0.4, i * 0.7, 0.2), (i, 0, 0)) for i in range(6)), False
    ),
}


@pytest.fixture
def opened(visit, tmp_path, random_gaussians, three_views):
    """Return a function that opens the page of a scene with an origin, with or without a path."""

    def make(path=None, **options):
        scene, tour = Scene(random_gaussians(60), origin=ORIGIN), page.Tour(path)
        (tmp_path / "scene.html").write_bytes(page.html(scene, three_views, title="scene", tour=tour))
        return visit(width=640, height=480, **options).open(tmp_path / "scene.html").ready()

    return make


def test_the_page_moves_as_python_does(opened):
    shown = opened()
    for name, path in PATHS.items():
        curve = PathCurve(path)
        # including times before the beginning, after the end, and exactly at keyframes
        times = np.r_[
            np.linspace(-1.0, curve.seconds + 1.0, 53), [float(k.time or 0) for k in path.keyframes]
        ]
        found = shown.tab.evaluate(POSES, [path.document(), times.tolist()])
        assert found["length"] == pytest.approx(curve.length, rel=1e-9, abs=1e-9), name
        for key, expected in zip(("eye", "R", "fov"), curve.poses(times), strict=True):
            is_now = np.array([pose[key] for pose in found["poses"]])
            np.testing.assert_allclose(is_now, expected, atol=1e-6, err_msg=f"{name}: {key}")


def stands_at(shown, expected):
    """Return whether the view is that of a keyframe."""
    here = shown.tab.evaluate("viewer.view.camera")
    np.testing.assert_allclose(here["eye"], expected.eye, atol=1e-6)
    np.testing.assert_allclose(here["R"], expected.R, atol=1e-6)
    assert 2 * np.degrees(np.arctan(here["H"] / 2 / here["fy"])) == pytest.approx(expected.fov)


def test_an_embedded_path_is_played_to_its_end_and_stops_when_somebody_moves(opened):
    path = KeyframePath(AROUND[:3], False, 0.5)
    shown = opened(path, fresh=True)
    before = shown.tab.evaluate("viewer.view.camera.eye")
    shown.tab.click("#path summary")
    assert shown.tab.inner_text("#path summary") == "camera path (3)"
    shown.tab.click("#play")
    shown.tab.wait_for_selector('#play[aria-pressed="false"]')
    stands_at(shown, AROUND[2])
    assert shown.tab.evaluate("viewer.view.camera.eye") != before
    shown.tab.check("#loop")
    shown.tab.keyboard.press("p")
    shown.tab.wait_for_selector('#play[aria-pressed="true"]')
    until(shown.tab, "viewer.journey.began !== null")
    shown.tab.mouse.move(450, 300)
    shown.tab.mouse.wheel(0, 100)
    shown.tab.wait_for_selector('#play[aria-pressed="false"]')
    still = shown.tab.evaluate("viewer.view.camera.eye")
    shown.tab.wait_for_timeout(100)
    assert shown.tab.evaluate("viewer.view.camera.eye") == still


def downloaded(shown, tmp_path):
    with shown.tab.expect_download() as caught:
        shown.tab.click("#download-path")
    assert caught.value.suggested_filename == "scene.path.json"
    caught.value.save_as(tmp_path / "path.json")
    return tmp_path / "path.json"


def test_saved_views_become_the_file_that_render_reads(opened, tmp_path):
    shown = opened(fresh=True)
    assert shown.tab.inner_text("#path summary") == "camera path (0)"
    shown.tab.click("#path summary")
    assert [shown.tab.is_disabled(name) for name in BUTTONS] == [False, True, True]
    shown.tab.keyboard.press("p")  # an empty path cannot be played, without a complaint
    views = []
    for press in ("k", "ArrowRight", "k", "ArrowRight"):
        shown.tab.keyboard.press(press)
        views.append(shown.tab.evaluate("viewer.view.camera"))
    shown.tab.click("#save-view")
    assert shown.tab.inner_text("#path summary") == "camera path (3)"
    assert [shown.tab.is_disabled(name) for name in BUTTONS] == [False, False, False]
    found = read_path(downloaded(shown, tmp_path), ORIGIN)
    assert not found.loop and found.duration is None and not found.timed
    for one, view in zip(found.keyframes, (views[0], views[1], views[3]), strict=True):
        np.testing.assert_allclose(one.eye, view["eye"], atol=1e-9)
        np.testing.assert_allclose(one.R, view["R"], atol=1e-12)
        assert one.fov == pytest.approx(2 * np.degrees(np.arctan(view["H"] / 2 / view["fy"])))
    shown.tab.click('button[aria-label="go to view 2"]')
    stands_at(shown, found.keyframes[1])
    shown.tab.click('button[aria-label="remove view 2"]')
    shown.tab.check("#loop")
    again = read_path(downloaded(shown, tmp_path), ORIGIN)
    assert again.loop and len(again.keyframes) == 2 and again.seconds == 4.0
    np.testing.assert_array_equal(again.keyframes[1].eye, found.keyframes[2].eye)


def test_a_held_key_saves_one_view_and_the_focus_stays_in_the_list(opened):
    tab = opened(fresh=True).tab
    tab.keyboard.down("k")
    tab.keyboard.down("k")  # as the keyboard repeats it
    tab.keyboard.up("k")
    assert tab.inner_text("#path summary") == "camera path (1)"
    tab.focus('button[aria-label="go to view 1"]')
    tab.keyboard.press("k")
    assert tab.inner_text("#path summary") == "camera path (2)"
    assert tab.evaluate("document.activeElement.getAttribute('aria-label')") == "go to view 1"


def test_an_embedded_path_is_written_unchanged_and_keeps_its_times_when_it_grows(opened, tmp_path):
    path = KeyframePath(around(1.0, 1.5, 4.0, 5.0), True, 7.5)
    shown = opened(path, fresh=True)
    shown.tab.click("#path summary")
    document = json.loads(downloaded(shown, tmp_path).read_text())
    expected = path.shifted(ORIGIN).document()
    assert {key: document[key] for key in document if key != "keyframes"} == {
        key: expected[key] for key in expected if key != "keyframes"
    }
    for one, other in zip(document["keyframes"], expected["keyframes"], strict=True):
        assert one == other
    shown.tab.click("#save-view")
    grown = read_path(downloaded(shown, tmp_path), ORIGIN)
    assert [k.time for k in grown.keyframes] == pytest.approx([1.0, 1.5, 4.0, 5.0, 5.0 + 4 / 3])
    assert grown.duration == pytest.approx(5 / 4 * (4 + 4 / 3)), (
        "the segment back to the start takes the mean time"
    )
    shown.tab.uncheck("#loop")
    assert read_path(downloaded(shown, tmp_path), ORIGIN).duration is None
    shown.tab.focus('button[aria-label="remove view 1"]')
    for left in (4, 3, 2, 1):
        shown.tab.keyboard.press("Enter")  # the next button has the focus
        assert shown.tab.inner_text("#path summary") == f"camera path ({left})"
    shown.tab.click("#save-view")
    assert not read_path(downloaded(shown, tmp_path), ORIGIN).timed, "a single time determines no speed"
