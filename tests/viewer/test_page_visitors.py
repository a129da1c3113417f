"""A page that was exported is for visitors: they see named views and numbered photos, no names of files."""

import io
import itertools
import json
import re

import numpy as np
import pytest
from PIL import Image

import gestures
from accessibility import contrast, grave_faults_in_all_styles, numbers
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.viewer import page
from gsplat_edu.viewer.page_proof import Proof, ShownPhoto
from viewer.handles import until


@pytest.fixture
def shared(visit, tmp_path, random_gaussians, three_views):
    """An exported page with a named view and a camera path."""
    keys = tuple(Keyframe(camera.eye, camera.R, 50.0) for _, camera in three_views)
    tour = page.Tour(KeyframePath(keys, False), views=[("The <front> door", three_views[2][1])])
    files = [(f"IMG_{i}.jpg", camera) for i, (_, camera) in enumerate(three_views)]
    path = tmp_path / "scene.html"
    page.write(path, Scene(random_gaussians(60)), files, held_out={"IMG_1.jpg"}, tour=tour)
    return visit(640, 480, fresh=True).open(path).ready().open_controls(), path


def test_visitors_see_named_views_and_no_file_names(shared, three_views):
    seen, path = shared
    assert b"IMG_" not in path.read_bytes()
    assert seen.tab.inner_text("#views summary") == "Views (1)"
    assert seen.tab.locator("#views button").all_inner_texts() == ["The <front> door"]
    assert seen.tab.inner_text("#cameras summary") == "Photos (3)"
    seen.tab.click("#cameras summary")
    assert seen.tab.locator("#cameras button").all_inner_texts() == ["photo 1", "photo 2 held out", "photo 3"]
    seen.tab.get_by_role("button", name="The <front> door").click()
    np.testing.assert_array_equal(seen.camera().eye, three_views[2][1].eye)
    assert seen.tab.locator("#views [aria-current=true]").count() == 1


def test_visitors_remove_only_the_keys_that_they_saved(shared):
    seen, _ = shared
    seen.tab.click("#path summary")
    assert seen.tab.locator("#path li").count() == 3
    assert seen.tab.get_by_role("button", name=re.compile("^remove view")).count() == 0
    seen.tab.click("#save-view")
    removes = seen.tab.get_by_role("button", name=re.compile("^remove view"))
    assert [one.get_attribute("aria-label") for one in removes.all()] == ["remove view 4"]
    removes.click()
    assert seen.tab.locator("#path li").count() == 3


def test_the_owners_page_keeps_the_names(tmp_path, random_gaussians, three_views):
    text = page.html(Scene(random_gaussians(9)), three_views).decode()
    facts = json.loads(text.split('id="facts">')[1].split("</script>")[0])
    assert [camera["name"] for camera in facts["cameras"]] == ["first", "second", "third <b>"]
    assert "shared" not in facts


RESTING = "document.body.classList.contains('resting')"

WIDTHS = ((320, 640), (390, 844), (768, 1024), (1280, 720), (1440, 900))
"""Windows of phones, tablets and computers, CSS px."""

LONG = "The observatory on the hill above the old harbour, photographed from the breakwater at dawn"


@pytest.fixture
def toured(visit, tmp_path, random_gaussians, three_views):
    """Open a page with a title and a tour of two long texts, and photos to compare; return it."""
    views = [(f"{LONG}, {i}", camera) for i, (_, camera) in enumerate(three_views[:2])]
    tour = page.Tour(
        views=views,
        texts={name: f"{LONG}. " * 6 for name, _ in views},
        proof=Proof(np.zeros(60, np.uint8), [ShownPhoto(0, jpeg())]),
        poster=jpeg(),
    )
    path = tmp_path / f"{LONG[:40]}.html"
    page.write(path, Scene(random_gaussians(60)), three_views, tour=tour)

    def make(*size, address="", **options):
        seen = visit(*size, fresh=True, **options)
        seen.tab.goto(path.as_uri() + address)
        return seen.ready()

    return make


def jpeg():
    made = io.BytesIO()
    Image.fromarray(np.full((60, 80, 3), (90, 80, 70), np.uint8)).save(made, "JPEG")
    return made.getvalue()


def boxes(seen, *selectors):
    """Return left, top, right and bottom of each element that is visible, CSS px."""
    found = {}
    for selector in selectors:
        if box := seen.tab.locator(selector).bounding_box():
            found[selector] = (box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"])
    return found


def overlap(one, other):
    return (
        min(one[2], other[2]) - max(one[0], other[0]) > 0
        and min(one[3], other[3]) - max(one[1], other[1]) > 0
    )


CHROME = ("#titles", "#bar", "#tools", "#help", "#guide", "#compare-card", "#legend")


@pytest.mark.parametrize("size", WIDTHS)
def test_nothing_lies_over_another_and_nothing_is_cut_off(toured, size):
    seen = toured(*size)
    presses = (
        "#fold #help-button #fold #seen #begin #fold #fold Escape #fold c #help-button #help-button Escape"
    )
    for press in ("", *presses.split()):
        if not press.startswith("#"):
            seen.press(*filter(None, [press]))
        elif seen.tab.is_visible(press):
            seen.tab.click(press)
        found = boxes(seen, *CHROME)
        assert "#bar" in found
        for name, (left, top, right, bottom) in found.items():
            assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1], (press, name)
        for one, other in itertools.combinations(found, 2):
            assert not overlap(found[one], found[other]), f"after {press}: {one} and {other}"
        assert seen.evaluate("document.documentElement.scrollWidth") <= size[0]


def test_the_bar_goes_after_a_rest_and_returns_with_the_pointer(toured):
    seen = toured(640, 480)
    tab = seen.tab
    tab.clock.install()
    tab.mouse.move(100, 100)
    tab.clock.run_for(2900)
    assert not seen.evaluate(RESTING)
    tab.clock.run_for(200)
    assert seen.evaluate(RESTING)
    tab.mouse.move(120, 100)
    assert not seen.evaluate(RESTING)
    seen.open_controls()
    tab.clock.run_for(10_000)
    assert not seen.evaluate(RESTING), "the controls are in use"
    tab.click("#fold")
    tab.evaluate("document.activeElement.blur()")
    tab.clock.run_for(3100)
    assert seen.evaluate(RESTING)


def test_the_hint_leaves_at_the_first_touch_and_numbers_are_behind_the_controls(toured):
    seen = toured(640, 480)
    assert seen.tab.inner_text("#hint") == "Drag to look around"
    assert not seen.tab.is_visible("#numbers")
    gestures.drag(seen.tab, (320, 150), (350, 150))
    assert not seen.tab.is_visible("#hint") and seen.tab.is_visible("#titles h1")
    assert seen.open_controls().tab.inner_text("#count") == "60 splats"


def test_the_tour_closes_everything_else(toured):
    seen = toured(390, 844, has_touch=True)
    seen.open_controls()
    seen.tab.keyboard.press("t")
    assert seen.tab.is_visible("#guide")
    assert [name for name in ("#tools", "#help", "#titles", "#begin") if seen.tab.is_visible(name)] == []
    assert seen.tab.inner_text("#guide h2").startswith("1. The observatory")
    seen.tab.click("#guide-close")
    assert seen.tab.is_visible("#titles")


def test_an_address_opens_a_view_and_the_picture_alone(toured, three_views):
    second = toured(640, 480, address="#view=2")
    np.testing.assert_allclose(second.camera().eye, three_views[1][1].eye)
    second.evaluate("location.hash = 'view=1'")
    until(second.tab, f"viewer.view.camera.eye[0] === {three_views[0][1].eye[0]}")
    second.evaluate("location.hash = 'view=99'")  # there is none
    alone = toured(640, 480, address="?ui=0")
    assert [name for name in (*CHROME, "#begin") if alone.tab.is_visible(name)] == []
    eye = alone.camera().eye
    gestures.drag(alone.tab, (320, 240), (350, 240))
    assert np.linalg.norm(alone.camera().eye - eye) > 0.01


def test_the_view_slows_down_beyond_the_photos_unless_switched_off(toured):
    seen = toured(640, 480)
    away = "Math.hypot(...viewer.view.camera.eye.map((x, i) => x - viewer.view.pivot[i])) / viewer.view.reach"
    out = "() => { for (let i = 0; i < 40; ++i) viewer.view.zoom(1.1); viewer.moved(-1); }"
    fly = "() => { for (let i = 0; i < 40; ++i) viewer.view.move([0, 0, -0.2]); viewer.moved(-1); }"
    for move in (out, fly):
        seen.press("r")
        seen.evaluate(move)
        assert 1.1 < seen.evaluate(away) < 1.7, "the view stops softly"
    seen.open_controls().tab.uncheck("#kept")
    seen.press("r")
    seen.evaluate(out)
    assert seen.evaluate(away) > 2.5


def test_a_scene_without_photos_does_not_slow_the_view_down(show, random_gaussians):
    seen = show(random_gaussians(20), width=640, height=480).open_controls()
    assert not seen.tab.is_visible("#keep")
    far = "Math.hypot(...viewer.view.camera.eye.map((x, i) => x - viewer.view.pivot[i])) / viewer.view.reach"
    seen.evaluate("() => { for (let i = 0; i < 40; ++i) viewer.view.zoom(1.1); viewer.moved(-1); }")
    assert seen.evaluate(far) > 2.5


@pytest.mark.parametrize("ground", [0, 255])
def test_the_glass_keeps_texts_and_icons_legible_over_any_scene(toured, ground):
    seen = toured(640, 480).open_controls()
    colours = """(selector) => {
      const one = document.querySelector(selector);
      let sheet = one;
      while (getComputedStyle(sheet).backgroundColor.endsWith(", 0)")) sheet = sheet.parentElement;
      return [getComputedStyle(one).color, getComputedStyle(sheet).backgroundColor];
    }"""
    for selector in ("#titles h1", "#hint", "#help-button", "#count", "#keep label", "#tools summary"):
        text, glass = (numbers(one) for one in seen.evaluate(colours, selector))
        behind = glass[3] * glass[:3] + (1 - glass[3]) * ground
        assert contrast(text[:3], behind) >= 4.5, selector


def test_axe_finds_nothing_serious_in_a_visitors_page(toured):
    tab = toured(640, 480).open_controls().tab
    assert grave_faults_in_all_styles(tab) == []


def test_the_poster_is_printed_in_place_of_the_picture(toured):
    seen = toured(640, 480)
    seen.tab.wait_for_selector("#poster", state="hidden")
    seen.tab.emulate_media(media="print")
    assert seen.tab.is_visible("#poster") and seen.tab.is_visible("#titles h1")
    assert [name for name in ("#canvas", "#bar", "#begin") if seen.tab.is_visible(name)] == []
