"""The handle in the editor's picture moves and turns by what geometry says, by mouse, keys and fingers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gestures import drag, swipe, touch
from gsplat_edu.edits.apply import SELECTED, edited, flags_after
from gsplat_edu.io.scene import Scene
from viewer.handles import ARROW, RING, Scale, about, shape

KEY = 8
"""CSS pixels that an arrow key moves; 1 with Shift."""

# A box in the middle of the view, turned by tilt, heading and roll.
BOX = """([center, half, angles]) => {
  editor.tools.choose("box");
  editor.tools.shape = { ...editor.tools.shape, center, half };
  editor.tools.gizmo.panel.setAngles(angles);
  return editor.tools.shape.rotation;
}"""


def opened_box(edit_page, random_gaussians, angles=(0.3, -0.5, 0.2), **options):
    shown = edit_page(random_gaussians(60), **options)
    focus = shown.evaluate("viewer.view.focus")
    rotation = shown.evaluate(BOX, [focus, [0.8, 0.7, 0.9], list(angles)])
    return shown, np.array(focus), np.array(rotation)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_arrow_moves_along_its_axis_only(edit_page, random_gaussians, axis):
    shown, center, rotation = opened_box(edit_page, random_gaussians)
    scale, direction = Scale(shown), rotation[:, axis]
    begin = center + 0.6 * ARROW * scale.pixel(center) * direction
    end = begin + 0.37 * direction
    drag(shown.tab, scale.place(begin), scale.place(end))
    now = shape(shown)
    # places are rounded to 0.01 px; along the line of sight a pixel is longer
    np.testing.assert_allclose(now["center"] - center, 0.37 * direction, atol=0.1 * scale.pixel(center))
    np.testing.assert_array_equal(now["rotation"], rotation)
    np.testing.assert_array_equal(now["half"], [0.8, 0.7, 0.9])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ring_turns_about_its_axis_by_the_angle_between_two_places_on_it(edit_page, random_gaussians, axis):
    shown, center, rotation = opened_box(edit_page, random_gaussians, (0.9, 0.7, 0.2))
    scale = Scale(shown)
    normal, p, q = (rotation[:, (axis + i) % 3] for i in range(3))
    sight = center - scale.camera.eye
    radius = RING * scale.pixel(center)
    angles = np.linspace(0, 2 * np.pi, 61)
    places = [center + radius * (p * np.cos(a) + q * np.sin(a)) for a in angles]
    # the middle of the half that faces the camera, then 0.8 further on
    first = int(np.argmin([sight @ (place - center) for place in places]))
    a, b = angles[first] + 0.13, angles[first] + 0.93
    begin, end = (center + radius * (p * np.cos(x) + q * np.sin(x)) for x in (a, b))
    drag(shown.tab, scale.place(begin), scale.place(end))
    now = shape(shown)
    np.testing.assert_allclose(now["rotation"], about(normal, 0.8) @ rotation, atol=2e-3)
    np.testing.assert_allclose(now["rotation"] @ now["rotation"].T, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(now["center"], center)


def test_a_ring_seen_as_a_line_turns_by_the_way_along_it(edit_page, random_gaussians):
    shown, center, _ = opened_box(edit_page, random_gaussians)
    R = shown.camera().R
    shown.evaluate(
        "(rows) => { editor.tools.shape = { ...editor.tools.shape, rotation: rows }; }", R.T.tolist()
    )
    scale = Scale(shown)
    # above the middle, where no arrow lies over the ring about the image's x axis
    start = scale.place(center) - np.array((0.0, 25.0))
    drag(shown.tab, start, start + np.array((0.0, 30.0)))
    turned = shape(shown)["rotation"] @ R
    # pixels per radian where the ring is grabbed, 25 px above its nearest place, which is enlarged by its nearness
    depth, radius = float(R[2] @ (center - scale.camera.eye)), RING * scale.pixel(center)
    slowest = RING * np.cos(np.arcsin(25 / RING))
    fastest = RING * depth / (depth - radius)
    vector = Rotation.from_matrix(turned).as_rotvec()
    assert 30 / fastest < np.linalg.norm(vector) < 30 / slowest
    np.testing.assert_allclose(np.abs(vector @ R[0]), np.linalg.norm(vector))
    assert R[1] @ turned @ -R[2] > 0.2, "the place in front goes down with the pointer"


def test_the_middle_moves_in_the_plane_of_the_image(edit_page, random_gaussians):
    shown, center, rotation = opened_box(edit_page, random_gaussians)
    scale = Scale(shown)
    start = scale.place(center)
    drag(shown.tab, start, start + np.array((70.0, -40.0)))
    now = shape(shown)
    expected = center + scale.pixel(center) * (
        70.0 * scale.camera.R[0] - 40.0 * scale.camera.R[1] * scale.camera.fx / scale.camera.fy
    )
    np.testing.assert_allclose(now["center"], expected, atol=0.03 * scale.pixel(center))
    np.testing.assert_array_equal(now["rotation"], rotation)


def test_a_sphere_has_arrows_and_a_middle_but_no_rings(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(60))
    shown.evaluate("""() => { editor.tools.choose("sphere");
      editor.tools.shape = { center: viewer.view.focus, radius: 0.5 }; editor.changed(); }""")
    scale, center = Scale(shown), shape(shown)["center"]
    axes = np.array(shown.evaluate("transposed(uprightAxes(viewer.view.up))"))
    begin = center + 0.6 * ARROW * scale.pixel(center) * axes[0]
    drag(shown.tab, scale.place(begin), scale.place(begin + 0.2 * axes[0]))
    np.testing.assert_allclose(shape(shown)["center"] - center, 0.2 * axes[0], atol=0.1 * scale.pixel(center))
    assert shape(shown)["radius"] == 0.5
    seen = shown.evaluate(
        "[...document.querySelectorAll('[data-handle]')].filter((b) => b.offsetParent).map((b) => b.textContent)"
    )
    assert seen == ["move x", "move y", "move z", "move freely"]


def test_keys_choose_a_part_and_move_it(edit_page, random_gaussians):
    shown, center, rotation = opened_box(edit_page, random_gaussians)
    keyboard, scale = shown.tab.keyboard, Scale(shown)
    shown.tab.focus("#canvas")
    keyboard.press("Shift+X")
    keyboard.press("ArrowRight")
    np.testing.assert_allclose(
        shape(shown)["center"], center + KEY * scale.pixel(center) * rotation[:, 0], rtol=1e-9
    )
    before = shape(shown)["center"]
    keyboard.press("Shift+ArrowDown")
    np.testing.assert_allclose(
        shape(shown)["center"], before - scale.pixel(before) * rotation[:, 0], rtol=1e-9
    )
    before = shape(shown)["center"]
    for _ in range(4):
        keyboard.press("Shift+X")
    assert shown.tab.get_attribute("[data-handle='turn y']", "aria-pressed") == "true"
    keyboard.press("ArrowLeft")
    keyboard.press("Shift+ArrowLeft")
    np.testing.assert_allclose(
        shape(shown)["rotation"], about(rotation[:, 1], np.radians(-5.5)) @ rotation, atol=1e-12
    )
    shown.tab.click("[data-handle='turn y']")  # no part is chosen now: the arrows move the cross again
    shown.tab.click("[data-handle='move z']")
    shown.press("ArrowUp")  # while the button has the focus
    moved = KEY * scale.pixel(before) * shape(shown)["rotation"][:, 2]
    np.testing.assert_allclose(shape(shown)["center"], before + moved, rtol=1e-9)
    shown.tab.click("[data-handle='move z']")
    there = shape(shown)
    shown.tab.focus("#canvas")
    keyboard.press("ArrowLeft")
    np.testing.assert_array_equal(shape(shown)["rotation"], there["rotation"])
    assert shown.evaluate("editor.tools.cursor") is not None


def test_a_finger_drags_the_handle_and_a_second_one_takes_it_back(edit_page, random_gaussians):
    shown, center, rotation = opened_box(edit_page, random_gaussians, width=390, height=844, has_touch=True)
    scale, session = Scale(shown), shown.tab.context.new_cdp_session(shown.tab)
    start = scale.place(center)
    swipe(shown.tab, start, start + np.array((60, 40)))
    moved = shape(shown)["center"]
    expected = scale.pixel(center) * (
        60 * scale.camera.R[0] + 40 * scale.camera.R[1] * scale.camera.fx / scale.camera.fy
    )
    # the picture has 490 rows for 489.5 CSS pixels
    np.testing.assert_allclose(moved - center, expected, atol=0.08 * scale.pixel(center))
    start = scale.place(moved)
    touch(session, "touchStart", start)
    touch(session, "touchMove", start + np.array((25, 0)))
    assert np.abs(shape(shown)["center"] - moved).max() > 0.01
    touch(session, "touchStart", start + np.array((25, 0)), start + np.array((100, 0)))
    touch(session, "touchEnd")
    np.testing.assert_array_equal(shape(shown)["center"], moved)
    np.testing.assert_array_equal(shape(shown)["rotation"], rotation)


def test_numbers_turn_the_box_and_a_button_levels_it(edit_page, random_gaussians):
    shown, _, _ = opened_box(edit_page, random_gaussians, (0.0, 0.0, 0.0))
    upright = np.array(shown.evaluate("uprightAxes(viewer.view.up)"))
    for index, value in enumerate((20, -50, 130)):
        shown.tab.fill(f"#edit-angles input >> nth={index}", str(value))
    expected = Rotation.from_euler("YXZ", [-50, 20, 130], degrees=True).as_matrix()
    np.testing.assert_allclose(shape(shown)["rotation"], upright @ expected, atol=1e-12)
    shown.tab.click("#edit-level-box")
    level = Rotation.from_euler("Y", -50, degrees=True).as_matrix()
    np.testing.assert_allclose(shape(shown)["rotation"], upright @ level, atol=1e-12)
    assert shown.tab.input_value("#edit-angles input >> nth=1") == "-50"


def test_a_turned_box_selects_and_crops_what_lies_in_it(edit_page, random_gaussians):
    gaussians = random_gaussians(400)
    shown = edit_page(gaussians)
    shown.evaluate(BOX, [[0.1, -0.1, 0.05], [0.3, 0.8, 0.5], [0.4, 0.9, -0.6]])
    shown.do("select-shape")
    box = shape(shown)
    inside = (
        np.abs((gaussians.means.double().numpy() - box["center"]) @ box["rotation"]) <= box["half"]
    ).all(axis=1)
    assert 20 < inside.sum() < 200
    np.testing.assert_array_equal(shown.flags() == SELECTED, inside)
    shown.do("crop")
    edits = shown.edits()
    np.testing.assert_array_equal(flags_after(edits.operations, gaussians) == SELECTED, inside)
    assert len(edited(Scene(gaussians), edits.operations).gaussians) == inside.sum()
