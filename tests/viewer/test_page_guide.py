"""Visitors take the guided tour of a page and compare photos with its picture, by pointer, keys and touch."""

import io

import numpy as np
import pytest
from PIL import Image

from accessibility import grave_faults_in_all_styles
from gestures import drag, inside, swipe
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.viewer import page
from gsplat_edu.viewer.page_proof import Proof, ShownPhoto
from viewer.handles import until
from waiting import awaited

SIZE = (640, 480)

RED = (200, 30, 40)
"""Colour of the first photo; the second one is blue."""

BLUE = (30, 40, 200)

TEXT = "First line <img src=x onerror=alert(1)>\nand a second one."


def cameras():
    eyes = [(0.4, -0.6, -2.2), (2.0, -0.5, 0.3), (-1.0, -0.4, 2.0)]
    return [Camera(look_at(eye, (0, 0, 0)), eye, 230.0, 230.0, 159.5, 119.5, 240, 320) for eye in eyes]


def jpeg(color):
    made = io.BytesIO()
    Image.fromarray(np.full((60, 80, 3), color, np.uint8)).save(made, "JPEG", quality=95)
    return made.getvalue()


@pytest.fixture
def shown(visit, tmp_path, random_gaussians):
    """Open a page with three named views, two of them steps of a tour, and two photos, the second held out."""

    def make(**options):
        a, b, c = cameras()
        tour = page.Tour(
            views=[("Door", a), ("Bookmark", b), ("Window & roof", c)],
            texts={"Door": TEXT, "Window & roof": "The end."},
            proof=Proof(None, [ShownPhoto(0, jpeg(RED)), ShownPhoto(2, jpeg(BLUE))]),
        )
        files = [(f"IMG_{i}.jpg", camera) for i, camera in enumerate(cameras())]
        path = tmp_path / "scene.html"
        page.write(path, Scene(random_gaussians(60)), files, held_out={"IMG_2.jpg"}, tour=tour)
        return visit(*SIZE, fresh=True, **options).open(path).ready()

    return make


def arrives(seen, camera):
    there = f"viewer.view.camera.eye.every((x, i) => Math.abs(x - {camera.eye.tolist()}[i]) < 1e-6)"
    until(seen.tab, f"viewer.flight === null && {there}")
    np.testing.assert_allclose(seen.camera().eye, camera.eye)
    np.testing.assert_allclose(seen.camera().R, camera.R)


def color_at(seen, x, y):
    """Return the colour that the window shows at a place."""
    png = seen.tab.screenshot(clip={"x": x, "y": y, "width": 1, "height": 1})
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[0, 0].astype(int)


def is_color(found, color):
    return abs(found - color).max() < 12


def becomes(seen, x, y, color):
    """Wait until the window shows a colour at a place; a photo is decoded after its address is set."""
    awaited(seen.tab, lambda: is_color(color_at(seen, x, y), color), f"the colour {color}")


def test_the_tour_goes_by_keys(shown):
    seen, (first, _, last) = shown(), cameras()
    tab = seen.tab
    assert tab.inner_text("#tour") == "Guided tour (2)" and not tab.is_visible("#guide")
    tab.keyboard.press("t")
    arrives(seen, first)
    assert tab.inner_text("#guide h2") == "1. Door"
    assert tab.inner_text("#guide-text") == TEXT and tab.locator("#guide img").count() == 0
    assert tab.get_attribute("#guide-back", "aria-disabled") == "true"
    tab.keyboard.press("ArrowLeft")
    assert tab.inner_text("#guide-step") == "1 of 2", "the tour has a beginning"
    tab.keyboard.press("ArrowRight")
    arrives(seen, last)
    assert tab.inner_text("#guide h2") == "2. Window & roof" and tab.inner_text("#guide-text") == "The end."
    assert tab.evaluate("document.querySelector('#guide h2').closest('[aria-live=polite]') !== null")
    tab.keyboard.press("ArrowRight")
    assert tab.inner_text("#guide-step") == "2 of 2", "and an end"
    tab.focus("#guide-back")
    tab.keyboard.press("Enter")
    arrives(seen, first)
    tab.keyboard.press("Escape")
    assert not tab.is_visible("#guide")
    tab.keyboard.press("ArrowRight")
    assert tab.text_content("#views [aria-current=true]") == "Bookmark", (
        "the arrows step through all views again"
    )


def test_the_tour_goes_by_swipes(shown):
    seen, (first, _, last) = shown(has_touch=True), cameras()
    seen.tab.click("#tour")
    arrives(seen, first)
    box = seen.tab.locator("#guide-text").bounding_box()
    ((x, y),) = inside(box, (0.5, 0.5))
    swipe(seen.tab, (x, y), (x - 90, y))
    arrives(seen, last)
    assert seen.tab.inner_text("#guide-step") == "2 of 2"
    swipe(seen.tab, (x, y), (x + 10, y))
    assert seen.tab.inner_text("#guide-step") == "2 of 2", "too short for a swipe"
    swipe(seen.tab, (x, y), (x + 90, y))
    arrives(seen, first)


def test_the_view_flies_unless_less_motion_is_preferred(shown):
    begins = "() => { document.getElementById('tour').click(); return viewer.flight !== null; }"
    flying, jumping = shown(), shown(reduced_motion="reduce")
    for seen, flies in ((flying, True), (jumping, False)):
        assert seen.evaluate(begins) == flies
        arrives(seen, cameras()[0])


ENDLESS = """() => {
  viewer.step(1);
  const { flight } = viewer.flight;
  const camera = flight.camera.bind(flight);
  flight.camera = (now) => {
    flight.began = null;
    return camera(now);
  };
}"""
"""Begins a flight to the next step that stays at its beginning."""


def test_a_drag_interrupts_a_flight(shown):
    seen = shown()
    seen.press("t")
    until(seen.tab, "viewer.flight === null")
    seen.evaluate(ENDLESS)
    drag(seen.tab, (500, 200), (520, 210))
    assert seen.evaluate("viewer.flight === null && viewer.cameraIndex === -1")


def test_a_photo_is_slid_over_the_picture_by_pointer(shown):
    seen, tab = (found := shown()), found.tab
    tab.click("#compare")
    arrives(seen, cameras()[0])
    assert tab.inner_text("#compare-card strong") == "photo 1: used for training (1 of 2)"
    becomes(seen, 250, 240, RED)
    assert not is_color(color_at(seen, 400, 240), RED)
    drag(tab, (320, 150), (450, 150))
    assert tab.locator("#photo-share").input_value() == "70"
    becomes(seen, 430, 240, RED)
    assert not is_color(color_at(seen, 480, 240), RED)
    tab.click("#compare-next")
    arrives(seen, cameras()[2])
    assert tab.inner_text("#compare-card strong") == "photo 3: held out, not used for training (2 of 2)"
    becomes(seen, 430, 240, BLUE)
    tab.click("#compare-close")
    assert not tab.is_visible("#photo") and not tab.is_visible("#photo-line")
    assert tab.evaluate("document.activeElement.id") == "compare", (
        "the focus is on what opened the comparison"
    )
    assert not is_color(color_at(seen, 430, 240), BLUE)


def test_a_photo_is_slid_by_keys_and_touch(shown):
    seen, tab = (found := shown(has_touch=True)), found.tab
    tab.keyboard.press("c")
    arrives(seen, cameras()[0])
    tab.keyboard.press(".")
    tab.keyboard.press(".")
    assert tab.locator("#photo-share").input_value() == "60"
    tab.keyboard.press(",")
    tab.focus("#photo-share")
    tab.keyboard.press("ArrowRight")
    assert tab.locator("#photo-share").input_value() == "56"
    assert tab.get_attribute("#photo-share", "aria-valuetext") == "photo 56 %, picture 44 %"
    arrives(seen, cameras()[0])  # the arrow moved the line only
    swipe(tab, (SIZE[0] * 0.56, 200), (160, 200))
    until(tab, "document.getElementById('photo-share').value === '25'")
    tab.focus("#canvas")
    tab.keyboard.press("ArrowRight")
    arrives(seen, cameras()[2])
    tab.keyboard.press("Escape")
    assert not tab.is_visible("#compare-card")


def test_a_photo_waits_until_the_picture_of_its_camera_is_on_the_screen(shown):
    tab = shown().tab
    tab.evaluate("viewer.compare.toggle()")
    for index in tab.evaluate("viewer.compare.indices.toReversed()"):
        before = f"viewer.goTo({index}), viewer.exact = null"
        assert tab.evaluate(f"({before}, document.getElementById('photo').hidden)"), index
        until(
            tab,
            f"!document.getElementById('photo').hidden && viewer.isWhole && viewer.cameraIndex === {index}",
        )


def test_a_photo_lies_exactly_over_the_picture_of_its_camera(shown):
    """The photo's corners are where the page's camera sees the corners of the camera's image."""
    seen = shown()
    seen.tab.click("#compare")
    arrives(seen, cameras()[0])
    box = seen.tab.locator("#photo").bounding_box()
    camera, here = cameras()[0], seen.camera()
    for u, v, x, y in (
        (-0.5, -0.5, box["x"], box["y"]),
        (319.5, 239.5, box["x"] + box["width"], box["y"] + box["height"]),
    ):
        ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        found = here.project(here.world_to_cam(camera.eye + ray @ camera.R))
        np.testing.assert_allclose(np.array(found[:2]) + 0.5, (x, y), atol=0.02)
    drag(seen.tab, (500, 150), (530, 150))
    assert not seen.tab.is_visible("#photo"), "the photo shows its own view only"
    assert seen.tab.is_visible("#compare-card")


def test_a_page_names_no_files_and_stores_photos_without_metadata(shown, tmp_path):
    shown()
    data = (tmp_path / "scene.html").read_bytes()
    assert b"IMG_" not in data
    assert b"Exif" not in jpeg(RED)


NAMELESS = ("button", "slider", "checkbox", "combobox", "region", "image", "heading", "DisclosureTriangle")
"""Roles that a screen reader announces by their names."""


@pytest.mark.parametrize("key", ["t", "c"])
def test_a_screen_reader_gets_a_name_for_everything(shown, key):
    seen = shown()
    seen.press(key)
    until(seen.tab, "viewer.flight === null")
    nodes = seen.tab.context.new_cdp_session(seen.tab).send("Accessibility.getFullAXTree")["nodes"]
    found = [
        (node["role"]["value"], node.get("name", {}).get("value", ""))
        for node in nodes
        if not node["ignored"]
    ]
    assert len([name for role, name in found if role == "button"]) >= 8
    assert [role for role, name in found if role in NAMELESS and not name.strip()] == []
    ids = seen.evaluate("[...document.querySelectorAll('[id]')].map(({ id }) => id)")
    assert len(ids) == len(set(ids))


def test_the_poster_is_shown_until_the_first_picture_and_without_scripts(visit, tmp_path, random_gaussians):
    path = tmp_path / "scene.html"
    page.write(path, Scene(random_gaussians(60)), tour=page.Tour(poster=jpeg(RED)))
    without = visit(*SIZE, fresh=True, java_script_enabled=False).open(path)
    assert is_color(color_at(without, 320, 100), RED)
    assert without.tab.is_visible("noscript p")
    hold = "addEventListener('DOMContentLoaded', (event) => window.held || event.stopImmediatePropagation(), true)"
    held = visit(*SIZE, fresh=True)
    held.tab.add_init_script(hold)
    held.open(path)
    assert is_color(color_at(held, 320, 100), RED), "the page has not drawn yet"
    drawn = visit(*SIZE, fresh=True).open(path).ready()
    drawn.tab.wait_for_selector("#poster", state="hidden")
    assert not is_color(color_at(drawn, 320, 100), RED)


def test_axe_finds_nothing_serious_in_a_page_with_a_tour_and_photos(shown):
    tab = shown().open_controls().tab
    for summary in tab.locator("summary:visible").all():
        summary.click()
    tab.keyboard.press("h")
    tab.locator("#help").wait_for()
    assert grave_faults_in_all_styles(tab) == []
