"""Answers that come in another order than their questions, and pages that load while something changes."""

import re

import numpy as np
import pytest

from accessibility import grave_faults_in_all_styles
from gestures import drag, inside
from gsplat_edu.cli.main import main
from gsplat_edu.data.drawn_masks import read_drawings
from gsplat_edu.data.left_out import read_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.region import read_region, write_region
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.scene.region import Region
from gsplat_edu.studio.commands import title_of
from studio.pages import capture_frame, go, held_back, mask_dialog, visitor_of, waiting
from waiting import awaited, resize, settle, until_in

REVERSED = """async ([first, second]) => {
  const { Store } = await import("/web/store.js");
  const { gallery } = await import("/web/gallery.js");
  const [store, shown] = [new Store(), gallery("photos/a")];
  const [ask, answers] = [window.fetch, []];
  const later = (asks) => {
    window.fetch = () => new Promise((resolve) => answers.push(resolve));
    const all = asks.map((one) => one());
    window.fetch = ask;
    return all;
  };
  const answer = (index, body) => {
    answers[index](new Response(JSON.stringify(body), { headers: { "Content-Type": "application/json" } }));
  };
  const photo = (name) => ({ photos: [{ name, problem: "cannot be read" }] });
  const library = later([() => store.refresh(), () => store.refresh()]);
  const photos = later([1, 2].map((modified) => () => shown.read({ files: 1, modified, videos: 0 })));
  for (const [i, name] of [[1, second], [0, first]]) {
    answer(i, { trouble: [], folder: name });
    answer(2 + i, photo(name));
    await Promise.all([library[i], photos[i]]);
  }
  return [store.library.folder, shown.element.querySelector(".name").textContent];
}"""
"""Asks twice for the library and twice for photos, and answers the second questions first."""


@pytest.fixture
def capture(library, request):
    """The folder of a capture of eight photos; each test has its own."""
    folder = library[0].library.root / "captures" / request.node.name.replace("_", "-")
    write_colmap(folder, *procedural_capture(48, 8, splats=120))
    return folder


def test_an_older_answer_does_not_replace_a_newer_one(visitor):
    assert visitor().tab.evaluate(REVERSED, ["older", "newer"]) == ["newer", "newer"]


def test_a_photo_left_out_while_the_cameras_load_is_left_out_there(visitor, capture):
    tab = go(visitor().tab, f"captures/{capture.name}")
    held = held_back(tab, f"**/captures/{capture.name}/page", lambda request: request.method != "HEAD")
    gallery = tab.get_by_role("region", name="photos")
    gallery.locator(".thumbs li").first.wait_for()
    tab.get_by_role("region", name="cameras").scroll_into_view_if_needed()
    awaited(tab, lambda: held)
    gallery.get_by_role("button", name="Leave out images/view_002.png").click()
    gallery.locator(".thumbs li.left-out").wait_for()
    assert read_left_out(capture) == ("images/view_002.png",)
    ((route, answer),) = held
    assert "view_002" in answer.text() and '"left_out":true' not in answer.text()
    route.fulfill(response=answer)
    frame = capture_frame(tab, capture.name)
    assert [one["left_out"] for one in frame.evaluate("viewer.cameras.list")] == [i == 2 for i in range(8)]


def test_the_saved_box_is_changed_although_its_page_was_not_there(visitor, capture):
    """Pressed before anybody has scrolled to the cameras, the button shows the box that is saved."""
    write_region(capture, Region(np.array([0.1, 0.0, -0.1]), np.eye(3), np.array([0.3, 0.2, 0.1])))
    tab = go(visitor().tab, f"captures/{capture.name}")
    tab.locator("summary", has_text="More").click()
    tab.get_by_role("button", name="Change the box").click()
    frame = capture_frame(tab, capture.name)
    until_in(tab, frame, "viewer.region.drawing")
    assert frame.evaluate("viewer.region.shape.half") == pytest.approx([0.3, 0.2, 0.1])


def test_a_late_answer_does_not_take_back_the_box(visitor, capture):
    person = visitor()
    held = held_back(
        person.tab,
        f"**/captures/{capture.name}/region",
        lambda request: request.method == "GET" and request.frame == person.tab.main_frame,
    )
    tab = go(person.tab, f"captures/{capture.name}")
    resize(tab, 1200, 900)
    tab.locator("summary", has_text="More").click()
    box = tab.get_by_label("Learn only what is in the box")
    awaited(tab, lambda: held)
    tab.get_by_role("button", name="Draw the box").click()
    capture_frame(tab, capture.name).get_by_role("button", name="save the box").click()
    tab.get_by_role("button", name="Change the box").wait_for()
    assert read_region(capture) is not None and '"region":null' in held[0][1].text()
    with tab.expect_response(re.compile("/region$")):
        held[0][0].fulfill(response=held[0][1])
    tab.evaluate("fetch('/api/jobs').then((answer) => answer.text())")  # the answer before it has been read
    assert box.is_enabled() and box.is_checked()
    assert tab.get_by_role("button", name="Change the box").is_visible()


DRAWN = "[...viewer.region.center, ...viewer.region.half].map(({ value }) => Number(value))"
"""The numbers beside a box that is drawn."""


def beside(visitor, library, capture):
    """Open a capture in two tabs; return both with the frames of their cameras."""
    person = visitor()
    tabs = [person.tab, visitor_of(person, library[1])]
    for tab in tabs:
        resize(tab, 1280, 900)
        tab.goto(f"{library[1]}#/captures/{capture.name}")
        tab.locator(".thumbs li").first.wait_for()
    frames = [capture_frame(tab, capture.name) for tab in tabs]
    for frame in frames:
        frame.click("#fold")  # the panel is closed in a narrow frame
    return list(zip(tabs, frames, strict=True))


def test_another_tab_shows_what_is_left_out(visitor, library, capture):
    (here, _), (there, frame) = beside(visitor, library, capture)
    here.get_by_role("button", name="Leave out images/view_003.png").click()
    there.locator(".thumbs li.left-out", has_text="view_003.png").wait_for()
    until_in(there, frame, "viewer.cameras.list.map(({ left_out }) => left_out).indexOf(true) === 3")
    here.get_by_role("button", name="Use again images/view_003.png").click()
    there.locator(".thumbs li.left-out").wait_for(state="detached")
    until_in(there, frame, "!viewer.cameras.list.some(({ left_out }) => left_out)")


def test_another_tab_shows_the_box_and_keeps_what_is_drawn_there(visitor, library, capture):
    (here, first), (there, second) = beside(visitor, library, capture)
    there.locator("summary", has_text="More").click()
    box = there.get_by_label("Learn only what is in the box")
    assert box.is_disabled()
    first.get_by_role("button", name="draw a box").click()
    first.get_by_role("button", name="save the box").click()
    there.get_by_role("button", name="Change the box").wait_for()
    until_in(there, second, "Boolean(viewer.region.saved)")
    box.uncheck()  # what the user has chosen stays while other boxes are saved
    there.get_by_role("region", name="cameras").scroll_into_view_if_needed()
    second.get_by_role("button", name="change the box").click()
    second.locator("#region-half input").first.fill("0.125")
    drawn = second.evaluate(DRAWN)
    first.get_by_role("button", name="change the box").click()
    first.locator("#region-center input").first.fill("0.25")
    first.get_by_role("button", name="save the box").click()
    second.get_by_text("saving it replaces the other one").wait_for()
    assert second.evaluate("viewer.region.saved.center[0]") == pytest.approx(0.25)
    assert second.evaluate(DRAWN) == drawn and second.evaluate("viewer.region.drawing")
    assert box.is_enabled() and not box.is_checked()
    first.get_by_role("button", name="remove the box").click()
    second.get_by_text("Another tab has removed the saved box").wait_for()
    there.get_by_role("button", name="Draw the box").wait_for()
    assert second.evaluate(DRAWN) == drawn and box.is_disabled()
    second.get_by_role("button", name="save the box").click()
    until_in(here, first, "viewer.region.saved?.half[0] === 0.125")
    assert read_region(capture).half[0] == 0.125


def test_other_tabs_hear_of_a_removed_export(page, studio):
    exports = studio.library.root / "scenes" / "wall" / "exports"
    exports.mkdir(parents=True)
    (exports / "wall.spz").write_bytes(b"x")
    told = []
    studio.library.changed = lambda: told.append(len(list(exports.iterdir())))
    assert page.delete("/api/scenes/wall/exports/wall.spz").status_code == 200
    assert told == [0]


def masking(tab):
    """Press *Mask this* of the first photo; return the dialog and a function that draws a rectangle, px."""
    dialog, box = mask_dialog(tab, "view_000")
    return dialog, lambda *corners: drag(tab, *inside(box, *((x / 48, y / 36) for x, y in corners)))


def drawn_on(capture):
    """The shapes on the mask of the first photo."""
    drawings = read_drawings(capture)
    return drawings["images/view_000.png"].shapes if drawings else ()


def test_a_mask_saved_in_another_tab_is_loaded_beneath_what_is_drawn_here(visitor, library, capture):
    (here, _), (there, _) = beside(visitor, library, capture)
    (mine, draw), (other, draw_there) = masking(here), masking(there)
    load = other.get_by_role("button", name="Load the other shapes")
    draw((2, 2), (10, 10))
    mine.get_by_text("1 shape, not saved").wait_for()
    assert load.is_hidden()
    mine.get_by_role("button", name="Save").click()
    # without changes, the other dialog shows what was saved
    other.get_by_text("1 shape, saved in another tab.").wait_for()
    draw_there((20, 20), (30, 30))
    draw((12, 2), (18, 10))
    mine.get_by_text("2 shapes, not saved").wait_for()
    mine.get_by_role("button", name="Save").click()
    other.get_by_text("another tab has saved this mask").wait_for()
    assert other.get_by_role("button", name="Save").is_disabled()
    assert "2 shapes, not saved" in other.inner_text() and len(drawn_on(capture)) == 2
    load.click()
    other.get_by_text("3 shapes, not saved").wait_for()
    assert load.is_hidden() and other.get_by_role("alert").is_hidden()
    there.keyboard.press("Control+z")  # takes back what was drawn here, and nothing else
    other.get_by_text("2 shapes, saved in another tab.").wait_for()
    draw_there((20, 20), (32, 30))
    other.get_by_text("3 shapes, not saved").wait_for()
    other.get_by_role("button", name="Save").click()
    mine.get_by_text("3 shapes, saved in another tab.").wait_for()
    assert drawn_on(capture) == ((2, 2, 10, 10), (12, 2, 18, 10), (20, 20, 32, 30))
    # what was removed here stays removed, what was added elsewhere comes
    mine.get_by_role("button", name="Remove all").click()
    mine.get_by_text("Nothing is drawn, not saved").wait_for()
    draw_there((40, 2), (46, 10))
    other.get_by_role("button", name="Save").click()
    mine.get_by_role("button", name="Load the other shapes").click()
    mine.get_by_text("1 shape, not saved").wait_for()
    mine.get_by_role("button", name="Undo").click()
    mine.get_by_text("4 shapes, saved in another tab.").wait_for()


def test_a_mask_that_was_changed_unheard_is_not_replaced(visitor, capture):
    """The page does not hear of the command line; saving is refused, and the shapes can be loaded."""
    tab = go(visitor().tab, f"captures/{capture.name}")
    resize(tab, 1200, 900)
    dialog, draw = masking(tab)
    draw((2, 2), (10, 10))
    tab.route("**/api/library", lambda route: None)  # whatever makes the page ask for the library
    assert main(["mask", str(capture), "images/view_000.png", "brush:3,30,30,40,30"]) == 0
    before = drawn_on(capture)
    with tab.expect_response(re.compile("/mask$")) as answer:
        dialog.get_by_role("button", name="Save").click()
    assert answer.value.status == 409
    dialog.get_by_text("other shapes were saved on its mask after this drawing began").wait_for()
    load = dialog.get_by_role("button", name="Load the other shapes")
    load.wait_for()
    assert dialog.get_by_role("alert").count() == 1 and drawn_on(capture) == before
    assert grave_faults_in_all_styles(tab) == []
    load.click()
    dialog.get_by_text("2 shapes, not saved").wait_for()
    dialog.get_by_role("button", name="Save").click()
    dialog.get_by_text(re.compile(r"^Saved\. ")).wait_for()  # not "not saved."
    assert drawn_on(capture) == (*before, (2, 2, 10, 10))


def test_a_mask_is_saved_by_this_tab_although_the_library_tells_of_it_first(visitor, capture):
    person = visitor()
    held = held_back(person.tab, "**/mask")  # questions about a mask name a photo; saving does not
    tab = go(person.tab, f"captures/{capture.name}")
    resize(tab, 1200, 900)
    dialog, draw = masking(tab)
    draw((2, 2), (10, 10))
    with tab.expect_response(re.compile(r"/mask\?photo=")):  # the page looks at what was saved
        dialog.get_by_role("button", name="Save").click()
    dialog.get_by_role("alert").wait_for()
    ((route, answer),) = held
    route.fulfill(response=answer)
    dialog.get_by_text(re.compile(r"^Saved\. ")).wait_for()  # not "not saved."
    assert dialog.get_by_role("alert").is_hidden()
    assert dialog.get_by_role("button", name="Load the other shapes").is_hidden()
    draw((12, 2), (18, 10))
    dialog.get_by_role("button", name="Save").click()
    awaited(tab, lambda: len(held) == 2)
    assert len(drawn_on(capture)) == 2
    tab.unroute("**/mask")


def test_a_job_that_was_removed_does_not_come_back_with_an_older_list(visitor, library, capture):
    (studio, _), person = library, visitor()
    tab = person.tab
    with waiting(studio):
        about = {"subject": f"captures/{capture.name}"}
        first, second = (studio.start({"command": command, **about}) for command in ("train", "doctor"))
        tab.goto("about:blank")
        held = held_back(tab, "**/api/jobs")
        tab.goto(f"{library[1]}#/jobs")
        awaited(tab, lambda: len(held) == 2)  # the page asks at its start, and once the stream is there
        studio.queue.remove(first.id)
        third = studio.start({"command": "train", **about, "to": "third"})
        card = tab.get_by_role("article", name=title_of(third.work))
        card.wait_for()  # so the stream has told of the removal, too
        for route, answer in held:
            assert first.id in answer.text()
            route.fulfill(response=answer)
        tab.get_by_role("article", name=title_of(second.work)).wait_for()
        settle(tab)
        assert tab.get_by_role("article", name=title_of(first.work)).count() == 0 and card.is_visible()
        tab.unroute("**/api/jobs")


def test_a_restored_entry_does_not_come_back_to_the_trash_with_an_older_list(visitor, library, capture):
    tab = visitor().tab
    for name in ("three", "four"):
        (library[0].library.root / "captures" / name).mkdir()
        library[0].library.remove("captures", name)
    go(tab, "trash")
    listed = tab.locator("main li")
    listed.nth(1).wait_for()
    held = held_back(tab, "**/api/trash", lambda request: not held)
    listed.filter(has_text="three").get_by_role("button").click()
    awaited(tab, lambda: held)
    listed.filter(has_text="four").get_by_role("button").click()
    listed.filter(has_text="four").wait_for(state="detached")
    with tab.expect_response("**/api/library"):  # comes once the older answer has been read
        held[0][0].fulfill(response=held[0][1])
    assert listed.count() == 0
