"""A run takes an eighth of the cases of the long tests, by commit count; eight consecutive counts take all."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

import slices

ROOT = Path(__file__).parents[2]


class Case(SimpleNamespace):
    """Stands for a collected test, and is compared by identity."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__


def cases(name, mark, values):
    """Make cases with the attributes of collected tests that `split` reads: a name, a marker and parameters."""
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


def runs(items, counts=range(8), **options):
    """Return the names of the cases that run at each of eight consecutive counts."""
    shards = slices.numbered(items)
    return [names(slices.split(items, shards, count % slices.SHARDS, **options)[0]) for count in counts]


@pytest.mark.parametrize("first", [0, 5, 860])
@pytest.mark.parametrize("size", [1, 2, 7, 8, 9, 24, 40])
@pytest.mark.parametrize("n", [1, 3])
def test_eight_consecutive_counts_run_every_case(first, size, n):
    items = cases("long", pytest.mark.sliced(n), range(size)) + cases("short", None, range(4))
    taken = runs(items, range(first, first + 8))
    assert set().union(*taken) == set(names(items))
    for kept in taken:
        assert kept == [name for name in names(items) if name in kept], "cases keep their order"
        assert set(names(cases("short", None, range(4)))) <= set(kept)
        assert min(n, size) <= len(kept) - 4 <= max(n, -(-size // 8))
    if size <= 7:
        assert any(len(kept) - 4 == min(n, size) for kept in taken)


def test_kept_and_left_out_are_all_cases():
    items = cases("long", pytest.mark.sliced(3), range(12))
    kept, left_out = slices.split(items, slices.numbered(items), 7)
    assert sorted(names(kept + left_out)) == sorted(names(items))


def test_every_value_of_a_parameter_keeps_its_share():
    items = cases("named", pytest.mark.sliced(1, by="value"), [True, False, True, True, False])
    for kept in runs(items):
        values = {items[names(items).index(name)].callspec.params["value"] for name in kept}
        assert values == {False, True}


def test_the_tests_of_a_group_share_what_is_kept():
    mark = pytest.mark.sliced(2, group="long")
    items = [*cases("one", mark, range(1)), *cases("two", mark, range(2)), *cases("three", mark, range(1))]
    taken = runs(items)
    assert all(2 <= len(kept) < 4 for kept in taken)
    assert set().union(*taken) == set(names(items))


def test_tests_that_share_a_fixture_run_together():
    mark = pytest.mark.sliced(1, group="built", together=True)
    items = [
        *cases("a.py::one", mark, range(2)),
        *cases("a.py::two", mark, range(1)),
        *cases("b.py::one", mark, range(2)),
    ]
    first, second = ("a.py::one[0]", "a.py::one[1]", "a.py::two[0]"), ("b.py::one[0]", "b.py::one[1]")
    assert set(map(tuple, runs(items))) - {first + second} == {first, second}


@pytest.mark.parametrize(("mark", "count"), [(pytest.mark.sliced(0), 0), (pytest.mark.sliced, 4)])
def test_a_test_may_run_only_in_a_soak_or_always(mark, count):
    """A test marked sliced(0) runs only in a soak. A test marked without a number selects its own files."""
    items = cases("long", mark, range(4))
    assert [len(kept) for kept in runs(items)] == [count] * 8


@pytest.mark.parametrize("n", [0, 1, 3])
def test_the_shards_of_a_soak_are_disjoint_and_hold_every_case(n):
    items = cases("long", pytest.mark.sliced(n), range(13)) + cases("wide", pytest.mark.sliced(n), range(2))
    times = Counter(name for kept in runs(items, soak=True) for name in kept)
    assert times == dict.fromkeys(names(items), 1)


def test_a_cases_shard_depends_on_no_other_test():
    """Otherwise, a case would wait longer than eight commits whenever another test is added or removed."""
    mark = pytest.mark.sliced(1, group="captures")
    items = cases("a.py::one", mark, range(5)) + cases("b.py::two", mark, range(3))
    alone = slices.numbered(items[5:])
    assert alone == {item: shard for item, shard in slices.numbered(items).items() if item in alone}


def test_a_shard_may_take_an_eighth_of_every_test(monkeypatch):
    items = cases("one", None, range(16)) + cases("two", pytest.mark.sliced(3), range(8))
    assert all(len(kept) == 16 + 1 for kept in runs(items, soak=True))
    monkeypatch.setattr(slices, "EVERY_TEST", True)
    assert Counter(name for kept in runs(items, soak=True) for name in kept) == dict.fromkeys(names(items), 1)
    assert all(len(kept) == 2 + 1 for kept in runs(items, soak=True))


def test_shard_none_runs_only_what_the_change_touches():
    items = cases("long", pytest.mark.sliced(3), range(12)) + cases("short", None, range(4))
    shards = slices.numbered(items)
    kept, _ = slices.split(items, {item: shards[item] for item in items[2:12]}, None)
    assert names(kept) == ["long[0]", "long[1]", *names(items[12:])]


def test_known_costs_are_spread_evenly():
    costs = {"a": (40.0, 1), "b": (30.0, 1), "c": (5.0, 8), "d": (10.0, 4), "e": (20.0, 3)}
    loads = [0.0] * slices.SHARDS
    for name, start in slices.balanced(costs).items():
        for i in range(costs[name][1]):
            loads[(start + i) % slices.SHARDS] += costs[name][0]
    # A shard takes 26 of 210 s on average. The longest case takes 40 s, and each shard has a case of 5 s.
    assert max(loads) == 45 and min(loads) >= 15


def test_the_tests_of_known_cost_exist():
    text = {path: (ROOT / path).read_text() for path in {key.partition("::")[0] for key in slices.SECONDS}}
    for key in slices.SECONDS:
        path, found, name = key.partition("::")
        assert f"def {name}(" in text[path] if found else "together=True" in text[path], key


HOOKS = "from slices import pytest_collection_modifyitems, pytest_report_header, pytest_runtest_makereport\n"
FAILING = """
import pytest

@pytest.mark.sliced(1)
@pytest.mark.parametrize("case", range(5))
def test_long(case):
    assert case == 9
"""


def pytest_run(folder, *words, **variables):
    """Run pytest on FAILING, with the hooks of this suite's conftest."""
    (folder / "test_failing.py").write_text(FAILING)
    (folder / "conftest.py").write_text(HOOKS)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:jaxtyping", *words]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GSPLAT_EDU_")}
    environment |= {"PYTHONPATH": str(ROOT / "tests"), "GSPLAT_EDU_SLICE": "860"} | variables
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)
    return done.stdout + done.stderr


@pytest.mark.own_process
def test_a_failure_says_how_to_repeat_its_slice(tmp_path):
    said = pytest_run(tmp_path)
    assert "1 failed, 4 deselected" in said, said
    assert "shard 4 of 0 to 7, GSPLAT_EDU_SLICE=860" in said.partition("collected")[0], said
    assert "name the test with :: to run it again; GSPLAT_EDU_SLICE=860" in said


@pytest.mark.sliced(2)
@pytest.mark.own_process
@pytest.mark.parametrize(
    ("words", "variables", "ends"),
    [
        (("test_failing.py::test_long",), {}, "5 failed"),
        (("test_failing.py::test_long[2]",), {"GSPLAT_EDU_SHARD": "none"}, "1 failed"),
        ((), {"GSPLAT_EDU_SHARD": "none"}, "5 deselected"),
        ((), {"GSPLAT_EDU_TOUCHED": "test_failing.py"}, "5 failed"),
        ((), {"GSPLAT_EDU_TOUCHED": "[3]", "GSPLAT_EDU_SHARD": "none"}, "1 failed, 4 deselected"),
        ((), {"GSPLAT_EDU_SOAK": "1"}, "5 failed"),
        ((), {"GSPLAT_EDU_SOAK": "1", "GSPLAT_EDU_SPLIT": "all"}, "5 failed"),
        ((), {"GSPLAT_EDU_SOAK": "1", "GSPLAT_EDU_SHARD": "4"}, "deselected"),
        ((), {"GSPLAT_EDU_SHARD": "8"}, "GSPLAT_EDU_SHARD is '8'; give a number from 0 to 7, or none"),
    ],
)
def test_named_touched_and_soaked_tests_run(words, variables, ends, tmp_path):
    said = pytest_run(tmp_path, *words, **variables)
    assert ends in said, said


@pytest.mark.own_process
def test_the_command_line_prints_the_shard(tmp_path):
    environment = os.environ | {"GSPLAT_EDU_SLICE": "861", "GSPLAT_EDU_SHARD": ""}
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "slices.py")],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env=environment,
    )
    assert done.stdout == "5\n"


def test_the_files_that_start_first_exist():
    assert len(slices.FIRST) > 5 and [name for name in slices.FIRST if not (ROOT / name).is_file()] == []
