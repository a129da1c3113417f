"""The studio's editor in Chromium: edits are saved, kept, guarded against overwriting, and exported."""

import json
import re

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.io.formats import read_scene
from studio.pages import until


def opened(tab, address):
    """Go to the editor's screen and return the frame with the editor."""
    tab.goto(f"{address}#/scenes/wall/edit")
    frame = tab.wait_for_selector(".scene iframe:not([hidden])").content_frame()
    frame.wait_for_selector("#edit")
    until(tab, frame, "Boolean(window.editor) && document.getElementById('message').hidden")
    return frame


def select_and_delete(tab, frame, corners):
    """Drag a rectangle over a part of the picture, in fractions of its size, and delete the selected splats."""
    frame.get_by_role("button", name="rectangle", exact=True).click()
    box = frame.locator("#canvas").bounding_box()
    (a, b), (c, d) = corners
    tab.mouse.move(box["x"] + a * box["width"], box["y"] + b * box["height"])
    tab.mouse.down()
    tab.mouse.move(box["x"] + c * box["width"], box["y"] + d * box["height"], steps=3)
    tab.mouse.up()
    frame.get_by_role("button", name="delete", exact=True).click()


@pytest.mark.sliced(1, group="the studio in a browser")
def test_edits_are_saved_kept_guarded_and_exported(visitor, wall_entry, tmp_path):
    person, scene = visitor(), wall_entry
    tab = person.tab
    tab.set_viewport_size({"width": 1000, "height": 620})
    address = tab.url.split("#")[0]
    frame = opened(tab, address)
    late = tab.context.new_page()
    late.set_viewport_size({"width": 1000, "height": 620})
    older = opened(late, address)  # opened before the first tab saves

    select_and_delete(tab, frame, ((0.2, 0.2), (0.5, 0.6)))
    left = frame.inner_text("#edit-count")
    assert (frame.inner_text("#edit-saved"), re.search(r"([\d,]+) of 176 left", left)[1]) != ("", "176")
    frame.get_by_role("button", name="save", exact=True).click()
    frame.locator("#edit-saved", has_text=re.compile("^saved$")).wait_for()
    stored = scene / "edits.json"
    assert [entry["op"] for entry in json.loads(stored.read_text())["operations"]] == ["select", "delete"]

    mine = stored.read_bytes()
    select_and_delete(late, older, ((0.3, 0.1), (0.7, 0.3)))
    older.get_by_role("button", name="save", exact=True).click()
    older.locator("#edit-message:not(:empty)").wait_for()
    said = "edits.json was changed elsewhere; download these edits, then reload the page"
    assert older.inner_text("#edit-message") == said and older.inner_text("#edit-saved") == "not saved"
    assert stored.read_bytes() == mine
    late.close()

    tab.reload()
    frame = opened(tab, address)
    assert frame.inner_text("#edit-count") == left
    assert frame.inner_text("#edit-list summary") == "operations (2)"

    tab.keyboard.press("3")  # the focus is outside of the frame, so the key is the page's
    person.reach("#/scenes/wall/share")
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    assert tab.get_by_label("apply the edits").is_checked()
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.locator(".exports .facts", has_text="PSNR").wait_for()
    with tab.expect_download() as download:
        tab.get_by_role("link", name="Download").click()
    out = tmp_path / "wall.spz"
    main(["convert", str(scene / "wall.ply"), str(out), "--edits", str(stored)])
    assert download.value.path().read_bytes() == out.read_bytes()
    assert f"{len(read_scene(out).gaussians)} of 176 left" in left


def focused(frame):
    return frame.evaluate("document.activeElement.textContent.trim() || document.activeElement.tagName")


@pytest.mark.sliced(1, group="the studio in a browser")
def test_the_keyboard_focus_keeps_its_place(visitor, wall_entry, library):
    person = visitor()
    tab = person.tab
    tab.set_viewport_size({"width": 1000, "height": 620})
    address = tab.url.split("#")[0]
    (wall_entry / "edits.json").unlink(missing_ok=True)
    frame = opened(tab, address)
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

    tab.goto(f"{address}#/")
    for name in ("one", "two"):
        (library[0].library.root / "captures" / name).mkdir()
        library[0].library.remove("captures", name)
    tab.goto(f"{address}#/trash")
    tab.get_by_role("button", name="Restore").nth(1).wait_for()
    tab.get_by_role("button", name="Restore").first.focus()
    tab.keyboard.press("Enter")
    until(tab, tab, "document.querySelectorAll('main li').length === 1")
    until(tab, tab, "document.activeElement.textContent === 'Restore'")
    tab.keyboard.press("?")
    until(tab, tab, "document.getElementById('keys').open")
    tab.keyboard.press("Escape")
    # the element that had the focus before the list of keys
    until(tab, tab, "document.activeElement.textContent === 'Restore'")
