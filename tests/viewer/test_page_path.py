"""The camera path of a page in a browser: the same motion as in Python, saved views, and the downloaded file."""

import json

import numpy as np
import pytest

from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import KeyframePath, read_path
from gsplat_edu.viewer import page
from js.camera_paths import AROUND, around
from viewer.handles import until
from waiting import FRAMES

ORIGIN = (500.0, -64.0, 8.0)

BUTTONS = ("#save-view", "#play", "#download-path")


@pytest.fixture
def opened(visit, tmp_path, random_gaussians, three_views):
    """Return a function that opens the page of a scene with an origin, with or without a path."""

    def make(path=None, **options):
        scene, tour = Scene(random_gaussians(60), origin=ORIGIN), page.Tour(path)
        (tmp_path / "scene.html").write_bytes(page.html(scene, three_views, title="scene", tour=tour))
        return visit(width=640, height=480, **options).open(tmp_path / "scene.html").ready().open_controls()

    return make


def stands_at(shown, expected):
    """Return whether the view is that of a keyframe."""
    here = shown.evaluate("viewer.view.camera")
    np.testing.assert_allclose(here["eye"], expected.eye, atol=1e-6)
    np.testing.assert_allclose(here["R"], expected.R, atol=1e-6)
    assert 2 * np.degrees(np.arctan(here["H"] / 2 / here["fy"])) == pytest.approx(expected.fov)


def test_an_embedded_path_is_played_to_its_end_and_stops_when_somebody_moves(opened):
    path = KeyframePath(AROUND[:3], False, 0.5)
    shown = opened(path, fresh=True)
    before = shown.evaluate("viewer.view.camera.eye")
    shown.tab.click("#path summary")
    assert shown.tab.inner_text("#path summary") == "Camera path (3)"
    shown.tab.click("#play")
    shown.tab.wait_for_selector('#play[aria-pressed="false"]')
    stands_at(shown, AROUND[2])
    assert shown.evaluate("viewer.view.camera.eye") != before
    shown.tab.check("#loop")
    shown.press("p")
    shown.tab.wait_for_selector('#play[aria-pressed="true"]')
    until(shown.tab, "viewer.journey.began !== null")
    shown.tab.mouse.move(100, 150)
    shown.tab.mouse.wheel(0, 100)
    shown.tab.wait_for_selector('#play[aria-pressed="false"]')
    still = shown.evaluate("viewer.view.camera.eye")
    shown.evaluate(FRAMES)
    assert shown.evaluate("viewer.view.camera.eye") == still


def downloaded(shown, tmp_path):
    with shown.tab.expect_download() as caught:
        shown.tab.click("#download-path")
    assert caught.value.suggested_filename == "scene.path.json"
    caught.value.save_as(tmp_path / "path.json")
    return tmp_path / "path.json"


def test_saved_views_become_the_file_that_render_reads(opened, tmp_path):
    shown = opened(fresh=True)
    assert shown.tab.inner_text("#path summary") == "Camera path (0)"
    shown.tab.click("#path summary")
    assert [shown.tab.is_disabled(name) for name in BUTTONS] == [False, True, True]
    shown.press("p")  # an empty path cannot be played, without a complaint
    views = []
    for press in ("k", "ArrowRight", "k", "ArrowRight"):
        shown.press(press)
        views.append(shown.evaluate("viewer.view.camera"))
    shown.tab.click("#save-view")
    assert shown.tab.inner_text("#path summary") == "Camera path (3)"
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
    assert tab.inner_text("#path summary") == "Camera path (1)"
    tab.focus('button[aria-label="go to view 1"]')
    tab.keyboard.press("k")
    assert tab.inner_text("#path summary") == "Camera path (2)"
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
        shown.press("Enter")  # the next button has the focus
        assert shown.tab.inner_text("#path summary") == f"Camera path ({left})"
    shown.tab.click("#save-view")
    assert not read_path(downloaded(shown, tmp_path), ORIGIN).timed, "a single time determines no speed"
