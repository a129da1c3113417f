"""Splats moved in the page are those that the command writes, and the page draws them so."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gestures import drag, swipe
from gsplat_edu.edits.apply import SELECTED, edited
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera, look_at
from js.random_edits import moved_one_by_one, random_operations
from viewer.handles import ARROW, RING, Scale, about, shape

CHOOSE = """([center, radius]) => {
  editor.perform({ op: "select", how: "replace", by: "sphere", center, radius });
  editor.tools.choose("move");
}"""
MEANS = "[...editor.values.means].map(String)"


def means_of(shown):
    return np.array(shown.evaluate(MEANS), dtype=np.float64).reshape(-1, 3)


def edits_of(shown):
    return shown.edits()


def test_the_handle_moves_the_selection_on_release(edit_page, random_gaussians):
    gaussians = random_gaussians(300)
    shown = edit_page(gaussians)
    shown.evaluate(CHOOSE, [[0.2, 0.1, 0.0], 0.5])
    scale, center = Scale(shown), shape(shown)["center"]
    flags = shown.flags()
    some = gaussians.means.double().numpy()[flags == SELECTED]
    np.testing.assert_allclose(center, (some.min(axis=0) + some.max(axis=0)) / 2)
    axes = np.array(shown.evaluate("transposed(uprightAxes(viewer.view.up))"))
    begin = center + 0.6 * ARROW * scale.pixel(center) * axes[0]
    drag(shown.tab, scale.place(begin), scale.place(begin + 0.3 * axes[0]))
    last = shown.last()
    assert last["op"] == "move" and last["rotation"] == np.eye(3).tolist()
    np.testing.assert_allclose(last["translation"], 0.3 * axes[0], atol=0.1 * scale.pixel(center))
    after = means_of(shown)
    np.testing.assert_array_equal(after[flags != SELECTED], gaussians.means.numpy()[flags != SELECTED])
    expected = [moved_one_by_one(last, mean) for mean in gaussians.means.numpy()[flags == SELECTED]]
    np.testing.assert_array_equal(after[flags == SELECTED], expected)
    np.testing.assert_array_equal(
        edited(Scene(gaussians), edits_of(shown).operations).gaussians.means.numpy(), after
    )
    # the handle is at the selection again, and undo takes both back
    np.testing.assert_allclose(shape(shown)["center"], center + np.array(last["translation"]), atol=1e-6)
    shown.press("Control+z")
    np.testing.assert_array_equal(means_of(shown), gaussians.means.double().numpy())
    np.testing.assert_array_equal(shape(shown)["center"], center)


def test_keys_and_numbers_move_the_selection_after_enter(edit_page, random_gaussians):
    gaussians = random_gaussians(200)
    shown = edit_page(gaussians)
    shown.evaluate(CHOOSE, [[0.0, 0.0, 0.0], 0.6])
    center, scale = shape(shown)["center"], Scale(shown)
    upright = np.array(shown.evaluate("uprightAxes(viewer.view.up)"))
    shown.tab.focus("#canvas")
    for key in ("Shift+X", "ArrowRight", "ArrowRight", *["Shift+X"] * 4, "ArrowRight"):
        shown.press(key)
    assert len(shown.operations()) == 1, "a preview only"
    shown.tab.fill("#edit-by input >> nth=1", "0.25")
    shown.press("Enter")
    last = shown.last()
    np.testing.assert_allclose(last["rotation"], about(upright[:, 1], np.radians(5)), atol=1e-12)
    expected = 16 * scale.pixel(center) * upright[:, 0]
    expected[1] = 0.25
    np.testing.assert_allclose(last["translation"], expected, atol=0.2 * scale.pixel(center))
    shown.tab.focus("#canvas")
    shown.press("Shift+X", "ArrowUp")
    shown.press("Escape")  # drops the preview
    assert len(shown.operations()) == 2
    assert shown.evaluate("viewer.renderer.motion.live") is None
    shown.press("Escape")
    assert shown.is_chosen("navigate")


def test_a_finger_turns_the_selection(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(200), width=390, height=844, has_touch=True)
    shown.evaluate(CHOOSE, [[0.0, 0.0, 0.0], 0.6])
    scale, center = Scale(shown), shape(shown)["center"]
    axes = np.array(shown.evaluate("transposed(uprightAxes(viewer.view.up))"))
    sight = center - scale.camera.eye
    k = int(np.argmax(np.abs(axes @ sight)))  # the ring that is seen most from the front
    p, q = axes[(k + 1) % 3], axes[(k + 2) % 3]
    radius = RING * scale.pixel(center)
    around = [center + radius * (p * np.cos(a) + q * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 73)]
    first = int(np.argmin([sight @ (place - center) for place in around])) % 72
    places = [scale.place(around[(first + i) % 72]) for i in (1, 5, 9)]
    swipe(shown.tab, *places)
    last = shown.last()
    assert last["op"] == "move" and last["translation"] == [0, 0, 0]
    np.testing.assert_allclose(last["rotation"], about(axes[k], np.radians(40)), atol=5e-3)


PERFORM = "(operations) => operations.forEach((operation) => editor.perform(operation))"


def place_of(eye):
    eye = np.array(eye)
    return Camera(look_at(eye, (0.1, 0.0, 0.0)), eye, fx=130.0, fy=130.0, cx=59.5, cy=49.5, H=100, W=120)


PREVIEW = """async ([rotation, by]) => {
  const { shape } = editor.tools;
  editor.tools.gizmo.take({ ...shape, rotation, center: plus(shape.center, by) });
}"""


@pytest.mark.parametrize("degree", [0, 3])
def test_the_page_draws_moved_splats_as_the_scene_that_the_command_writes(
    edit_page, random_gaussians, degree
):
    """Centres, rotations and harmonics: the other page opens the scene with its edits applied."""
    gaussians = random_gaussians(150, rest=(degree + 1) ** 2 - 1, seed=5)
    shown = edit_page(gaussians)
    before = shown.picture(place_of((0.4, -0.6, -2.2)))
    turn = Rotation.from_rotvec((0.4, 1.9, -0.7)).as_matrix().tolist()
    for center, by in (((0.3, 0.0, 0.0), [0.2, -0.1, 0.3]), ((0.0, 0.4, 0.2), [-0.3, 0.1, 0.0])):
        shown.evaluate(CHOOSE, [list(center), 0.7])
        shown.evaluate(PREVIEW, [turn, by])
        shown.do("move")
        shown.evaluate("editor.perform({ op: 'deselect' })")  # nothing is coloured
    operations = edits_of(shown).operations
    left = edited(Scene(gaussians), operations).gaussians
    assert float((left.quats - gaussians.quats).abs().max()) > 0.1
    if degree:
        assert float((left.sh_rest - gaussians.sh_rest).abs().max()) > 0.1
    other = edit_page(left)
    for eye in ((0.4, -0.6, -2.2), (-1.9, 0.5, 1.0)):
        ours, theirs = shown.picture(place_of(eye)), other.picture(place_of(eye))
        # a page stores quaternions as int16, harmonics as float16; colours are half floats
        assert np.abs(ours - theirs).max() < 0.01
    assert np.abs(shown.picture(place_of((0.4, -0.6, -2.2))) - before).max() > 0.3


def test_the_preview_shows_what_the_move_gives(edit_page, random_gaussians):
    """Splats do not overlap here, so that their order, which is older in the preview, does not matter."""
    gaussians = random_gaussians(150, seed=6)
    keep = np.linalg.norm(gaussians.means.numpy(), axis=1) < 0.35
    gaussians = gaussians.map(lambda tensor: tensor[keep])
    shown = edit_page(gaussians)
    shown.evaluate("editor.perform({ op: 'select', how: 'replace', by: 'all' }); editor.tools.choose('move')")
    # about the line of sight, so that the order of depths stays
    camera = place_of((0.0, 0.0, -2.2))
    turn = about((camera.R[2]), 0.6).tolist()
    shown.evaluate(PREVIEW, [turn, (0.1 * camera.R[0]).tolist()])
    preview = shown.picture(camera)
    shown.evaluate("editor.mover.perform()")
    moved = shown.picture(camera)
    shown.evaluate("editor.undo()")
    still = shown.picture(camera)
    assert np.abs(preview - moved).max() < 0.01 < 0.2 < np.abs(still - moved).max()


def test_a_click_finds_the_surface_of_moved_splats(edit_page, random_gaussians):
    gaussians = random_gaussians(400)
    shown = edit_page(gaussians, width=160, height=160)
    shown.evaluate(PERFORM, random_operations(8)[:6])
    pairs = shown.evaluate("""async () => {
      await viewer.settled();
      const camera = viewer.camera(), found = [];
      for (let u = 20; u < 150; u += 17) for (let v = 10; v < 90; v += 13) found.push([
        editor.tools.depthAt(camera, u, v), viewer.renderer.surface(camera, viewer.settings, u, v)]);
      return found; }""")
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    assert len(both) > 5 and all((a is None) == (b is None) for a, b in pairs)
    assert all(a <= b * (1 + 1e-6) and b <= a * 1.0008 for a, b in both)
