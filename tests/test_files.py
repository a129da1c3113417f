import errno
import os
import shutil
import stat
import tracemalloc
from pathlib import Path

import pytest

from gsplat_edu import ArgumentError
from gsplat_edu.base import files
from gsplat_edu.base.files import (
    check_writable,
    described,
    newest_first,
    remove_leftovers,
    unreadable,
    written_aside,
)
from gsplat_edu.base.reading import open_file, stored_path
from gsplat_edu.cli.running import run_command
from systems import needs_posix


def test_parent_folders_are_made_and_the_file_appears_complete(tmp_path):
    path = tmp_path / "a" / "b" / "c.txt"
    with written_aside(path) as aside:
        aside.write_text("new")
        assert not path.exists() and aside.parent == path.parent and aside.suffix == ".txt"
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


@needs_posix
def test_permissions_are_those_of_any_new_file(tmp_path):
    old = os.umask(0o022)
    try:
        with written_aside(tmp_path / "x") as aside:
            aside.write_text("")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o644


@needs_posix
def test_writers_do_not_change_the_permissions_of_files_that_other_threads_make(tmp_path, monkeypatch):
    """The umask belongs to the whole process: a thread that sets it for a moment opens other threads' files to all."""
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("the umask was changed"))
    with written_aside(tmp_path / "x") as aside:
        aside.unlink()
        aside.write_text("")  # some writers make the file anew
        aside.chmod(0o600)
    assert (tmp_path / "x").stat().st_mode == aside_like(tmp_path).stat().st_mode


def aside_like(folder):
    (folder / "plain").touch()
    return folder / "plain"


def test_a_folder_that_vanishes_meanwhile_is_passed_over(tmp_path, monkeypatch):
    left = tmp_path / "z" / f".x.{files.this_machine()}-{2**22 + 1}-0123abcd.ply"
    for folder in ("a/b", "z"):
        (tmp_path / folder).mkdir(parents=True)
    left.touch()
    (tmp_path / "z" / "kept").touch()
    scan = os.scandir

    def vanishing(place):
        if place in (tmp_path / "a" / "b", str(tmp_path / "a" / "b")):
            monkeypatch.undo()
            shutil.rmtree(tmp_path / "a")  # another program removes it once it is listed
        return scan(place)

    monkeypatch.setattr(os, "scandir", vanishing)
    remove_leftovers(tmp_path)
    assert not (tmp_path / "a").exists() and [path.name for path in left.parent.iterdir()] == ["kept"]


@needs_posix
def test_a_link_is_no_leftover(tmp_path):
    name = f".x.{files.this_machine()}-{2**22 + 1}-0123abcd.ply"
    (tmp_path / name).symlink_to(tmp_path / "elsewhere.ply")
    remove_leftovers(tmp_path)
    assert (tmp_path / name).is_symlink()


def test_files_are_sorted_by_time_and_vanished_ones_left_out(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    for time, path in zip((1, 3, 2), paths, strict=True):
        path.touch()
        os.utime(path, (time, time))
    assert newest_first([*paths, tmp_path / "gone"]) == [paths[1], paths[2], paths[0]]


def test_a_failure_leaves_the_old_file(tmp_path):
    path = tmp_path / "x"
    path.write_text("old")
    with pytest.raises(RuntimeError), written_aside(path) as aside:
        aside.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_check_writable_gives_the_reason(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ArgumentError, match=r"^--out: cannot write .*; choose another place$"):
        check_writable("--out", tmp_path / "file" / "x.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ArgumentError, match="is a folder"):
        check_writable("--out", tmp_path / "folder.png")
    check_writable("--out", tmp_path / "new" / "x.png")
    assert list((tmp_path / "new").iterdir()) == []


def test_an_error_names_the_requested_file_and_the_reason(tmp_path, monkeypatch):
    def refuse(*words, **options):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / ".scene.ab12cd34.ply"))

    for name in ("open", None):
        if name is not None:
            monkeypatch.setattr(os, name, refuse)
        else:
            monkeypatch.undo()
        with pytest.raises(OSError) as caught, written_aside(tmp_path / "scene.ply") as aside:
            raise PermissionError(errno.EACCES, "Permission denied", str(aside))
        message = described(caught.value)
        assert message.startswith(f"{tmp_path / 'scene.ply'}: permission denied; choose another place")
    assert list(tmp_path.iterdir()) == []


def test_errors_are_described_without_error_numbers():
    assert described(OSError(errno.ENOSPC, "No space left on device", "a.png")) == (
        "a.png: no space left on device; make room, or choose another place"
    )
    assert described(OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b")).startswith("a to b: ")
    assert described(OSError("the socket is gone")) == "the socket is gone"
    assert described(OSError(errno.EIO, "Input/output error")) == "input/output error"


def test_the_command_line_prints_the_requested_name(tmp_path, capsys):
    def command():
        (tmp_path / "file").write_text("")
        with written_aside(tmp_path / "file" / "scene.ply"):
            pass

    assert run_command("gsplat-edu render", command, debug=False) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        f"gsplat-edu render: {tmp_path / 'file' / 'scene.ply'}: file {'already ' if os.name == 'nt' else ''}exists; "
        "choose another place"
    )
    assert "Errno" not in error


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.EACCES, "check its permissions"), (errno.EIO, "check the file")]
)
def test_unreadable_files_have_one_wording(number, advice):
    error = OSError(number, os.strerror(number), "elsewhere")
    assert unreadable(Path("a.bin"), error) == f"a.bin: cannot be read ({os.strerror(number)}); {advice}"
    assert "cannot be read (gone); check the file" in unreadable(Path("a.bin"), OSError("gone"))


@pytest.mark.parametrize(
    ("value", "names"),
    [
        ("a/b.jpg", True),
        ("\udcff.jpg", True),
        ("\ud800.jpg", False),
        ("a\0b", False),
        ("//server/share", False),
        (7, False),
    ],
)
def test_paths_in_files_have_only_characters_that_names_can_have(value, names):
    """A byte that is not UTF-8 is a lone surrogate from U+DC80 on in a name; no file has other surrogates."""
    assert (stored_path(value) is not None) == names


def test_a_read_allocates_no_more_than_the_file_holds(tmp_path):
    """As a decoder does for a PNG whose first piece claims 4 GiB."""
    (tmp_path / "a").write_bytes(b"abc" * 100)
    with open_file(tmp_path / "a") as file:
        file.seek(290)
        tracemalloc.start()
        found = file.read(2**32 - 1)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert found == (b"abc" * 100)[290:] and peak < 1 << 20 and file.read(1 << 30) == b""
