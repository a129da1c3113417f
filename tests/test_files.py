import os
import stat

import pytest

from gsplat_edu import ArgumentError
from gsplat_edu.files import check_writable, written_aside


def test_parents_are_made_and_the_file_appears_whole(tmp_path):
    path = tmp_path / "a" / "b" / "c.txt"
    with written_aside(path) as aside:
        aside.write_text("new")
        assert not path.exists() and aside.parent == path.parent and aside.suffix == ".txt"
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


def test_permissions_are_those_of_any_new_file(tmp_path):
    old = os.umask(0o022)
    try:
        with written_aside(tmp_path / "x") as aside:
            aside.write_text("")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == 0o644


def test_a_failure_leaves_what_was_there(tmp_path):
    path = tmp_path / "x"
    path.write_text("old")
    with pytest.raises(RuntimeError), written_aside(path) as aside:
        aside.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_check_writable_says_why_not(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ArgumentError, match=r"^--out: cannot write .*; choose another place$"):
        check_writable("--out", tmp_path / "file" / "x.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ArgumentError, match="is a folder"):
        check_writable("--out", tmp_path / "folder.png")
    check_writable("--out", tmp_path / "new" / "x.png")
    assert list((tmp_path / "new").iterdir()) == []
