"""Faults of the cameras and the cloud, each at three severities."""

import math

import cv2
import numpy as np
import pytest

from doctor.rooms import replaced, room, turned, with_camera
from gsplat_edu.doctor.finding import Severity


@pytest.fixture
def orbit():
    return room("orbit", 96)


INTRINSICS = {
    "uneven": (lambda c, x: {"fx": c.fx * x}, [(1.04, False), (1.3, True), (2.4, True)]),
    "off the middle": (lambda c, x: {"cx": c.cx + x * c.W}, [(0.03, False), (0.2, True), (0.4, True)]),
    "too wide": (
        lambda c, x: {
            "fx": c.W / 2 / math.tan(math.radians(x / 2)),
            "fy": c.W / 2 / math.tan(math.radians(x / 2)),
        },
        [(100, False), (140, True), (165, True)],
    ),
    "too narrow": (
        lambda c, x: {
            "fx": c.W / 2 / math.tan(math.radians(x / 2)),
            "fy": c.W / 2 / math.tan(math.radians(x / 2)),
        },
        [(15, False), (5, True), (1, True)],
    ),
}


@pytest.mark.parametrize(
    ("how", "amount", "is_named"), [(how, *case) for how, (_, cases) in INTRINSICS.items() for case in cases]
)
def test_intrinsics_no_camera_has(diagnosed, orbit, how, amount, is_named):
    views, points = orbit
    spoiled = [with_camera(view, **INTRINSICS[how][0](view.camera, amount)) for view in views]
    found = [f for f in diagnosed(spoiled, points).findings if f.name == "intrinsics"]
    assert bool(found) == is_named
    assert all("24 of 24 photos" in f.sentence and f.images == () for f in found)


@pytest.mark.parametrize(("factor", "is_named"), [(1.1, False), (1.5, True), (0.4, True)])
def test_one_camera_of_another_focal_length(named, orbit, factor, is_named):
    views, points = orbit
    camera = views[7].camera
    spoiled = replaced(views, {7: with_camera(views[7], fx=factor * camera.fx, fy=factor * camera.fy)})
    assert named(spoiled, points).get("intrinsics", ()) == ((views[7].name,) if is_named else ())


@pytest.mark.parametrize(("share", "is_fatal"), [(0.2, False), (1e-3, True), (0.0, True)])
def test_turning_on_the_spot_is_hopeless(diagnosed, share, is_fatal):
    views, points = room("outward", 96)
    spoiled = [with_camera(view, eye=share * view.camera.eye) for view in views]
    diagnosis = diagnosed(spoiled, points)
    assert diagnosis.hopeless == is_fatal
    assert ("no parallax" in [f.name for f in diagnosis.findings]) == is_fatal
    if is_fatal:
        assert "walk while you take the photos" in diagnosis.advice[0]


def test_without_points_only_one_place_is_hopeless(diagnosed):
    """Nothing says how far the subject is."""
    views, _ = room("outward", 96)
    assert not diagnosed([with_camera(view, eye=1e-3 * view.camera.eye) for view in views]).hopeless
    assert diagnosed([with_camera(view, eye=(7.0, 8.0, 9.0)) for view in views]).hopeless


@pytest.mark.parametrize("with_points", [True, False])
@pytest.mark.parametrize("layout", ["orbit", "forward"])
@pytest.mark.parametrize(("degrees", "is_named"), [(8, False), (95, True), (175, True)])
def test_cameras_that_look_away(named, layout, degrees, is_named, with_points):
    views, points = room(layout, 96)
    points = points[np.abs(points).max(axis=1) < 4.5] if layout == "orbit" else points  # the ball alone
    spoiled = replaced(views, {5: turned(views[5], degrees), 16: turned(views[16], -degrees)})
    found = named(spoiled, points if with_points else None).get("look away", ())
    ends = tuple(name.rpartition("/")[2] for name in found)
    assert ends == ((views[5].name, views[16].name) if is_named else ())


@pytest.mark.parametrize(("missing", "name"), [(2, None), (4, "hole"), (6, "hole"), (14, "one side")])
def test_a_hole_in_an_orbit(diagnosed, orbit, missing, name):
    views, points = orbit
    left = views[:5] + views[5 + missing :]
    found = [f for f in diagnosed(left, points).findings if f.name in ("hole", "one side")]
    assert [f.name for f in found] == ([name] if name else [])
    if name == "hole":
        assert found[0].severity is Severity.WARNING
        assert f"no camera in {15 * (missing + 1)} degrees" in found[0].sentence
        assert views[4].name in found[0].advice and views[5 + missing].name in found[0].advice
    elif name:
        assert found[0].severity is Severity.NOTE, "a thing on a wall has no back"


def test_one_height_is_a_note(diagnosed, orbit):
    """The cameras of the orbit go up and down; put at one height, they see no top."""
    views, points = orbit
    ring = [with_camera(view, eye=view.camera.eye * (1, 0, 1)) for view in views]
    (found,) = [f for f in diagnosed(ring, points).findings if f.name == "one height"]
    assert found.severity is Severity.NOTE
    assert "one height" not in [f.name for f in diagnosed(views, points).findings]


@pytest.mark.parametrize(("share", "is_named"), [(0.005, False), (0.06, True), (0.15, True)])
def test_points_far_outside(named, orbit, share, is_named):
    views, points = orbit
    rng = np.random.default_rng(2)
    far = 300.0 * rng.normal(size=(round(share * len(points)), 3))
    assert ("far points" in named(views, np.concatenate([points, far]))) == is_named


@pytest.mark.parametrize(("share", "is_named"), [(0.02, False), (0.12, True), (0.6, True)])
def test_points_that_no_camera_sees(named, share, is_named):
    views, points = room("forward", 96)
    rng = np.random.default_rng(3)
    behind = rng.normal((0.0, 0.0, -6.0), 1.0, (round(share * len(points)), 3))
    assert ("unseen points" in named(views, np.concatenate([points, behind]))) == is_named


@pytest.mark.parametrize(("factor", "count"), [(2, 24), (2, 3), (1, 0)])
def test_photos_smaller_than_their_camera_are_a_note(diagnosed, orbit, factor, count):
    views, points = orbit

    def spoil(folder):
        for view in views[:count]:
            path = str(folder / "images" / view.name)
            cv2.imwrite(path, cv2.resize(cv2.imread(path), None, fx=1 / factor, fy=1 / factor))

    found = [f for f in diagnosed(views, points, spoil).findings if f.name == "sizes"]
    assert len(found) == bool(count)
    for finding in found:
        assert finding.severity is Severity.NOTE and "first 48x36 for 96x72" in finding.sentence
        assert len(finding.images) == count % 24


def test_what_the_reader_notes_is_told(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        (folder / "sparse" / "1").mkdir()

    facts = diagnosed(views, points, spoil).facts
    assert any("sparse holds 2 models: 0 is read" in value for _, value in facts)
