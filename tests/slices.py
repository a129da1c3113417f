"""The slice of the long tests that one commit runs.

A test marked `sliced(n)` has more cases than a change should wait for: a run takes n of them, drawn by a seed that is
the commit's hash, so that the choice differs from commit to commit and is the same in every process of one run.
`sliced(n, by="is_named")` takes n for each value of that parameter. Fuzzers take the seed of their first damaged file
from the commit as well. With GSPLAT_EDU_SOAK=1 (`make soak`) every case runs. conftest.py takes the hooks from here.
"""

import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

WITHOUT_GIT = 15
"""The seed where there is no commit to take it from."""


def commit_seed(folder: Path) -> int:
    """Return the first 32 bits of the hash of the commit that is checked out in a folder."""
    try:
        words = ["git", "-C", str(folder), "rev-parse", "--verify", "HEAD"]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError:
        return WITHOUT_GIT
    return int(done.stdout[:8], 16) if done.returncode == 0 else WITHOUT_GIT


# Kept in the environment, so that the workers of pytest-xdist choose the same cases.
SEED = int(os.environ.setdefault("GSPLAT_EDU_SLICE", str(commit_seed(Path(__file__).parent))))
SOAK = os.environ.get("GSPLAT_EDU_SOAK", "") not in ("", "0")
HOW_TO_REPEAT = f"run it again with GSPLAT_EDU_SLICE={SEED} in the environment, whatever the commit"

FIRST = (
    "tests/sfm/test_reconstruct.py",
    "tests/repo/test_notebooks.py",
    "tests/sfm/test_wrong_poses.py",
    "tests/runs/test_training.py",
    "tests/gpu/test_render.py",
    "tests/viewer/test_live.py",
    "tests/repo/test_scripts.py",
    "tests/sfm/test_mapping.py",
    "tests/sfm/test_lenses.py",
    "tests/sfm/test_masks.py",
    "tests/sfm/test_photos.py",
    "tests/viewer/test_page_drawing.py",
    "tests/viewer/test_live_browser.py",
    "tests/repo/test_site.py",
    "tests/gpu/test_loss.py",
    "tests/train/test_memory.py",
    "tests/doctor/test_appearance.py",
    "tests/native/test_gradients.py",
    "tests/golden/test_chapter_trajectory.py",
    "tests/cli/test_sfm.py",
)
"""Files that take longest. A file stays in one process, so the long ones start while there are others left to share."""


def count(name: str, sliced: int, soak: int) -> int:
    """Return how many damaged files a fuzzer reads: as the variable `name` says, else those of this kind of run."""
    return int(os.environ.get(name, soak if SOAK else sliced))


def split(items: list[pytest.Item], seed: int) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Part the tests into those that run and the cases that this seed leaves out.

    Args:
        items: The collected tests.
        seed: What draws the cases.

    Returns:
        The tests to run, in their order, and the others.
    """
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if marker := item.get_closest_marker("sliced"):
            kind = item.callspec.params[marker.kwargs["by"]] if "by" in marker.kwargs else ""
            cases.setdefault(f"{item.nodeid.partition('[')[0]} {kind}", []).append(item)
    left_out: set[pytest.Item] = set()
    for name, all_of_it in cases.items():
        size = next(iter(all_of_it[0].get_closest_marker("sliced").args), len(all_of_it))
        drawn = random.Random(f"{seed} {name}").sample(all_of_it, min(size, len(all_of_it)))
        left_out |= set(all_of_it) - set(drawn)
    return [item for item in items if item not in left_out], [item for item in items if item in left_out]


def pytest_report_header() -> str:
    """Say which slice of the long tests runs."""
    return "sliced tests: every case" if SOAK else f"sliced tests: GSPLAT_EDU_SLICE={SEED}"


@pytest.hookimpl(trylast=True)  # after -k and -m
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the cases that this slice has not, and put the longest files first."""
    kept, left_out = (list(items), []) if SOAK else split(items, SEED)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
    ranks = {name: i for i, name in enumerate(FIRST)}
    items[:] = sorted(kept, key=lambda item: ranks.get(item.nodeid.partition("::")[0], len(FIRST)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Say below the failure of a sliced test how the same slice is drawn again."""
    report = yield
    if report.failed and item.get_closest_marker("sliced") and not SOAK:
        report.sections.append(("slice", HOW_TO_REPEAT))
    return report
