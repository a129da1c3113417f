"""Photos that share nothing, in Chromium: the search for their poses fails, and leaves one next step."""

import re

import pytest

from studio.pages import DROP, encoded, go, png
from waiting import until_in

PRIMARY = "[...document.querySelectorAll('main .primary')].filter((one) => one.checkVisibility())"


def test_a_failed_search_for_poses_leaves_one_next_step_and_nothing_to_train(visitor, library):
    pytest.importorskip("pycolmap")
    studio, _ = library
    person = visitor()
    tab = person.tab
    tab.evaluate(DROP, [[[f"{i}.png", encoded(png(i, (160, 120)))] for i in range(3)], ".drop"])
    person.reach("#/photos/photos")
    tab.get_by_role("button", name="Find the poses").click()
    card = tab.get_by_role("article", name="poses of photos")
    card.locator(".badge.failed").wait_for()
    (work,) = (job.work for job in studio.queue.jobs())
    assert (studio.library.root / work.outputs[0] / "sfm").is_dir(), "a search that can be resumed is kept"
    assert not card.locator("progress").is_visible(), (
        "a bar says how far a job is, not how far its last stage was"
    )
    assert tab.evaluate(f"{PRIMARY}.map((one) => one.textContent)") == ["Try again"]

    go(tab, "")
    until_in(tab, tab, "document.querySelectorAll('.project li .badge').length === 2")
    assert tab.locator("a.card").count() == 1, "photos and what was made from them are one project"
    inside = tab.get_by_role("article", name="photos")
    inside.locator("summary", has_text="Everything in it (2)").click()
    assert inside.locator("li", has_text="Capture photos").locator(".badge").inner_text() == "no poses yet"
    inside.get_by_role("link", name=re.compile("^Next: Try again")).wait_for()
    go(tab, "captures/photos")
    tab.get_by_text("has no poses yet").wait_for()
    assert not tab.get_by_role("button", name="Start training").is_visible()
    assert not tab.get_by_role("button", name="Examine").is_visible()
    back = tab.get_by_role("link", name="Go to the photos")
    until_in(tab, tab, f"{PRIMARY}.length > 0")  # the next step comes with the library's list
    assert tab.evaluate(f"{PRIMARY}.length") == 1
    back.click()
    person.reach("#/photos/photos")
