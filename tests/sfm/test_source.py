"""Unusable sources are refused in one line before any work, and a failure leaves no files."""

import json

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.sfm.source import check_source, needs_poses, too_few

RNG = np.random.default_rng(0)


def photos(folder, count):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        Image.fromarray(RNG.integers(0, 255, (30, 40, 3)).astype(np.uint8)).save(folder / f"{i}.png")
    return folder


@pytest.fixture
def run(tmp_path):
    """Make a folder with the files by which a run is recognised."""
    folder = photos(tmp_path / "run" / "renders", 4).parent
    (folder / "config.json").write_text(json.dumps({"data": {"path": "captures/desk"}}))
    (folder / "cameras.json").write_text("[]")
    return folder


@pytest.mark.parametrize("command", ["sfm", "train"])
def test_a_run_folder_is_refused_as_photos(run, tmp_path, capsys, command):
    out = ["--out"] if command == "train" else []
    assert main([command, str(run), *out, str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is a run, whose pictures are renders, not photos" in line
    assert line.endswith("give the capture it was trained on, captures/desk")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("contents", ["{", "[" * 100_000, '{"data": {"path": 7}}'])
def test_a_run_with_a_damaged_configuration_is_still_recognised(run, contents):
    (run / "config.json").write_text(contents)
    with pytest.raises(DatasetError, match="give the capture it was trained on$"):
        needs_poses(run)


@pytest.mark.parametrize("command", ["sfm", "train"])
def test_refusing_other_files_and_empty_folders_names_photos_and_videos(tmp_path, capsys, command):
    out = ["--out"] if command == "train" else []
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    for name, what in (("notes.txt", "is neither a photo nor a video"), ("empty", "holds no photos")):
        assert main([command, str(tmp_path / name), *out, str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{name}: {what}" in line and "a folder of photos" in line and "video" in line
        assert not (tmp_path / "out").exists()


def test_two_photos_are_too_few(tmp_path):
    source = photos(tmp_path / "photos", 2)
    with pytest.raises(DatasetError, match="holds 2 photos; poses need at least 3, from different places"):
        check_source(source, tmp_path / "out")
    Image.open(source / "0.png").save(source / "one.jpg")
    assert len(check_source(source, tmp_path / "out")) == 3


def test_a_damaged_jpeg_is_not_told_to_become_one(tmp_path):
    assert too_few(tmp_path, 0, ["a.jpg", "b.JPEG"]).endswith("copy them from the camera again")
    assert too_few(tmp_path, 0, ["a.jpg", "b.raf"]).endswith("export them as JPEG")


@pytest.mark.usefixtures("colmap")
def test_a_failure_before_any_result_leaves_no_folder(tmp_path):
    (tmp_path / "broken.mp4").write_bytes(b"not a video")
    mine = tmp_path / "mine"
    mine.mkdir()
    for out in (tmp_path / "deep" / "out", mine):
        assert main(["sfm", str(tmp_path / "broken.mp4"), str(out)]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.mp4", "mine"]
    assert not any(mine.iterdir()), "an existing folder is not removed and stays empty"
