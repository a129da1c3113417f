"""The editor in a browser, used by mouse, keys and fingers, with a server that saves and a second tab."""

import json
import threading

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import flags_after, views_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page, page_parts
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.edit_serve import ADDRESS, EditServer
from viewer.handles import touch, until


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
def served(tmp_path):
    """Serve the wall as a file with the editor."""
    scene, file = tmp_path / "wall.ply", tmp_path / "edits.json"
    write_scene(scene, Scene(wall()))
    source = open_source(scene)
    with EditServer("127.0.0.1", 0, page_parts.policy(page_parts.EDITOR), file) as server:
        server.prepare(identity_of(source.scene), scene)
        editing = editing_of(source, scene, file, ADDRESS)
        server.page = page.html(source.scene, (), source.settings, "wall", editing=editing)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join(10)


@pytest.fixture
def opened(browser, served):
    """Return a function that opens the served page in a tab without complaints."""
    tabs, complaints = [], []

    def make(width=900, height=420, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        tab = context.new_page()
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.goto(served.url)
        tab.wait_for_selector("#edit")
        tabs.append(context)
        return tab

    yield make
    for context in tabs:
        context.close()
    assert complaints == []


def operations(tab):
    return tab.evaluate("editor.history.done")


def last(tab):
    return operations(tab)[-1]


def selected(tab):
    return int(tab.inner_text("#edit-count").split()[0].replace(",", ""))


def drag(tab, *points, button="left"):
    tab.mouse.move(*points[0])
    tab.mouse.down(button=button)
    for point in points[1:]:
        tab.mouse.move(*point, steps=2)
    tab.mouse.up(button=button)


def place(tab, x, y):
    """Return the pixel at which the page shows the point (x, y, 0)."""
    return tab.evaluate(
        "(p) => { const c = viewer.camera(), { u, v } = seenAt(c, p); return [u + 0.5, v + 0.5]; }", [x, y, 0]
    )


def use_every_tool(tab):
    """Select and delete with each tool; return the kinds of operations so far."""
    tab.keyboard.press("t")
    drag(tab, place(tab, -1.6, -1.1), place(tab, 0.0, 1.1))
    assert last(tab)["by"] == "rectangle" and selected(tab) == 8 * 11
    tab.keyboard.press("l")
    tab.keyboard.down("Shift")
    drag(tab, *(place(tab, *p) for p in ((0.6, -1.1), (1.6, -1.1), (1.6, 1.1), (0.6, 1.1))))
    tab.keyboard.up("Shift")
    assert (last(tab)["by"], last(tab)["how"], selected(tab)) == ("lasso", "add", 8 * 11 + 5 * 11)
    tab.keyboard.press("b")
    tab.keyboard.press("]")
    tab.keyboard.press("3")
    drag(tab, place(tab, -1.5, -1), place(tab, -1.5, 1))
    assert (last(tab)["by"], last(tab)["how"]) == ("brush", "subtract") and selected(tab) < 143
    tab.keyboard.press("Delete")
    tab.keyboard.press("o")
    tab.keyboard.press("1")
    drag(tab, place(tab, 0.3, 0.0), place(tab, 0.5, 0.0))
    tab.keyboard.press("Enter")
    assert (
        last(tab)["by"] == "sphere"
        and last(tab)["center"][2] == pytest.approx(0, abs=0.1)
        and selected(tab) > 0
    )
    tab.keyboard.press("j")
    tab.keyboard.press("Shift+J")
    tab.keyboard.press("x")
    tab.fill("#edit-half input >> nth=0", "0.25")
    tab.keyboard.press("Enter")
    assert last(tab)["by"] == "box" and last(tab)["half"][0] == 0.25
    tab.keyboard.press("Escape")  # the field loses the focus
    tab.keyboard.press("g")
    tab.mouse.click(*place(tab, 0.3, 0.2))
    tab.keyboard.press("Enter")
    assert last(tab)["by"] == "color"
    tab.keyboard.press("n")


def mark_points(tab):
    """Level the scene, scale and measure by clicks."""
    before = tab.evaluate("viewer.view.up")
    tab.keyboard.press("z")
    for point in ((0.1, -0.6), (0.5, -0.5), (0.3, 0.8)):
        tab.mouse.click(*place(tab, *point))
    assert last(tab)["op"] == "upright"
    up = tab.evaluate("viewer.view.up")
    assert up != before and abs(up[2]) > 0.99, "the wall is now the floor"
    assert up[2] * tab.evaluate("viewer.view.camera.eye[2]") > 0, "the view is from above"
    tab.keyboard.press("Control+z")
    assert tab.evaluate("viewer.view.up") == before
    tab.keyboard.press("c")
    for point in ((0.1, 0.0), (0.5, 0.0)):
        tab.mouse.click(*place(tab, *point))
    tab.fill("#edit-length", "2")
    tab.click("[data-do=scale]")
    tab.keyboard.press("m")
    for point in ((0.1, 0.0), (0.5, 0.0)):
        tab.mouse.click(*place(tab, *point))
    assert float(tab.inner_text("#edit-hint").split()[1]) == pytest.approx(2, rel=0.02)
    tab.click("#edit-note")
    tab.keyboard.type("rk <b>pfu")  # letters that are shortcuts outside of fields
    tab.keyboard.press("Enter")
    assert last(tab)["note"] == "rk <b>pfu" and len(tab.evaluate("viewer.keyframes.path.keyframes")) == 0
    tab.keyboard.press("Escape")


def keep_views_and_move(tab):
    """Keep a path, a named view and a start view; then move all splats by keys."""
    tab.keyboard.press("v")
    tab.keyboard.press("k")
    drag(tab, (300, 200), (340, 210))
    tab.keyboard.press("k")
    assert last(tab)["op"] == "path"
    tab.click("#edit-views summary")
    tab.fill("#edit-name", "from the side")
    tab.type("#edit-text", "A <b>step</b>.\nT, C and V are letters here.")
    tab.click("[data-do=view]")
    tab.click("[data-do=start]")
    tab.focus("#canvas")
    for key in ("0", "Shift+V", "Shift+X", "ArrowRight", "ArrowRight", "Enter"):
        tab.keyboard.press(key)
    assert last(tab)["op"] == "move" and tab.evaluate("viewer.keyframes.path.keyframes.length") == 2


def test_everything_by_mouse_and_keyboard_then_saved_reopened_and_converted(opened, served, tmp_path):
    tab = opened()
    empty = tab.evaluate("editor.text()")
    use_every_tool(tab)
    mark_points(tab)
    keep_views_and_move(tab)
    assert tab.inner_text("#edit-saved") == "not saved"
    tab.keyboard.press("Control+s")
    tab.wait_for_selector('#edit-saved:text-is("saved")')
    text = tab.evaluate("editor.text()")
    assert served.file.read_text() == text
    with tab.expect_download() as caught:
        tab.click("[data-do=download]")
    caught.value.save_as(tmp_path / "downloaded.json")
    assert caught.value.suggested_filename == "edits.json"
    assert (tmp_path / "downloaded.json").read_bytes() == served.file.read_bytes()
    edits = read_edits(served.file)
    flags = np.array(tab.evaluate("[...editor.history.flags]"), dtype=np.uint8)
    np.testing.assert_array_equal(flags_after(edits.operations, wall()), flags)
    views = views_after(edits.operations)
    assert views.start is not None and views.path is not None and views.named[0].name == "from the side"
    assert views.named[0].text == "A <b>step</b>.\nT, C and V are letters here."
    for name in ("edits.json", "downloaded.json"):
        assert (
            main(
                [
                    "convert",
                    str(tmp_path / "wall.ply"),
                    "--edits",
                    str(tmp_path / name),
                    str(tmp_path / f"{name}.spz"),
                ]
            )
            == 0
        )
    assert (tmp_path / "edits.json.spz").read_bytes() == (tmp_path / "downloaded.json.spz").read_bytes()

    second = opened()
    assert second.evaluate("editor.text()") == text
    assert second.evaluate("[...editor.history.flags]") == flags.tolist()
    means = tab.evaluate("[...editor.values.means]")
    assert second.evaluate("[...editor.values.means]") == means != wall().means.ravel().tolist()
    until(second, "editor.values.motion.stale === null && viewer.renderer.motion.any")  # it is drawn there
    assert second.evaluate("viewer.keyframes.path.keyframes.length") == 2
    for _ in edits.operations:
        second.keyboard.press("u")
    assert second.evaluate("editor.text()") == empty
    second.keyboard.press("Control+s")
    second.wait_for_selector('#edit-saved:text-is("saved")')
    tab.keyboard.press("i")
    tab.keyboard.press("Control+s")
    tab.wait_for_selector('#edit-message:has-text("was changed elsewhere")')
    assert served.file.read_text() == empty, "the edits of the second tab are not overwritten"


def test_the_view_moves_while_a_tool_is_chosen_and_keys_draw(opened):
    tab = opened()
    tab.keyboard.press("t")
    moved = "viewer.view.camera.eye.some((x, i) => x !== {}[i])"
    eye = tab.evaluate("viewer.view.camera.eye")
    drag(tab, (300, 200), (330, 220), button="right")
    panned = tab.evaluate("viewer.view.camera.eye")
    assert panned != eye and operations(tab) == []
    tab.mouse.wheel(0, -100)
    until(tab, moved.format(panned))
    panned = tab.evaluate("viewer.view.camera.eye")
    assert operations(tab) == []
    tab.keyboard.down("Space")
    drag(tab, (300, 200), (330, 220))
    tab.keyboard.up("Space")
    assert tab.evaluate("viewer.view.camera.eye") != panned and operations(tab) == []
    tab.keyboard.press("Enter")  # no point is chosen, and no cross is shown yet
    assert operations(tab) == []
    for key, times in (
        ("ArrowLeft", 20),
        ("ArrowUp", 15),
        ("Enter", 1),
        ("ArrowRight", 45),
        ("ArrowDown", 40),
    ):
        for _ in range(times):
            tab.keyboard.press(key)
    tab.keyboard.press("Enter")
    assert [operation["op"] for operation in operations(tab)] == ["select"] and selected(tab) > 0
    assert tab.evaluate("viewer.cameraIndex") == -1
    tab.keyboard.press("Escape")
    tab.keyboard.press("Escape")
    assert tab.get_attribute("[data-tool=navigate]", "aria-pressed") == "true"
    tab.click("#edit-list summary")
    tab.click("#edit-list li button >> nth=0")  # the view as opened
    assert selected(tab) == 0 and tab.evaluate("editor.history.undone.length") == 1


def test_one_finger_draws_and_two_move_the_view_on_a_phone(opened):
    tab = opened(390, 844, has_touch=True)
    session = tab.context.new_cdp_session(tab)
    tab.tap("[data-tool=brush]")
    tab.wait_for_selector("[data-tool=brush][aria-pressed=true]")
    eye = tab.evaluate("viewer.view.camera.eye")
    touch(session, "touchStart", (150, 250))
    touch(session, "touchMove", (240, 250))
    touch(session, "touchEnd")
    assert last(tab)["by"] == "brush" and selected(tab) > 0
    assert tab.evaluate("viewer.view.camera.eye") == eye
    touch(session, "touchStart", (150, 250))
    touch(session, "touchStart", (150, 250), (250, 250))
    touch(session, "touchMove", (130, 270), (270, 270))
    touch(session, "touchEnd")
    assert len(operations(tab)) == 1 and tab.evaluate("viewer.view.camera.eye") != eye
    touch(session, "touchStart", (150, 250))
    touch(session, "touchEnd")
    assert len(operations(tab)) == 2, "one finger draws again"
    sizes = tab.evaluate(
        "[...document.querySelectorAll('#edit button')].map((b) => b.getBoundingClientRect().height)"
    )
    assert min(size for size in sizes if size) >= 40
    assert tab.evaluate("document.documentElement.scrollWidth") == 390


def test_every_control_of_the_editor_has_a_name_and_its_keys_are_its_own(opened):
    tab = opened()
    unnamed = tab.evaluate("""() => [...document.querySelectorAll("#edit :is(button, input, select)")].filter(
      (e) => !(e.textContent || e.closest("label")?.textContent || e.getAttribute("aria-label"))).length""")
    assert unnamed == 0
    keys = set(tab.evaluate("Object.keys(EDIT_KEYS)"))
    assert not keys & set("frkphwasdqe") and len(keys) > 20
    assert json.loads(tab.evaluate("editor.text()"))["operations"] == []
