"""axe-core finds nothing serious on any screen of the studio, wide and narrow, light and dark."""

import re

import pytest

from accessibility import grave_faults, grave_faults_in_all_styles
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from studio.pages import examined, frame_of, go
from studio.test_page_watch import runs
from waiting import until_in

__all__ = ["runs"]

SCREENS = {
    "library": "",
    "capture": "captures/egg",
    "watch": "runs/egg",
    "judge": "runs/egg/judge",
    "compare": "runs/egg-2/compare",
    "share": "runs/egg/share",
    "jobs": "jobs",
    "trash": "trash",
}
"""Places by the name of their screen."""


@pytest.mark.parametrize("screen", SCREENS)
def test_a_screen(visitor, runs, screen):
    tab = go(visitor().tab, SCREENS[screen])
    tab.locator("main h1").first.wait_for()
    tab.wait_for_load_state("networkidle")
    assert grave_faults_in_all_styles(tab) == []


def test_the_editor(visitor, runs):
    tab = go(visitor().tab, "runs/egg/edit")
    frame_of(tab)
    assert grave_faults_in_all_styles(tab) == []


def test_a_capture_with_its_choices_its_places_and_its_findings(visitor, library):
    views, points, colors = procedural_capture(48, 12, splats=120)
    write_colmap(library[0].library.root / "captures" / "seen", views, points, colors)
    tab = go(visitor().tab, "captures/seen")
    tab.locator("summary", has_text="More").click()
    examined(tab)
    tab.get_by_role("region", name="cameras").scroll_into_view_if_needed()
    frame_of(tab).locator("#canvas").wait_for()
    assert grave_faults_in_all_styles(tab) == []


def test_the_dialog_that_draws_a_mask(visitor, library):
    views, points, colors = procedural_capture(48, 6, splats=120)
    write_colmap(library[0].library.root / "captures" / "drawn", views, points, colors)
    tab = go(visitor().tab, "captures/drawn")
    tab.get_by_role("button", name="Mask this: images/view_001.png").click()
    dialog = tab.locator("dialog.mask[open]")
    dialog.wait_for()
    until_in(tab, tab, "document.activeElement === document.querySelector('dialog.mask svg')")
    for key in ("Enter", "ArrowRight", "ArrowDown", "Enter"):
        tab.keyboard.press(key)
    assert grave_faults_in_all_styles(tab) == []
    dialog.get_by_role("button", name="Save").click()
    dialog.get_by_role("textbox", name="command").wait_for()
    assert grave_faults_in_all_styles(tab) == []


def test_the_offer_to_rename_what_came_from_a_capture(visitor, runs):
    tab = go(visitor().tab, "captures/egg")
    tab.locator("summary", has_text="Rename or remove").click()
    tab.get_by_role("checkbox", name=re.compile("rename what came from it")).wait_for()
    assert grave_faults_in_all_styles(tab) == []


def test_the_list_of_keys(visitor, runs):
    tab = go(visitor().tab, "")
    tab.get_by_role("button", name=re.compile("keys", re.IGNORECASE)).click()
    tab.locator("dialog[open]").wait_for()
    assert grave_faults_in_all_styles(tab) == []


def test_a_fault_is_found(visitor, runs):
    tab = go(visitor().tab, "")
    tab.locator("main h1").first.wait_for()
    tab.evaluate("""() => {
      const faint = document.createElement("p");
      faint.textContent = "hardly legible";
      Object.assign(faint.style, { color: "#888888", background: "#999999" });
      document.querySelector("main").append(faint, document.createElement("input"));
    }""")
    rules = {fault.partition(":")[0] for fault in grave_faults(tab)}
    assert rules == {"color-contrast", "label"}
