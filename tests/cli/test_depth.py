"""`--depth` of train and doctor, from the command line to the run's files."""

import json

import numpy as np
import pytest

from data.depth_maps import ray_lengths, traced, write_capture, write_maps
from gsplat_edu.cli.main import main

pytestmark = pytest.mark.slow


def lines_of(capsys):
    out, err = capsys.readouterr()
    return " ".join((out + err).split())


WORDS = "--iterations 20 --backend cpu --appearance none --sky none --max-gaussians 800 --save-every 10"


def train(folder, out, *words):
    """Train 20 iterations; return the exit code."""
    return main(["train", str(folder), "--out", str(out), *WORDS.split(), *words])


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """The traced capture, and its maps in millimetres."""
    folder = tmp_path_factory.mktemp("depth")
    return write_capture(folder / "capture"), write_maps(folder / "maps")


def test_a_run_learns_from_depth_logs_it_and_resumes(capture, tmp_path, capsys):
    folder, maps = capture
    train(folder, tmp_path / "run", "--depth", str(maps))
    assert "depth maps of 8 of 8 photos: z in a unit of" in lines_of(capsys)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["data"]["depth"] == str(maps.resolve()) and len(config["digests"]["given_depth"]) == 64
    log = (tmp_path / "run" / "log.jsonl").read_text()
    assert '"depth"' in log
    assert train(folder, tmp_path / "run", "--resume", "--iterations", "30") == 2  # without its depth
    assert "was started with other given depth" in lines_of(capsys)
    train(folder, tmp_path / "run", "--depth", str(maps), "--resume", "--iterations", "30")
    assert "extended from 20 to 30" in lines_of(capsys)


def test_points_of_tracks_and_settings(capture, tmp_path, capsys):
    folder, maps = capture
    train(folder, tmp_path / "run", "--depth", "points", "--set", "points_weight=0.05")
    assert "depth of 8 of 8 photos from the points in their tracks" in lines_of(capsys)
    for words, said in (
        (("--set", "depth_unit=1"), "only --depth uses it"),
        (("--depth", str(tmp_path / "nothing")), "is no folder"),
        (("--depth", str(maps), "--set", "depth_unit=1"), "times too large"),
        (("--depth", "capture"), "holds no depth map"),
        (("--depth", str(maps), "--set", "depth_kind=metres"), "depth_kind"),
    ):
        assert train(folder, tmp_path / "other", *words) == 2 and said in lines_of(capsys)


def doctor(capsys, folder, maps):
    main(["doctor", str(folder), "--depth", str(maps), "--no-forecast", "--backend", "cpu"])
    return lines_of(capsys)


def test_doctor_judges_depth(capture, tmp_path, capsys):
    """Good maps make a row; maps that do not fit, and single bad ones, become findings with advice."""
    folder, maps = capture
    said = doctor(capsys, folder, maps)
    assert "depth maps of 10 of 10 photos: z in a unit of" in said and "disagree" not in said
    assert f"--depth {maps}" in said, "the command in the advice trains with it"
    rays = write_maps(tmp_path / "rays", lambda depth, view: depth * ray_lengths(view.camera))
    assert "ray length in a unit of" in doctor(capsys, folder, rays)
    names = [view.name for view in traced().views]
    mixed = write_maps(tmp_path / "mixed", lambda depth, view: depth * (3 if view.name == names[4] else 1))
    (mixed / names[7]).unlink()
    said = doctor(capsys, folder, mixed)
    assert "1 of 10 depth maps disagree with the points" in said and names[4] in said
    assert "1 of 10 photos have no depth map" in said and names[7] in said
    rng = np.random.default_rng(0)
    noise = write_maps(tmp_path / "noise", lambda depth, view: rng.uniform(0.5, 8, depth.shape))
    said = doctor(capsys, folder, noise)
    assert "the depth maps do not fit: they are neither z nor ray length" in said
    assert "check that the maps belong to these photos and poses" in said
    (maps / "bad.txt").write_text("no map")
    assert "10 of 10" in doctor(capsys, folder, maps)
    assert "depth of 10 of 10 photos from the points" in doctor(capsys, folder, "points")


def test_doctor_finds_the_maps_of_a_capture_by_itself(tmp_path, capsys):
    folder = write_capture(tmp_path, "transforms")
    write_maps(folder / "depths", scale=0.3)  # whole units only
    contents = json.loads((folder / "transforms.json").read_text())
    for frame in contents["frames"]:
        frame["depth_file_path"] = frame["file_path"].replace("images/", "depths/")
    (folder / "transforms.json").write_text(json.dumps(contents))
    main(["doctor", str(folder), "--no-forecast", "--backend", "cpu"])
    assert "the depth maps do not fit" in lines_of(capsys)
