"""A folder has one writer. A second writer is told who holds the lock, and no lock outlives its process."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.locks import LOCK, locked

fcntl = pytest.importorskip("fcntl", reason="needs POSIX: flock and fork")

HOLDS = """
import sys, os
from pathlib import Path
from gsplat_edu.base.locks import locked
with locked("--out", Path(sys.argv[1]), "gsplat-edu train", print):
    child = os.fork() if sys.argv[2] == "fork" else 1
    if child == 0:
        os.setsid()
    os.write(1, f"held {child}\\n".encode())  # one write: two processes share the pipe
    sys.stdin.read()
"""


def holder(folder, fork="none"):
    command = [sys.executable, "-c", HOLDS, str(folder), fork]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    lines = [process.stdout.readline() for _ in range(2 if fork == "fork" else 1)]
    assert all(line.startswith("held") for line in lines), lines
    return process, max(int(line.split()[1]) for line in lines)


def kill(process):
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def lock(folder):
    with locked("--out", folder, "gsplat-edu train", pytest.fail):
        return True


@pytest.mark.own_process
def test_a_second_writer_is_told_the_holder_and_kill_9_frees_the_lock(tmp_path):
    process, _ = holder(tmp_path / "run")
    message = rf"^--out: .*run is in use by `gsplat-edu train`, process {process.pid} on .+, since 2\d{{3}}-.*; wait"
    with pytest.raises(ArgumentError, match=message):
        lock(tmp_path / "run")
    kill(process)
    assert (tmp_path / "run" / LOCK).exists(), "a killed process does not remove its file"
    assert lock(tmp_path / "run")
    assert not (tmp_path / "run" / LOCK).exists()


@pytest.mark.own_process
def test_a_forked_child_does_not_keep_the_lock(tmp_path):
    process, child = holder(tmp_path / "run", "fork")
    try:
        with pytest.raises(ArgumentError, match=f"process {process.pid} "):
            lock(tmp_path / "run")
        process.kill()
        process.wait()
        os.kill(child, 0)  # the child keeps running, because it reads from an open pipe
        assert lock(tmp_path / "run")
    finally:
        os.kill(child, signal.SIGKILL)
        process.stdin.close()
        process.stdout.close()


def test_a_process_cannot_lock_a_folder_twice(tmp_path):
    with locked("OUT", tmp_path, "gsplat-edu sfm", pytest.fail):
        with pytest.raises(ArgumentError, match=f"^OUT: .*process {os.getpid()} "):
            lock_as_out(tmp_path)
        assert (tmp_path / LOCK).exists()
    assert list(tmp_path.iterdir()) == []


def lock_as_out(folder):
    with locked("OUT", folder, "gsplat-edu sfm", pytest.fail):
        return True


def test_a_created_folder_left_empty_is_removed(tmp_path):
    assert lock(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    with locked("--out", tmp_path / "a" / "b", "gsplat-edu train", pytest.fail):
        (tmp_path / "a" / "file").write_text("kept")
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "file"]


def test_the_contents_of_a_damaged_lock_are_not_printed(tmp_path):
    with locked("--out", tmp_path, "gsplat-edu train", pytest.fail):
        for text in (
            '{"pid": "\x1b[31m", "host": "\n", "what": 1, "since": []}',
            "{",
            "7",
            "\xff" * 50,
            "[" * 995,
        ):
            (tmp_path / LOCK).write_text(text)
            with pytest.raises(ArgumentError, match="is in use by") as caught:
                lock(tmp_path)
            assert str(caught.value).isprintable()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_gives_one_message(tmp_path, monkeypatch, number):
    def refuse(handle, how):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    said = []
    with locked("--out", tmp_path, "gsplat-edu train", said.append):
        assert not (tmp_path / LOCK).exists()
    assert len(said) == 1 and "has no locks" in said[0]


def test_a_lock_that_is_a_link_is_refused_and_its_target_is_unchanged(tmp_path):
    target = tmp_path / "target.txt"
    target.write_text("kept")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / ".lock").symlink_to(target)
    with (
        pytest.raises(ArgumentError, match="is a link"),
        locked("FOLDER", tmp_path / "folder", "a test", print),
    ):
        pass
    assert target.read_text() == "kept"


@pytest.mark.parametrize("looks", [1, 2])
def test_a_lock_file_that_vanishes_between_two_looks_at_it_is_no_error(tmp_path, monkeypatch, looks):
    """Its holder removes it at the end; it must not be taken for a link or a folder then."""
    (tmp_path / LOCK).touch()
    look, seen = Path.stat, []

    def vanishing(path, **options):
        found = look(path, **options)
        if path.name == LOCK:
            seen.append(path)
            if len(seen) == looks:
                monkeypatch.undo()
                path.unlink(missing_ok=True)
        return found

    begin = os.open

    def opening(path, *words, **options):
        if Path(path).name == LOCK:
            monkeypatch.undo()  # from here on it is our own file
        return begin(path, *words, **options)

    monkeypatch.setattr(Path, "stat", vanishing)
    monkeypatch.setattr(os, "open", opening)
    assert lock(tmp_path) and seen


@pytest.mark.parametrize("at", [LOCK, "run"])
def test_a_folder_that_its_holder_removes_at_the_end_is_made_again(tmp_path, monkeypatch, at):
    """It vanishes when the lock file is about to be opened, or when the folder is tried out."""
    folder, begin = tmp_path / "run", os.open

    def opening(path, *words, **options):
        if Path(path).name == at:
            monkeypatch.undo()
            shutil.rmtree(folder)
        return begin(path, *words, **options)

    folder.mkdir()
    monkeypatch.setattr(os, "open", opening)
    with locked("--out", folder, "gsplat-edu train", pytest.fail):
        assert (folder / LOCK).is_file()
