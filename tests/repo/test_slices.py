"""The cases of the long tests that one run draws: some per commit, others with the next, all of them over time."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import slices

ROOT = Path(__file__).parents[2]


class Case(SimpleNamespace):
    """A stand-in for a collected test; compared by identity."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__


def cases(name, mark, values):
    """Make stand-ins with what `split` reads of collected tests: a name, a marker and parameters."""
    return [
        Case(
            nodeid=f"{name}[{i}]",
            get_closest_marker=lambda wanted: mark.mark if mark and wanted == "sliced" else None,
            callspec=SimpleNamespace(params={"value": value}),
        )
        for i, value in enumerate(values)
    ]


def names(items):
    return [item.nodeid for item in items]


def test_a_seed_draws_the_same_cases_and_all_seeds_draw_all_of_them():
    items = cases("long", pytest.mark.sliced(3), range(12)) + cases("short", None, range(4))
    drawn = [names(slices.split(items, seed)[0]) for seed in range(100)]
    assert drawn[7] == names(slices.split(items, 7)[0])
    for kept in drawn:
        assert len(kept) == 3 + 4 and kept == [name for name in names(items) if name in kept], (
            "the order is kept"
        )
        assert set(names(cases("short", None, range(4)))) <= set(kept)
    # 100 seeds miss a case with a probability of 0.75**100, below 1e-12.
    assert set().union(*drawn) == set(names(items))
    kept, left_out = slices.split(items, 7)
    assert sorted(names(kept + left_out)) == sorted(names(items))


def test_every_value_of_a_parameter_keeps_its_share():
    items = cases("named", pytest.mark.sliced(1, by="value"), [True, False, True, True, False])
    for seed in range(20):
        assert sorted(item.callspec.params["value"] for item in slices.split(items, seed)[0]) == [False, True]


def test_the_tests_of_a_group_share_what_is_drawn():
    mark = pytest.mark.sliced(2, group="long")
    items = [*cases("one", mark, range(1)), *cases("two", mark, range(2)), *cases("three", mark, range(1))]
    drawn = [names(slices.split(items, seed)[0]) for seed in range(100)]
    assert all(len(kept) == 2 for kept in drawn)
    assert set().union(*drawn) == set(names(items))


def test_tests_that_share_a_fixture_are_drawn_together():
    mark = pytest.mark.sliced(1, group="built", together=True)
    items = [
        *cases("a.py::one", mark, range(2)),
        *cases("a.py::two", mark, range(1)),
        *cases("b.py::one", mark, range(2)),
    ]
    drawn = {tuple(names(slices.split(items, seed)[0])) for seed in range(100)}
    assert drawn == {("a.py::one[0]", "a.py::one[1]", "a.py::two[0]"), ("b.py::one[0]", "b.py::one[1]")}


@pytest.mark.parametrize(("mark", "count"), [(pytest.mark.sliced(0), 0), (pytest.mark.sliced, 4)])
def test_a_test_may_run_only_in_a_soak_or_always(mark, count):
    """sliced(0) runs only in a soak. A test sliced without a number selects its own files."""
    assert len(slices.split(cases("long", mark, range(4)), 1)[0]) == count


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_the_seed_comes_from_the_commit(tmp_path):
    assert slices.commit_seed(tmp_path) == slices.WITHOUT_GIT
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    seeds = []
    for words in (
        ["init", "--quiet"],
        *[["commit", "--quiet", "--allow-empty", "-m", str(i)] for i in range(2)],
    ):
        subprocess.run([*git, *words], check=True)
        seeds.append(slices.commit_seed(tmp_path))
    assert len(set(seeds)) == 3 and seeds[0] == slices.WITHOUT_GIT
    found = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert f"{seeds[2]:08x}" == found[:8]


HOOKS = "from slices import pytest_collection_modifyitems, pytest_report_header, pytest_runtest_makereport\n"
FAILING = """
import pytest

@pytest.mark.sliced(1)
@pytest.mark.parametrize("case", range(5))
def test_long(case):
    assert case == 9
"""


@pytest.mark.own_process
def test_a_failure_says_how_to_draw_its_slice_again(tmp_path):
    """Run pytest itself with the hooks of this suite's conftest."""
    (tmp_path / "test_failing.py").write_text(FAILING)
    (tmp_path / "conftest.py").write_text(HOOKS)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:jaxtyping", str(tmp_path)]
    paths = os.environ | {"PYTHONPATH": str(ROOT / "tests")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=paths)
    assert "1 failed, 4 deselected" in done.stdout, done.stdout + done.stderr
    assert f"GSPLAT_EDU_SLICE={slices.SEED}" in done.stdout.partition("collected")[0], (
        "a run reports what it drew"
    )
    assert slices.HOW_TO_REPEAT in done.stdout


def test_the_files_that_start_first_exist():
    assert len(slices.FIRST) > 5 and [name for name in slices.FIRST if not (ROOT / name).is_file()] == []
