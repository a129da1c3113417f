"""Searches for poses, in Chromium: one that fails leaves one next step, and photos that have no pose come first."""

import json
import re
from urllib.parse import quote

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.sfm.photos import fingerprint, photo_files
from studio.pages import BY_DAY, DROP, encoded, go, png
from waiting import until_in

PRIMARY = "[...document.querySelectorAll('main .primary')].filter((one) => one.checkVisibility())"


def test_a_failed_search_for_poses_leaves_one_next_step_and_nothing_to_train(visitor, library):
    pytest.importorskip("pycolmap")
    studio, _ = library
    person = visitor()
    tab = person.tab
    tab.evaluate(DROP, [[[f"{i}.png", encoded(png(i, (160, 120)))] for i in range(3)], ".drop"])
    person.reach(f"#/photos/{quote(BY_DAY)}")
    tab.get_by_role("button", name="Place the photos").click()
    card = tab.get_by_role("article", name=f"cameras of {BY_DAY}")
    card.locator(".badge.poor").wait_for()
    (work,) = (job.work for job in studio.queue.jobs())
    assert (studio.library.root / work.outputs[0] / "sfm").is_dir(), "a search that can be resumed is kept"
    assert not card.locator("progress").is_visible(), (
        "a bar says how far a job is, not how far its last stage was"
    )
    assert tab.evaluate(f"{PRIMARY}.map((one) => one.textContent)") == ["Try again"]

    inside = tab.locator(".everything")
    inside.locator("summary", has_text="Everything in it (2)").click()
    assert (
        inside.locator("li", has_text=f"Cameras {BY_DAY}").locator(".badge").inner_text() == "not placed yet"
    )
    go(tab, "")
    project = tab.get_by_role("article", name=BY_DAY)
    project.get_by_text("Finding the cameras failed").wait_for()
    assert tab.locator("a.card").count() == 1, "photos and what was made from them are one project"
    project.get_by_role("link", name=re.compile("^Next: Try again")).wait_for()
    go(tab, f"captures/{BY_DAY}")
    tab.get_by_text("are not placed yet").wait_for()
    assert not tab.get_by_role("button", name="Start training").is_visible()
    assert not tab.get_by_role("button", name="Examine").is_visible()
    back = tab.get_by_role("link", name="Go to the photos")
    until_in(tab, tab, f"{PRIMARY}.length > 0")  # the next step comes with the library's list
    assert tab.evaluate(f"{PRIMARY}.length") == 1
    back.click()
    person.reach(f"#/photos/{quote(BY_DAY)}")


def test_photos_that_were_not_placed_come_first_and_the_next_step_leads_to_the_cameras(visitor, library):
    root = library[0].library.root
    photos, capture = root / "photos" / "lamp", root / "captures" / "lamp"
    views, points, colors = procedural_capture(24, 18, splats=60)
    write_colmap(capture, views[6:], points, colors)
    photos.mkdir()
    for i in range(20):
        (photos / f"{i:02d}.png").write_bytes(png(i))
    names = [f"{i:02d}.png" for i in range(8)]
    given = fingerprint(photo_files(photos), photos)
    stages = {
        "photos": {"options": {"photos": given}, "facts": {"names": [f"{i:02d}.png" for i in range(20)]}},
        "mapping": {"options": {}, "facts": {"names": [f"{i:02d}.png" for i in range(8, 20)]}},
        "capture": {"options": {}, "facts": {"error": 0.7, "left_out": names}},
    }
    (capture / "sfm").mkdir()
    (capture / "sfm" / "stages.json").write_text(json.dumps({"stages": stages}))
    person = visitor()
    tab = person.tab
    tab.get_by_role("article", name="lamp").get_by_role(
        "link", name="Next: Look at the cameras, lamp"
    ).click()
    person.reach("#/captures/lamp")
    missing = tab.get_by_role("group", name="photos that were not placed")
    missing.get_by_text("8 of 20 photos were not placed.").wait_for()
    assert "Take two more photos beside each of them" in missing.inner_text()
    assert "Take two more beside 08.png." in missing.inner_text()
    until_in(
        tab,
        tab,
        "[...document.querySelectorAll('.unplaced img')].filter((one) => one.naturalWidth).length === 8",
    )
    for later in ("cameras", "training", "photos", "doctor"):
        box = tab.get_by_role("region", name=later).bounding_box()
        assert box["y"] > missing.bounding_box()["y"], later
    doctor = tab.get_by_role("region", name="doctor")
    finding = doctor.locator(".finding", has_text="8 of 20 photos could not be placed")
    finding.wait_for()  # without an examination: it is certain
    assert finding.locator("img").count() == 8
    assert finding.get_by_role("button").count() == 0  # what has no pose is not used anyway
    tab.get_by_role("button", name="Next: Start training").wait_for()
