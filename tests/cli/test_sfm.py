"""`gsplat-edu sfm`: its messages, and one-line errors for bad input."""

import argparse
import importlib.util
import io
import os
import shutil
import signal

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from gsplat_edu.base.locks import locked
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.cli.sfm import options_from
from gsplat_edu.cli.terminal import stage_bars
from gsplat_edu.cli.train import with_poses
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.options.train import options_from as train_options_from
from gsplat_edu.sfm.reconstruct import SfmOptions
from lab.captures.textured_box import box_camera, box_orbit, photograph_box


@pytest.fixture
def colmap():
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")


def save(folder, cameras):
    folder.mkdir(parents=True, exist_ok=True)
    for i, camera in enumerate(cameras):
        Image.fromarray(photograph_box(camera)).save(folder / f"{i}.jpg")


def test_options(tmp_path):
    def options(*words):
        return options_from(build_parser(["sfm"]).parse_args(["sfm", "photos", "out", *words]))

    words = "--frames 40 --matcher nearest --mapper global --camera-model OPENCV_FISHEYE --max-features 5000"
    words += " --max-image-size 2000 --threads 3"
    chosen = options(*words.split())
    source, out = chosen.source, chosen.out
    assert options() == SfmOptions(source, out)
    assert chosen == SfmOptions(source, out, 40, "nearest", "global", "OPENCV_FISHEYE", 5000, 2000, 3)


@pytest.mark.usefixtures("colmap")
def test_photos_become_a_capture(tmp_path, capsys):
    save(tmp_path / "photos", box_orbit(6, turn=1.8))
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "my out")]) == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert "6 of 6 photos have a pose" in said and "mean reprojection error 0." in said
    assert "few photos: 6 photos are few" in said, "what is certain about the capture is said at the end"
    assert f"next: gsplat-edu train '{tmp_path / 'my out'}' --out RUN" in said, "the command can be pasted"
    assert len(load_dataset(tmp_path / "my out").train) == 5


def _noise(folder):
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(4):
        Image.fromarray(rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)).save(folder / f"{i}.png")


def _blank(folder):
    folder.mkdir()
    for i in range(3):
        Image.new("RGB", (160, 120), (200, 200, 200)).save(folder / f"{i}.png")


def _texts(folder):
    folder.mkdir()
    for i in range(3):
        (folder / f"{i}.txt").write_text("hello")


def _video_inside(folder):
    folder.mkdir()
    (folder / "walk.mp4").write_bytes(b"")


def _unreadable(folder):
    folder.mkdir()
    for i in range(3):
        (folder / f"{i}.jpg").write_bytes(b"not a photo")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder: None, "photos: does not exist; give a folder of photos, or a video"),
        (lambda folder: folder.mkdir(), "photos: holds no photos; give a folder of photos, or a video"),
        (_texts, "photos: holds no photos; give a folder"),
        (_video_inside, "photos: holds no photos; it holds a video; give that: "),
        (lambda folder: save(folder, box_orbit(1)), "photos: holds one photo; poses need at least 3"),
        (
            _unreadable,
            "holds no photo that can be decoded: 0.jpg (not a JPEG, PNG, WebP, TIFF, BMP, PPM or HEIC image), 1.jpg",
        ),
        (_noise, "no two photos match; 59 features a photo, 0 of 6 pairs match (medians): "),
        (_blank, "0 features a photo, 0 of 3 pairs match (medians): 100 % of a photo is blank; show more"),
        (lambda folder: folder.write_text("hello"), "photos: is neither a photo nor a video"),
        (
            lambda file: Image.fromarray(photograph_box(box_camera(0.0))).save(file, format="PNG"),
            "photos: is a single photo; give a folder",
        ),
    ],
)
@pytest.mark.usefixtures("colmap", "as_shipped")
def test_input_that_yields_no_poses_is_a_one_line_error(tmp_path, capsys, make, says):
    make(tmp_path / "photos")
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and said.startswith("gsplat-edu sfm: ")
    assert not (tmp_path / "out" / "sparse").exists()


@pytest.mark.usefixtures("colmap", "as_shipped")
def test_an_empty_video_is_one_line(tmp_path, capsys):
    (tmp_path / "walk.mp4").write_bytes(b"")
    assert main(["sfm", str(tmp_path / "walk.mp4"), str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "walk.mp4: is not a video that OpenCV can decode" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("out", "says"),
    [
        ("photos", "is the folder of the photos"),
        (".", "is the folder of the photos"),
        ("posed", "already holds photos or poses"),
        ("photos/0.jpg", "0.jpg is a file; give a folder"),
    ],
)
@pytest.mark.usefixtures("colmap", "as_shipped")
def test_the_users_photos_are_not_overwritten(tmp_path, capsys, out, says):
    _refused(tmp_path, capsys, tmp_path / ("images" if out == "." else "photos"), out, says)


@pytest.mark.parametrize("place", ["sfm/photos", "sfm/frames", "masks", "sparse/0", "images/day 1"])
@pytest.mark.usefixtures("colmap", "as_shipped")
def test_photos_inside_the_output_folder_are_not_removed(tmp_path, capsys, place):
    _refused(tmp_path, capsys, tmp_path / "out" / place, "out", "is the folder of the photos")


@pytest.mark.usefixtures("colmap", "as_shipped")
def test_a_video_inside_the_output_folder_is_not_removed(tmp_path, capsys):
    (tmp_path / "out" / "sfm" / "frames").mkdir(parents=True)
    video = tmp_path / "out" / "sfm" / "frames" / "walk.mp4"
    video.write_bytes(b"")
    assert main(["sfm", str(video), str(tmp_path / "out")]) == 2
    assert "is the folder of the photos" in capsys.readouterr().err
    assert video.is_file()


@pytest.mark.parametrize(
    "mine", ["masks/mine.png", "sparse/mine.txt", "images/mine.txt", "sfm/models/mine.txt", "sfm/database.db"]
)
@pytest.mark.usefixtures("colmap", "as_shipped")
def test_files_that_no_run_created_are_kept(tmp_path, capsys, mine):
    (tmp_path / "out" / mine).parent.mkdir(parents=True)
    (tmp_path / "out" / mine).write_text("mine")
    _refused(
        tmp_path, capsys, tmp_path / "photos", "out", "already holds photos or poses; choose another folder"
    )


def _refused(tmp_path, capsys, source, out, says):
    save(source, box_orbit(3))
    (tmp_path / "posed" / "images").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    assert main(["sfm", str(source), str(tmp_path / out)]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--frames", "2"], "frames"),
        (["--frames", "many"], "--frames"),
        (["--matcher", "best"], "matcher"),
        (["--mapper", "glomap"], "mapper"),
        (["--camera-model", "FOV"], "--camera-model: "),
        (["--max-features", "0"], "--max-features: "),
        (["--max-image-size", "8"], "--max-image-size: "),
        (["--threads", "-1"], "threads"),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_options_out_of_range_cost_one_line(tmp_path, capsys, words, named):
    try:
        code = main(["sfm", str(tmp_path), str(tmp_path / "out"), *words])
    except SystemExit as stop:  # raised by argparse
        code = stop.code
    said = capsys.readouterr().err
    assert code == 2 and named in said and said.count("\n") == 1


@pytest.mark.usefixtures("as_shipped")
def test_without_pycolmap_one_line_says_how_to_install_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["sfm", str(tmp_path), str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert 'pip install -c constraints.txt ".[sfm]"' in said and said.count("\n") == 1


@pytest.mark.usefixtures("colmap")
def test_an_interrupt_says_how_to_resume(tmp_path, capsys, monkeypatch):
    save(tmp_path / "photos", [box_camera(0.2 * i) for i in range(4)])

    def press(*arguments):
        signal.raise_signal(signal.SIGTERM)  # what a batch system sends

    monkeypatch.setattr("gsplat_edu.sfm.reconstruct.copy_photos", press)
    before = signal.getsignal(signal.SIGTERM)
    assert main(["sfm", str(tmp_path / "photos"), str(tmp_path / "out")]) == 130
    assert "the same command resumes after the last completed stage" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_bars_show_one_stage_after_another():
    drawn = io.StringIO()
    with stage_bars(Console(file=drawn, force_terminal=True, width=100)) as progress:
        for stage, total in (("features", 3), ("matches", 7)):
            for done in range(total + 1):
                progress(stage, done, total)
    assert "features" in drawn.getvalue() and "7/7" in drawn.getvalue()


@pytest.fixture
def never(monkeypatch):
    """Fail if structure from motion starts."""

    def fail(*arguments):
        raise AssertionError("structure from motion started")

    monkeypatch.setattr("gsplat_edu.cli.train.reconstruct", fail)


@pytest.mark.usefixtures("as_shipped", "never")
def test_an_existing_run_needs_resume_before_its_capture_is_replaced(tmp_path, capsys):
    save(tmp_path / "photos", box_orbit(3))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text('{"format": 1}')
    assert main(["train", str(tmp_path / "photos"), "--out", str(tmp_path / "run")]) != 0
    said = capsys.readouterr().err
    assert "already holds a run; add --resume" in said and said.count("\n") == 1


@pytest.mark.usefixtures("as_shipped", "never")
def test_a_training_does_not_search_for_poses_where_another_command_does(tmp_path, capsys):
    save(tmp_path / "photos", box_orbit(3))
    found = tmp_path / "run" / "capture"
    with locked("OUT", found, "gsplat-edu sfm", pytest.fail):
        assert main(["train", str(tmp_path / "photos"), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert f"--out: {found} is in use by `gsplat-edu sfm`" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("never")
def test_a_resumed_run_keeps_its_poses(tmp_path):
    save(tmp_path / "photos", box_orbit(3))
    found = tmp_path / "run" / "capture"
    (found / "sparse" / "0").mkdir(parents=True)
    (found / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    (tmp_path / "run" / "config.json").write_text('{"format": 1}')
    words = ["train", str(tmp_path / "photos"), "--out", str(tmp_path / "run"), "--resume"]
    options = train_options_from(build_parser(["train"]).parse_args(words))
    said = []
    assert (
        with_poses(
            options,
            argparse.Namespace(panorama="auto", scale="auto"),
            Console(file=io.StringIO()),
            said.append,
        ).data
        == found
    )
    assert len(said) == 1 and "using the poses that this run started with" in said[0]


@pytest.mark.usefixtures("as_shipped", "never")
def test_missing_points_are_reported_before_poses_are_computed(tmp_path, capsys):
    save(tmp_path / "photos", box_orbit(3))
    words = ["train", str(tmp_path / "photos"), "--out", str(tmp_path / "run"), "--points", "nowhere.ply"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--points: nowhere.ply does not exist" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("never")
def test_a_time_limit_that_cannot_hold_the_poses_is_refused_first(tmp_path, capsys, monkeypatch):
    """60 photos of 320 x 240 px: 60 * 4.5 s * sqrt(0.0768 / 2.07) / 2 cores is 26 s."""
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    save(tmp_path / "photos", box_orbit(1))
    (photo,) = (tmp_path / "photos").iterdir()
    for number in range(59):
        shutil.copy(photo, photo.with_name(f"copy_{number:02d}{photo.suffix}"))
    words = ["train", str(tmp_path / "photos"), "--out", str(tmp_path / "run"), "--time-limit", "10s"]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--time-limit" in said and "poses of its photos takes about 26 s" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()
