"""The tests that a change touches, in small repositories and in this one."""

import shutil
import subprocess
from pathlib import Path

import pytest

import touched

ROOT = Path(__file__).parents[2]
WITHOUT_GIT = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder, *words):
    command = ["git", "-C", str(folder), "-c", "user.name=a", "-c", "user.email=a@example.org", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def commit(folder, name):
    """Write a file and commit it."""
    (folder / name).write_text(name)
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "-m", name)


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A main branch of two commits."""
    monkeypatch.delenv("GSPLAT_EDU_BASE", raising=False)
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "--quiet", "--initial-branch", "main")
    for name in ("one", "two"):
        commit(folder, name)
    return folder


@WITHOUT_GIT
def test_on_the_main_branch_the_base_is_the_parent(repository):
    assert touched.history(repository) == touched.History(2, frozenset({"two"}))
    (repository / "one").write_text("changed")
    (repository / "new").write_text("untracked")
    assert touched.history(repository).changed == {"one", "two", "new"}


@WITHOUT_GIT
def test_on_a_branch_the_base_is_where_it_left_the_main_branch(repository):
    git(repository, "switch", "--quiet", "-c", "work")
    for name in ("three", "four"):
        commit(repository, name)
    git(repository, "mv", "one", "moved")
    assert touched.history(repository) == touched.History(4, frozenset({"three", "four", "one", "moved"}))


@WITHOUT_GIT
def test_an_amended_commit_touches_and_counts_the_same(repository):
    before = touched.history(repository)
    git(repository, "commit", "--quiet", "--amend", "-m", "another message")
    assert touched.history(repository) == before


@WITHOUT_GIT
def test_a_base_can_be_named(repository, monkeypatch):
    commit(repository, "three")
    monkeypatch.setenv("GSPLAT_EDU_BASE", "HEAD~2")
    assert touched.history(repository).changed == {"two", "three"}
    monkeypatch.setenv("GSPLAT_EDU_BASE", "nothing")
    assert touched.history(repository).missing


@WITHOUT_GIT
def test_without_history_the_shard_is_the_first_and_the_reason_is_given(repository, tmp_path):
    """A shallow clone has too few commits to count."""
    git(tmp_path, "clone", "--quiet", "--depth", "1", repository.as_uri(), "shallow")
    inside = repository / "unpacked"
    inside.mkdir()
    for folder, why in ((tmp_path / "shallow", "shallow"), (inside, "no git"), (tmp_path, "no git")):
        found = touched.history(folder)
        assert (found.count, found.changed) == (0, frozenset()) and why in found.missing, folder


def tree(folder, **files):
    """Write files; "__" in a name stands for a slash."""
    for name, text in files.items():
        path = folder / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.fixture
def project(tmp_path):
    """A package that imports a module of many users, `base`, and one of few, `ruler`; its tests have helpers."""
    packages = {f"src__gsplat_edu__p{i}__m": "import gsplat_edu.base\n" for i in range(touched.FEW + 1)}
    tree(tmp_path, **packages, src__gsplat_edu__base="", src__gsplat_edu__ruler="")
    tree(
        tmp_path,
        src__gsplat_edu__p0__n="from gsplat_edu import ruler\n",
        src__gsplat_edu__room__lamp="",
        src__gsplat_edu__p1__n="from gsplat_edu.room.lamp import x\n",
        tests__test_lamp="",
        tests__p0__test_a="from helper import x\n",
        tests__p1__test_b="from p1.near import x\n",
        tests__p1__test_c="",
        tests__p1__near="import helper\n",
        tests__p2__conftest="import fixtures\n",
        tests__p2__test_d="from gsplat_edu.base import x\n",
        tests__test_ruler="",
        tests__helper="",
        tests__fixtures="",
        tests__conftest="import helper\n",
        tests__made__city="from made.paint import x\n",
        tests__made__paint="",
        tests__p2__test_e="from made.city import x\n",
        benchmarks__blocks="from made.city import x\n",
    )
    return tmp_path


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ("tests/p1/test_c.py", ["tests/p1/test_c.py"]),
        ("tests/helper.py", ["tests/p0/test_a.py", "tests/p1/test_b.py"]),
        ("tests/p1/near.py", ["tests/p1/test_b.py"]),
        ("tests/p1/data/x.bin", ["tests/p1/test_b.py", "tests/p1/test_c.py"]),
        ("tests/p2/conftest.py", ["tests/p2/test_d.py", "tests/p2/test_e.py"]),
        ("tests/fixtures.py", ["tests/p2/test_d.py", "tests/p2/test_e.py"]),
        ("tests/made/paint.py", ["[benchmarks/blocks.py]", "tests/p2/test_e.py"]),
        ("tests/conftest.py", []),
        ("src/gsplat_edu/p1/m.py", ["tests/p1/test_b.py", "tests/p1/test_c.py"]),
        ("src/gsplat_edu/ruler.py", ["tests/p0/test_a.py", "tests/test_ruler.py"]),
        ("src/gsplat_edu/base.py", ["tests/p2/test_d.py"]),
        ("src/gsplat_edu/room/lamp.py", ["tests/p1/test_b.py", "tests/p1/test_c.py", "tests/test_lamp.py"]),
        ("notebooks/source/09_train.py", ["[09_train]"]),
        ("benchmarks/raster.py", ["[benchmarks/raster.py]"]),
        ("benchmarks/ladder/rung.h", ["[benchmarks/ladder]"]),
        ("tests/p1/test_gone.py", []),
        ("README.md", []),
    ],
)
def test_a_change_touches(changed, expected, project):
    assert sorted(touched.tests_of(project, [changed])) == expected


def test_every_package_has_tests():
    package = ROOT / "src" / "gsplat_edu"
    folders = {path.parent for path in package.glob("*/__init__.py")}
    with_tests = {folder for folder in folders if (ROOT / "tests" / folder.name).is_dir()}
    names = {f"src/gsplat_edu/{folder.name}/module.py" for folder in with_tests}
    names |= {
        path.relative_to(ROOT).as_posix()
        for folder in folders - with_tests
        for path in folder.glob("*.py")
        if path.name != "__init__.py"
    }
    assert len(names) > 30
    assert {name for name in names if not touched.tests_of(ROOT, [name])} == set()


def test_the_names_in_the_table_exist():
    for key, places in touched.ELSEWHERE.items():
        assert (ROOT / key).exists(), key
        for place in places:
            assert (ROOT / "tests" / place).exists(), place
