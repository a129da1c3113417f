"""The editor's rail and inspector, the search for an action, the cube of directions, and the grid on the ground."""

import itertools

import numpy as np
import pytest

from accessibility import grave_faults_in_all_styles
from viewer.handles import until


@pytest.fixture
def opened(edit_page, random_gaussians, three_views):
    def make(width=900, height=700, **options):
        return edit_page(random_gaussians(200), three_views, width=width, height=height, **options)

    return make


def found(shown):
    return shown.tab.locator("#edit-found [role=option] span").all_inner_texts()


def test_an_action_is_found_by_words_of_its_name_and_done_by_enter(opened):
    shown = opened()
    shown.press("Control+k")
    assert len(found(shown)) == 9, "the first actions, before anything is typed"
    shown.tab.keyboard.type("freehand")
    assert found(shown) == ["lasso"]
    shown.press("Enter")
    assert shown.is_chosen("lasso") and not shown.tab.is_visible("#edit-search")
    shown.press("Control+k")
    shown.tab.keyboard.type("select all")
    shown.press("ArrowDown", "ArrowUp", "Enter")
    assert shown.last()["by"] == "all" and shown.selected() == 200
    shown.do("search")
    shown.tab.keyboard.type("undo k")  # K alone would save a view
    assert shown.tab.is_visible("text=No action has these words.")
    shown.press("Escape")
    assert not shown.tab.is_visible("#edit-search") and len(shown.operations()) == 1
    assert shown.evaluate("viewer.keyframes.path.keyframes.length") == 0


def test_the_search_leaves_out_what_cannot_be_pressed_now(opened):
    shown = opened()
    for words, names in (("delete everything outside", []), ("delete the selected", [])):
        shown.press("Control+k")
        shown.tab.keyboard.type(words)
        assert found(shown) == names, words
        shown.press("Escape")
    shown.choose("box")
    shown.press("Control+k")
    shown.tab.keyboard.type("full help")
    assert found(shown) == []
    shown.press(*["Backspace"] * 9)
    shown.tab.keyboard.type("help")
    assert "Help" in found(shown)
    shown.tab.click("#edit-found li:has-text('Help')")
    assert shown.tab.is_visible("#help")


@pytest.mark.parametrize("side", ["front", "back", "right", "left", "top", "bottom"])
def test_a_side_of_the_cube_is_a_view_along_its_axis(opened, side):
    shown = opened(reduced_motion="reduce")
    up = np.array(shown.evaluate("viewer.view.up"))
    forward = np.array(shown.evaluate("viewer.view.start.R"))[2]
    forward = forward - up * (up @ forward)
    forward /= np.linalg.norm(forward)
    right = np.cross(-up, forward)
    focus, distance = np.array(shown.evaluate("viewer.view.focus")), shown.evaluate("viewer.view.distance")
    shown.evaluate("(side) => document.querySelector(`[data-side=${side}]`).click()", side)
    ahead = {"front": forward, "back": -forward, "right": -right, "left": right, "top": -up, "bottom": up}[
        side
    ]
    camera = shown.camera()
    np.testing.assert_allclose(camera.R[2], ahead, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(camera.R), 1.0)
    np.testing.assert_allclose(camera.eye, focus - distance * ahead, atol=1e-6)
    if side not in ("top", "bottom"):
        np.testing.assert_allclose(camera.R[1], -up, atol=1e-6, err_msg="the view is level")
    facing = f"""(() => {{
      const area = (one) => one.getBoundingClientRect().width * one.getBoundingClientRect().height;
      const sides = [...document.querySelectorAll("#edit-cube button")].sort((a, b) => area(b) - area(a));
      return sides.slice(0, 2).some((one) => one.dataset.side === "{side}");
    }})()"""
    until(shown.tab, facing)  # the side that was pressed, or the one behind it, is the largest


def test_the_grid_lies_on_the_ground_and_is_drawn_over_the_scene(opened):
    shown = opened()
    overlay = "document.getElementById('edit-overlay').hidden"
    assert shown.evaluate(overlay)
    shown.do("grid")
    until(shown.tab, f"!{overlay}")
    assert shown.is_on("grid")
    lines = np.array(shown.evaluate("editor.grid"))
    assert lines.shape == (42, 2, 3)
    up = np.array(shown.evaluate("viewer.view.up"))
    heights = lines @ up
    assert np.ptp(heights) < 1e-6, "it is level"
    means = np.array(shown.evaluate("[...editor.values.means]")).reshape(-1, 3)
    seen = np.array(shown.evaluate("[...editor.values.logits]")) > 0
    assert (means[seen] @ up > heights.min()).mean() > 0.9, "few splats lie below the ground"
    shown.do("grid")
    until(shown.tab, overlay)


def test_cells_have_round_lengths(opened):
    found = opened().evaluate("[0.013, 0.2, 3, 7, 999].map(roundLength)")
    np.testing.assert_allclose(found, [0.01, 0.2, 2, 5, 500])


PARTS = ("#edit-rail", "#edit-options", "#edit-column", "#panel", "#edit-cube")


@pytest.mark.parametrize("size", [(768, 1024), (1280, 720), (1440, 900)])
def test_the_parts_of_the_editor_lie_beside_each_other(opened, size):
    shown = opened(*size)
    for tool in ("navigate", "box", "floor"):
        shown.choose(tool)
        boxes = {name: shown.tab.locator(name).bounding_box() for name in PARTS}
        for name, box in boxes.items():
            assert box["x"] >= 0 and box["x"] + box["width"] <= size[0], (tool, name)
            assert box["y"] >= 0 and box["y"] + box["height"] <= size[1], (tool, name)
        for (one, a), (other, b) in itertools.combinations(boxes.items(), 2):
            across = min(a["x"] + a["width"], b["x"] + b["width"]) - max(a["x"], b["x"])
            down = min(a["y"] + a["height"], b["y"] + b["height"]) - max(a["y"], b["y"])
            assert across <= 0 or down <= 0, f"{tool}: {one} and {other}"


def test_axe_finds_nothing_serious_in_the_editor_and_its_search(opened):
    shown = opened()
    shown.choose("box")
    assert grave_faults_in_all_styles(shown.tab) == []
    shown.press("Control+k")
    assert grave_faults_in_all_styles(shown.tab) == []
