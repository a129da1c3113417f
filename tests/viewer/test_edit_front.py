"""The editor selects only what is in front, exactly as the command does with its file, and shows what is selected."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import flags_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page
from gsplat_edu.viewer.edit_page import editing_of
from viewer.handles import until

NEAR_WALL, FAR_WALL = 0.0, 0.8
"""z of two walls that face the camera; the far one is larger."""

THICKNESS = 0.01


def wall(z, halves, step=0.1):
    """Return the means of a wall at z."""
    x, y = (torch.arange(-half, half + 1e-6, step) for half in halves)
    x, y = torch.meshgrid(x, y, indexing="ij")
    return torch.stack([x.ravel(), y.ravel(), torch.full((x.numel(),), z)], dim=1)


def splats(means, angle=0.0):
    """Return discs at these means, turned about the y axis."""
    n = len(means)
    log_scales = torch.log(torch.tensor([0.08, 0.08, THICKNESS])).expand(n, 3).contiguous()
    quats = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0]).expand(n, 4).contiguous()
    colors = torch.full((n, 1, 3), 0.5)
    return Gaussians(means, quats, log_scales, colors, torch.zeros(n, 0, 3), torch.full((n,), 4.0))


def two_walls():
    return splats(torch.cat([wall(NEAR_WALL, (0.8, 0.6)), wall(FAR_WALL, (1.6, 1.2))]))


@pytest.fixture
def edit(visit, tmp_path):
    """Return a function that writes a scene and its page with the editor, and opens the page in front of it."""

    def make(gaussians, width=640, height=400, **options):
        source = Source(tmp_path / "scene.ply", Scene(gaussians), (), RenderSettings(depth=False))
        editing = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json")
        html = page.html(source.scene, (), source.settings, "scene", (), None, editing)
        (tmp_path / "edit.html").write_bytes(html)
        write_scene(tmp_path / "scene.ply", source.scene)
        shown = visit(width=width, height=height, **options).open(tmp_path / "edit.html").ready()
        shown.tab.wait_for_selector("#edit")
        shown.tab.evaluate(FACE)
        return shown.tab

    return make


FACE = """async () => {
  viewer.view.camera = { ...viewer.view.camera, R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], eye: [0, 0, -3] };
  viewer.moved(-1);
  await viewer.settled();
}"""


def place(tab, x, y, z=NEAR_WALL):
    """Return the CSS pixel at which the page shows a point."""
    return tab.evaluate(
        """(p) => { const c = viewer.camera(), { u, v } = seenAt(c, p), box = viewer.canvas.getBoundingClientRect();
        return [box.left + (u + 0.5) * box.width / c.W, box.top + (v + 0.5) * box.height / c.H]; }""",
        [x, y, z],
    )


def drag(tab, *points):
    tab.mouse.move(*points[0])
    tab.mouse.down()
    for point in points[1:]:
        tab.mouse.move(*point, steps=3)
    tab.mouse.up()


def draw(tab, tool, corners):
    """Draw with a tool around, or along, some points of the near wall."""
    points = [place(tab, *corner) for corner in corners]
    if tool == "polygon":
        tab.keyboard.press("Shift+L")
        for point in points:
            tab.mouse.click(*point)
        tab.keyboard.press("Enter")
    elif tool == "rectangle":
        tab.keyboard.press("t")
        drag(tab, points[0], points[2])
    else:
        tab.keyboard.press({"lasso": "l", "brush": "b"}[tool])
        drag(tab, *points)


def flags_of(tab):
    return np.array(tab.evaluate("[...editor.history.flags]"), dtype=np.uint8)


def last(tab):
    return tab.evaluate("editor.history.done.at(-1)")


def shape_only(tab):
    """Return which splats the last selection would hold without its limit of depths."""
    return np.array(
        tab.evaluate("[...members({ ...editor.history.done.at(-1), front: undefined }, editor.values)]"),
        dtype=bool,
    )


SQUARE = ((-0.45, -0.35), (0.45, -0.35), (0.45, 0.35), (-0.45, 0.35))


@pytest.mark.parametrize("tool", ["rectangle", "lasso", "polygon", "brush"])
def test_only_the_near_wall_is_selected_in_the_page_and_by_the_command(edit, tmp_path, tool):
    gaussians = two_walls()
    near = gaussians.means[:, 2].numpy() == NEAR_WALL
    tab = edit(gaussians)
    tab.keyboard.press("5")
    assert tab.get_attribute("[data-do=front]", "aria-pressed") == "true"
    draw(tab, tool, SQUARE)
    shape = shape_only(tab)
    assert (shape & near).sum() > 15 and (shape & ~near).sum() > 5, "the shape covers both walls"
    np.testing.assert_array_equal(flags_of(tab) == 1, shape & near)
    tab.keyboard.press("Delete")
    (tmp_path / "edits.json").write_text(tab.evaluate("editor.text()"))
    edits = read_edits(tmp_path / "edits.json")
    np.testing.assert_array_equal(flags_after(edits.operations, gaussians), flags_of(tab))
    words = ["convert", str(tmp_path / "scene.ply"), "--edits", str(tmp_path / "edits.json")]
    assert main([*words, str(tmp_path / "out.ply")]) == 0
    left = read_scene(tmp_path / "out.ply").gaussians.means
    assert torch.equal(left, gaussians.means[torch.from_numpy(~(shape & near))])
    draw(tab, tool, SQUARE)
    behind = flags_of(tab) == 1
    assert not (behind & near).any() and (tool == "brush" or behind.sum() > 20), (
        "the far wall shows in the hole"
    )
    tab.keyboard.press("5")
    draw(tab, tool, SQUARE)
    assert "front" not in last(tab) and tab.get_attribute("[data-do=front]", "aria-pressed") == "false"


def test_a_large_shape_takes_the_far_wall_where_it_is_visible_and_not_behind_the_near_one(edit):
    gaussians = two_walls()
    means = gaussians.means.numpy()
    near = means[:, 2] == NEAR_WALL
    tab = edit(gaussians)
    tab.keyboard.press("5")
    tab.evaluate("""() => { const camera = viewer.camera();
      const shape = { by: "rectangle", camera: pictureOf(camera), corners: [-0.5, -0.5, camera.W, camera.H] };
      editor.tools.select("replace", shape, camera); }""")
    found = flags_of(tab) == 1
    assert found[near].all()
    x, y = (np.abs(means[:, i]) * 3 / (3 + FAR_WALL) for i in (0, 1))  # as seen on the near wall's plane
    behind, beside = (x < 0.8) & (y < 0.6), (x > 1.05) | (y > 0.85)
    assert behind[~near].sum() > 100 and beside[~near].sum() > 100
    assert not found[~near & behind].any() and found[~near & beside].all()


def test_splats_just_under_a_rough_surface_belong_to_it(edit):
    """A wall as deep as three deviations of its splats is taken as a whole; a sloped wall, too."""
    rng = np.random.default_rng(0)
    means = wall(NEAR_WALL, (0.8, 0.6), 0.05)
    rough = means.clone()
    rough[:, 2] += torch.from_numpy(rng.uniform(0, 2 * THICKNESS, len(means)).astype(np.float32))
    sloped = means.clone()
    sloped[:, 2] += 1.2 * means[:, 0]
    for surface, angle in ((rough, 0.0), (sloped, -math.atan(1.2))):
        parts = [splats(surface, angle).tensors(), splats(wall(2.5, (2.5, 2.0))).tensors()]
        both = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        tab = edit(Gaussians(**both))
        tab.keyboard.press("5")
        draw(tab, "rectangle", SQUARE)
        shape = shape_only(tab)
        expected = shape & (np.arange(len(shape)) < len(surface))
        np.testing.assert_array_equal(flags_of(tab) == 1, expected)
        assert 0 < expected.sum() < shape.sum()


def test_the_surface_of_the_grid_is_that_of_a_click(edit, random_gaussians):
    """Depths of the grid and of single pixels agree; where there is no surface, neither finds one."""
    tab = edit(random_gaussians(600), 200, 160)
    found = tab.evaluate("""() => {
      const camera = viewer.camera(), { values, history } = editor, { settings, facts } = viewer;
      const lattice = { u0: 3, v0: 5, du: 11, dv: 9, across: 17, down: 9 };
      const scene = { values, flags: history.flags, settings, near: facts.near };
      const { depths, ends } = visibleSurface(scene, camera, lattice);
      const clicks = Array.from(depths, (_, k) =>
        editor.tools.depthAt(camera, 3 + 11 * (k % 17), 5 + 9 * Math.floor(k / 17)) ?? 0);
      return [[...depths], clicks, [...ends]];
    }""")
    depths, clicks, ends = map(np.array, found)
    assert (depths > 0).sum() > 20 and (depths == 0).sum() > 5
    np.testing.assert_allclose(depths, clicks, rtol=1e-12)
    assert (ends[depths > 0] > depths[depths > 0]).all()


def test_a_front_is_small_and_where_there_is_no_surface_it_has_no_limit(edit):
    tab = edit(splats(torch.cat([wall(NEAR_WALL, (0.3, 0.3)), torch.tensor([[1.2, 0.0, 2.0]])])))
    tab.evaluate("values => { editor.values.logits[editor.values.count - 1] = -3; }")  # faint
    tab.keyboard.press("5")
    draw(tab, "rectangle", ((-1.2, -0.5), (1.2, -0.5), (1.2, 0.5), (-1.2, 0.5)))
    front = last(tab)["front"]
    assert None in front["deepest"] and flags_of(tab).all()
    assert (
        len(front["deepest"]) == front["columns"] * front["rows"]
        and max(front["columns"], front["rows"]) <= 48
    )
    assert all(len(str(depth)) <= 7 for depth in front["deepest"] if depth is not None)


def selected(tab):
    return int((flags_of(tab) == 1).sum())


def corners(tab):
    return tab.evaluate("editor.tools.polygon.corners.length")


def test_a_polygon_closes_at_its_first_corner_by_a_double_click_and_by_enter(edit):
    tab = edit(two_walls())
    tab.keyboard.press("Shift+L")
    points = [place(tab, *corner) for corner in SQUARE]
    for point in points:
        tab.mouse.click(*point)
    assert corners(tab) == 4 and tab.evaluate("editor.history.done.length") == 0
    tab.mouse.click(points[0][0] + 4, points[0][1] - 3)
    assert corners(tab) == 0 and last(tab)["by"] == "lasso" and len(last(tab)["points"]) == 4
    by_first = selected(tab)
    for point in points[:3]:
        tab.mouse.click(*point)
    tab.mouse.dblclick(*points[3])
    assert corners(tab) == 0 and len(last(tab)["points"]) == 4 and selected(tab) == by_first > 0
    tab.keyboard.down("Shift")
    for point in points[:2]:
        tab.mouse.click(*point)
    tab.keyboard.press("Enter")
    assert corners(tab) == 2, "two corners enclose nothing"
    tab.mouse.click(*points[2])
    tab.keyboard.press("Enter")
    tab.keyboard.up("Shift")
    assert (last(tab)["how"], len(last(tab)["points"])) == ("add", 3)


def test_corners_are_taken_back_dropped_and_lost_with_the_view(edit):
    tab = edit(two_walls())
    tab.keyboard.press("0")
    tab.keyboard.press("Shift+L")
    for corner in SQUARE[:3]:
        tab.mouse.click(*place(tab, *corner))
    tab.keyboard.press("Backspace")
    assert corners(tab) == 2
    tab.click("[data-do=corner-back]")
    assert corners(tab) == 1
    for _ in range(3):
        tab.keyboard.press("Backspace")
    assert corners(tab) == 0 and [step["op"] for step in tab.evaluate("editor.history.done")] == ["select"]
    tab.mouse.click(*place(tab, *SQUARE[0]))
    tab.keyboard.press("Escape")
    assert corners(tab) == 0 and tab.get_attribute("[data-tool=polygon]", "aria-pressed") == "true"
    tab.mouse.click(*place(tab, *SQUARE[0]))
    tab.mouse.wheel(0, -100)
    tab.wait_for_selector('#edit-message:has-text("view has moved")')
    assert corners(tab) == 0


def test_a_polygon_is_drawn_with_the_keys_alone(edit):
    tab = edit(two_walls())
    tab.keyboard.press("Shift+L")
    for key, times in (("ArrowLeft", 8), ("ArrowUp", 6), ("ArrowRight", 8), ("ArrowDown", 6)):
        for _ in range(times):
            tab.keyboard.press(key)
        tab.keyboard.press("Enter")
    assert corners(tab) == 4
    tab.keyboard.press("Enter")
    assert last(tab)["by"] == "lasso" and selected(tab) > 0


def test_a_polygon_is_drawn_by_taps_on_a_phone(edit):
    tab = edit(two_walls(), 390, 844, has_touch=True, is_mobile=True)
    tab.tap("[data-tool=polygon]")
    tab.wait_for_selector("[data-tool=polygon][aria-pressed=true]")
    assert tab.is_disabled("[data-do=close-polygon]")
    for count, corner in enumerate(SQUARE, 1):
        tab.touchscreen.tap(*place(tab, *corner))
        until(tab, f"editor.tools.polygon.corners.length === {count}")
    tab.tap("[data-do=close-polygon]")
    until(tab, "editor.history.done.length > 0")
    assert tab.evaluate("document.activeElement.id") == "canvas", "the panel does not scroll away"
    assert corners(tab) == 0 and last(tab)["by"] == "lasso" and selected(tab) > 0
    assert tab.evaluate("document.documentElement.scrollWidth") == 390


CANVAS = """async () => {
  while (viewer.isMoving()) await new Promise((later) => setTimeout(later, 20));
  await viewer.settled();
  const gl = viewer.renderer.gl, { width, height } = viewer.canvas, bytes = new Uint8Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  viewer.put(viewer.camera());
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return [width, height, [...bytes]];
}"""


def canvas(tab):
    """Return what the canvas shows, (H, W, 3), first row on top."""
    width, height, data = tab.evaluate(CANVAS)
    return np.array(data, dtype=np.uint8).reshape(height, width, 4)[::-1, :, :3].astype(int)


def is_highlight(picture):
    return (np.abs(picture - np.array([255, 191, 26])) < 12).all(axis=2)


def test_centres_rings_and_an_outline_show_the_selection(edit):
    tab = edit(two_walls(), 320, 240)
    plain = canvas(tab)
    tab.evaluate("""editor.perform({ op: "select", how: "replace", by: "box", center: [0, 0, 0],
      half: [0.31, 0.21, 0.1], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] })""")
    assert selected(tab) == 7 * 5
    tinted = canvas(tab)
    assert not is_highlight(tinted).any() and (tinted != plain).any()

    tab.keyboard.press("7")
    dots = is_highlight(canvas(tab))
    for x in (-0.3, 0.0, 0.3):
        u, v = np.round(place(tab, x, 0.2)).astype(int)
        assert dots[v - 2 : v + 2, u - 2 : u + 2].any(), "a dot at the centre"
    assert 35 * 4 <= dots.sum() <= 35 * 16

    tab.keyboard.press("8")
    rings = canvas(tab)
    assert (np.abs(rings - tinted).max(axis=2) > 20).mean() > 0.1
    tab.keyboard.press("6")
    assert (canvas(tab) == tinted).all()

    tab.keyboard.press("9")
    outlined = canvas(tab)
    edge = is_highlight(outlined)
    rows, columns = np.nonzero(edge)
    (left, top), (right, bottom) = place(tab, -0.3, -0.2), place(tab, 0.3, 0.2)
    assert columns.min() < left < right < columns.max() and rows.min() < top < bottom < rows.max()
    assert columns.min() > left - 30 and rows.max() < bottom + 30
    assert (outlined[~edge] == plain[~edge]).all(), "elsewhere the picture is that without a selection"
    tab.keyboard.press("n")
    assert (canvas(tab) == plain).all()
    pressed = tab.evaluate(
        "[...document.querySelectorAll('[data-look]')].map((b) => b.getAttribute('aria-pressed'))"
    )
    assert pressed == ["true", "false", "false", "true"]


def test_a_picked_colour_is_the_scene_s_whatever_is_shown(edit):
    tab = edit(two_walls(), 320, 240)
    pick = "() => { const c = viewer.camera(); return editor.pictureColor(c, Math.round(c.cx), Math.round(c.cy)); }"
    expected = tab.evaluate(pick)
    tab.keyboard.press("0")
    for key in ("7", "8", "9"):
        tab.keyboard.press(key)
        assert tab.evaluate(pick) == expected
