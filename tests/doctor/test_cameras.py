"""Faults of the cameras and the cloud, each at three severities."""

import math
import os
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from doctor.rooms import replaced, room, turned, with_camera
from gsplat_edu.data.reader import read_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.cameras import check_away
from gsplat_edu.scene.camera import Camera
from gsplat_edu.survey.capture import Shot, Survey
from gsplat_edu.survey.finding import Severity
from gsplat_edu.survey.photos import PhotoStats
from gsplat_edu.survey.support import observed_points

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).parents[3] / "shared" / "data"))


@pytest.fixture
def orbit():
    return room("orbit", 96)


INTRINSICS = {
    "uneven": (lambda c, x: {"fx": c.fx * x}, [(1.04, False), (1.3, True)]),
    "off the middle": (lambda c, x: {"cx": c.cx + x * c.W}, [(0.03, False), (0.2, True)]),
    "its angle": (
        lambda c, x: dict.fromkeys(("fx", "fy"), c.W / 2 / math.tan(math.radians(x / 2))),
        [(100, False), (140, True), (15, False), (5, True)],
    ),
}


@pytest.mark.parametrize(
    ("how", "amount", "is_named"), [(how, *case) for how, (_, cases) in INTRINSICS.items() for case in cases]
)
def test_implausible_intrinsics(diagnosed, orbit, how, amount, is_named):
    views, points = orbit
    spoiled = [with_camera(view, **INTRINSICS[how][0](view.camera, amount)) for view in views]
    found = [f for f in diagnosed(spoiled, points).findings if f.name == "intrinsics"]
    assert bool(found) == is_named
    assert all("24 of 24 photos" in f.sentence and f.images == () for f in found)


@pytest.mark.parametrize(("factor", "is_named"), [(1.1, False), (1.5, True), (0.6, True)])
def test_one_camera_with_another_focal_length(named, orbit, factor, is_named):
    views, points = orbit
    camera = views[7].camera
    spoiled = replaced(views, {7: with_camera(views[7], fx=factor * camera.fx, fy=factor * camera.fy)})
    assert named(spoiled, points).get("intrinsics", ()) == ((views[7].name,) if is_named else ())


@pytest.mark.parametrize(("share", "is_fatal"), [(0.2, False), (1e-3, True), (0.0, True)])
def test_cameras_with_one_centre_are_hopeless(diagnosed, share, is_fatal):
    views, points = room("outward", 96)
    spoiled = [with_camera(view, eye=share * view.camera.eye) for view in views]
    diagnosis = diagnosed(spoiled, points)
    assert diagnosis.hopeless == is_fatal
    assert ("no parallax" in [f.name for f in diagnosis.findings]) == is_fatal
    if is_fatal:
        assert "walk while you take the photos" in diagnosis.advice[0]


def test_without_points_only_cameras_with_one_centre_are_hopeless(diagnosed):
    """The distance to the subject is unknown, so a short baseline cannot be judged."""
    views, _ = room("outward", 96)
    assert not diagnosed([with_camera(view, eye=1e-3 * view.camera.eye) for view in views]).hopeless
    assert diagnosed([with_camera(view, eye=(7.0, 8.0, 9.0)) for view in views]).hopeless


@pytest.mark.parametrize(
    ("layout", "degrees", "with_points", "is_named"),
    [
        *(("orbit", 8, True, False), ("forward", 8, False, False), ("orbit", 95, False, True)),
        *(("forward", 95, True, True), ("orbit", 175, True, True), ("forward", 175, False, True)),
    ],
)
def test_cameras_that_look_away(named, layout, degrees, is_named, with_points):
    views, points = room(layout, 96)
    # the points of the ball
    points = points[np.abs(points).max(axis=1) < 4.5] if layout == "orbit" else points
    spoiled = replaced(views, {5: turned(views[5], degrees), 16: turned(views[16], -degrees)})
    found = named(spoiled, points if with_points else None).get("facing away", ())
    ends = tuple(name.rpartition("/")[2] for name in found)
    assert ends == ((views[5].name, views[16].name) if is_named else ())


@pytest.mark.parametrize(("missing", "name"), [(2, None), (4, "hole"), (6, "hole"), (14, "one side")])
def test_a_hole_in_an_orbit(diagnosed, orbit, missing, name):
    views, points = orbit
    remaining = views[:5] + views[5 + missing :]
    found = [f for f in diagnosed(remaining, points).findings if f.name in ("hole", "one side")]
    assert [f.name for f in found] == ([name] if name else [])
    if name == "hole":
        assert found[0].severity is Severity.WARNING
        assert f"a gap of {15 * (missing + 1)} degrees" in found[0].sentence
        assert views[4].name in found[0].advice and views[5 + missing].name in found[0].advice
    elif name:
        assert found[0].severity is Severity.NOTE, "a subject on a wall is never seen from behind"


def test_one_height_is_a_note(diagnosed, orbit):
    """The cameras of the orbit have different heights. Moved to one height, they do not see the top."""
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


def test_notes_of_the_reader_are_shown(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        shutil.copytree(folder / "sparse" / "0", folder / "sparse" / "1")

    facts = diagnosed(views, points, spoil).facts
    read, left = (f"{number} ({len(views)} photos)" for number in (0, 1))
    assert any(f"sparse holds 2 models: {read} is read, {left} not" in value for _, value in facts)


def with_tracks(folder, counts):
    """Write `counts` observed points into the images of a model, in the order of their names."""
    path = folder / "sparse" / "0" / "images.bin"
    data = path.read_bytes()
    (number,), at, written = struct.unpack_from("<Q", data), 8, [data[:8]]
    for count in counts:
        end = data.index(b"\0", at + 64) + 1
        (points,) = struct.unpack_from("<Q", data, end)
        seen = np.zeros(count + 5, [("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
        seen["point"][:5] = -1  # features without a point
        written += [data[at:end], struct.pack("<Q", len(seen)), seen.tobytes()]
        at = end + 8 + 24 * points
    assert number == len(counts) and at == len(data)
    path.write_bytes(b"".join(written))
    cloud = path.with_name("points3D.bin")
    measured = bytearray(cloud.read_bytes())
    # a mapper writes the reprojection error; here the first point has one
    struct.pack_into("<d", measured, 8 + struct.calcsize("<Q3d3B"), 0.7)
    cloud.write_bytes(measured)


COUNTS = [200] * 24


@pytest.mark.parametrize(("count", "is_named"), [(60, False), (11, True), (0, True)])
def test_a_pose_based_on_few_points_is_named(named, orbit, count, is_named):
    views, points = orbit
    counts = [*COUNTS[:7], count, *COUNTS[8:]]
    found = named(views, points, lambda folder: with_tracks(folder, counts)).get("doubtful poses", ())
    assert found == ((f"{views[7].name} ({count} points)",) if is_named else ())


def test_few_points_in_all_photos_make_no_single_pose_doubtful(named, orbit):
    views, points = orbit
    found = named(views, points, lambda folder: with_tracks(folder, [25, 40] * 12))
    assert "doubtful poses" not in found


@pytest.mark.parametrize(("times", "is_named"), [(2, False), (20, True)])
def test_a_camera_that_stands_far_away_is_named(named, orbit, times, is_named):
    """If the model has point counts, the camera is named only if its count is low, otherwise by its distance alone."""
    views, points = orbit
    spoiled = replaced(views, {7: with_camera(views[7], eye=times * views[7].camera.eye)})
    low = [*COUNTS[:7], 60, *COUNTS[8:]]
    for counts in (low, None):
        spoil = None if counts is None else lambda folder: with_tracks(folder, low)
        (label,) = named(spoiled, points, spoil).get("doubtful poses", ("",))
        assert ("times as far as the others" in label) == is_named
        assert label.startswith(views[7].name) == is_named
    assert "doubtful poses" not in named(spoiled, points, lambda folder: with_tracks(folder, COUNTS)), (
        "many points support this pose, so it is right"
    )


def test_a_camera_with_few_points_that_looks_past_the_subject_is_named(named, orbit):
    views, points = orbit
    points = points[np.abs(points).max(axis=1) < 4.5]
    spoiled = replaced(views, {5: turned(views[5], 35)})
    low = [*COUNTS[:5], 60, *COUNTS[6:]]
    found = named(spoiled, points, lambda folder: with_tracks(folder, low))
    assert found["doubtful poses"] == (f"{views[5].name} (60 points, points away from the common subject)",)
    assert "doubtful poses" not in named(spoiled, points, lambda folder: with_tracks(folder, COUNTS))


@pytest.mark.parametrize(("times", "is_named"), [(2.5, False), (4, True), (20, True)])
def test_without_counts_a_camera_that_stands_apart_is_named(named, orbit, times, is_named):
    """Distances are relative to the distance that three quarters of the cameras keep. At 4 units from the centre, the
    nearest camera is 3 units away."""
    views, _ = orbit
    spoiled = replaced(views, {7: with_camera(views[7], eye=times * views[7].camera.eye)})
    (label,) = named(spoiled).get("doubtful poses", ("",))
    assert bool(label) == is_named
    assert label.endswith(f"{views[7].name} ({times:.0f} times as far as the others)") or not is_named


@pytest.mark.parametrize(("degrees", "is_named"), [(20, False), (35, True)])
def test_without_counts_a_camera_whose_picture_misses_the_subject_is_named(named, orbit, degrees, is_named):
    views, _ = orbit
    spoiled = replaced(views, {i: turned(views[i], degrees) for i in (3, 12)})
    found = named(spoiled).get("doubtful poses", ())
    assert [name.rpartition("/")[2] for name in found] == [
        f"{views[i].name} (points away from the common subject)" for i in (3, 12) if is_named
    ]


@pytest.mark.parametrize("capture", ["fox", "snowmiku97", "truck11"])
def test_no_pose_of_a_clean_capture_is_doubted(capture):
    """The check runs without counts of observed points, and the photos are not decoded."""
    folder = DATA / capture
    if not folder.is_dir():
        pytest.skip(f"{capture} is not on this machine; see GSPLAT_EDU_DATA")
    read, stats = read_capture(folder), PhotoStats(np.zeros((4, 4, 3), np.uint8), np.zeros(8))
    shots = []
    for frame in read.frames:
        camera = Camera.posed(frame.R, frame.eye, frame.lens.undistorted())
        shots.append(Shot(frame.name, frame.lens, (camera.W, camera.H), camera, stats))
    points = np.zeros((0, 3)) if read.cloud is None else read.cloud.points
    assert check_away(Survey(folder, read.layout, tuple(shots), (), (), points, ())) == []


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_tracks_computed_from_poses_are_no_evidence_for_them(tmp_path, orbit, kind):
    views, points = orbit
    write_colmap(tmp_path, views[:4], points, np.full(points.shape, 0.5), binary=kind == "bin")
    assert observed_points(tmp_path) == {}
    (tmp_path / "sparse" / "0" / f"points3D.{kind}").unlink()
    assert min(observed_points(tmp_path).values()) > 0, "without points3D, the tracks count"


def test_observed_points_are_read_from_text_too(tmp_path):
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 10 10 9 9 5 5\n")
    rows = b"1 1 0 0 0 0 0 0 1 a b.png\n1 2 7 3 4 -1 5 6 8\n\n2 1 0 0 0 0 0 0 1 d\\raw\xff.png\n\n"
    (model / "images.txt").write_bytes(b"# Image list\n" + rows)
    assert observed_points(tmp_path) == {"a b.png": 2, r"d/raw\xff.png": 0}, (
        "names are decoded like those of frames"
    )
    assert observed_points(tmp_path / "nowhere") == {}
