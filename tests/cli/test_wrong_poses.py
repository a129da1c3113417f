"""Two absurd poses of 24: `train` names them, leaves them out unless told otherwise, and survives them."""

import json

import numpy as np
import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.left_out import write_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.certain import certain_findings, without_wrong_poses
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View

WRONG = {5: (-5000.0, 300.0, 1200.0), 18: (2000.0, 4000.0, -7000.0)}
"""Training photos, and where their poses put them; the others are 3 units from the centre."""

LOST = 1.0
"""Most that wrong poses may cost the held-out photos, dB."""


def moved(camera, eye):
    return Camera(camera.R, np.array(eye), camera.fx, camera.fy, camera.cx, camera.cy, camera.H, camera.W)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """The folder of a clean capture without the two photos, and of the capture with their wrong poses."""
    root = tmp_path_factory.mktemp("captures")
    views, points, colors = procedural_capture(size=24, count=24)
    views = [
        View(moved(view.camera, WRONG[i]), view.read().image, name=view.name) if i in WRONG else view
        for i, view in enumerate(views)
    ]
    for name in ("clean", "wrong"):
        write_colmap(root / name, views, points, colors)
    write_left_out(root / "clean", [f"images/{views[i].name}" for i in WRONG])
    return root, views


@pytest.fixture(scope="module")
def runs(captures, tmp_path_factory):
    """Trainings of the clean capture, of that with wrong poses, and of all its photos; and what the others printed."""
    root, _ = captures
    out = tmp_path_factory.mktemp("runs")
    for name, capture, options in (
        ("clean", "clean", ()),
        ("default", "wrong", ()),
        ("kept", "wrong", ("--trust-poses",)),
    ):
        words = ("--iterations", "150", "--appearance", "none", "--sky", "none", "--max-gaussians", "600")
        assert main(["train", str(root / capture), "--out", str(out / name), *words, *options]) == 0
    return {name: RunFolder(out / name) for name in ("clean", "default", "kept")}


def psnr(run, split="test"):
    return run.read_metrics()[split]["psnr"]


def test_the_extent_is_that_of_the_other_cameras(captures):
    _, views = captures
    eyes = np.array([view.camera.eye for i, view in enumerate(views) if i not in WRONG])
    expected = 1.1 * np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()
    assert scene_extent([view.camera for view in views]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_train_leaves_the_photos_out_and_trains_as_if_they_were_not_there(runs):
    default, clean = (runs[name].scene(150).read_bytes() for name in ("default", "clean"))
    assert default == clean
    assert runs["default"].read_metrics()["train"]["num_images"] == 19
    listed = json.loads(runs["default"].config.read_text())["data"]["left_out"]
    assert sorted(listed) == ["images/view_005.png", "images/view_018.png"]


def test_a_training_with_the_photos_loses_at_most_a_decibel(runs):
    assert runs["kept"].read_metrics()["train"]["num_images"] == 21
    assert psnr(runs["kept"]) > psnr(runs["clean"]) - LOST
    assert runs["kept"].read_config()["data"]["left_out"] == []


def test_the_photos_are_named_and_the_choice_can_be_revoked(captures, tmp_path, capsys):
    root, _ = captures
    words = [
        "train",
        str(root / "wrong"),
        "--iterations",
        "1",
        "--appearance",
        "none",
        "--sky",
        "none",
        "--out",
    ]
    assert main([*words, str(tmp_path / "a")]) == 0
    said = capsys.readouterr().out
    assert "wrong poses: 2 of 24 cameras" in said and "--trust-poses" in said
    assert all(f"view_{i:03d}.png" in said for i in WRONG)
    assert main([*words, str(tmp_path / "b"), "--trust-poses"]) == 0
    said = capsys.readouterr().out
    assert "wrong poses: 2 of 24 cameras" in said and "training without" not in said


def test_eval_and_resume_agree_with_the_training(runs, captures, capsys):
    root, _ = captures
    run = runs["default"]
    before = run.read_metrics()
    assert main(["eval", str(run.path)]) == 0
    after = run.read_metrics()
    for split in ("test", "train"):
        assert (after[split]["psnr"], after[split]["num_images"]) == (
            before[split]["psnr"],
            before[split]["num_images"],
        )
    capsys.readouterr()
    words = ["train", str(root / "wrong"), "--iterations", "150", "--appearance", "none", "--sky", "none"]
    # the capture's own list and the option do not change what the run began with
    options = ["--max-gaussians", "600", "--out", str(run.path), "--resume", "--trust-poses"]
    assert main([*words, *options]) == 0
    assert "nothing to do" in capsys.readouterr().out


def test_the_doctor_names_the_same_photos(captures, capsys):
    root, _ = captures
    (finding,) = [f for f in certain_findings(CaptureReader(root / "wrong")) if f.leaves_out]
    assert main(["doctor", str(root / "wrong"), "--no-forecast", "--backend", "cpu"]) == 0
    assert f"wrong poses: {finding.sentence}" in capsys.readouterr().out


def test_nothing_is_left_out_of_a_clean_capture(captures):
    root, _ = captures
    reader = CaptureReader(root / "clean")
    assert without_wrong_poses(reader, certain_findings(reader)) is None


def test_photos_that_the_capture_leaves_out_stay_out(captures):
    root, _ = captures
    write_left_out(root / "wrong", ["images/view_003.png"])
    try:
        reader = CaptureReader(root / "wrong")
        chosen = without_wrong_poses(reader, certain_findings(reader))
    finally:
        write_left_out(root / "wrong", [])
    assert sorted(chosen) == [f"images/view_{i:03d}.png" for i in (3, 5, 18)]
