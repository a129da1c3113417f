"""Faults planted in files are reported."""

import json

import cv2
import numpy as np
import pytest

from doctor.rooms import room
from gsplat_edu.data.notes import MissingPhotos
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.doctor.before import examine
from gsplat_edu.doctor.certain import certain_findings, known_photos
from gsplat_edu.doctor.diagnosis import advice_lines
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Severity


@pytest.fixture
def orbit():
    return room("orbit", 96, 24, ending="png")


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


SPOILED = {
    "nearly whole": lambda path: cut(path, 0.9),
    "half": lambda path: cut(path, 0.5),
    "empty": lambda path: path.write_bytes(b""),
    "no image": lambda path: path.write_text("<html>not found</html>"),
}


@pytest.mark.parametrize(
    ("how", "which"),
    [*((how, [3]) for how in SPOILED), ("half", [2, 7, 11]), ("half", [0, 1, 2, 3, 4, 5, 6, 7])],
)
def test_damaged_photos_are_named_and_the_others_examined(diagnosed, orbit, how, which):
    views, points = orbit
    names = [views[i].name for i in which]

    def spoil(folder):
        for name in names:
            SPOILED[how](folder / "images" / name)

    diagnosis = diagnosed(views, points, spoil)
    (found,) = [f for f in diagnosis.findings if f.name == "unusable"]
    assert found.images == tuple(names)
    assert f"{len(names)} of 24 photos (" in found.sentence
    assert "sharpness" in diagnosis.fine and not diagnosis.hopeless
    assert names[0] in diagnosis.advice[0]


def test_a_truncated_jpeg_is_named_too(tmp_path, orbit):
    """JPEGs are decoded at a fraction of their size, which must not hide missing data."""
    views, _ = orbit
    write_transforms(tmp_path, views[:13])
    contents = json.loads((tmp_path / "transforms.json").read_text())
    for view, frame in zip(views, contents["frames"], strict=False):
        path = tmp_path / "images" / view.name
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.resize(cv2.imread(str(path)), None, fx=25, fy=25))
        path.unlink()
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
    (tmp_path / "transforms.json").write_text(json.dumps(contents))
    cut(tmp_path / "images" / "view_004.jpg", 0.8)
    survey = prepare(CaptureReader(tmp_path))
    (refused,) = survey.refused
    assert refused.name == "images/view_004.jpg" and refused.reason.startswith("image file is truncated")
    assert {max(shot.stats.thumbnail.shape) for shot in survey.shots} == {128}
    assert {shot.size for shot in survey.shots} == {(2400, 1800)}, "the size of the file, not the decoded one"


def test_all_photos_damaged_is_hopeless(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        for path in (folder / "images").iterdir():
            path.write_bytes(b"")

    diagnosis = diagnosed(views, points, spoil)
    assert diagnosis.hopeless
    assert "0 of 24 photos can be used" in diagnosis.ranked[0].sentence


@pytest.mark.parametrize("count", [1, 5, 17])
def test_missing_photos_are_counted(diagnosed, count):
    views, points = room("orbit", 96, 40, ending="png")

    def spoil(folder):
        for view in views[3 : 3 + count]:
            (folder / "images" / view.name).unlink()

    (found,) = [f for f in diagnosed(views, points, spoil).findings if f.name == "missing"]
    assert (
        f"{count} missing image{'s' if count > 1 else ''} of 40 listed, first view_003.png" in found.sentence
    )


@pytest.mark.parametrize(
    ("count", "severity"), [(1, Severity.NOTE), (4, Severity.WARNING), (10, Severity.WARNING)]
)
def test_photos_without_a_pose_are_reported(tmp_path, orbit, count, severity):
    views, points = orbit
    write_colmap(tmp_path, views[count:], points, np.full_like(points, 0.5))
    for i in range(count):
        photo = tmp_path / "images" / views[-1].name
        (tmp_path / "images" / f"extra_{i}.JPG").write_bytes(photo.read_bytes())
    (tmp_path / "images" / "Thumbs.db").write_bytes(b"no photo")
    (found,) = [f for f in examine(prepare(CaptureReader(tmp_path))).findings if f.name == "no pose"]
    assert found.severity is severity
    assert found.images == tuple(f"extra_{i}.JPG" for i in range(count))


def test_photos_that_a_search_left_out_are_reported_though_the_capture_has_none_of_them(tmp_path, orbit):
    """The folder of a capture that a search made holds only what has a pose."""
    views, points = orbit
    write_colmap(tmp_path, views[6:], points, np.full_like(points, 0.5))
    left = {
        "left_out": ["a.jpg", "day 2/b.jpg"],
        "unclear": ["c.jpg"],
        "doubtful": ["d.jpg", "e.jpg", "f.jpg"],
    }
    stages = {"capture": {"options": {}, "facts": {"error": 0.5, **left}}}
    (tmp_path / "sfm").mkdir()
    (tmp_path / "sfm" / "stages.json").write_text(json.dumps({"stages": stages}))
    certain = certain_findings(CaptureReader(tmp_path))
    for findings in (certain, examine(prepare(CaptureReader(tmp_path))).findings):
        (found,) = [one for one in findings if one.name == "no pose"]
        assert found.severity is Severity.WARNING
        assert found.images == ("a.jpg", "day 2/b.jpg", "c.jpg", "d.jpg", "e.jpg", "f.jpg")
        assert found.sentence.startswith(f"6 of {len(views)} photos could not be placed")
    assert known_photos(CaptureReader(tmp_path))["unposed"] == 6  # what the verdict on a run is told
    for damaged in ("{", "[]", json.dumps({"stages": {"capture": {"facts": {"left_out": [1]}}}})):
        (tmp_path / "sfm" / "stages.json").write_text(damaged)
        assert known_photos(CaptureReader(tmp_path))["unposed"] == 0


@pytest.mark.parametrize(("count", "name"), [(24, None), (8, "few photos"), (1, "usable")])
def test_few_photos_are_reported(named, orbit, count, name):
    views, points = orbit
    found = set(named(views[:: 24 // count][:count], points)) & {"few photos", "usable"}
    assert found == ({name} if name else set())


def test_a_photo_of_another_shape_than_its_camera_is_named(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        path = str(folder / "images" / views[5].name)
        cv2.imwrite(path, cv2.imread(path)[:40])

    (found,) = [f for f in diagnosed(views, points, spoil).findings if f.name == "unusable"]
    assert found.images == (views[5].name,) and "another aspect ratio" in found.sentence


def test_names_that_read_like_messages_do_not_change_the_findings(tmp_path, orbit):
    """Findings are read from fields. If sentences were parsed, such a name would be taken for a part of one."""
    views, _ = orbit
    odd = "cannot be decoded (x); 1 of 2 photos have no file: skipped, first"
    write_transforms(tmp_path, views)
    contents = json.loads((tmp_path / "transforms.json").read_text())
    for view, frame, name in zip(views, contents["frames"], (f"{odd} a.png", f"{odd} b.png"), strict=False):
        frame["file_path"] = f"images/{name}"
        (tmp_path / "images" / view.name).rename(tmp_path / "images" / name)
    (tmp_path / "transforms.json").write_text(json.dumps(contents))
    path = str(tmp_path / "images" / f"{odd} a.png")
    cv2.imwrite(path, cv2.imread(path)[:40])
    (tmp_path / "images" / f"{odd} b.png").unlink()
    survey = prepare(CaptureReader(tmp_path))
    assert survey.notes == (MissingPhotos(1, 24, f"images/{odd} b.png"),)
    found = {finding.name: finding for finding in examine(survey).findings}
    assert found["missing"].sentence == f"1 missing image of 24 listed, first images/{odd} b.png"
    assert (
        found["unusable"].sentence
        == "1 of 23 photos (the photo is 96x40 but its camera 96x72, another aspect ratio)"
    )


def test_a_reason_shared_by_several_photos_is_given_once(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        for view in views[3:9]:
            path = str(folder / "images" / view.name)
            cv2.imwrite(path, cv2.imread(path)[:40])

    (found,) = [f for f in diagnosed(views, points, spoil).findings if f.name == "unusable"]
    assert len(found.images) == 6 and found.sentence.count("another aspect ratio") == 1


def test_the_advice_is_three_sentences_with_the_most_severe_first(diagnosed, orbit):
    views, points = orbit

    def spoil(folder):
        (folder / "images" / views[3].name).write_bytes(b"")
        (folder / "images" / views[4].name).unlink()

    lines = advice_lines(diagnosed(views, points, spoil))
    assert len(lines) == 4
    assert lines[1].startswith("  1. ") and views[3].name in lines[1] and "missing" in lines[2]
    assert "gsplat-edu train" in lines[3]
