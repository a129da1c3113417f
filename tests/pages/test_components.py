"""In Chromium, every component in every state: legible in both themes, and nothing beside the screen."""

import re

import pytest

from accessibility import grave_faults_in_all_styles
from gsplat_edu.base.styles import components
from waiting import resize

WIDTHS = (320, 390, 768, 1280, 1440)

BESIDE = """() => [...document.querySelectorAll('main *')].filter((one) => {
  if (one.parentElement.closest('.filmstrip, .tabs, .table, pre, svg')) return false;
  const { left, right, width } = one.getBoundingClientRect();
  return width && (left < 0 || right > document.documentElement.clientWidth + 0.5);
}).map((one) => one.outerHTML.slice(0, 120))"""
"""Elements that reach beyond the screen, except inside what scrolls by itself."""


@pytest.fixture
def tab(browser, gallery):
    opened = browser.new_page()
    opened.goto(gallery)
    return opened


def test_every_component_is_on_the_page(tab):
    shown = {
        re.sub(" ", "-", name)
        for name in tab.eval_on_selector_all(
            "main > section", "(all) => all.map((one) => one.getAttribute('aria-label'))"
        )
    }
    assert set(components()) - {"page", "badge"} <= shown


def test_nothing_is_hard_to_read_or_without_a_name(tab):
    assert grave_faults_in_all_styles(tab) == []


@pytest.mark.parametrize("width", WIDTHS)
def test_the_longest_names_fit_on_every_screen(tab, width):
    resize(tab, width, 900)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.evaluate(BESIDE) == []


def test_a_tooltip_is_shown_to_keys_and_pointers(tab):
    shown = "(one) => getComputedStyle(one, '::after').display === 'block'"
    undo = tab.get_by_role("button", name="Undo").first
    assert not undo.evaluate(shown)
    undo.hover()
    assert undo.evaluate(shown)
    tab.mouse.move(0, 0)
    assert not undo.evaluate(shown)
    tab.get_by_role("button", name="Donau").first.focus()
    tab.keyboard.press("Tab")
    assert undo.evaluate(shown)


def test_nothing_moves_for_people_who_ask_for_that(tab):
    moves = "getComputedStyle(document.querySelector('.primary')).transitionDuration"
    tab.emulate_media(reduced_motion="no-preference")
    assert tab.evaluate(moves).startswith("0.15s")
    tab.emulate_media(reduced_motion="reduce")
    assert set(tab.evaluate(moves).split(", ")) == {"0s"}
