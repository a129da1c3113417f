"""What arrives late on the page of a capture, while something is pressed, or after a later question."""

import re

import pytest

from gsplat_edu.data.left_out import read_left_out
from viewer.handles import until
from viewer.test_capture_matches import DOTS
from viewer.test_capture_page import folder, opened, served
from waiting import awaited, settle

__all__ = ["folder", "opened", "served"]


def test_a_photo_is_laid_over_the_picture_before_it_is_shown(opened):
    """Otherwise it would be shown for a moment at a corner of the window."""
    tab = opened()
    where = (
        "() => { const { x, y, width } = element('through').getBoundingClientRect(); return [x, y, width]; }"
    )
    at_first = tab.evaluate(f"""async () => {{
      viewer.askFrame = () => {{}};
      viewer.choose(2);
      await viewer.look();
      return ({where})();
    }}""")
    tab.evaluate("viewer.draw(viewer.camera(), 0)")
    assert at_first == tab.evaluate(where) and at_first[2] > 100


PHOTOS = re.compile("/thumbs/")


def first_held(tab, address):
    """Hold the first request from now on for an address; return a list that will have its route."""
    held = []
    tab.route(address, lambda route: route.continue_() if held else held.append(route))
    return held


def waits_for(tab, held):
    awaited(tab, lambda: held)
    return held[0]


def pressed_while(tab, name, arrive):
    """Press a button, let something arrive that moves it away from the pointer, and release."""
    button = tab.get_by_role("button", name=name)
    button.hover()
    before = button.bounding_box()
    tab.mouse.down()
    arrive()
    settle(tab)
    assert button.bounding_box() != before
    tab.mouse.up()


def test_a_press_counts_although_findings_arrive_meanwhile(opened, served):
    """They lengthen the legend, which moves the buttons below it."""
    tab, done = opened(), []

    def heard(route):
        answer = route.fetch()
        route.fulfill(response=answer)
        done.extend([1] if answer.json()["done"] else [])

    def arrive():
        tab.route("**/findings*", heard)
        served.marks = {tab.evaluate(f"viewer.facts.cameras[{i}].name"): [f"kind {i}"] for i in range(4)}
        waits_for(tab, done)

    pressed_while(tab, "draw a box", arrive)
    until(tab, "viewer.region.drawing")
    tab.get_by_text("The doctor found something about 4 photos.").wait_for()


@pytest.mark.parametrize("call", ["mark(new Map([[name, ['dark']]]))", "left(new Map([[photo, true]]))"])
def test_a_press_counts_although_the_page_around_tells_something_meanwhile(opened, call):
    tab = opened()
    tell = f"() => {{ const {{ name, photo }} = viewer.cameras.list[1]; viewer.{call}; }}"
    pressed_while(tab, "draw a box", lambda: tab.evaluate(tell))
    until(tab, "viewer.region.drawing && document.querySelectorAll('#legend li').length === 2")


def test_a_press_counts_although_the_photo_arrives_meanwhile(opened):
    tab = opened()
    held = first_held(tab, PHOTOS)
    tab.evaluate("() => { viewer.choose(2); }")
    route = waits_for(tab, held)

    def arrive():
        with tab.expect_response(PHOTOS):
            route.continue_()

    pressed_while(tab, "stand here", arrive)
    until(tab, "viewer.through === viewer.cameras.list[2]")
    tab.locator("#photo").wait_for()


def test_two_photos_are_left_out_although_the_first_answer_is_late(opened, folder):
    tab = opened()
    held = first_held(tab, "**/left-out")
    tab.evaluate("() => { for (const i of [1, 2]) { viewer.choose(i); viewer.leave(); } }")
    route = waits_for(tab, held)
    answer = route.fetch()
    asked = []
    tab.on("request", lambda request: asked.append(request.url.rpartition("/")[2]))
    settle(tab)  # the page would ask the second question
    assert "left-out" not in asked
    route.fulfill(response=answer)
    until(tab, "viewer.cameras.list.filter((camera) => camera.left_out).length === 2")
    assert len(read_left_out(folder)) == 2
    tab.evaluate("() => { viewer.leave(); viewer.leave(); }")  # uses it again, and leaves it out
    tab.evaluate("viewer.leaving")
    assert len(read_left_out(folder)) == 2
    tab.get_by_role("button", name="use again").wait_for()


def test_the_focus_stays_in_the_list_of_photos_that_share_points(opened):
    tab = opened()
    tab.evaluate("() => { viewer.choose(2); }")
    tab.focus("#sharing button >> nth=1")
    tab.keyboard.press("Enter")
    until(tab, "viewer.cameras.chosen !== 2")
    assert (
        tab.evaluate("[...document.querySelectorAll('#sharing button')].indexOf(document.activeElement)") == 1
    )


def test_the_points_of_a_photo_are_not_drawn_on_the_one_before(opened):
    tab = opened()
    tab.evaluate("() => { viewer.choose(2); }")
    until(tab, f"({DOTS})()")
    held = first_held(tab, PHOTOS)
    tab.evaluate("() => { viewer.choose(3); }")
    route = waits_for(tab, held)
    assert not tab.evaluate(DOTS)
    route.continue_()
    until(tab, f"({DOTS})()")
