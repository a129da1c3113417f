"""Levelling by the directions of cameras: a known tilt is found, and cameras that leave it open are refused."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.edits.apply import upright_rotation, views_after
from gsplat_edu.scene.camera import Camera
from js.tilted_cameras import UP, around
from viewer.handles import until


def angle(a, b):
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))


def test_the_button_levels_the_scene_for_page_and_command(edit_page, random_gaussians):
    cameras = tuple(
        (f"{i}.jpg", Camera(R, eye, 200.0, 200.0, 99.5, 79.5, 160, 200))
        for i, (R, eye) in enumerate(around(12))
    )
    shown = edit_page(random_gaussians(50), cameras)
    shown.choose("floor")
    shown.do("level")
    said = shown.tab.inner_text("#edit-turned")
    turn = angle(UP, (0.0, -1.0, 0.0))
    assert said.startswith(f"12 cameras turn the scene as opened by {turn:.1f}°; standard error 0.")
    np.testing.assert_allclose(shown.evaluate("viewer.view.up"), UP, atol=1e-6)
    (operation,) = shown.edits().operations
    np.testing.assert_allclose(upright_rotation(operation) @ UP, (0.0, -1.0, 0.0), atol=1e-6)
    assert views_after([operation]).upright
    shown.press("Control+z")
    assert json.loads(shown.text())["operations"] == []


def test_a_scene_without_cameras_has_no_such_button(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(5))
    shown.choose("floor")
    assert not shown.tab.is_visible("[data-do=level]")


def slide(shown, **degrees):
    for name, value in degrees.items():
        shown.evaluate(
            """([name, value]) => {
              const slider = document.getElementById(`edit-${name}`);
              slider.value = value;
              slider.dispatchEvent(new Event("input", { bubbles: true }));
            }""",
            [name, value],
        )


def horizon(shown):
    """The line's up direction, and its ends in the picture."""
    return np.array(shown.evaluate("editor.leveller.up")), shown.evaluate(
        "horizonOf(editor.leveller.up, viewer.camera()).map(({ u, v }) => [u, v])"
    )


def test_two_angles_and_a_horizon_level_the_scene_in_one_step(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(50))
    assert not shown.tab.is_visible("#edit-pitch")
    shown.choose("floor")
    assert shown.tab.is_disabled("[data-do=level-angles]")
    camera = shown.evaluate("viewer.camera()")
    R, up = np.array(camera["R"]), np.array(shown.evaluate("viewer.view.up"))
    _, ((_, left), (_, right)) = horizon(shown)
    slide(shown, pitch=4)
    _, ((_, higher), (_, other)) = horizon(shown)
    assert higher < left - 1 and other < right - 1
    slide(shown, roll=12.5)
    found, ends = horizon(shown)
    assert ends[1][1] - other > ends[0][1] - higher  # clockwise
    turn = Rotation.from_euler("z", 12.5, degrees=True) * Rotation.from_euler("x", 4, degrees=True)
    expected = R.T @ turn.apply(R @ up)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    for u, v in ends:  # both ends look along the floor
        ray = [(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"], 1.0]
        assert np.dot(R.T @ ray, expected) == pytest.approx(0.0, abs=1e-9)
    assert "4.0°, 12.5°" in shown.tab.get_by_role("group", name="level by angles").inner_text()
    ids = shown.evaluate("[...document.querySelectorAll('[id]')].map(({ id }) => id)")
    assert len(ids) == len(set(ids))
    until(shown.tab, "!editor.overlay.canvas.hidden")  # the line, once the next picture is drawn
    # another view shows the same horizon
    shown.evaluate("() => { viewer.view.pivot = [0, 0, 0.1]; viewer.askFrame(); }")
    np.testing.assert_allclose(horizon(shown)[0], expected, atol=1e-12)
    shown.do("level-angles")
    (operation,) = shown.edits().operations
    np.testing.assert_allclose(upright_rotation(operation) @ expected, (0.0, -1.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(shown.evaluate("viewer.view.up"), expected, atol=1e-6)
    assert shown.tab.input_value("#edit-pitch") == shown.tab.input_value("#edit-roll") == "0"
    shown.evaluate("editor.undo()")
    assert json.loads(shown.text())["operations"] == []
    np.testing.assert_allclose(shown.evaluate("viewer.view.up"), up, atol=1e-12)
    slide(shown, pitch=9)
    shown.choose("box")
    shown.choose("floor")
    assert shown.tab.input_value("#edit-pitch") == "0" and shown.tab.is_disabled("[data-do=level-angles]")
