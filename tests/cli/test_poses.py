"""`--poses` chooses the file of a capture whose poses are read."""

import json

import pytest

import gsplat_edu.cli.main as command_line
from data.pose_programs import write_nvm, write_opensfm, write_polycam
from gsplat_edu.data.left_out import LEFT_OUT
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms


def said(capsys, *words, code=0):
    assert command_line.main([*map(str, words)]) == code
    printed = capsys.readouterr()
    return printed.err if code else printed.out


@pytest.mark.parametrize("name", ["any name.nvm", "reconstruction.json"])
def test_info_reads_the_chosen_file(tmp_path, capsys, name):
    write_opensfm(tmp_path)
    write_nvm(tmp_path)
    program = {"any name.nvm": "VisualSFM", "reconstruction.json": "OpenSfM"}[name]
    for given in (name, tmp_path / name):
        assert f"poses of {program}: 6 of 6 photos" in said(capsys, "info", tmp_path, "--poses", given)


def test_a_chosen_file_goes_before_a_colmap_model(tmp_path, capsys):
    write_colmap(tmp_path, *procedural_capture(24, 6, splats=40))
    write_opensfm(tmp_path)
    assert "COLMAP" in said(capsys, "info", tmp_path)
    assert "poses of OpenSfM" in said(capsys, "info", tmp_path, "--poses", "reconstruction.json")


def test_a_colmap_model_goes_before_a_transforms_json(tmp_path, capsys):
    capture, (views, points, colors) = tmp_path / "capture", procedural_capture(24, 6, splats=40)
    write_transforms(capture, views)
    write_colmap(capture, views[:5], points, colors)
    assert "transforms.json" in said(capsys, "info", capture)
    model, run = ("--poses", "sparse/0/images.bin"), tmp_path / "run"
    assert "COLMAP" in said(capsys, "info", capture, *model)
    few = ("--iterations", 1, "--backend", "cpu", "--trust-poses")
    said(capsys, "train", capture, *model, "--out", run, *few)
    assert len(json.loads((run / "cameras.json").read_text())) == 5
    said(capsys, "train", capture, *model, "--out", run, *few, "--resume")


def test_a_file_in_a_programs_own_folder_belongs_to_the_capture(tmp_path, capsys):
    write_polycam(tmp_path)
    write_polycam(tmp_path, kind="")
    (tmp_path / LEFT_OUT).write_text("keyframes/images/shot_0.jpg\n")
    out = said(capsys, "info", tmp_path, "--poses", "keyframes/cameras/shot_1.json")
    assert "poses of Polycam: 6 of 12 photos" in out


def test_train_keeps_the_chosen_file(tmp_path, capsys):
    capture = tmp_path / "capture"
    write_opensfm(capture)
    write_nvm(capture)
    run = tmp_path / "run"
    said(
        capsys,
        *("train", capture, "--poses", "any name.nvm", "--out", run, "--iterations", 1, "--backend", "cpu"),
        "--trust-poses",
    )
    assert json.loads((run / "config.json").read_text())["data"]["path"].endswith("any name.nvm")


@pytest.mark.parametrize("command", ["info", "doctor"])
@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("missing.xml", "--poses: missing.xml is no file in"),
        ("images/shot_0.png", "has no poses of a known program"),
        ("../other/any name.nvm", "does not belong to"),
    ],
)
def test_what_is_no_pose_file_of_the_capture_is_refused(tmp_path, capsys, command, given, says):
    write_opensfm(tmp_path / "capture")
    write_nvm(tmp_path / "other")
    err = said(capsys, command, tmp_path / "capture", "--poses", given, code=2)
    assert says in err and err.count("\n") == 1
