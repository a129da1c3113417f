"""Changes of one capture by several threads and processes follow one another: none is lost, none is half done."""

import errno
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from data.test_drawn_masks import W, colmap, excluded, tree
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.locks import LOCK, locked
from gsplat_edu.cli.main import main
from gsplat_edu.data import changes
from gsplat_edu.data.changes import CHANGES, changing
from gsplat_edu.data.drawn_masks import draw_mask, read_drawings
from gsplat_edu.data.left_out import change_left_out, read_left_out
from gsplat_edu.data.mask_shapes import covered
from gsplat_edu.data.reader import read_capture

PROCESSES, THREADS = 2, 6
PHOTOS = PROCESSES * THREADS

ADDS = """
import sys, threading
from pathlib import Path
from gsplat_edu.data.drawn_masks import draw_mask
from gsplat_edu.data.left_out import change_left_out
from gsplat_edu.data.reader import read_capture

capture, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
frames = read_capture(capture).frames

def add(number):
    draw_mask(capture, f"{number:02d}.png", [(0, 0, 2 + number, 5)])
    change_left_out(capture, frames, [f"{number:02d}.png"])
    draw_mask(capture, f"{number:02d}.png", [(0, 0, 2 + number, 3), (1, 1, 4, 9)])

print("ready", flush=True)
sys.stdin.readline()
threads = [threading.Thread(target=add, args=[number]) for number in range(first, first + count)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


@pytest.fixture
def capture(tmp_path):
    return colmap(tmp_path / "capture", [f"{i:02d}.png" for i in range(PHOTOS + 1)])


@pytest.mark.own_process
def test_what_two_processes_of_six_threads_add_at_once_is_all_there(capture):
    """Each of 12 threads draws on the mask of a photo of its own, twice, and leaves the photo out."""
    words = [[str(capture), str(THREADS * k), str(THREADS)] for k in range(PROCESSES)]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", ADDS, *some],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for some in words
    ]
    try:
        assert [process.stdout.readline() for process in processes] == ["ready\n"] * PROCESSES
        for process in processes:
            process.stdin.write("go\n")
            process.stdin.flush()
        assert [process.communicate(timeout=300)[1] for process in processes] == [""] * PROCESSES
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    drawings = read_drawings(capture)
    assert sorted(drawings) == [f"images/{i:02d}.png" for i in range(PHOTOS)]
    assert read_left_out(capture) == tuple(sorted(drawings))
    change_left_out(capture, [], None)
    for i in range(PHOTOS):
        shapes = drawings[f"images/{i:02d}.png"].shapes
        assert shapes == ((0, 0, 2 + i, 3), (1, 1, 4, 9))
        assert np.array_equal(excluded(capture, f"{i:02d}.png"), covered(shapes, W, W))
    assert not (capture / CHANGES).exists()


def test_a_change_waits_for_another_one_and_sees_what_it_wrote(capture):
    frames, begun, changed = read_capture(capture).frames, threading.Event(), []

    def change():
        begun.set()
        changed.append(change_left_out(capture, frames, ["01.png"]))

    with changing(capture):
        thread = threading.Thread(target=change)
        thread.start()
        assert begun.wait(60)
        (capture / "left_out.txt").write_text("images/00.png\n")
        assert changed == []
    thread.join(60)
    assert changed == [("images/00.png", "images/01.png")]


def test_a_search_for_poses_does_not_keep_changes_waiting(capture):
    with locked("OUT", capture, "gsplat-edu sfm", pytest.fail):
        draw_mask(capture, "01.png", [(0, 0, 4, 4)])
        assert (capture / LOCK).exists() and not (capture / CHANGES).exists()


def test_a_change_that_lasts_too_long_is_told_in_one_line(capture, monkeypatch, capsys):
    monkeypatch.setattr(changes, "PATIENCE", 0.0)
    before = tree(capture)
    words = ["mask", str(capture), "01.png"]
    with locked("CAPTURE", capture, "a change of this capture", pytest.fail, file=CHANGES):
        for command in ([*words, "0,0,4,4"], ["leave-out", str(capture), "01.png"]):
            assert main(command) == 2
            said = capsys.readouterr().err
            assert f"in use by `a change of this capture`, process {os.getpid()}" in said
            assert said.count("\n") == 1
        assert main(words) == 0 and main(["leave-out", str(capture)]) == 0  # reading needs no lock
    assert tree(capture) == before


def test_a_capture_on_a_read_only_disk_is_read(capture, monkeypatch, capsys):
    draw_mask(capture, "01.png", [(0, 0, 4, 4)])
    change_left_out(capture, read_capture(capture).frames, ["02.png"])
    before, begin = tree(capture), os.open

    def opening(path, flags, *words, **options):
        if flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR) and str(path).startswith(str(capture)):
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return begin(path, flags, *words, **options)

    monkeypatch.setattr(os, "open", opening)
    words = ["mask", str(capture), "01.png"]
    assert main(words) == 0 and "\n0,0,4,4" in capsys.readouterr().out
    assert main(["leave-out", str(capture)]) == 0 and "02.png" in capsys.readouterr().out
    for command in ([*words, "1,1,5,5"], [*words, "--undo"], ["leave-out", str(capture), "01.png"]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert "Read-only file system" in said and said.count("\n") == 1
    assert tree(capture) == before


def test_a_capture_without_locks_is_changed_and_threads_still_take_turns(capture, monkeypatch):
    fcntl = pytest.importorskip("fcntl", reason="needs POSIX")
    monkeypatch.setattr(fcntl, "flock", _no_locks)
    frames = read_capture(capture).frames
    threads = [
        threading.Thread(target=change_left_out, args=(capture, frames, [f"{i:02d}.png"]))
        for i in range(PHOTOS)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(read_left_out(capture)) == PHOTOS and not (capture / CHANGES).exists()


def _no_locks(handle, how):
    raise OSError(errno.EOPNOTSUPP, "Operation not supported")


def test_a_capture_that_does_not_exist_leaves_nothing_behind(tmp_path):
    with pytest.raises(DatasetError):
        draw_mask(tmp_path / "none", "01.png", [(0, 0, 4, 4)])
    assert list(tmp_path.iterdir()) == []
