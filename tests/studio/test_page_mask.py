"""Parts of a photo are masked on the page by mouse, finger and keyboard, with undo; a printed command repeats it."""

import json
import re
import shlex

import numpy as np
import pytest
from PIL import Image

from accessibility import grave_faults_in_all_styles
from gestures import drag, inside, swipe
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.drawn_masks import DRAWN, read_drawings
from gsplat_edu.data.mask_shapes import BrushStroke, covered
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.jobs.record import Work
from gsplat_edu.scene.views import View
from processes import Program
from studio.pages import COMMAND, examined, go, mask_dialog, waiting
from waiting import resize, until_in

W, H = 96, 72


@pytest.fixture
def capture(library):
    """A capture of 96 x 72 px photos, each test its own; the mask of view_001 hides its lower half."""
    captures = library[0].library.root / "captures"
    folder = captures / f"drawn-{len(list(captures.iterdir()))}"
    write_colmap(folder, *procedural_capture(W, 12, splats=200))
    own = np.full((H, W), 255, np.uint8)
    own[H // 2 :] = 0
    (folder / "masks").mkdir()
    Image.fromarray(own).save(folder / "masks" / "view_001.png")
    return folder


def hidden(capture, name):
    """Pixels of a photo that do not count."""
    dataset = load_dataset(capture, DataSettings(test_every=0))
    mask = next(view for view in dataset.train if view.name == name).read().mask
    return np.zeros((H, W), bool) if mask is None else ~mask


def draw(tab, box, *points):
    """Drag along some points of the photo, px."""
    drag(tab, *inside(box, *((x / W, y / H) for x, y in points)))


def saved(dialog, said="Saved. "):
    save = dialog.get_by_role("button", name="Save")
    save.click()
    dialog.get_by_role("status").filter(has_text=re.compile(f"^{said}")).wait_for()
    assert save.is_disabled()
    return dialog.get_by_role("textbox", name="command").inner_text()


@pytest.mark.parametrize("size", [(390, 844), (1440, 900)])
def test_a_rectangle_and_an_outline_are_drawn_undone_saved_and_removed(visitor, capture, size):
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    person = visitor()
    resize(person.tab, size[0], size[1])
    tab = go(person.tab, f"captures/{capture.name}")
    dialog, box = mask_dialog(tab, "view_001")
    assert "has a mask of its own" in dialog.inner_text()
    assert dialog.get_by_role("button", name="Save").is_disabled()
    draw(tab, box, (10, 8), (40, 26))
    dialog.get_by_text("1 shape, not saved").wait_for()
    dialog.get_by_role("radio", name="outline").check()
    draw(tab, box, (60, 5), (90, 5), (90, 35), (60, 35))
    dialog.get_by_text("2 shapes, not saved").wait_for()
    draw(tab, box, (1, 1), (20, 1), (20, 40))
    tab.keyboard.press("Control+z")
    dialog.get_by_text("2 shapes, not saved").wait_for()
    command = saved(dialog)
    # before the command line, of which the page knows nothing, changes the mask
    tab.locator(".thumbs li", has_text="view_001.png").get_by_text("masked", exact=True).wait_for()
    found = hidden(capture, "view_001.png")
    assert found[10:24, 14:36].all() and found[8:33, 65:85].all() and found[H // 2 :].all()
    assert not found[:4].any() and not found[29:34, 2:55].any()
    # the printed command does the same
    words = shlex.split(command)
    assert words[:4] == ["gsplat-edu", "mask", str(capture), "images/view_001.png"]
    drawn = (capture / "masks" / "view_001.png").read_bytes()
    assert main([*words[1:4], "--undo"]) == 0
    assert {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()} == before
    assert main(words[1:]) == 0
    assert (capture / "masks" / "view_001.png").read_bytes() == drawn
    dialog.get_by_role("button", name="Close").click()
    tab.reload()
    dialog, box = mask_dialog(tab, "view_001")
    dialog.get_by_text("2 shapes.").wait_for()
    dialog.get_by_role("button", name="Remove all").click()
    assert saved(dialog, "Removed. ").endswith("--undo")
    assert {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()} == before
    assert grave_faults_in_all_styles(tab) == []


def test_the_keyboard_draws_and_escape_gives_up_the_begun_shape_first(visitor, capture):
    tab = go(visitor().tab, f"captures/{capture.name}")
    dialog, _ = mask_dialog(tab, "view_002")
    press = tab.keyboard.press
    for key in ("Shift+ArrowLeft", "Enter", "ArrowRight", "Escape"):
        press(key)
    assert dialog.is_visible()
    dialog.get_by_text("Nothing is drawn").wait_for()
    for key in ("Enter", *["ArrowRight"] * 4, *["ArrowDown"] * 5, "Enter"):
        press(key)
    dialog.get_by_text("1 shape, not saved").wait_for()
    saved(dialog)
    step = round(W / 50)
    x, y = W // 2 - 1 + step, H // 2
    assert read_drawings(capture)["images/view_002.png"].shapes == ((x, y, x + 4 * step, y + 5 * step),)
    assert hidden(capture, "view_002.png").sum() == 20 * step * step
    press("Escape")
    dialog.wait_for(state="detached")


@pytest.mark.parametrize("size", [(390, 844), (1440, 900)])
def test_a_brush_paints_beside_the_photo_too_and_a_command_repeats_it(visitor, capture, size):
    before = {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()}
    person = visitor()
    resize(person.tab, size[0], size[1])
    tab = go(person.tab, f"captures/{capture.name}")
    dialog, box = mask_dialog(tab, "view_002")
    tip, slider = dialog.locator(".tip"), dialog.get_by_role("slider", name="radius of the brush")
    assert slider.is_hidden() and tip.is_hidden()
    dialog.get_by_role("radio", name="brush").check()
    assert slider.input_value() == "2"  # of 96 px
    draw(tab, box, (20, 30))  # a tap
    assert (tip.get_attribute("r"), tip.get_attribute("cx"), tip.get_attribute("cy")) == ("2", "20", "30")
    dialog.get_by_text("1 shape, not saved").wait_for()
    for key in "]]]":
        tab.keyboard.press(key)
    assert slider.input_value() == tip.get_attribute("r") == "5"
    tab.keyboard.press("[")
    draw(tab, box, (80, 60), (94, 60), (102, 60))  # out of the photo
    dialog.get_by_text("2 shapes, not saved").wait_for()
    slider.fill("9")
    assert dialog.locator(".brush").inner_text() == "9 px"
    draw(tab, box, (40, 40), (60, 40))
    tab.keyboard.press("Control+z")
    dialog.get_by_text("2 shapes, not saved").wait_for()
    assert dialog.locator(".strokes:not(.trace) path").count() == 2
    tab.mouse.move(1, 1)
    until_in(tab, tab, "document.querySelector('.tip').style.display === 'none'")
    command = saved(dialog)
    tap, stroke = read_drawings(capture)["images/view_002.png"].shapes
    assert tap == BrushStroke(2, (20, 30)) and stroke.radius == 4 and max(stroke.points[::2]) > W
    assert np.array_equal(hidden(capture, "view_002.png"), covered([tap, stroke], W, H))
    words = shlex.split(command)
    assert words[4] == "brush:2,20,30"
    drawn = (capture / "masks" / "view_002.png.png").read_bytes()
    assert main([*words[1:4], "--undo"]) == 0
    assert {path: path.read_bytes() for path in capture.rglob("*") if path.is_file()} == before
    assert main(words[1:]) == 0
    assert (capture / "masks" / "view_002.png.png").read_bytes() == drawn
    dialog.get_by_role("button", name="Close").click()
    dialog, _ = mask_dialog(tab, "view_002")
    assert dialog.locator(".strokes:not(.trace) path").count() == 2
    assert grave_faults_in_all_styles(tab) == []


def test_keys_and_a_long_way_paint_as_well(visitor, capture):
    tab = go(visitor().tab, f"captures/{capture.name}")
    dialog, _ = mask_dialog(tab, "view_002")
    dialog.get_by_role("radio", name="brush").check()
    dialog.locator("svg").focus()
    for key in ("Shift+ArrowLeft", "Enter", "Enter"):
        tab.keyboard.press(key)
    dialog.get_by_text("1 shape, not saved").wait_for()
    # longer than one stroke may be
    tab.evaluate(
        """() => {
          const svg = document.querySelector("dialog.mask svg");
          const { left, top, width, height } = svg.getBoundingClientRect();
          const send = (kind, x, y) => svg.dispatchEvent(new PointerEvent(kind, {
            clientX: left + (x / 96) * width, clientY: top + (y / 72) * height, isPrimary: true, bubbles: true,
          }));
          svg.setPointerCapture = () => {};
          send("pointerdown", 5, 5);
          for (let i = 0; i < 1500; ++i) send("pointermove", i % 2 ? 5 : 30, 5 + (i % 40));
          send("pointerup", 5, 60);
        }"""
    )
    dialog.get_by_text("3 shapes, not saved").wait_for()
    saved(dialog)
    first, *long = read_drawings(capture)["images/view_002.png"].shapes
    assert first == BrushStroke(2, (W // 2 - 1, H // 2)) and len(long) == 2
    assert hidden(capture, "view_002.png")[6:44, 6:30].all()


def test_a_finger_draws(browser, library, capture):
    context = browser.new_context(has_touch=True, is_mobile=True, viewport={"width": 390, "height": 844})
    tab = context.new_page()
    tab.goto(f"{library[1]}#/captures/{capture.name}")
    dialog, box = mask_dialog(tab, "view_002")
    swipe(tab, *inside(box, (0.1, 0.1), (0.3, 0.2), (0.5, 0.4)))
    dialog.get_by_text("1 shape, not saved").wait_for()
    saved(dialog)
    assert hidden(capture, "view_002.png")[9:26, 12:46].all()
    context.close()


@pytest.fixture(scope="module")
def swapped(library, tmp_path_factory):
    """A run whose photo view_005 was taken from elsewhere."""
    root = library[0].library.root
    views, points, colors = procedural_capture(W, 16, splats=400)
    views = [*views[:5], View(views[5].camera, views[12].read().image, name=views[5].name), *views[6:]]
    write_colmap(root / "captures" / "wrong", views, points, colors)
    words = ["train", root / "captures" / "wrong", "--out", root / "runs" / "wrong", "--iterations", 200]
    assert Program(COMMAND, words, tmp_path_factory.mktemp("wrong")).ended()[0] == 0
    return root / "captures" / "wrong"


def test_a_run_is_trained_again_with_the_mask_of_a_finding(visitor, library, swapped):
    tab = go(visitor().tab, "runs/wrong/judge")
    part = examined(tab)
    part.get_by_role("button", name="Mask this: view_005.png").first.click()
    dialog = tab.locator("dialog.mask[open]")
    dialog.wait_for()
    until_in(tab, tab, "document.querySelector('.painted img').complete")
    draw(tab, dialog.locator("svg").bounding_box(), (10, 10), (80, 60))
    saved(dialog)
    dialog.get_by_role("button", name="Close").click()
    with waiting(library[0]):
        part.get_by_role("button", name="Train again with the masks").click()
        tab.wait_for_url(re.compile("#/runs/wrong-run"))
        job = library[0].queue.jobs()[-1]
        # its masks stay as they are until it has ended
        address = "/api/captures/wrong/mask"
        answer = tab.evaluate(
            """async (address) => {
              const body = JSON.stringify({ photo: "images/view_005.png", shapes: [], version: "" });
              const given = { method: "POST", body, headers: { "Content-Type": "application/json" } };
              const answer = await fetch(address, given);
              return [answer.status, await answer.text()];
            }""",
            address,
        )
    assert answer[0] == 409 and "is used by “" in answer[1] and (swapped / DRAWN).exists()
    assert job.work.inputs == ("captures/wrong",)


def test_requests_that_are_no_drawing_change_nothing(page, studio):
    capture = studio.library.root / "captures" / "six"
    write_colmap(capture, *procedural_capture(32, 6, splats=50))
    address, photo = "/api/captures/six/mask", "images/view_000.png"
    version = page.get(address, params={"photo": photo}).json()["version"]
    for body, status, line in (
        ({"photo": "../../etc/passwd", "shapes": []}, 404, "passwd"),
        ({"photo": photo, "shapes": [[1, 2, 3]]}, 400, "has 3 numbers"),
        ({"photo": photo, "shapes": [[1, 2, 3, "4"]]}, 400, "has to be a whole number"),
        ({"photo": photo, "shapes": [[1, 2, 3, 1e9]]}, 400, "has to be a whole number"),
        ({"photo": photo, "shapes": ["0,0,4,4"]}, 400, "has to be an object or a list"),
        ({"photo": photo, "shapes": [[0, 0, 32, 24]]}, 400, "leave the photo out instead"),
        (
            {"photo": photo, "shapes": [{"brush": 1e300, "points": [1, 1]}]},
            400,
            "brush: is 1e+300, but has to be a whole number",
        ),
        (
            {"photo": photo, "shapes": [{"brush": 2, "points": [1, 2.5]}]},
            400,
            "points[1]: is 2.5, but has to be a whole number",
        ),
        ({"photo": photo, "shapes": [{"brush": 2}]}, 400, "shape: lacks 'points'"),
        ({"photo": photo}, 400, "shapes: is missing"),
    ):
        answer = page.post(address, json=body | {"version": version})
        assert answer.status_code == status and line in answer.json()["error"], answer.text
    assert not (capture / DRAWN).exists() and not (capture / "masks").exists()
    answer = page.post(address, json={"photo": photo, "shapes": [[0, 0, 4, 4]]})
    assert answer.status_code == 400 and "version: is missing" in answer.json()["error"]
    found = page.post(address, json={"photo": photo, "shapes": [[0, 0, 4, 4]], "version": version}).json()
    assert (found["W"], found["H"], found["shapes"], found["own"]) == (32, 24, [[0, 0, 4, 4]], False)
    assert page.get(address, params={"photo": photo}).json() == found
    # what was saved after a drawing began is not replaced, unless it is the same
    answer = page.post(address, json={"photo": photo, "shapes": [[4, 4, 8, 8]], "version": version})
    assert answer.status_code == 409 and "other shapes were saved on its mask" in answer.json()["error"]
    assert (
        page.post(address, json={"photo": photo, "shapes": [[0, 0, 4, 4]], "version": version}).json()
        == found
    )
    assert page.get(address, params={"photo": photo}).json() == found
    listed = page.get("/api/captures/six/photos").json()["photos"]
    assert [one["name"] for one in listed if one["masked"]] == [photo]
    work = Work("train", ("captures/six",), ("runs/six",), {})
    studio.queue.submit(work)
    answer = page.post(address, json={"photo": photo, "shapes": [], "version": found["version"]})
    assert answer.status_code == 409 and "training of six" in answer.json()["error"].lower(), answer.text
    (capture / DRAWN).write_text(json.dumps([]))
    assert "is damaged; delete it" in page.get("/api/captures/six/photos").json()["error"]
