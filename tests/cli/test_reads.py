"""A command reads its capture once, also if it chooses settings, measures the machine and trains."""

from collections import Counter
from pathlib import Path

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data import reader
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts import bench
from gsplat_edu.photos import decoding
from lab.captures.city import City, write_city

COUNTED = ((reader, "read_capture"), (decoding, "image_header"), (decoding, "image_size"))


def _counting(counts, name, really):
    def counting(path):
        counts[name, path] += 1
        return really(path)

    return counting


@pytest.fixture
def reads(monkeypatch):
    """Count the calls of the functions that read a capture and the headers of its photos, by function and path."""
    counts = Counter()
    for module, name in COUNTED:
        monkeypatch.setattr(module, name, _counting(counts, name, getattr(module, name)))
    return counts


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(48, 13, splats=60))
    return folder


def photo_headers(folder):
    return {("image_header", path): 1 for path in (folder / "images").iterdir()}


def test_train_with_everything_left_open(capture, tmp_path, reads, monkeypatch, capsys):
    monkeypatch.setattr(bench, "PILOT_STEPS", 5)
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--iterations", "12"]
    words += ["--resolution", "auto", "--refine", "auto", "--transients", "auto", "--appearance", "auto"]
    assert main([*words, "--max-memory", "4GiB", "--time-limit", "9h"]) == 0
    assert reads == {("read_capture", capture): 1} | photo_headers(capture)
    said = capsys.readouterr().out
    for chosen in ("--resolution auto: ", "--refine none: short", "forecast: time", "--transients none: "):
        assert chosen in said
    reads.clear()
    assert main([*words, "--resume"]) == 0
    assert not reads, "a finished run needs no capture"


def test_train_at_a_given_resolution_that_memory_limits(capture, tmp_path, reads):
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--iterations", "12"]
    assert main([*words, "--resolution", "2", "--max-memory", "4GiB"]) == 0
    assert reads == {("read_capture", capture): 1} | photo_headers(capture)


def test_doctor_before_and_after_a_training(capture, tmp_path, reads, capsys):
    assert main(["doctor", str(capture), "--iterations", "20"]) == 0
    assert reads == {("read_capture", capture): 1} | photo_headers(capture)
    assert "forecast   time: about" in capsys.readouterr().out
    run = str(tmp_path / "run")
    assert main(["train", str(capture), "--out", run, "--iterations", "12", "--strategy", "adc"]) == 0
    for command in ("doctor", "eval", "clean"):
        reads.clear()
        assert main([command, run]) == 0
        assert reads == {("read_capture", capture): 1} | photo_headers(capture), command


def test_blocks(tmp_path, reads, monkeypatch):
    """Splitting, all blocks and merging share what was read once, also if the path is relative."""
    monkeypatch.chdir(tmp_path)
    write_city(tmp_path / "city", City(photos=36, width=32, points=40))
    words = [
        "train",
        "city",
        "--out",
        "run",
        "--blocks",
        "2",
        "--iterations",
        "12",
        "--coarse-iterations",
        "12",
    ]
    assert main([*words, "--until", "split"]) == 0
    assert reads == {("read_capture", Path("city")): 1} | photo_headers(Path("city"))
    reads.clear()
    assert main([*words, "--resume"]) == 0
    assert reads == {("read_capture", tmp_path / "city"): 1} | photo_headers(tmp_path / "city")
    reads.clear()
    words[words.index("run")] = "at_once"
    assert main(words) == 0
    assert reads == {("read_capture", Path("city")): 1} | photo_headers(Path("city"))
