"""The studio's editor in Chromium: edits are saved, kept, guarded against overwriting, and exported."""

import json
import re
import struct

from accessibility import grave_faults_in_all_styles
from gestures import drag, inside
from gsplat_edu.cli.main import main
from gsplat_edu.io.formats import read_scene
from studio.pages import go, visitor_of
from waiting import awaited, pass_time, resize, until_in


def opened(tab):
    """Go to the editor's screen and return the frame with the editor."""
    go(tab, "scenes/wall/edit")
    # by its title, because the screen before this one may have had a scene as well
    frame = tab.wait_for_selector("iframe[title='editor of wall']:not([hidden])").content_frame()
    frame.wait_for_selector("#edit-side")
    until_in(tab, frame, "Boolean(window.editor) && document.getElementById('message').hidden")
    return frame


HELD = """(() => {
  const ask = window.fetch.bind(window);
  let held = null;
  window.unanswered = 0;
  window.hold = () => {
    held = new Promise((resolve) => (window.release = resolve));
  };
  window.fetch = async (address, ...more) => {
    if (!String(address).startsWith("/api/library")) return ask(address, ...more);
    await held;
    unanswered += 1;
    return ask(address, ...more).finally(() => (unanswered -= 1));
  };
})()"""
"""Holds the page's questions about the library back between `hold()` and `release()`."""


def shares(tab):
    """Leave the editor for the screen that exports."""
    tab.locator("nav.tabs").get_by_role("link", name="Share").click()
    tab.get_by_role("button", name="Export", exact=True).wait_for()


def select_and_delete(tab, frame, corners):
    """Drag a rectangle over a part of the picture, in fractions of its size, and delete the selected splats."""
    frame.get_by_role("button", name="rectangle", exact=True).click()
    box = frame.locator("#canvas").bounding_box()
    drag(tab, *inside(box, *corners))
    frame.get_by_role("button", name="delete", exact=True).click()


def test_edits_are_saved_kept_guarded_and_exported(visitor, wall_entry, tmp_path):
    person, scene = visitor(), wall_entry
    tab = person.tab
    resize(tab, 1000, 620)
    frame = opened(tab)
    late = visitor_of(person, person.tab.url)
    resize(late, 1000, 620)
    older = opened(late)  # opened before the first tab saves

    select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
    left = frame.inner_text("#edit-count")
    assert (frame.inner_text("#edit-saved"), re.search(r"([\d,]+) of 176 left", left)[1]) != ("", "176")
    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    stored = scene / "edits.json"
    assert [entry["op"] for entry in json.loads(stored.read_text())["operations"]] == ["select", "delete"]

    mine = stored.read_bytes()
    select_and_delete(late, older, ((0.3, 0.35), (0.6, 0.5)))
    older.get_by_role("button", name="save", exact=True).click()
    older.locator("#edit-message:not(:empty)").wait_for()
    said = "edits.json was changed elsewhere; download these edits, then reload the page"
    assert older.inner_text("#edit-message") == said and older.inner_text("#edit-saved") == "not saved"
    assert stored.read_bytes() == mine
    late.close()

    tab.reload()
    frame = opened(tab)
    assert frame.inner_text("#edit-count") == left
    assert frame.inner_text("#edit-list summary") == "History (2)"

    tab.keyboard.press("3")  # the focus is outside of the frame, so the key is the page's
    person.reach("#/scenes/wall/share")
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    assert tab.get_by_label("apply the edits").is_checked()
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.locator(".exports .facts", has_text="your scene").wait_for()
    with tab.expect_download() as download:
        tab.get_by_role("link", name="Download").click()
    out = tmp_path / "wall.spz"
    main(["convert", str(scene / "wall.ply"), str(out), "--edits", str(stored)])
    assert download.value.path().read_bytes() == out.read_bytes()
    assert f"{len(read_scene(out).gaussians)} of 176 left" in left


def test_edits_saved_just_now_are_exported(visitor, wall_entry, library):
    """Although the page has not yet heard from the library that there are any."""
    person, stored = visitor(), wall_entry / "edits.json"
    tab = person.tab
    resize(tab, 1000, 620)
    stored.unlink(missing_ok=True)
    tab.add_init_script(HELD)
    tab.reload()
    frame = opened(tab)
    select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
    tab.evaluate("hold()")
    until_in(tab, tab, "unanswered === 0")  # an answer on its way would tell of the edits
    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    shares(tab)
    assert not tab.get_by_label("apply the edits").is_visible()
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    tab.get_by_label("Title and name of the file").fill("at once")
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.evaluate("release()")
    tab.locator(".exports .name", has_text="at once.spz").wait_for()
    assert "--edits" in person.command("export of at once.spz")
    stored.unlink()


def test_an_export_has_at_most_the_size_that_was_typed(visitor, wall_entry):
    person = visitor()
    tab = person.tab
    tab.evaluate("location.hash = '#/scenes/wall/share'")
    tab.get_by_role("button", name="Export", exact=True).wait_for()
    size = tab.get_by_label("At most (MB)")
    tab.get_by_role("radio", name=re.compile("^PLY")).check()
    assert not size.is_visible(), "a PLY is exact"
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    size.fill("0.01")
    tab.get_by_label("Title and name of the file").fill("small")
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.locator(".exports .name", has_text="small.spz").wait_for()
    assert "--size 0.01MB" in person.command("export of small.spz")
    assert (wall_entry / "exports" / "small.spz").stat().st_size <= 10_000


def test_two_saves_at_once_are_no_conflict(visitor, wall_entry):
    """Ctrl S twice, and an edit in between: the second one waits for the first one, and both are stored."""
    person, stored = visitor(), wall_entry / "edits.json"
    tab = person.tab
    resize(tab, 1000, 620)
    stored.unlink(missing_ok=True)
    frame = opened(tab)
    select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
    held = []
    tab.route(
        "**/edits*", lambda route: held.append(route) if route.request.method == "PUT" else route.continue_()
    )
    save = frame.get_by_role("button", name="save", exact=True)
    save.click()
    frame.get_by_role("button", name="invert", exact=True).click()
    save.click()
    for count in (1, 2):
        awaited(tab, lambda count=count: len(held) == count)
        held[-1].continue_()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    assert frame.inner_text("#edit-message") == ""
    done = [entry["op"] for entry in json.loads(stored.read_text())["operations"]]
    assert done == ["select", "delete", "invert"]
    tab.unroute("**/edits*")
    stored.unlink()


def focused(frame):
    return frame.evaluate("document.activeElement.textContent.trim() || document.activeElement.tagName")


def test_the_keyboard_focus_keeps_its_place(visitor, wall_entry, library):
    person = visitor()
    tab = person.tab
    resize(tab, 1000, 620)
    (wall_entry / "edits.json").unlink(missing_ok=True)
    frame = opened(tab)
    for name, then in (
        ("all", "all"),
        ("delete", "undo"),
        ("undo", "undo"),
        ("undo", "redo"),
        ("invert", "invert"),
    ):
        frame.get_by_role("button", name=name, exact=True).focus()
        tab.keyboard.press("Enter")
        assert focused(frame) == then, name  # if the page had the focus, the next Tab would begin at its top
    tab.keyboard.press("h")
    listed = frame.locator("#help tr:visible td:first-child").all_inner_texts()
    keys = frame.evaluate("Object.keys(EDIT_KEYS)")
    shown = " ".join(listed).lower().split()
    assert [
        key for key in keys if key != "backspace" and key.replace("Shift+", "") not in " ".join(shown)
    ] == []

    go(tab, "")
    for name in ("one", "two"):
        (library[0].library.root / "captures" / name).mkdir()
        library[0].library.remove("captures", name)
    go(tab, "trash")
    tab.get_by_role("button", name="Restore").nth(1).wait_for()
    tab.get_by_role("button", name="Restore").first.focus()
    tab.keyboard.press("Enter")
    until_in(tab, tab, "document.querySelectorAll('main li').length === 1")
    until_in(tab, tab, "document.activeElement.textContent === 'Restore'")
    tab.keyboard.press("?")
    until_in(tab, tab, "document.getElementById('keys').open")
    tab.keyboard.press("Escape")
    # the element that had the focus before the list of keys
    until_in(tab, tab, "document.activeElement.textContent === 'Restore'")


def test_unsaved_edits_survive_another_tab_of_the_page(visitor, wall_entry):
    """They come back unsaved; if others were saved meanwhile, the person chooses."""
    person, stored = visitor(), wall_entry / "edits.json"
    tab = person.tab
    resize(tab, 1000, 620)
    stored.unlink(missing_ok=True)
    frame = opened(tab)
    select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
    left = frame.inner_text("#edit-count")
    tabs = tab.locator("nav.tabs")
    tabs.get_by_role("link", name="Share").click()
    tab.get_by_text("Edits that are not saved yet are not exported").wait_for()
    tabs.get_by_role("link", name="Edit (unsaved)").wait_for()
    tab.get_by_role("link", name="Projects", exact=True).click()
    person.reach("#/")
    frame = opened(tab)
    frame.locator("#edit-count", has_text=left).wait_for()
    assert frame.inner_text("#edit-saved") == "not saved" and not stored.exists()

    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    mine = json.loads(stored.read_text())
    frame.get_by_role("button", name="undo", exact=True).click()
    shares(tab)
    stored.write_text(json.dumps(mine | {"operations": []}))  # as another tab does
    frame = opened(tab)
    tab.get_by_text("other edits were saved since").wait_for()
    assert (
        "176 of 176 left" in frame.inner_text("#edit-count")
        and frame.inner_text("#edit-saved") != "not saved"
    )
    tab.get_by_role("button", name="Use mine").click()
    assert frame.inner_text("#edit-list summary") == "History (1)"
    shares(tab)
    stored.write_text(json.dumps(mine))
    frame = opened(tab)
    tab.get_by_role("button", name="Discard them").click()
    assert frame.inner_text("#edit-list summary") == "History (2)"
    tabs.get_by_role("link", name="Edit", exact=True).wait_for()


def test_the_view_and_the_card_of_a_scene_show_the_saved_edits(visitor, wall_entry):
    """Like exports; a box switches to the scene as it was, and edits of another scene are named and left out."""
    person, stored = visitor(), wall_entry / "edits.json"
    tab = person.tab
    resize(tab, 1000, 620)
    stored.unlink(missing_ok=True)
    go(tab, "")
    card = tab.locator("a.card", has_text="wall").locator("img")
    tab.locator("a.card", has_text="wall").scroll_into_view_if_needed()
    until_in(tab, tab, "document.querySelector('a.card[href*=wall] img').naturalWidth > 0")
    before = card.get_attribute("src")
    frame = opened(tab)
    select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
    left = int(re.search(r"([\d,]+) of 176 left", frame.inner_text("#edit-count"))[1])
    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()

    def shows(count):
        until_in(
            tab,
            tab,
            f"document.querySelector('.scene iframe')?.contentWindow?.viewer?.facts.count === {count}",
        )

    tab.locator("nav.tabs").get_by_role("link", name="View").click()
    assert 0 < left < 176
    shows(left)
    tab.get_by_label("with the saved edits").uncheck()
    shows(176)
    tab.get_by_label("with the saved edits").check()
    shows(left)
    tab.get_by_role("link", name="Projects", exact=True).click()
    tab.locator("a.card", has_text="wall").scroll_into_view_if_needed()
    until_in(
        tab,
        tab,
        f"document.querySelector('a.card[href*=wall] img').naturalWidth > 0 && {before!r} !== "
        "document.querySelector('a.card[href*=wall] img').getAttribute('src')",
    )
    document = json.loads(stored.read_text())
    document["scene"]["sha256"] = "0" * 64
    stored.write_text(json.dumps(document))
    go(tab, "scenes/wall")
    tab.reload()
    tab.get_by_text("The saved edits are not shown.").wait_for()
    shows(176)
    stored.unlink()


def test_unsaved_edits_survive_a_closed_tab_and_fit_their_scene_only(visitor, wall_entry):
    """The browser's storage has them; the editor of this scene offers them, that of another does not."""
    person, stored = visitor(), wall_entry / "edits.json"
    stored.unlink(missing_ok=True)
    resize(person.tab, 1000, 620)

    def closed_with_edits():
        tab = visitor_of(person, person.tab.url)
        resize(tab, 1000, 620)
        frame = opened(tab)
        select_and_delete(tab, frame, ((0.15, 0.35), (0.5, 0.75)))
        until_in(tab, tab, "localStorage.length === 1")
        tab.evaluate("for (let i = 0; i < 10000; ++i) clearInterval(i)")
        frame.get_by_role("button", name="invert", exact=True).click()
        left = frame.inner_text("#edit-count")
        tab.goto("about:blank")  # a page that goes writes down what has changed since the last look
        until_in(
            person.tab, person.tab, "Object.values(localStorage).some((text) => text.includes('invert'))"
        )
        tab.close()
        return left

    left, tab = closed_with_edits(), person.tab
    tab.clock.install()
    tab.reload()
    frame = opened(tab)
    notice = tab.get_by_text(re.compile(r"There are unsaved changes from .*\d:\d\d"))
    notice.wait_for()
    assert "176 of 176 left" in frame.inner_text("#edit-count")
    assert grave_faults_in_all_styles(tab) == []
    pass_time(tab, 1500)  # the offer outlasts the looks at what is not saved
    tab.get_by_role("button", name="Restore").click()
    assert frame.inner_text("#edit-count") == left and frame.inner_text("#edit-saved") == "not saved"
    until_in(tab, tab, "localStorage.length === 1")
    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    until_in(tab, tab, "localStorage.length === 0")

    stored.unlink()
    go(tab, "")
    closed_with_edits()
    other = wall_entry.parent / "other"
    other.mkdir()
    scene = (wall_entry / "wall.ply").read_bytes()
    opacity = struct.pack("<f", 3.0)  # of the last splat, before three scales and a quaternion
    assert scene[-32:-28] == struct.pack("<f", 4.0)
    (other / "other.ply").write_bytes(scene[:-32] + opacity + scene[-28:])
    go(tab, "scenes/other/edit")
    frame = tab.wait_for_selector("iframe[title='editor of other']:not([hidden])").content_frame()
    until_in(tab, frame, "Boolean(window.editor) && document.getElementById('message').hidden")
    pass_time(tab, 1500)
    assert not notice.is_visible()
    opened(tab)
    tab.get_by_role("button", name="Forget").click()
    until_in(tab, tab, "localStorage.length === 0")
    tab.reload()
    opened(tab)
    pass_time(tab, 1500)
    assert not notice.is_visible()
