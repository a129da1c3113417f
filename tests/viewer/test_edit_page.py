"""The editor in a browser selects, deletes and stores exactly the splats that Python does."""

import functools
import json

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.edits.apply import SELECTED, edited, flags_after, placed, views_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.edits.runs import runs_of
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source

SEEDS, SIZE = 20, (360, 240)
"""Number of sequences. Size of the picture, px: small, to take little time; the panel covers the lower part."""

# Plays gestures by the events of a browser: clicks on buttons, input into fields, pointers on the canvas.
PLAY = """async (gestures) => {
  const canvas = document.getElementById("canvas");
  const fire = (target, kind, [x, y], keys = {}) => target.dispatchEvent(new PointerEvent(kind, {
    bubbles: true, cancelable: true, pointerId: 7, button: 0, clientX: x, clientY: y, ...keys }));
  for (const { click, fill, drag, keys, key, turn, open, perform } of gestures) {
    if (click) document.querySelector(click).click();
    if (open) document.querySelector(open).open = true;
    if (perform) editor.perform(perform);
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

STATE = """() => ({
  text: editor.text(), flags: [...editor.history.flags], means: [...editor.values.means].map(String) })"""


def source_of(gaussians, path="scene.ply", origin=(0.0, 0.0, 0.0)):
    return Source(path, Scene(gaussians, origin=origin), (), RenderSettings(jacobian_limit=1.3, depth=False))


@pytest.fixture
def edit(edit_page):
    """Return a function that opens the editor in a small window."""
    return functools.partial(edit_page, width=SIZE[0], height=SIZE[1])


def state(shown):
    found = shown.evaluate(STATE)
    return found["text"], np.array(found["flags"], dtype=np.uint8)


def means_of(shown):
    """Return the centres of all splats in the page."""
    return np.array(shown.evaluate(STATE)["means"], dtype=np.float64).reshape(-1, 3)


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
            "polygon": [tool("polygon"), *self.clicks(5), does("close-polygon")],
            "brush": [tool("brush"), fill("edit-radius", self.rng.integers(5, 30)), self.stroke(12)],
            "sphere": [tool("sphere"), {"drag": [self.point(), self.point()]}, does("select-shape")],
            "box": [
                tool("box"),
                {"fill": [half, str(self.number(0.1, 1))]},
                {"fill": [center, str(self.number(-0.5, 0.5))]},
                *self.angles(),
                does("select-shape"),
            ],
            "color": [tool("color"), *self.clicks(1), fill("edit-tolerance", 70), does("select-color")],
            "opacity": [
                fill("edit-opacity-low", self.number(0, 0.5)),
                fill("edit-opacity-high", self.number(0.5, 1)),
                does("select-opacity"),
            ],
            "size": [fill("edit-size-low", self.number(0, 0.1)), does("select-size")],
            "distance": self.histogram("distance"),
            "list": [{"perform": self.listed()}],
            "shares": self.histogram(self.rng.choice(["opacity", "size"])),
        }

    def listed(self):
        """Return a selection of some of the splats by their indices."""
        runs = runs_of(self.rng.random(300) < 0.5)
        return {"op": "select", "how": "add", "by": "list", "reason": "by chance", "runs": runs}

    def at(self, count, **operation):
        """Return a gesture whose points need no surface below clicks."""
        return {"perform": {**operation, "points": self.rng.normal(size=(count, 3)).tolist()}}

    def histogram(self, quantity):
        """Return gestures that select a range of the bar chart."""
        low, high = sorted(self.rng.integers(0, 200, 2))
        return [
            {"open": "#edit-histogram"},
            fill("edit-quantity", quantity),
            fill("edit-low", low),
            fill("edit-high", high),
            does("select-range"),
        ]

    def near(self, name):
        """Return gestures that grow or shrink the selection."""
        return [fill("edit-near", self.number(0.05, 0.4)), does(name)]

    def by(self):
        places = ("first-of-type", "last-child")
        return [{"fill": [f"#edit-by label:{place} input", self.text(-0.4, 0.4)]} for place in places]

    def angles(self):
        places = ("first-of-type", "last-child")
        return [{"fill": [f"#edit-angles label:{place} input", self.text(-80, 80)]} for place in places]

    def text(self, low, high):
        return str(self.number(low, high))

    def others(self):
        """Return all other gestures."""
        how = self.rng.choice(["replace", "add", "subtract", "intersect"])
        state = self.rng.choice(["all", "none", "invert", "delete", "hide", "show"])
        name = f"view {self.rng.integers(3)}"
        return {
            "how": [{"click": f"[data-how={how}]"}],
            "state": [does(state)],
            **{name: [does(name)] for name in ("none", "invert", "hide", "show", "delete")},
            "grow": self.near("grow"),
            "shrink": self.near("shrink"),
            "front": [does("front")],
            "turn": [{"turn": self.rng.normal(0, 0.8, 2).tolist()}],
            "undo": [does("undo"), does("undo"), does("redo")],
            "crop": [tool("box"), {"fill": ["#edit-half input", "2.5"]}, *self.angles(), does("crop")],
            "move": [tool("move"), *self.by(), *self.angles(), does("move")],
            "floor": [tool("floor"), *self.clicks(3), self.at(3, op="upright")],
            "distance": [self.at(2, op="scale", length=2, unit="m")],
            "scale": [tool("scale"), *self.clicks(2), fill("edit-length", 1.5), does("scale")],
            "measure": [tool("measure"), *self.clicks(2), does("measure"), self.at(2, op="measure", note="")],
            "view": [fill("edit-name", name), does("view"), does("start")],
            "order": [{"perform": {"op": "order_views", "names": ["view 2", "view 0"]}}],
            "remove": [{"perform": {"op": "remove_view", "name": f"view {self.rng.integers(3)}"}}],
            "path": [{"key": "k"}, {"turn": [0.2, 0.1]}, {"key": "k"}],
        }


def gestures_of(seed):
    """Return all kinds of gestures in random order; selections twice, so that there are splats to delete."""
    hand = Hand(seed)
    moved = [does("all"), *hand.others()["move"]]  # at least once with a selection
    decks = [hand.shapes(), hand.shapes(), hand.others(), {"state": hand.others()["state"], "moved": moved}]
    gestures = [gesture for deck in decks for gesture in deck.values()]
    return [step for k in hand.rng.permutation(len(gestures)) for step in gestures[k]]


def exported(folder, edits, gaussians, left):
    """Check that the command writes the splats that remain in the page."""
    words = ["convert", str(folder / "scene.ply"), "--edits", str(folder / "edits.json")]
    assert main([*words, str(folder / "out.ply")]) == (0 if left.any() else 2)
    if left.any():
        kept = edited(Scene(gaussians), edits.operations)
        assert len(kept.gaussians) == left.sum()
        expected = placed(kept, views_after(edits.operations)).gaussians.tensors()
        for name, tensor in read_scene(folder / "out.ply").gaussians.tensors().items():
            assert torch.equal(tensor, expected[name]), name


EVERY_KIND = {
    *("rectangle", "lasso", "brush", "sphere", "box", "color", "opacity", "size", "distance", "list", "all"),
    *("front", "grow", "shrink", "deselect", "invert", "delete", "hide", "show", "crop", "move"),
    *("upright", "scale", "start", "view", "remove_view", "order_views", "path", "measure"),
}
"""Selections and operations that each scene's sequences contain."""

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
    kinds = set()
    start, moves = means_of(shown), 0
    for seed in range(degree, SEEDS, 4):
        shown.evaluate("viewer.reset()")
        shown.evaluate(PLAY, gestures_of(seed))
        text, flags = state(shown)
        (tmp_path / "edits.json").write_text(text)
        edits = read_edits(tmp_path / "edits.json")
        np.testing.assert_array_equal(flags_after(edits.operations, gaussians), flags, err_msg=f"seed {seed}")
        exported(tmp_path, edits, gaussians, flags <= SELECTED)
        there = means_of(shown)
        left = edited(Scene(gaussians), edits.operations).gaussians.means.double().numpy()
        np.testing.assert_array_equal(left, there[flags <= SELECTED])
        moves += not np.array_equal(there, start)
        if seed % 8 > 3:  # without stored states, undo repeats the operations before
            shown.evaluate("editor.history.changes.forEach((_, i) => editor.history.forget(i))")
        count = len(edits.operations)
        assert count > 5
        done = json.loads(text)["operations"]
        kinds |= {entry.get("by", entry["op"]) for entry in done} | {
            "front" for entry in done if "front" in entry
        }
        shown.evaluate(CLICK, ["undo", count])
        undone = state(shown)
        assert undone[0] == opened[0] and not undone[1].any()
        np.testing.assert_array_equal(means_of(shown), start)
        shown.evaluate(CLICK, ["redo", count])
        redone = state(shown)
        assert redone[0] == text
        np.testing.assert_array_equal(redone[1], flags)
        np.testing.assert_array_equal(means_of(shown), there)
        shown.evaluate(CLICK, ["undo", count])
    assert kinds >= EVERY_KIND
    assert moves > 0, "some of the sequences move splats"


def test_the_random_sequences_hold_every_gesture():
    gestures = [gesture for seed in range(SEEDS) for gesture in gestures_of(seed)]
    clicked = {gesture["click"].split("=")[1].strip("]") for gesture in gestures if "click" in gesture}
    assert clicked >= {"front", "polygon", "close-polygon"}
    assert clicked >= {"rectangle", "lasso", "brush", "sphere", "box", "color", "floor", "scale", "measure"}
    states = "all none invert grow shrink select-range delete hide show"
    others = "crop move view start undo redo"
    assert clicked >= {*states.split(), *others.split()}


def test_a_scene_without_splats_can_be_opened(edit, random_gaussians):
    shown = edit(random_gaussians(0))
    gestures = [{"click": f"[data-do={name}]"} for name in ("all", "invert", "undo", "redo")]
    shown.evaluate(PLAY, [*gestures, {"click": "[data-tool=sphere]"}, {"drag": [[50, 50], [60, 60]]}])
    assert shown.tab.inner_text("#edit-count") == "0 selected · 0 of 0 left"
    assert "nothing at that point" in shown.tab.inner_text("#edit-message")
    assert shown.tab.is_hidden("#edit-floaters"), "a page that no server sent can propose nothing"
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
    found, drawn = shown.evaluate(DEPTHS, places)
    assert [depth is None for depth in found] == [depth is None for depth in drawn]
    pairs = [(a, b) for a, b in zip(found, drawn, strict=True) if a is not None]
    assert all(a <= b * (1 + 1e-6) and b <= a * 1.0008 for a, b in pairs)
    assert len(pairs) > 5 and len(found) - len(pairs) > 2
