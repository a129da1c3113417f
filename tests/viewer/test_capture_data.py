"""What the page of a capture shows: outlines against the cameras' projections, chosen points, findings, and gaps."""

import dataclasses

import numpy as np
import pytest

from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.left_out import write_left_out
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.native_lens import native_intrinsics
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.gap import widest_gap
from gsplat_edu.scene.camera import Camera
from gsplat_edu.survey.finding import Finding, Severity
from gsplat_edu.survey.geometry import Geometry
from gsplat_edu.viewer import capture_data
from gsplat_edu.viewer.capture_data import (
    FEW,
    SPHERE,
    capture_facts,
    chosen_points,
    lines_of,
    marks_of,
    outline_of,
    packed,
)
from viewer.captures import measured, ring, row


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "egg & spoon"


def test_outlines_lie_at_the_borders_of_the_photos(folder):
    """Every corner of an outline, placed by the camera's pose, projects to a corner of the photo."""
    views = ring(folder)
    facts = capture_facts(CaptureReader(folder), "a").facts
    assert [camera["name"] for camera in facts["cameras"]] == [view.name for view in views]
    for camera, view in zip(facts["cameras"], views, strict=True):
        outline = np.array(facts["shapes"][camera["shape"]]["outline"])
        corners = np.array(camera["eye"]) + facts["size"] * outline @ np.array(camera["R"])
        u, v, z = view.camera.project(view.camera.world_to_cam(corners))
        W, H = view.camera.W, view.camera.H
        expected = np.array([[0, 0], [W, 0], [W, H], [0, H]]) - 0.5
        np.testing.assert_allclose(np.stack([u, v], 1), expected, atol=1e-3)
        assert (z > 0).all()
        assert camera["photo"] == f"images/{view.name}"
    assert len(facts["shapes"]) == 1  # of one lens


def test_distorted_corners_are_those_of_the_lens():
    plain = Lens(400, 300, 300.0, 300.0, 200.0, 150.0)
    distorted = dataclasses.replace(plain, coefficients=(-0.1,))
    inner, outer = outline_of(plain), outline_of(distorted)
    assert (inner[:, 2] > outer[:, 2] + 1e-3).all()  # a barrel sees more at its corners
    x, y = outer[:, 0] / outer[:, 2], outer[:, 1] / outer[:, 2]
    factor = 1 - 0.1 * (x**2 + y**2)
    np.testing.assert_allclose(300 * x * factor + 200, [-0.5, 399.5, 399.5, -0.5], atol=1e-4)


@pytest.mark.parametrize("focal", [130.0, 260.0])
def test_a_fisheye_is_a_cone_to_the_border_of_its_image(focal):
    lens = Lens(400, 400, focal, focal, 199.5, 199.5, (0.0, 0.0, 0.0, 0.0), "fisheye")
    rim = outline_of(lens)
    camera = Camera.posed(np.eye(3), np.zeros(3), native_intrinsics(lens))
    u, v, _ = camera.project(rim)
    x, y = abs(u - 199.5), abs(v - 199.5)
    reach = (
        np.maximum(x, y) if focal > 200 else np.hypot(x, y)
    )  # border, or circle: its corners are behind the camera
    np.testing.assert_allclose(reach, 200.0, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(rim, axis=1), 1.0)
    angles = np.hypot(u - 199.5, v - 199.5) / focal
    np.testing.assert_allclose(rim[:, 2], np.cos(angles), atol=1e-5)
    lines = np.array([np.concatenate(line) for line in lines_of(lens)])
    assert len(lines) == 24 + 4 + 2
    assert np.isfinite(lines).all()


def test_a_panorama_is_a_sphere_with_a_mark_ahead():
    *sphere, ahead = lines_of(FaceLens.of(200, 100, 0))
    np.testing.assert_allclose(np.linalg.norm(np.array(sphere).reshape(-1, 3), axis=1), SPHERE)
    np.testing.assert_array_equal(ahead[1], [0, 0, 1])
    assert not len(outline_of(FaceLens.of(200, 100, 0)))


def test_points_are_chosen_evenly_and_shuffled():
    count, most = 1000, 150
    points = np.arange(count, dtype=float)[:, None] * [1.0, 0.0, 0.0]
    chosen = chosen_points(Cloud(points, np.zeros((count, 3))), most)
    places = chosen.points[:, 0]
    assert len(places) == most
    steps = np.diff(np.sort(places))
    assert steps.min() >= 6
    assert steps.max() <= 7
    first = np.sort(places[:50])  # a beginning is spread over all
    assert first[0] < 100
    assert first[-1] > 900
    assert (chosen_points(Cloud(points, np.zeros((count, 3))), most).points == chosen.points).all()
    data = packed(Cloud(points[:2], np.array([[0, 0.5, 1], [2.0, -1, 1]])))
    assert np.frombuffer(data, "<f4", 6).tolist() == points[:2].ravel().tolist()
    assert list(data[24:]) == [0, 128, 255, 255, 0, 255]


def test_findings_counts_and_left_out_photos(folder, monkeypatch):
    views = ring(folder)
    facts = capture_facts(CaptureReader(folder), "a").facts
    assert {camera["points"] for camera in facts["cameras"]} == {None}  # computed tracks are no evidence
    measured(folder)
    write_left_out(folder, [f"images/{views[2].name}"])
    monkeypatch.setattr(capture_data, "SUPPORT", 1e9)
    counts = capture_data.observed_points(folder)
    counts[views[4].name] = 1
    monkeypatch.setattr(capture_data, "observed_points", lambda path: counts)
    found = {views[1].name: ["blurred"], views[4].name: ["exposure"]}
    facts = capture_facts(CaptureReader(folder), "a", found).facts
    assert [camera["left_out"] for camera in facts["cameras"]] == [i == 2 for i in range(len(views))]
    assert {i: c["marks"] for i, c in enumerate(facts["cameras"]) if c["marks"]} == {
        1: ["blurred"],
        4: [FEW, "exposure"],
    }
    assert facts["cameras"][0]["points"] == counts[views[0].name] > 0


def test_marks_are_the_names_of_findings_by_photo():
    findings = [
        Finding("blurred", Severity.WARNING, "", "", ("a", "b")),
        Finding("hole", Severity.WARNING, "", ""),
        Finding("exposure", Severity.WARNING, "", "", ("b",)),
    ]
    assert marks_of(findings) == {"a": ["blurred"], "b": ["blurred", "exposure"]}


@pytest.mark.parametrize("middle", [2, 5, 8, 11])
def test_the_gap_lies_where_cameras_were_taken_away(folder, middle):
    """Of a ring of 12, three neighbours are missing: the arc has 120 degrees, and its middle is where the middle one of
    them stood, but for its height."""
    gone = ring(folder.with_name("whole"))[middle].camera
    views = ring(folder, skipped=((middle - 1) % 12, middle, (middle + 1) % 12))
    geometry = Geometry([view.camera for view in views], np.zeros((0, 3)))
    gap = widest_gap(geometry)
    assert np.degrees(gap.angle) == pytest.approx(120, abs=1)
    names = {f"view_{(middle + by) % 12:03}.png" for by in (-2, 2)}
    assert {views[edge].name for edge in gap.edges} == names
    level = [0, 2]
    np.testing.assert_allclose(gap.middle[level], gone.eye[level], atol=0.25)
    ends = {tuple(np.round(gap.arc[i], 6)) for i in (0, -1)}
    assert ends == {tuple(np.round(views[edge].camera.eye, 6)) for edge in gap.edges}
    facts = capture_facts(CaptureReader(folder), "a").facts
    assert "an arc of 120 degrees" in facts["gap_sentence"]
    assert all(name in facts["gap_sentence"] for name in names)
    for place in (0, -1):
        np.testing.assert_allclose(facts["gap"][place], gap.arc[place], atol=1e-2)
    np.testing.assert_allclose(facts["gap"][len(facts["gap"]) // 2], gap.middle, atol=2e-2)


def test_without_a_gap_or_a_common_subject_there_is_no_arc(folder, tmp_path):
    ring(folder)
    facts = capture_facts(CaptureReader(folder), "a").facts
    assert facts["gap"] is None
    assert facts["gap_sentence"] == "The photos leave no wide gap around their subject."
    row(tmp_path / "row")
    facts = capture_facts(CaptureReader(tmp_path / "row"), "a").facts
    assert facts["gap"] is None
    assert "do not look at a common point" in facts["gap_sentence"]


def test_left_out_photos_leave_a_gap(folder):
    views = ring(folder)
    write_left_out(folder, [view.name for view in views[4:7]])
    assert "an arc of 120 degrees" in capture_facts(CaptureReader(folder), "a").facts["gap_sentence"]


def test_the_start_view_shows_all_cameras(folder):
    views = ring(folder)
    facts = capture_facts(CaptureReader(folder), "a").facts
    numbers = {k: v for k, v in facts["start"]["camera"].items() if k != "subject"}
    camera = Camera(**numbers)
    u, v, z = camera.project(camera.world_to_cam(np.stack([view.camera.eye for view in views])))
    assert (z > 0).all()
    assert ((u > 0) & (u < camera.W) & (v > 0) & (v < camera.H)).all()
    assert np.ptp(u) > 0.3 * camera.W
    left, top, right, bottom = facts["start"]["camera"]["subject"]
    assert ((u > left) & (u < right) & (v > top) & (v < bottom)).all()
