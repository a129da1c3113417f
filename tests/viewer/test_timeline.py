"""The timeline of the camera path, used by mouse, keys and fingers, in the editor and in a visitor's page. What its
edits make of a path is tested in js/path_edits.test.js.
"""

from dataclasses import replace

import numpy as np
import pytest

from gestures import drag, swipe
from gsplat_edu.edits.apply import views_after
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.curve import PathCurve
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.scene.camera import look_at
from gsplat_edu.viewer import page
from viewer.handles import until

EYES = [(0, 0, -4), (0.5, -0.2, -3.6), (2.5, -0.5, -2), (3, 0, 1)]
TIMES = (0.0, 1.0, 3.0, 6.0)


def keyframes(times=TIMES, holds=(0.0,) * 4):
    return tuple(
        Keyframe(np.array(eye, float), look_at(eye, (0, 0, 0)), 50.0 - i, time, hold)
        for i, (eye, time, hold) in enumerate(zip(EYES, times, holds, strict=True))
    )


def path(times=TIMES, holds=(0.0,) * 4, loop=False, **more):
    return KeyframePath(keyframes(times, holds), loop, **more)


@pytest.fixture
def opened(edit_page, random_gaussians):
    """Return a function that opens the editor with a path, which is one operation."""

    def make(of, width=900, height=700, **options):
        shown = edit_page(random_gaussians(40), width=width, height=height, **options)
        shown.evaluate("(path) => editor.perform({ op: 'path', path })", of.document())
        if not shown.tab.is_visible("#tools"):
            shown.tab.click("#fold")
        shown.tab.click("#path summary")
        shown.tab.wait_for_selector("#strip")
        shown.evaluate("document.getElementById('strip').scrollIntoView({ block: 'center' })")
        return shown

    return make


def stored(shown):
    """Return the path that the edits file of the page stores, as Python reads it."""
    edits = shown.edits()
    return views_after(edits.operations).path


def steps(shown):
    return len(shown.operations())


def seen_at(shown, curve, seconds):
    """Check that the picture shows the path at a time."""
    eyes, rotations, _ = curve.poses([seconds])
    here = shown.evaluate("viewer.view.camera")
    np.testing.assert_allclose(here["eye"], eyes[0], atol=1e-6)
    np.testing.assert_allclose(here["R"], rotations[0], atol=1e-6)


def order(shown):
    """Return which of the first views are now where, by their fields of view."""
    return [round(50 - k.fov) + 1 for k in stored(shown).keyframes]


def times(shown):
    return [k.time for k in stored(shown).keyframes]


BEGINS = """() => {
  const { timeline } = viewer.keyframes;
  const reached = timeline.reached.bind(timeline);
  window.began = [];
  timeline.reached = (seconds) => {
    began.push(seconds);
    reached(seconds);
  };
}"""
"""Notes where the playhead is in each frame from now on."""


class Strip:
    """Where the strip shows times."""

    def __init__(self, shown, seconds=6.0):
        self.box, self.span = shown.tab.locator("#strip").bounding_box(), 1.1 * seconds

    def marker(self, seconds):
        return self.box["x"] + seconds / self.span * self.box["width"], self.box["y"] + 36

    def ruler(self, seconds):
        return self.box["x"] + seconds / self.span * self.box["width"], self.box["y"] + 8

    @property
    def pixel(self):
        return self.span / self.box["width"]


def focused(shown):
    return shown.evaluate("document.activeElement.getAttribute('aria-label')")


def test_markers_are_pressed_and_dragged_and_undo_takes_it_back(opened):
    shown = opened(path())
    shown.tab.mouse.click(*Strip(shown).marker(3.0))
    assert steps(shown) == 1 and shown.tab.inner_text("#chosen-view") == "view 3"
    seen_at(shown, PathCurve(path()), 3.0)

    strip, before = Strip(shown), shown.text()
    drag(shown.tab, strip.marker(3.0), strip.marker(4.2))
    assert steps(shown) == 2 and order(shown) == [1, 2, 3, 4]
    assert times(shown) == pytest.approx([0, 1, 4.2, 6], abs=strip.pixel)
    assert focused(shown) == "time of view 3"
    assert float(shown.tab.input_value("#view-time")) == pytest.approx(times(shown)[2], abs=0.006)
    shown.press("Control+z")
    assert shown.text() == before
    assert shown.tab.get_attribute(".marker >> nth=2", "aria-valuenow") == "3"

    strip = Strip(shown)
    drag(shown.tab, strip.marker(3.0), strip.marker(0.5))
    assert order(shown) == [1, 3, 2, 4]
    assert times(shown) == pytest.approx([0, 0.5, 1, 6], abs=strip.pixel)
    assert shown.tab.inner_text("#chosen-view") == "view 2" and focused(shown) == "time of view 2"

    shown.press("Control+z")
    strip = Strip(shown)
    drag(shown.tab, strip.marker(0.0), strip.marker(2.0))
    assert order(shown) == [2, 1, 3, 4]
    assert times(shown) == pytest.approx([0, 1, 2, 5], abs=strip.pixel)
    strip = Strip(shown, stored(shown).seconds)
    drag(shown.tab, strip.marker(times(shown)[3]), strip.marker(times(shown)[3] + 0.4))
    assert stored(shown).seconds == pytest.approx(5.4, abs=2 * strip.pixel)


def test_the_playhead_scrubs_and_play_begins_there(opened):
    shown = opened(path(ease="views"))
    strip, curve = Strip(shown), PathCurve(path(ease="views"))
    drag(shown.tab, strip.ruler(1.0), strip.ruler(4.5))
    at = shown.evaluate("viewer.keyframes.timeline.at")
    assert at == pytest.approx(4.5, abs=strip.pixel) and steps(shown) == 1
    seen_at(shown, curve, at)
    shown.tab.click("#play")
    shown.tab.wait_for_selector('#play[aria-pressed="false"]')
    assert shown.evaluate("viewer.keyframes.timeline.at") == pytest.approx(6.0)
    seen_at(shown, curve, 6.0)
    shown.evaluate(BEGINS)
    shown.tab.click("#play")
    until(shown.tab, "began.length > 0")
    assert shown.evaluate("began[0]") < 5.5, "after the end it begins again"
    if shown.tab.get_attribute("#play", "aria-pressed") == "true":
        shown.tab.click("#play")


def test_keys_move_views_and_the_playhead_while_a_tool_is_chosen(opened):
    shown = opened(path())
    shown.choose("rectangle")
    shown.tab.focus(".marker >> nth=1")
    shown.press(*["ArrowRight"] * 3)
    assert times(shown) == pytest.approx([0, 1.3, 3, 6]) and steps(shown) == 4
    shown.press("Shift+ArrowRight", "Shift+ArrowRight")
    assert order(shown) == [1, 3, 2, 4] and times(shown) == pytest.approx([0, 3, 3.3, 6])
    assert focused(shown) == "time of view 3" and shown.evaluate("editor.tools.cursor") is None
    now = path((0.0, 3.0, 3.3, 6.0))
    now = replace(
        now,
        keyframes=tuple(
            replace(keyframes()[i], time=k.time) for i, k in zip((0, 2, 1, 3), now.keyframes, strict=True)
        ),
    )
    shown.press("Enter")
    seen_at(shown, PathCurve(now), 3.3)
    shown.tab.focus("#playhead")
    shown.press("Home", "Shift+ArrowRight", "ArrowRight")
    seen_at(shown, PathCurve(now), 1.1)
    assert shown.tab.get_attribute("#playhead", "aria-valuetext") == "1.1 s"
    shown.press("End")
    seen_at(shown, PathCurve(now), 6.0)


def test_a_finger_drags_a_marker_and_scrubs(opened):
    shown = opened(path(), width=390, height=844, has_touch=True)
    strip = Strip(shown)
    x, y = strip.marker(1.0)
    swipe(shown.tab, (x + 8, y), (strip.marker(2.2)[0] + 8, y + 5))
    assert times(shown) == pytest.approx([0, 2.2, 3, 6], abs=strip.pixel), (
        "the finger need not hit the middle"
    )
    swipe(shown.tab, strip.ruler(0.3), strip.ruler(5.0))
    at = shown.evaluate("viewer.keyframes.timeline.at")
    assert at == pytest.approx(5.0, abs=strip.pixel) and steps(shown) == 2
    seen_at(shown, PathCurve(stored(shown)), at)


def fill(shown, name, value):
    shown.tab.fill(f"#{name}", str(value))
    shown.press("Enter")


def test_numbers_set_time_rest_and_duration(opened):
    shown = opened(path())
    shown.tab.mouse.click(*Strip(shown).marker(1.0))
    fill(shown, "view-time", 1.5)
    assert times(shown) == pytest.approx([0, 1.5, 3, 6])
    fill(shown, "view-rest", 2.5)
    assert [k.hold for k in stored(shown).keyframes] == [0, 2.5, 0, 0]
    assert times(shown) == pytest.approx([0, 1.5, 4.01, 6]), "the rest pushes the next view later"
    fill(shown, "path-seconds", 12)
    assert stored(shown).seconds == pytest.approx(12)
    assert times(shown) == pytest.approx([0, 3, 8.02, 12]) and stored(shown).keyframes[
        1
    ].hold == pytest.approx(5)
    fill(shown, "view-rest", 0)
    assert "hold" not in shown.text().splitlines()[-3]
    shown.tab.select_option("#path-ease", "ends")
    assert stored(shown).ease == "ends"
    shown.do("undo")
    assert stored(shown).ease is None and shown.tab.input_value("#path-ease") == ""


def test_views_change_places_are_replaced_and_inserted(opened):
    shown = opened(path())
    strip = Strip(shown)
    shown.tab.mouse.click(*strip.marker(1.0))
    shown.tab.click("#view-later")
    assert order(shown) == [1, 3, 2, 4] and times(shown) == list(TIMES)
    shown.tab.click("#view-earlier")
    assert order(shown) == [1, 2, 3, 4]
    shown.evaluate("viewer.view.orbit(0.4, 0.1); viewer.moved(-1)")
    here = shown.evaluate("viewer.view.camera.eye")
    shown.tab.click("#replace-view")
    assert times(shown) == list(TIMES)
    np.testing.assert_allclose(stored(shown).keyframes[1].eye, here)
    shown.tab.mouse.click(*strip.ruler(2.0))
    shown.evaluate("viewer.view.orbit(0.2, 0); viewer.moved(-1)")
    here = shown.evaluate("viewer.view.camera.eye")
    shown.tab.click("#insert-view")
    assert times(shown) == pytest.approx([0, 1, 2, 3, 6], abs=strip.pixel)
    np.testing.assert_allclose(stored(shown).keyframes[2].eye, here)
    assert shown.tab.inner_text("#chosen-view") == "view 3"
    shown.evaluate("viewer.keyframes.timeline.goTo(3)")
    shown.tab.click("#insert-view")
    assert times(shown)[4] == pytest.approx(4.5), "at a view, halfway to the next one"


def test_a_path_without_times_keeps_its_speed_until_a_time_is_set(opened):
    shown = opened(path((None,) * 4))
    curve = PathCurve(path((None,) * 4))
    met = curve.seconds * curve._lengths[::64] / curve.length
    found = [float(shown.tab.get_attribute(f".marker >> nth={i}", "aria-valuenow")) for i in range(4)]
    assert found == pytest.approx(met, abs=0.006)
    fill(shown, "path-seconds", 9)
    assert not stored(shown).timed and stored(shown).duration == 9
    shown.evaluate("viewer.keyframes.timeline.goTo(1)")
    shown.tab.click("#insert-view")
    assert not stored(shown).timed and len(stored(shown).keyframes) == 5
    assert stored(shown).seconds == pytest.approx(12), "as long per segment as before"
    shown.do("undo")
    shown.tab.focus(".marker >> nth=3")
    shown.press("ArrowRight")
    assert times(shown) == pytest.approx([*(1.5 * met[:3]), 9.1])


def test_a_visitor_arranges_the_path_but_replaces_no_view_of_the_author(visit, tmp_path, random_gaussians):
    tour = page.Tour(path(ease="ends"))
    page.write(tmp_path / "scene.html", Scene(random_gaussians(40)), (), tour=tour)
    shown = visit(900, 700, fresh=True).open(tmp_path / "scene.html").ready().open_controls()
    shown.tab.click("#path summary")
    assert shown.tab.input_value("#path-ease") == "ends" and not shown.tab.is_visible("#replace-view")
    shown.tab.fill("#view-rest", "1.5")
    shown.press("Enter")
    assert shown.evaluate("viewer.keyframes.document().keyframes[0].hold") == 1.5
    shown.press("Escape")
    shown.evaluate("viewer.keyframes.timeline.goTo(4)")
    shown.tab.click("#insert-view")
    assert shown.tab.is_visible("#replace-view")
    labels = shown.tab.locator("#path li button[aria-label^=remove]").evaluate_all(
        "all => all.map((one) => one.ariaLabel)"
    )
    assert labels == ["remove view 4"], "only the visitor's own"
