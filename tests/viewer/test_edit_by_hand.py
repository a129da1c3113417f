"""The editor in a browser, used by mouse, keys and fingers, with a server that saves and a second tab."""

import json

import numpy as np
import pytest
import torch

from gestures import drag, swipe, touch
from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import flags_after, views_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.scene.gaussians import Gaussians
from viewer.handles import until
from viewer.pages import Editor


def wall():
    """A wall of splats at z = 0, so that every click near its middle hits a surface."""
    x, y = torch.meshgrid(torch.linspace(-1.5, 1.5, 16), torch.linspace(-1, 1, 11), indexing="ij")
    n = x.numel()
    means = torch.stack([x.ravel(), y.ravel(), torch.zeros(n)], dim=1)
    log_scales = torch.log(torch.tensor([0.15, 0.15, 0.01])).expand(n, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4)
    colors = means[:, None].contiguous()
    return Gaussians(
        means,
        quats.contiguous(),
        log_scales.contiguous(),
        colors,
        torch.zeros(n, 0, 3),
        torch.full((n,), 4.0),
    )


@pytest.fixture
def served(edit_site):
    return edit_site(wall())


@pytest.fixture
def opened(served, visit):
    """Return a function that opens the served page in a tab."""

    def make(width=1440, height=800, **options):
        shown = visit(width, height, url=served.url, kind=Editor, **options).ready()
        shown.expected = "status of 412"
        return shown

    return make


def use_every_tool(shown):
    """Select and delete with each tool; return the kinds of operations so far."""
    shown.press("t")
    drag(shown.tab, shown.place(-1.6, -1.1), shown.place(0.0, 1.1))
    assert shown.last()["by"] == "rectangle" and shown.selected() == 8 * 11
    shown.press("l")
    shown.tab.keyboard.down("Shift")
    drag(shown.tab, *(shown.place(*p) for p in ((0.6, -1.1), (1.6, -1.1), (1.6, 1.1), (0.6, 1.1))))
    shown.tab.keyboard.up("Shift")
    assert (shown.last()["by"], shown.last()["how"], shown.selected()) == ("lasso", "add", 8 * 11 + 5 * 11)
    shown.press("b", "]", "3")
    drag(shown.tab, shown.place(-1.5, -1), shown.place(-1.5, 1))
    assert (shown.last()["by"], shown.last()["how"]) == ("brush", "subtract") and shown.selected() < 143
    shown.press("Delete", "o", "1")
    drag(shown.tab, shown.place(0.3, 0.0), shown.place(0.5, 0.0))
    shown.press("Enter")
    assert (
        shown.last()["by"] == "sphere"
        and shown.last()["center"][2] == pytest.approx(0, abs=0.1)
        and shown.selected() > 0
    )
    shown.press("j", "Shift+J", "x")
    shown.tab.fill("#edit-half input >> nth=0", "0.25")
    shown.press("Enter")
    assert shown.last()["by"] == "box" and shown.last()["half"][0] == 0.25
    shown.press("Escape")  # the field loses the focus
    shown.press("g")
    shown.tab.mouse.click(*shown.place(0.3, 0.2))
    shown.press("Enter")
    assert shown.last()["by"] == "color"
    shown.press("n")


def mark_points(shown):
    """Level the scene, scale and measure by clicks."""
    before = shown.evaluate("viewer.view.up")
    shown.press("z")
    for point in ((0.1, -0.6), (0.5, -0.5), (0.3, 0.8)):
        shown.tab.mouse.click(*shown.place(*point))
    assert shown.last()["op"] == "upright"
    up = shown.evaluate("viewer.view.up")
    assert up != before and abs(up[2]) > 0.99, "the wall is now the floor"
    assert up[2] * shown.evaluate("viewer.view.camera.eye[2]") > 0, "the view is from above"
    shown.press("Control+z")
    assert shown.evaluate("viewer.view.up") == before
    shown.press("c")
    for point in ((0.1, 0.0), (0.5, 0.0)):
        shown.tab.mouse.click(*shown.place(*point))
    shown.tab.fill("#edit-length", "2")
    shown.do("scale")
    shown.press("m")
    for point in ((0.1, 0.0), (0.5, 0.0)):
        shown.tab.mouse.click(*shown.place(*point))
    assert float(shown.tab.inner_text("#edit-hint").split()[1]) == pytest.approx(2, rel=0.02)
    shown.tab.click("#edit-note")
    shown.tab.keyboard.type("rk <b>pfu")  # letters that are shortcuts outside of fields
    shown.press("Enter")
    assert shown.last()["note"] == "rk <b>pfu" and len(shown.evaluate("viewer.keyframes.path.keyframes")) == 0
    shown.press("Escape")


def keep_views_and_move(shown):
    """Keep a path, a named view and a start view; then move all splats by keys."""
    shown.press("v", "k")
    drag(shown.tab, (300, 200), (340, 210))
    shown.press("k")
    assert shown.last()["op"] == "path"
    shown.tab.click("#edit-views summary")
    shown.tab.fill("#edit-name", "from the side")
    shown.tab.type("#edit-text", "A <b>step</b>.\nT, C and V are letters here.")
    shown.do("view")
    shown.do("start")
    shown.tab.focus("#canvas")
    shown.press("0", "Shift+V", "Shift+X", "ArrowRight", "ArrowRight", "Enter")
    assert shown.last()["op"] == "move" and shown.evaluate("viewer.keyframes.path.keyframes.length") == 2


def test_everything_by_mouse_and_keyboard_then_saved_reopened_and_converted(opened, served, tmp_path):
    shown = opened()
    empty = shown.text()
    use_every_tool(shown)
    mark_points(shown)
    keep_views_and_move(shown)
    assert shown.tab.inner_text("#edit-saved") == "not saved"
    shown.press("Control+s")
    shown.tab.wait_for_selector('#edit-saved:text-is("saved")')
    text = shown.text()
    assert served.file.read_text() == text
    with shown.tab.expect_download() as caught:
        shown.do("download")
    caught.value.save_as(tmp_path / "downloaded.json")
    assert caught.value.suggested_filename == "edits.json"
    assert (tmp_path / "downloaded.json").read_bytes() == served.file.read_bytes()
    edits = read_edits(served.file)
    flags = shown.flags()
    np.testing.assert_array_equal(flags_after(edits.operations, wall()), flags)
    views = views_after(edits.operations)
    assert views.start is not None and views.path is not None and views.named[0].name == "from the side"
    assert views.named[0].text == "A <b>step</b>.\nT, C and V are letters here."
    for name in ("edits.json", "downloaded.json"):
        assert (
            main(
                [
                    "convert",
                    str(tmp_path / "scene.ply"),
                    "--edits",
                    str(tmp_path / name),
                    str(tmp_path / f"{name}.spz"),
                ]
            )
            == 0
        )
    assert (tmp_path / "edits.json.spz").read_bytes() == (tmp_path / "downloaded.json.spz").read_bytes()

    second = opened()
    assert second.text() == text
    assert second.evaluate("[...editor.history.flags]") == flags.tolist()
    means = shown.evaluate("[...editor.values.means]")
    assert second.evaluate("[...editor.values.means]") == means != wall().means.ravel().tolist()
    until(
        second.tab, "editor.values.motion.stale === null && viewer.renderer.motion.any"
    )  # it is drawn there
    assert second.evaluate("viewer.keyframes.path.keyframes.length") == 2
    for _ in edits.operations:
        second.press("u")
    assert second.text() == empty
    second.press("Control+s")
    second.tab.wait_for_selector('#edit-saved:text-is("saved")')
    shown.press("i", "Control+s")
    shown.tab.wait_for_selector('#edit-message:has-text("was changed elsewhere")')
    assert served.file.read_text() == empty, "the edits of the second shown are not overwritten"


def test_the_view_moves_while_a_tool_is_chosen_and_keys_draw(opened):
    shown = opened()
    shown.press("t")
    moved = "viewer.view.camera.eye.some((x, i) => x !== {}[i])"
    eye = shown.evaluate("viewer.view.camera.eye")
    drag(shown.tab, (300, 200), (330, 220), button="right")
    panned = shown.evaluate("viewer.view.camera.eye")
    assert panned != eye and shown.operations() == []
    shown.tab.mouse.wheel(0, -100)
    until(shown.tab, moved.format(panned))
    panned = shown.evaluate("viewer.view.camera.eye")
    assert shown.operations() == []
    shown.tab.keyboard.down("Space")
    drag(shown.tab, (300, 200), (330, 220))
    shown.tab.keyboard.up("Space")
    assert shown.evaluate("viewer.view.camera.eye") != panned and shown.operations() == []
    shown.press("Enter")  # no point is chosen, and no cross is shown yet
    assert shown.operations() == []
    for key, times in (
        ("ArrowLeft", 20),
        ("ArrowUp", 15),
        ("Enter", 1),
        ("ArrowRight", 45),
        ("ArrowDown", 40),
    ):
        shown.press(*[key] * times)
    shown.press("Enter")
    assert [operation["op"] for operation in shown.operations()] == ["select"] and shown.selected() > 0
    assert shown.evaluate("viewer.cameraIndex") == -1
    shown.press("Escape", "Escape")
    assert shown.is_chosen("navigate")
    shown.tab.click("#edit-list summary")
    shown.tab.click("#edit-list li button >> nth=0")  # the view as opened
    assert shown.selected() == 0 and shown.evaluate("editor.history.undone.length") == 1


def test_one_finger_draws_and_two_move_the_view_on_a_phone(opened):
    shown = opened(390, 844, has_touch=True)
    session = shown.tab.context.new_cdp_session(shown.tab)
    shown.tab.tap("[data-tool=brush]")
    shown.tab.wait_for_selector("[data-tool=brush][aria-pressed=true]")
    eye = shown.evaluate("viewer.view.camera.eye")
    swipe(shown.tab, (150, 250), (240, 250))
    assert shown.last()["by"] == "brush" and shown.selected() > 0
    assert shown.evaluate("viewer.view.camera.eye") == eye
    touch(session, "touchStart", (150, 250))
    touch(session, "touchStart", (150, 250), (250, 250))
    touch(session, "touchMove", (130, 270), (270, 270))
    touch(session, "touchEnd")
    assert len(shown.operations()) == 1 and shown.evaluate("viewer.view.camera.eye") != eye
    swipe(shown.tab, (150, 250))
    assert len(shown.operations()) == 2, "one finger draws again"
    sizes = shown.evaluate(
        "[...document.querySelectorAll('#edit button')].map((b) => b.getBoundingClientRect().height)"
    )
    assert min(size for size in sizes if size) >= 40
    assert shown.evaluate("document.documentElement.scrollWidth") == 390


def test_every_control_of_the_editor_has_a_name_and_its_keys_are_its_own(opened):
    shown = opened()
    unnamed = shown.evaluate("""() => [...document.querySelectorAll("#edit :is(button, input, select)")].filter(
      (e) => !(e.textContent || e.closest("label")?.textContent || e.getAttribute("aria-label"))).length""")
    assert unnamed == 0
    keys = set(shown.evaluate("Object.keys(EDIT_KEYS)"))
    assert not keys & set("frkphwasdqe") and len(keys) > 20
    assert json.loads(shown.text())["operations"] == []
