"""The guided tour previewed in the editor, the order of the named views, and the accessibility of all panels."""

import numpy as np
import pytest

from accessibility import grave_faults_in_all_styles
from gestures import swipe
from gsplat_edu.edits.apply import views_after
from viewer.handles import until

STEPS = [("Door", "Enter <b>here</b>."), ("Bookmark", ""), ("Window", "Second.\nLine."), ("Roof", "The end.")]


@pytest.fixture
def opened(edit_page, random_gaussians):
    """Return a function that opens the editor with four named views, three of which have a text."""

    def make(width=900, height=700, **options):
        shown = edit_page(random_gaussians(60), width=width, height=height, **options)
        for name, text in STEPS:
            shown.evaluate(
                "([name, text]) => { viewer.view.orbit(0.3, 0.1); viewer.moved(-1); editor.keepView(name, text); }",
                [name, text],
            )
        shown.select_all()
        shown.tab.click("#edit-views summary")
        shown.choose("box")
        return shown

    return make


def named(shown):
    edits = shown.edits()
    return {view.name: view.view for view in views_after(edits.operations).named}


def arrives(shown, name):
    until(shown.tab, f"document.querySelector('#guide h2').textContent.endsWith('. {name}')")
    until(shown.tab, "viewer.flight === null")
    view = named(shown)[name]
    here = shown.evaluate("viewer.view.camera")
    np.testing.assert_allclose(here["eye"], view.eye, atol=1e-9)
    np.testing.assert_allclose(here["R"], view.R, atol=1e-9)


def picture(shown):
    pixels = "async () => { await viewer.settled(); return [...viewer.renderer.pixels()].slice(0, 60000); }"
    return np.array(shown.evaluate(pixels))


def test_the_tour_goes_by_keys_as_a_visitor_sees_it(opened):
    shown = opened()
    shown.evaluate("editor.perform({ op: 'measure', points: [[0, 0, 0], [1, 0, 0]], note: '' })")
    done = len(shown.operations())
    assert shown.tab.inner_text("[data-do=tour]") == "preview the tour (3)"
    shown.tab.focus("[data-do=tour]")
    shown.press("Enter")
    arrives(shown, "Door")
    assert shown.tab.inner_text("#guide-text") == "Enter <b>here</b>."
    assert shown.evaluate("editor.tools.tool") == "navigate"
    plain = picture(shown)
    shown.tab.wait_for_selector("#edit-overlay", state="hidden")  # a visitor sees no measures
    for key, name in (
        ("ArrowRight", "Window"),
        ("ArrowRight", "Roof"),
        ("ArrowRight", "Roof"),
        ("ArrowLeft", "Window"),
    ):
        shown.press(key)
        arrives(shown, name)
    assert shown.tab.inner_text("#guide-step") == "2 of 3"
    shown.press("ArrowLeft")
    arrives(shown, "Door")
    shown.press("Escape")
    assert not shown.tab.is_visible("#guide")
    shown.tab.wait_for_selector("#edit-overlay")
    assert shown.tab.get_attribute("[data-do=tour]", "aria-pressed") == "false"
    assert not np.allclose(picture(shown), plain), "the selection is tinted again"
    shown.evaluate("editor.perform({ op: 'deselect' })")
    np.testing.assert_allclose(picture(shown), plain, atol=1e-6)
    assert len(shown.operations()) == done + 1


def test_the_tour_goes_by_touch_and_ends_with_its_last_step(opened):
    shown = opened(width=390, height=844, has_touch=True)
    shown.tab.tap("[data-do=tour]")
    arrives(shown, "Door")
    card, edit = (shown.tab.locator(name).bounding_box() for name in ("#guide", "#edit"))
    assert card["y"] > 0 and card["y"] + card["height"] <= edit["y"] + 1, "above the editor's panel"
    shown.tab.tap("#guide-next")
    arrives(shown, "Window")
    box = shown.tab.locator("#guide-text").bounding_box()
    x, y = box["x"] + 200, box["y"] + 5
    swipe(shown.tab, (x, y), (x - 90, y))
    arrives(shown, "Roof")
    for name in ("Roof", "Window"):  # with a step removed, the tour stays at its step, or at the one before
        shown.evaluate("(name) => editor.perform({ op: 'remove_view', name })", name)
    assert shown.tab.inner_text("#guide h2") == "1. Door"
    shown.evaluate("editor.perform({ op: 'remove_view', name: 'Door' })")
    assert not shown.tab.is_visible("#guide") and shown.tab.is_disabled("[data-do=tour]")


def test_buttons_change_the_order_of_views_with_undo(opened):
    shown = opened()
    before = shown.text()
    shown.tab.focus('[aria-label="Door later"]')
    shown.press("Enter")
    shown.press("Enter")  # the focus follows the view
    assert list(named(shown)) == ["Bookmark", "Window", "Door", "Roof"]
    shown.do("tour")
    arrives(shown, "Window")
    shown.tab.click('[aria-label="Door earlier"]')
    assert list(named(shown)) == ["Bookmark", "Door", "Window", "Roof"]
    assert shown.tab.inner_text("#guide h2") == "2. Window", "the tour stays where it is"
    shown.tab.click('[aria-label="Bookmark earlier"]', force=True)
    assert shown.evaluate("editor.history.done.at(-1).names[0]") == "Bookmark"
    for _ in range(3):
        shown.do("undo")
    assert shown.text() == before and list(named(shown)) == [name for name, _ in STEPS]


def test_all_panels_of_the_editor_are_accessible(opened):
    """Every tool's panel, with all that can be opened, in light and dark, wide and narrow."""
    shown = opened().open_controls()
    shown.evaluate(
        """() => {
          for (let i = 0; i < 3; ++i) { viewer.keyframes.save(); viewer.view.orbit(0.2, 0); viewer.moved(-1); }
          for (const details of document.querySelectorAll("details")) details.open = true;
        }"""
    )
    shown.tab.wait_for_selector("#strip")
    for tool in shown.tab.locator("[data-tool]").evaluate_all("all => all.map((one) => one.dataset.tool)"):
        shown.evaluate("(tool) => editor.tools.choose(tool)", tool)
        assert grave_faults_in_all_styles(shown.tab) == [], tool
    shown.evaluate("editor.tour.guide.toggle()")
    assert grave_faults_in_all_styles(shown.tab) == []
