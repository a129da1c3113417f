"""The editor in a browser selects, deletes and stores exactly the splats that Python does."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import SELECTED, flags_after, placed, views_after
from gsplat_edu.edits.cells import MOST_TESTS, Work
from gsplat_edu.edits.document import parse_edits, read_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.edits.membership import Values, members
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source
from gsplat_edu.viewer import page
from gsplat_edu.viewer.edit_page import editing_of

SEEDS = 20
GESTURES = 25
SIZE = (360, 240)
"""Small, so that a picture takes little time; the panel covers the lower part."""

# Plays gestures by the events of a browser: clicks on buttons, input into fields, pointers on the canvas.
PLAY = """async (gestures) => {
  const canvas = document.getElementById("canvas");
  const fire = (target, kind, [x, y], keys = {}) => target.dispatchEvent(new PointerEvent(kind, {
    bubbles: true, cancelable: true, pointerId: 7, button: 0, clientX: x, clientY: y, ...keys }));
  for (const { click, fill, drag, keys, key, turn } of gestures) {
    if (click) document.querySelector(click).click();
    if (fill) {
      const field = document.querySelector(fill[0]);
      field.value = fill[1];
      field.dispatchEvent(new Event("input", { bubbles: true }));
    }
    if (key) canvas.dispatchEvent(new KeyboardEvent("keydown", { key, code: key, bubbles: true, cancelable: true }));
    if (turn) {
      viewer.view.orbit(...turn);
      viewer.moved(-1);
    }
    if (drag) {
      await viewer.settled();
      fire(canvas, "pointerdown", drag[0], keys);
      for (const point of drag.slice(1)) fire(canvas, "pointermove", point, keys);
      fire(canvas, "pointerup", drag[drag.length - 1], keys);
    }
  }
}"""

STATE = """() => ({ text: editor.text(), flags: [...editor.history.flags] })"""


def source_of(gaussians, path="scene.ply", origin=(0.0, 0.0, 0.0)):
    return Source(path, Scene(gaussians), (), RenderSettings(jacobian_limit=1.3, depth=False), origin)


@pytest.fixture
def edit(visit, tmp_path):
    """Return a function that writes a scene and its page with the editor, and opens the page."""

    def make(gaussians, origin=(0.0, 0.0, 0.0), width=SIZE[0], height=SIZE[1], **options):
        source = source_of(gaussians, tmp_path / "scene.ply", origin)
        editing = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json")
        html = page.html(source.scene, (), source.settings, "scene", (), page.Tour(None, origin), editing)
        (tmp_path / "edit.html").write_bytes(html)
        write_scene(tmp_path / "scene.ply", source.scene)
        shown = visit(width=width, height=height, **options).open(tmp_path / "edit.html").ready()
        shown.tab.wait_for_selector("#edit")
        return shown

    return make


def state(shown):
    found = shown.tab.evaluate(STATE)
    return found["text"], np.array(found["flags"], dtype=np.uint8)


def tool(name):
    return {"click": f"[data-tool={name}]"}


def does(name):
    return {"click": f"[data-do={name}]"}


def fill(name, value):
    return {"fill": [f"#{name}", str(value)]}


class Hand:
    """Makes random gestures."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def point(self):
        return (np.array([SIZE[0] / 2, 0.29 * SIZE[1]]) + self.rng.uniform(-45, 45, 2)).tolist()

    def stroke(self, most):
        steps = self.rng.normal(0, 12, (int(self.rng.integers(2, most)), 2)).cumsum(axis=0) + self.point()
        return {
            "drag": [self.point(), *np.clip(steps, 1, (SIZE[0] - 1, SIZE[1] - 1)).tolist()],
            **self.keys(),
        }

    def clicks(self, count):
        return [{"drag": [self.point()]} for _ in range(count)]

    def keys(self):
        return {"keys": {name: bool(self.rng.random() < 0.2) for name in ("shiftKey", "ctrlKey")}}

    def number(self, low, high):
        return round(float(self.rng.uniform(low, high)), 3)

    def shapes(self):
        """Return gestures that select."""
        half, center = "#edit-half input", "#edit-center label:last-child input"
        return {
            "rectangle": [tool("rectangle"), self.stroke(4)],
            "lasso": [tool("lasso"), self.stroke(30)],
            "brush": [tool("brush"), fill("edit-radius", self.rng.integers(5, 30)), self.stroke(12)],
            "sphere": [tool("sphere"), {"drag": [self.point(), self.point()]}, does("select-shape")],
            "box": [
                tool("box"),
                {"fill": [half, str(self.number(0.1, 1))]},
                {"fill": [center, str(self.number(-0.5, 0.5))]},
                does("select-shape"),
            ],
            "color": [tool("color"), *self.clicks(1), fill("edit-tolerance", 70), does("select-color")],
            "opacity": [
                fill("edit-opacity-low", self.number(0, 0.5)),
                fill("edit-opacity-high", self.number(0.5, 1)),
                does("select-opacity"),
            ],
            "size": [fill("edit-size-low", self.number(0, 0.1)), does("select-size")],
        }

    def others(self):
        """Return all other gestures."""
        how = self.rng.choice(["replace", "add", "subtract", "intersect"])
        state = self.rng.choice(["all", "none", "invert", "delete", "hide", "show"])
        name = f"view {self.rng.integers(3)}"
        return {
            "how": [{"click": f"[data-how={how}]"}],
            "state": [does(state)],
            "delete": [does("delete")],
            "turn": [{"turn": self.rng.normal(0, 0.8, 2).tolist()}],
            "undo": [does("undo"), does("undo"), does("redo")],
            "crop": [tool("box"), {"fill": ["#edit-half input", "2.5"]}, does("crop")],
            "floor": [tool("floor"), *self.clicks(3)],
            "scale": [tool("scale"), *self.clicks(2), fill("edit-length", 1.5), does("scale")],
            "measure": [tool("measure"), *self.clicks(2), does("measure")],
            "view": [fill("edit-name", name), does("view"), does("start")],
            "path": [{"key": "k"}, {"turn": [0.2, 0.1]}, {"key": "k"}],
        }


def gestures_of(seed):
    """Return random gestures with every tool, many of them selections, so that there are splats to delete."""
    hand, found = Hand(seed), []
    for _ in range(GESTURES):
        kinds = hand.shapes() if hand.rng.random() < 0.55 else hand.others()
        found += kinds[hand.rng.choice(list(kinds))]
    return found


def exported(folder, edits, gaussians, left):
    """Check that the command writes the splats that remain in the page."""
    words = ["convert", str(folder / "scene.ply"), "--edits", str(folder / "edits.json")]
    assert main([*words, str(folder / "out.ply")]) == (0 if left.any() else 2)
    if left.any():
        rows = torch.from_numpy(left)
        kept = Scene(gaussians.map(lambda tensor: tensor[rows]))
        expected = placed(kept, views_after(edits.operations)).gaussians.tensors()
        for name, tensor in read_scene(folder / "out.ply").gaussians.tensors().items():
            assert torch.equal(tensor, expected[name]), name


CLICK = "([name, count]) => { for (let i = 0; i < count; ++i) document.querySelector(`[data-do=${name}]`).click(); }"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_random_sequences_select_and_delete_the_same_splats_as_the_command(
    edit, random_gaussians, tmp_path, degree
):
    """The page and `convert --edits` agree on every splat. Undoing everything gives the first bytes, redoing the
    last."""
    gaussians = random_gaussians(300, rest=(degree + 1) ** 2 - 1, seed=degree)
    shown = edit(gaussians)
    opened = state(shown)
    assert not opened[1].any()
    for seed in range(degree, SEEDS, 4):
        shown.tab.evaluate("viewer.reset()")
        shown.tab.evaluate(PLAY, gestures_of(seed))
        text, flags = state(shown)
        (tmp_path / "edits.json").write_text(text)
        edits = read_edits(tmp_path / "edits.json")
        np.testing.assert_array_equal(flags_after(edits.operations, gaussians), flags, err_msg=f"seed {seed}")
        exported(tmp_path, edits, gaussians, flags <= SELECTED)
        if seed % 8 > 3:  # without stored states, undo repeats the operations before
            shown.tab.evaluate("editor.history.changes.forEach((_, i) => editor.history.forget(i))")
        count = len(edits.operations)
        assert count > 5
        shown.tab.evaluate(CLICK, ["undo", count])
        undone = state(shown)
        assert undone[0] == opened[0] and not undone[1].any()
        shown.tab.evaluate(CLICK, ["redo", count])
        redone = state(shown)
        assert redone[0] == text
        np.testing.assert_array_equal(redone[1], flags)
        shown.tab.evaluate(CLICK, ["undo", count])


def test_the_random_sequences_hold_every_gesture():
    gestures = [gesture for seed in range(SEEDS) for gesture in gestures_of(seed)]
    clicked = {gesture["click"].split("=")[1].strip("]") for gesture in gestures if "click" in gesture}
    assert clicked >= {"rectangle", "lasso", "brush", "sphere", "box", "color", "floor", "scale", "measure"}
    assert clicked >= {
        "all",
        "none",
        "invert",
        "delete",
        "hide",
        "show",
        "crop",
        "view",
        "start",
        "undo",
        "redo",
    }


HOLDS = """([regions, { count, ...arrays }]) => {
  const values = { count, ...Object.fromEntries(Object.entries(arrays).map(([k, v]) => [k, new Float32Array(v)])) };
  const work = new EditWork();
  return [regions.map((region) => [...members(region, values, work)]), MOST_TESTS - work.left];
}"""


def random_regions(rng, count):
    """Return regions as in a file, with numbers of all kinds: whole, tiny, huge, and equal to those of splats."""

    def numbers(n, spread=1.0):
        return (spread * rng.normal(size=n)).round(int(rng.integers(0, 17))).tolist()

    def rotation():
        return Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix().tolist()

    def camera():
        at = numbers(3, 2.0)
        sizes = dict(zip(("fx", "fy", "cx", "cy"), rng.uniform(10, 300, 4).tolist(), strict=True))
        return {"position": at, "rotation": rotation(), **sizes, "width": 300, "height": 200}

    made = []
    for _ in range(count):
        u0, u1, v0, v1 = *np.sort(rng.uniform(-50, 350, 2)), *np.sort(rng.uniform(-50, 250, 2))
        low, high = sorted(numbers(2))
        points = rng.uniform(-20, 320, (int(rng.integers(3, 40)), 2))
        half = np.abs(numbers(3)) + 0.01
        made += [
            {"by": "rectangle", "camera": camera(), "corners": [float(x) for x in (u0, v0, u1, v1)]},
            {"by": "lasso", "camera": camera(), "points": points.tolist()},
            {"by": "lasso", "camera": camera(), "points": points.round().tolist()},
            {
                "by": "brush",
                "camera": camera(),
                "radius": 10.0,
                "points": points[: len(points) // 3 + 1].tolist(),
            },
            {"by": "sphere", "center": numbers(3), "radius": float(10.0 ** rng.uniform(-2, 30))},
            {"by": "sphere", "center": [0, 0, 0], "radius": 1},
            {"by": "box", "center": numbers(3), "rotation": rotation(), "half": half.tolist()},
            {"by": "color", "low": [-1, low, -1e6], "high": [1, 1e6, high]},
            {"by": "opacity", "low": low},
            {"by": "size", "low": low, "high": high},
        ]
    return made


def test_both_languages_find_the_same_splats_of_any_values(edit, random_gaussians):
    """Splats have NaN, infinite, denormal and huge numbers, and centres exactly on borders."""
    rng, n = np.random.default_rng(0), 400
    odd = np.array([np.nan, np.inf, -np.inf, 3e38, -1e-45, 0.0, 1.0, -1.0, 0.1], dtype=np.float32)

    def mixed(*shape):
        values = rng.normal(size=shape).astype(np.float32)
        where = rng.random(shape) < 0.15
        values[where] = rng.choice(odd, int(where.sum()))
        return values

    arrays = {"means": mixed(n, 3), "log_scales": mixed(n, 3), "logits": mixed(n), "sh0": mixed(n, 3)}
    regions = random_regions(rng, 8)
    given = {name: array.ravel().tolist() for name, array in arrays.items()}
    found, tests = edit(random_gaussians(5)).tab.evaluate(HOLDS, [regions, {"count": n, **given}])
    values = Values(**{name: array.astype(np.float64) for name, array in arrays.items()})
    scene = identity_of(random_gaussians(5)).document()
    operations = [{"op": "select", "how": "add", **region} for region in regions]
    content = {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": operations}
    edits = parse_edits(json.dumps(content).encode(), "e.json")
    some, work = 0, Work()
    for select, region, inside in zip(edits.operations, regions, found, strict=True):
        expected = members(select.region, values, work)
        np.testing.assert_array_equal(np.array(inside, bool), expected, err_msg=str(region))
        some += 0 < expected.sum() < n
    assert some > 50, "most regions contain some splats but not all"
    assert tests == MOST_TESTS - work.left > 0, "both count equally many tests, so both refuse the same files"


def test_a_scene_without_splats_can_be_opened(edit, random_gaussians):
    shown = edit(random_gaussians(0))
    gestures = [{"click": f"[data-do={name}]"} for name in ("all", "invert", "undo", "redo")]
    shown.tab.evaluate(PLAY, [*gestures, {"click": "[data-tool=sphere]"}, {"drag": [[50, 50], [60, 60]]}])
    assert shown.tab.inner_text("#edit-count") == "0 selected · 0 of 0 left"
    assert "nothing at that point" in shown.tab.inner_text("#edit-message")
    assert state(shown)[1].size == 0 and state(shown)[0].count('"op"') == 2


DEPTHS = """async (places) => {
  await viewer.settled();
  const camera = viewer.camera();
  const found = places.map(([u, v]) => editor.tools.depthAt(camera, u, v));
  const drawn = places.map(([u, v]) => viewer.renderer.surface(camera, viewer.settings, u, v));
  return [found, drawn];
}"""


def test_a_click_finds_the_surface_that_all_splats_show(edit, random_gaussians):
    """The processor finds the same depth as drawing, for thin, large and tilted splats. Drawing bisects the depth to
    0.07 % and returns the upper end (`SURFACE_STEPS` in draw.js).
    """
    shown = edit(random_gaussians(900), width=120, height=120)
    places = [[u, v] for u in range(2, 118, 24) for v in range(3, 68, 13)]
    found, drawn = shown.tab.evaluate(DEPTHS, places)
    assert [depth is None for depth in found] == [depth is None for depth in drawn]
    pairs = [(a, b) for a, b in zip(found, drawn, strict=True) if a is not None]
    assert all(a <= b * (1 + 1e-6) and b <= a * 1.0008 for a, b in pairs)
    assert len(pairs) > 5 and len(found) - len(pairs) > 2
