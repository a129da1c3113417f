"""Commands compare poses with photos, read them as the photos show, and refuse those of other photos."""

import json

import numpy as np
import pytest

import gsplat_edu.cli.main as command_line
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.views import View
from lab.captures.textured_box import box_orbit, photograph_box

AGREE = "The poses agree with the photos: 0."
MISREAD = (
    "The poses agree with the photos only if the cameras' y and z axes point the other way (OpenGL's axes)"
)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """The folders of a right capture, of one with OpenCV's axes where OpenGL's are expected, and of one mixed up."""
    top = tmp_path_factory.mktemp("captures")
    cameras = box_orbit(14, 4.0, (320, 240))
    views = [
        View(camera, photograph_box(camera), name=f"box_{i:02d}.png") for i, camera in enumerate(cameras)
    ]
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (200, 3))
    gl = np.diag([1.0, -1.0, -1.0, 1.0])
    for name in ("right", "misread", "mixed"):
        write_transforms(top / name, views, points, np.full((200, 3), 0.5))
        path = top / name / "transforms.json"
        contents = json.loads(path.read_text())
        matrices = [np.array(frame["transform_matrix"]) for frame in contents["frames"]]
        changed = {
            "right": matrices,
            "misread": [M @ gl for M in matrices],
            "mixed": [matrices[5 * i % len(matrices)] for i in range(len(matrices))],
        }[name]
        for frame, M in zip(contents["frames"], changed, strict=True):
            frame["transform_matrix"] = M.tolist()
        path.write_text(json.dumps(contents))
    return top


def said(capsys, *words, code=0):
    assert command_line.main([*map(str, words)]) == code
    printed = capsys.readouterr()
    return printed.err if code else printed.out


def trained(capsys, capture, out, *words, iterations=4):
    few = ("--iterations", iterations, "--backend", "cpu", "--resolution", 4)
    return said(capsys, "train", capture, "--out", out, *few, *words)


def test_a_training_reads_misread_poses_as_the_photos_show(captures, tmp_path, capsys):
    """So that it is, to rounding, that of the right capture; what belongs to the run reads them so, too."""
    assert AGREE in trained(capsys, captures / "right", tmp_path / "right")
    out = trained(capsys, captures / "misread", tmp_path / "run")
    assert MISREAD in out and "): read so" in out
    reading = RunFolder(tmp_path / "run").read_config()["data"]["reading"]
    assert reading == "the cameras' y and z axes point the other way (OpenGL's axes)"
    assert "reading" not in RunFolder(tmp_path / "right").read_config()["data"]
    right, run = (RunFolder(tmp_path / name).read_cameras((0.0, 0.0, 0.0)) for name in ("right", "run"))
    for (name, _, camera), (same, _, other) in zip(right, run, strict=True):
        assert name == same
        np.testing.assert_allclose(other.R, camera.R, atol=1e-9)
        np.testing.assert_allclose(other.eye, camera.eye, atol=1e-9)
    said(capsys, "eval", tmp_path / "run")
    assert "read as the photos show" not in said(capsys, "doctor", tmp_path / "right")


def test_a_resumed_run_keeps_the_reading_without_another_comparison(captures, tmp_path, capsys):
    trained(capsys, captures / "misread", tmp_path / "run", iterations=3)
    before = RunFolder(tmp_path / "run").cameras.read_bytes()
    out = trained(capsys, captures / "misread", tmp_path / "run", "--resume", iterations=6)
    assert MISREAD not in out and "read as the photos show: the cameras' y and z axes" in out
    assert RunFolder(tmp_path / "run").cameras.read_bytes() == before


def test_poses_of_other_photos_are_refused_unless_they_are_trusted(captures, tmp_path, capsys):
    err = trained_in_vain(capsys, captures / "mixed", tmp_path / "run")
    assert "mixed: the poses do not agree with the photos (" in err and "--trust-poses" in err
    assert err.count("\n") == 1 and not (tmp_path / "run").exists()
    out = trained(capsys, captures / "mixed", tmp_path / "run", "--trust-poses")
    assert "agree" not in out


def trained_in_vain(capsys, capture, out):
    words = ("train", capture, "--out", out, "--iterations", 4, "--backend", "cpu", "--resolution", 4)
    return said(capsys, *words, code=2)


@pytest.mark.parametrize(
    ("name", "says"),
    [("right", AGREE), ("misread", MISREAD), ("mixed", "The poses do not agree with the photos")],
)
def test_info_and_the_doctor_say_what_the_photos_say(captures, capsys, name, says):
    for command in (["info"], ["doctor", "--no-forecast"]):
        assert says in said(capsys, command[0], captures / name, *command[1:])
        assert "agree" not in said(capsys, command[0], captures / name, "--trust-poses", *command[1:])


def test_an_unknown_reading_of_a_run_is_one_line(captures, tmp_path, capsys):
    run = tmp_path / "run"
    trained(capsys, captures / "misread", run)
    config = json.loads((run / "config.json").read_text())
    config["data"]["reading"] = "backwards"
    (run / "config.json").write_text(json.dumps(config))
    err = said(capsys, "eval", run, code=2)
    assert "reading: 'backwards' is not known" in err and err.count("\n") == 1
