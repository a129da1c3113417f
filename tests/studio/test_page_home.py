"""Home in Chromium: projects as pictures with their state and age, how to begin, and drops anywhere."""

import re

import pytest

from accessibility import grave_faults_in_all_styles
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from studio.conftest import Inline
from studio.pages import DROP, encoded, go, png, served
from waiting import resize, until_in

WIDTHS = (320, 390, 768, 1280, 1440)


@pytest.fixture(scope="module")
def empty(tmp_path_factory):
    with served(tmp_path_factory.mktemp("empty") / "library", Inline()) as (_, url):
        yield url


@pytest.fixture(scope="module")
def owl(library):
    """A capture."""
    root = library[0].library.root
    write_colmap(root / "captures" / "owl", *procedural_capture(32, 8, splats=60))
    return root


def check_widths(tab):
    """Nothing lies beside the screen, on any of its widths."""
    for width in WIDTHS:
        resize(tab, width, 800)
        over = tab.evaluate("document.documentElement.scrollWidth - innerWidth")
        assert over <= 0, f"{over} px beside a screen of {width} px"


def test_a_person_without_projects_sees_how_to_begin(visitor, empty):
    person = visitor(empty)
    tab, said = person.tab, []
    tab.on("console", lambda message: said.append(message.text))
    first = tab.get_by_role("region", name="First project")
    first.get_by_text("Drop photos anywhere").wait_for()
    walks = first.get_by_role("list", name="how to take the photos").get_by_role("listitem")
    assert walks.get_by_role("heading").all_inner_texts() == ["A thing", "A room", "A house"]
    for walk in walks.all():
        box = walk.locator("svg").bounding_box()
        assert min(box["width"], box["height"]) > 60
    assert first.get_by_role("button", name="Try the example").is_visible()
    assert not tab.get_by_role("button", name="New", exact=True).is_visible()
    check_widths(tab)
    assert grave_faults_in_all_styles(tab) == []
    assert said == []


def test_files_dropped_anywhere_on_any_screen_begin_a_project(visitor, library, owl):
    """A screen that takes no photos leaves them to home."""
    person = visitor()
    tab = person.tab
    go(tab, "jobs")
    tab.locator("h1", has_text="Jobs").wait_for()
    files = [[f"walk/{i}.png", encoded(png(i))] for i in range(2)]
    tab.evaluate(DROP, [files, "header"])
    until_in(tab, tab, "location.hash.startsWith('#/photos/')")
    tab.locator(".thumbs img").nth(1).wait_for()
    name = tab.evaluate("decodeURIComponent(location.hash.slice(9))")
    tab.evaluate(DROP, [[["late.png", encoded(png(7))]], "header"])  # this screen adds them to its own
    tab.locator(".thumbs .name", has_text="late.png").wait_for()
    assert len(list((library[0].library.root / "photos" / name).iterdir())) == 3


def test_what_is_dragged_over_the_page_shows_that_it_may_be_dropped(visitor, owl):
    tab = visitor().tab
    over = """(types) => {
      const transfer = new DataTransfer();
      transfer.items.add(...types);
      document.querySelector("h1").dispatchEvent(new DragEvent("dragover", { dataTransfer: transfer, bubbles: true }));
    }"""
    tab.evaluate(over, ["a text", "text/plain"])
    assert not tab.locator(".drop-here").is_visible()
    tab.evaluate(over.replace("...types", "new File(['x'], 'a.png')"), [])
    assert tab.locator(".drop-here").is_visible()
    tab.evaluate("dispatchEvent(new DragEvent('dragleave'))")
    assert not tab.locator(".drop-here").is_visible()


def test_new_opens_the_ways_to_begin_by_keyboard(visitor, owl):
    tab = visitor().tab
    begin = tab.get_by_role("button", name="New", exact=True)
    begin.focus()
    tab.keyboard.press("Enter")
    dialog = tab.get_by_role("dialog", name="New project")
    dialog.get_by_role("button", name="Choose files").wait_for()
    assert grave_faults_in_all_styles(tab) == []
    dialog.locator("summary", has_text="Other ways").click()
    dialog.get_by_label("Path of the folder or file").wait_for()
    check_widths(tab)
    tab.keyboard.press("Escape")
    assert not dialog.is_visible()
    assert begin.evaluate("(button) => document.activeElement === button")


def test_a_card_has_picture_age_state_and_the_bar_of_its_training(visitor, library, owl):
    """The bar and the time left are those of a training that runs."""
    studio = library[0]
    tab = visitor().tab
    card = tab.get_by_role("article", name="owl")
    card.get_by_text("Cameras: placed").wait_for()
    card.locator("img:not([hidden])").wait_for()
    assert card.get_by_text("just now").or_(card.get_by_text("min ago")).count() == 1
    bar = card.get_by_role("progressbar")
    assert bar.count() == 0
    job = studio.start({"command": "train", "subject": "captures/owl", "options": {"iterations": 30000}})
    try:
        card.locator(".states", has_text=re.compile("Training, .* left")).wait_for()
        bar.and_(tab.get_by_label("progress of training of owl")).wait_for()
        assert 0 < bar.evaluate("(bar) => bar.value / bar.max") < 1
        check_widths(tab)
    finally:
        studio.queue.cancel(job.id)
    card.get_by_text("Training: not finished").wait_for()
    assert not bar.is_visible()


def test_emptying_the_trash_asks_first(visitor, library, owl):
    """The button is no wider than its words, and what is asked can be refused by keyboard."""
    (owl / "scenes" / "old").mkdir()
    library[0].library.remove("scenes", "old")
    tab = go(visitor().tab, "trash")
    resize(tab, 1440, 900)
    clear = tab.get_by_role("button", name="Empty the trash")
    clear.wait_for()
    assert clear.bounding_box()["width"] < 200
    dialog = tab.get_by_role("dialog", name="Empty the trash?")
    clear.click()
    dialog.wait_for()
    assert grave_faults_in_all_styles(tab) == []
    tab.keyboard.press("Escape")
    dialog.wait_for(state="detached")
    assert [one["name"] for one in library[0].library.trash()] == ["old"]
    clear.click()
    dialog.get_by_role("button", name="Delete everything").click()
    tab.get_by_text("The trash is empty.").wait_for()
    assert library[0].library.trash() == []


def test_the_rail_has_five_steps_at_the_left_or_along_the_top(visitor, owl):
    tab = go(visitor().tab, "captures/owl")
    rail = tab.get_by_role("navigation", name="steps of the project")
    rail.locator("[aria-current=step]", has_text="Cameras").wait_for()
    titles = rail.locator(".step").all_inner_texts()
    assert titles == ["Photos", "Cameras", "Training", "Scene", "Share"]
    drawn = "[...document.querySelectorAll('.rail use')].filter((one) => one.getBBox().width > 10).length"
    until_in(tab, tab, f"{drawn} === 5")
    check_widths(tab)
    for width, beside in ((390, False), (1440, True)):
        resize(tab, width, 800)
        steps, stage = rail.bounding_box(), tab.locator(".stage").bounding_box()
        assert (steps["x"] + steps["width"] <= stage["x"]) == beside
        assert (steps["y"] + steps["height"] <= stage["y"]) != beside
