"""Levelling by the directions of cameras: a known tilt is found, and cameras that leave it open are refused."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.edits.apply import upright_rotation, views_after
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.scene.camera import Camera, look_at
from viewer.handles import until

TILT = Rotation.from_rotvec((0.2, 0.1, -0.35)).as_matrix()
"""From the level world to the scene's."""

UP = TILT @ (0.0, -1.0, 0.0)


def rolled(R, angle):
    """Turn a camera about its line of sight."""
    return Rotation.from_rotvec((0.0, 0.0, angle)).as_matrix() @ R


def around(n, turn=2 * np.pi, height=-0.8, rolls=None):
    """Return cameras in an arc about the middle, looking down a little, in the tilted scene."""
    angles = np.linspace(0, turn, n, endpoint=False)
    rolls = np.zeros(n) if rolls is None else rolls
    found = []
    for angle, roll in zip(angles, rolls, strict=True):
        eye = np.array((3 * np.sin(angle), height, -3 * np.cos(angle)))
        found.append((rolled(look_at(eye, np.zeros(3)), roll) @ TILT.T, TILT @ eye))
    return found


def found_by(shown, cameras):
    return shown.tab.evaluate("(cameras) => upOfCameras(cameras)", [{"R": R.tolist()} for R, _ in cameras])


def angle(a, b):
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))


def test_level_cameras_give_the_exact_tilt(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(5))
    for cameras in (around(12), around(40, 1.0), around(9, height=-2.9), around(5, 3.0)):
        result = found_by(shown, cameras)
        np.testing.assert_allclose(result["up"], UP, atol=1e-7)
        assert result["count"] == len(cameras)


def test_the_error_of_rolled_photos_is_as_large_as_stated(edit_page, random_gaussians):
    """Rolls are normal with 4 degrees. In an arc the error lies along one direction, so its root mean square is the
    standard error; all around, both horizontal directions have that error."""
    shown = edit_page(random_gaussians(5))
    rng = np.random.default_rng(2)
    for n, turn, directions in ((60, 2 * np.pi, 2), (60, 1.6, 1)):
        errors, stated = [], []
        for _ in range(60):
            result = found_by(shown, around(n, turn, rolls=rng.normal(0, np.radians(4), n)))
            errors.append(angle(result["up"], UP))
            stated.append(np.degrees(result["error"]))
        ratio = np.sqrt(np.mean(np.square(errors)) / directions) / np.mean(stated)
        assert 0.7 < ratio < 1.4


def test_a_few_portrait_photos_do_not_matter_and_many_are_refused(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(5))
    rng = np.random.default_rng(4)

    def photos(n, share, turn=2 * np.pi):
        rolls = rng.normal(0, np.radians(1), n)
        rolls[rng.permutation(n)[: round(share * n)]] += np.pi / 2
        return around(n, turn, rolls=rolls)

    assert angle(found_by(shown, photos(200, 0.05))["up"], UP) < 3
    for share, turn in ((0.5, 2 * np.pi), (0.5, 0.3), (0.35, 2 * np.pi)):
        assert "rolled too differently" in found_by(shown, photos(200, share, turn))["refused"]
    upside = around(40, rolls=np.where(np.arange(40) % 2, 0, np.pi))
    assert "rolled too differently" in found_by(shown, upside)["refused"], (
        "half of the photos are upside down"
    )


def test_cameras_that_leave_the_tilt_open_are_refused(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(5))
    R = look_at(np.array((0.0, 0.0, -3.0)), np.zeros(3)) @ TILT.T
    row = [(R, np.array((x, 0.0, 0.0))) for x in range(20)]
    assert "nearly one direction" in found_by(shown, row)["refused"]
    assert "at least 3" in found_by(shown, around(2))["refused"]
    # from straight above, whether the camera looks up or down is undecided
    down = [(rolled(look_at((0.0, -3.0, 1e-6), np.zeros(3)), x) @ TILT.T, np.zeros(3)) for x in range(6)]
    assert "rolled too differently" in found_by(shown, down)["refused"]


EIGEN = "(list) => list.map((matrix) => eigenvectors(matrix))"


def test_eigenvectors_are_those_of_numpy(edit_page, random_gaussians):
    rng = np.random.default_rng(1)
    matrices = [a @ a.T for a in rng.normal(size=(30, 3, 3))] + [np.diag([3.0, 1.0, 2.0]), np.zeros((3, 3))]
    found = edit_page(random_gaussians(5)).tab.evaluate(EIGEN, [matrix.tolist() for matrix in matrices])
    for matrix, pairs in zip(matrices, found, strict=True):
        np.testing.assert_allclose([pair["value"] for pair in pairs], np.linalg.eigvalsh(matrix), atol=1e-12)
        for pair in pairs:
            v = np.array(pair["vector"])
            np.testing.assert_allclose(matrix @ v, pair["value"] * v, atol=1e-12)
            assert v @ v == pytest.approx(1.0)


def test_the_button_levels_the_scene_for_page_and_command(edit_page, random_gaussians):
    cameras = tuple(
        (f"{i}.jpg", Camera(R, eye, 200.0, 200.0, 99.5, 79.5, 160, 200))
        for i, (R, eye) in enumerate(around(12))
    )
    shown = edit_page(random_gaussians(50), cameras)
    shown.tab.click("[data-tool=floor]")
    shown.tab.click("[data-do=level]")
    said = shown.tab.inner_text("#edit-turned")
    turn = angle(UP, (0.0, -1.0, 0.0))
    assert said.startswith(f"12 cameras turn the scene as opened by {turn:.1f}°; standard error 0.")
    np.testing.assert_allclose(shown.tab.evaluate("viewer.view.up"), UP, atol=1e-6)
    (operation,) = parse_edits(shown.tab.evaluate("editor.text()").encode(), "e.json").operations
    np.testing.assert_allclose(upright_rotation(operation) @ UP, (0.0, -1.0, 0.0), atol=1e-6)
    assert views_after([operation]).upright
    shown.tab.keyboard.press("Control+z")
    assert json.loads(shown.tab.evaluate("editor.text()"))["operations"] == []


def test_a_scene_without_cameras_has_no_such_button(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(5))
    shown.tab.click("[data-tool=floor]")
    assert not shown.tab.is_visible("[data-do=level]")


def slide(tab, **degrees):
    for name, value in degrees.items():
        tab.evaluate(
            """([name, value]) => {
              const slider = document.getElementById(`edit-${name}`);
              slider.value = value;
              slider.dispatchEvent(new Event("input", { bubbles: true }));
            }""",
            [name, value],
        )


def horizon(tab):
    """The line's up direction, and its ends in the picture."""
    return np.array(tab.evaluate("editor.leveller.up")), tab.evaluate(
        "horizonOf(editor.leveller.up, viewer.camera()).map(({ u, v }) => [u, v])"
    )


def test_two_angles_and_a_horizon_level_the_scene_in_one_step(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(50))
    tab = shown.tab
    assert not tab.is_visible("#edit-pitch")
    tab.click("[data-tool=floor]")
    assert tab.is_disabled("[data-do=level-angles]")
    camera = tab.evaluate("viewer.camera()")
    R, up = np.array(camera["R"]), np.array(tab.evaluate("viewer.view.up"))
    _, ((_, left), (_, right)) = horizon(tab)
    slide(tab, pitch=4)
    _, ((_, higher), (_, other)) = horizon(tab)
    assert higher < left - 1 and other < right - 1
    slide(tab, roll=12.5)
    found, ends = horizon(tab)
    assert ends[1][1] - other > ends[0][1] - higher  # clockwise
    turn = Rotation.from_euler("z", 12.5, degrees=True) * Rotation.from_euler("x", 4, degrees=True)
    expected = R.T @ turn.apply(R @ up)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    for u, v in ends:  # both ends look along the floor
        ray = [(u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"], 1.0]
        assert np.dot(R.T @ ray, expected) == pytest.approx(0.0, abs=1e-9)
    assert "4.0°, 12.5°" in tab.get_by_role("group", name="level by angles").inner_text()
    ids = tab.evaluate("[...document.querySelectorAll('[id]')].map(({ id }) => id)")
    assert len(ids) == len(set(ids))
    until(tab, "!editor.overlay.canvas.hidden")  # the line, once the next picture is drawn
    # another view shows the same horizon
    tab.evaluate("() => { viewer.view.pivot = [0, 0, 0.1]; viewer.askFrame(); }")
    np.testing.assert_allclose(horizon(tab)[0], expected, atol=1e-12)
    tab.click("[data-do=level-angles]")
    (operation,) = parse_edits(tab.evaluate("editor.text()").encode(), "e.json").operations
    np.testing.assert_allclose(upright_rotation(operation) @ expected, (0.0, -1.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(tab.evaluate("viewer.view.up"), expected, atol=1e-6)
    assert tab.input_value("#edit-pitch") == tab.input_value("#edit-roll") == "0"
    tab.evaluate("editor.undo()")
    assert json.loads(tab.evaluate("editor.text()"))["operations"] == []
    np.testing.assert_allclose(tab.evaluate("viewer.view.up"), up, atol=1e-12)
    slide(tab, pitch=9)
    tab.click("[data-tool=box]")
    tab.click("[data-tool=floor]")
    assert tab.input_value("#edit-pitch") == "0" and tab.is_disabled("[data-do=level-angles]")
