"""The editor selects only what is in front, exactly as the command does with its file, and shows what is selected."""

import numpy as np
import pytest
import torch

from gestures import drag
from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import flags_after
from gsplat_edu.io.formats import read_scene
from gsplat_edu.scene.gaussians import Gaussians
from viewer.handles import until

NEAR_WALL, FAR_WALL = 0.0, 0.8
"""z of two walls that face the camera; the far one is larger."""


def two_walls():
    """Return discs on both walls."""
    walls = []
    for z, halves in ((NEAR_WALL, (0.8, 0.6)), (FAR_WALL, (1.6, 1.2))):
        x, y = torch.meshgrid(*(torch.arange(-half, half + 1e-6, 0.1) for half in halves), indexing="ij")
        walls.append(torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), z)], dim=1))
    means = torch.cat(walls)
    n = len(means)
    return Gaussians(
        means,
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        torch.log(torch.tensor([0.08, 0.08, 0.01])).repeat(n, 1),
        torch.full((n, 1, 3), 0.5),
        torch.zeros(n, 0, 3),
        torch.full((n,), 4.0),
    )


@pytest.fixture
def edit(edit_page):
    """Return a function that opens the editor in front of the walls."""

    def make(width=640, height=400, **options):
        shown = edit_page(two_walls(), width=width, height=height, **options)
        shown.evaluate(FACE)
        return shown

    return make


FACE = """async () => {
  viewer.view.camera = { ...viewer.view.camera, R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], eye: [0, 0, -3] };
  viewer.moved(-1);
  await viewer.settled();
}"""


def draw(shown, tool, corners):
    """Draw with a tool around, or along, some points of the near wall."""
    points = [shown.place(*corner) for corner in corners]
    if tool == "polygon":
        shown.press("Shift+L")
        for point in points:
            shown.tab.mouse.click(*point)
        shown.press("Enter")
    elif tool == "rectangle":
        shown.press("t")
        drag(shown.tab, points[0], points[2])
    else:
        shown.press({"lasso": "l", "brush": "b"}[tool])
        drag(shown.tab, *points)


def shape_only(shown):
    """Return which splats the last selection would hold without its limit of depths."""
    return np.array(
        shown.evaluate("[...members({ ...editor.history.done.at(-1), front: undefined }, editor.values)]"),
        dtype=bool,
    )


SQUARE = ((-0.45, -0.35), (0.45, -0.35), (0.45, 0.35), (-0.45, 0.35))


def test_only_the_near_wall_is_selected_in_the_page_and_by_the_command(edit, tmp_path):
    gaussians, shown = two_walls(), edit()
    near = gaussians.means[:, 2].numpy() == NEAR_WALL
    shown.press("5")
    assert shown.is_on("front")
    for tool in ("rectangle", "lasso", "polygon", "brush"):
        draw(shown, tool, SQUARE)
        shape = shape_only(shown)
        assert (shape & near).sum() > 15 and (shape & ~near).sum() > 5, "the shape covers both walls"
        np.testing.assert_array_equal(shown.flags() == 1, shape & near)
        shown.press("Delete")
        edits = shown.edits()
        np.testing.assert_array_equal(flags_after(edits.operations, gaussians), shown.flags())
        (tmp_path / "edits.json").write_text(shown.text())
        draw(shown, tool, SQUARE)
        behind = shown.flags() == 1
        assert not (behind & near).any() and (tool == "brush" or behind.sum() > 20), (
            "the far wall shows in the hole"
        )
        shown.press(*["u"] * len(shown.operations()))
    words = ["convert", str(tmp_path / "scene.ply"), "--edits", str(tmp_path / "edits.json")]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    left = read_scene(tmp_path / "out.ply").gaussians.means
    assert torch.equal(left, gaussians.means[torch.from_numpy(~(shape & near))])
    shown.press("5")
    draw(shown, tool, SQUARE)
    assert "front" not in shown.last() and not shown.is_on("front")


def corners(shown):
    return shown.evaluate("editor.tools.polygon.corners.length")


def test_a_polygon_closes_at_its_first_corner_by_a_double_click_and_by_enter(edit):
    shown = edit()
    shown.press("Shift+L")
    points = [shown.place(*corner) for corner in SQUARE]
    for point in points:
        shown.tab.mouse.click(*point)
    assert corners(shown) == 4 and len(shown.operations()) == 0
    shown.tab.mouse.click(points[0][0] + 4, points[0][1] - 3)
    assert corners(shown) == 0 and shown.last()["by"] == "lasso" and len(shown.last()["points"]) == 4
    by_first = shown.selected()
    for point in points[:3]:
        shown.tab.mouse.click(*point)
    shown.tab.mouse.dblclick(*points[3])
    assert corners(shown) == 0 and len(shown.last()["points"]) == 4 and shown.selected() == by_first > 0
    shown.tab.keyboard.down("Shift")
    for point in points[:2]:
        shown.tab.mouse.click(*point)
    shown.press("Enter")
    assert corners(shown) == 2, "two corners enclose nothing"
    shown.tab.mouse.click(*points[2])
    shown.press("Enter")
    shown.tab.keyboard.up("Shift")
    assert (shown.last()["how"], len(shown.last()["points"])) == ("add", 3)


def test_corners_are_taken_back_dropped_and_lost_with_the_view(edit):
    shown = edit()
    shown.press("0", "Shift+L")
    for corner in SQUARE[:3]:
        shown.tab.mouse.click(*shown.place(*corner))
    shown.press("Backspace")
    assert corners(shown) == 2
    shown.do("corner-back")
    assert corners(shown) == 1
    shown.press(*["Backspace"] * 3)
    assert corners(shown) == 0 and [step["op"] for step in shown.operations()] == ["select"]
    shown.tab.mouse.click(*shown.place(*SQUARE[0]))
    shown.press("Escape")
    assert corners(shown) == 0 and shown.is_chosen("polygon")
    shown.tab.mouse.click(*shown.place(*SQUARE[0]))
    shown.tab.mouse.wheel(0, -100)
    shown.tab.wait_for_selector('#edit-message:has-text("view has moved")')
    assert corners(shown) == 0


def test_a_polygon_is_drawn_with_the_keys_alone(edit):
    shown = edit()
    shown.press("Shift+L")
    for key, times in (("ArrowLeft", 8), ("ArrowUp", 6), ("ArrowRight", 8), ("ArrowDown", 6)):
        shown.press(*[key] * times, "Enter")
    assert corners(shown) == 4
    shown.press("Enter")
    assert shown.last()["by"] == "lasso" and shown.selected() > 0


def test_a_polygon_is_drawn_by_taps_on_a_phone(edit):
    shown = edit(390, 844, has_touch=True, is_mobile=True)
    shown.tab.tap("[data-tool=polygon]")
    shown.tab.wait_for_selector("[data-tool=polygon][aria-pressed=true]")
    assert shown.tab.is_disabled("[data-do=close-polygon]")
    for count, corner in enumerate(SQUARE, 1):
        shown.tab.touchscreen.tap(*shown.place(*corner))
        until(shown.tab, f"editor.tools.polygon.corners.length === {count}")
    shown.tab.tap("[data-do=close-polygon]")
    until(shown.tab, "editor.history.done.length > 0")
    assert shown.evaluate("document.activeElement.id") == "canvas", "the panel does not scroll away"
    assert corners(shown) == 0 and shown.last()["by"] == "lasso" and shown.selected() > 0
    assert shown.evaluate("document.documentElement.scrollWidth") == 390


CANVAS = """async () => {
  await viewer.settled();
  const gl = viewer.renderer.gl, { width, height } = viewer.canvas, bytes = new Uint8Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  viewer.put(viewer.camera());
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return [width, height, [...bytes]];
}"""


def canvas(shown):
    """Return what the canvas shows, (H, W, 3), first row on top."""
    until(shown.tab, "!viewer.isMoving()")
    width, height, data = shown.evaluate(CANVAS)
    return np.array(data, dtype=np.uint8).reshape(height, width, 4)[::-1, :, :3].astype(int)


def is_highlight(picture):
    return (np.abs(picture - np.array([255, 191, 26])) < 12).all(axis=2)


def test_centres_rings_and_an_outline_show_the_selection(edit):
    shown = edit(320, 240)
    plain = canvas(shown)
    shown.evaluate("""editor.perform({ op: "select", how: "replace", by: "box", center: [0, 0, 0],
      half: [0.31, 0.21, 0.1], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] })""")
    assert shown.selected() == 7 * 5
    tinted = canvas(shown)
    assert not is_highlight(tinted).any() and (tinted != plain).any()

    shown.press("7")
    dots = is_highlight(canvas(shown))
    for x in (-0.3, 0.0, 0.3):
        u, v = np.round(shown.place(x, 0.2)).astype(int)
        assert dots[v - 2 : v + 2, u - 2 : u + 2].any(), "a dot at the centre"
    assert 35 * 4 <= dots.sum() <= 35 * 16

    shown.press("8")
    rings = canvas(shown)
    assert (np.abs(rings - tinted).max(axis=2) > 20).mean() > 0.1
    shown.press("6")
    assert (canvas(shown) == tinted).all()

    shown.press("9")
    outlined = canvas(shown)
    edge = is_highlight(outlined)
    rows, columns = np.nonzero(edge)
    (left, top), (right, bottom) = shown.place(-0.3, -0.2), shown.place(0.3, 0.2)
    assert columns.min() < left < right < columns.max() and rows.min() < top < bottom < rows.max()
    assert columns.min() > left - 30 and rows.max() < bottom + 30
    assert (outlined[~edge] == plain[~edge]).all(), "elsewhere the picture is that without a selection"
    shown.press("n")
    assert (canvas(shown) == plain).all()
    pressed = shown.evaluate(
        "[...document.querySelectorAll('[data-look]')].map((b) => b.getAttribute('aria-pressed'))"
    )
    assert pressed == ["true", "false", "false", "true"]


def test_a_picked_colour_is_the_scene_s_whatever_is_shown(edit):
    shown = edit(320, 240)
    pick = "() => { const c = viewer.camera(); return editor.pictureColor(c, Math.round(c.cx), Math.round(c.cy)); }"
    expected = shown.evaluate(pick)
    shown.press("0")
    for key in ("7", "8", "9"):
        shown.press(key)
        assert shown.evaluate(pick) == expected
