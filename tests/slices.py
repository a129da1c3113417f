"""The slice of the long tests that one commit runs.

A test marked `sliced(n)` has more cases than a change should wait for. A run draws n of them with the commit's hash as
seed, so the choice varies between commits and is the same in all processes of a run. `sliced(n, by="is_named")` draws n
for each value of that parameter, and tests marked `sliced(n, group="name")` share their n. With `together=True`, the
tests of a file that are marked for a group count as one case, because they share an expensive fixture. Fuzzers also
derive the seed of their first damaged file from the commit. With GSPLAT_EDU_SOAK=1 (`make soak`) every case runs.
conftest.py imports the hooks from here.
"""

import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

WITHOUT_GIT = 15
"""The seed if there is no commit."""


def commit_seed(folder: Path) -> int:
    """Return the first 32 bits of the hash of the commit checked out in a folder."""
    try:
        command = ["git", "-C", str(folder), "rev-parse", "--verify", "HEAD"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return WITHOUT_GIT
    return int(done.stdout[:8], 16) if done.returncode == 0 else WITHOUT_GIT


# Stored in the environment, so that the workers of pytest-xdist draw the same cases.
SEED = int(os.environ.setdefault("GSPLAT_EDU_SLICE", str(commit_seed(Path(__file__).parent))))
SOAK = os.environ.get("GSPLAT_EDU_SOAK", "") not in ("", "0")
HOW_TO_REPEAT = f"set GSPLAT_EDU_SLICE={SEED} in the environment to run it again on any commit"

FIRST = (
    "tests/repo/test_site.py",
    "tests/repo/test_notebooks.py",
    "tests/studio/test_page.py",
    "tests/studio/test_server.py",
    "tests/viewer/test_edit_page.py",
    "tests/viewer/test_page_drawing.py",
    "tests/viewer/test_live_browser.py",
    "tests/sfm/test_panoramas.py",
    "tests/runs/test_training.py",
    "tests/runs/test_processes.py",
    "tests/repo/test_wheels.py",
    "tests/train/test_batches.py",
    "tests/gpu/test_training.py",
    "tests/blocks/test_cluster.py",
    "tests/blocks/test_runs.py",
    "tests/sfm/test_training.py",
    "tests/viewer/test_page_controls.py",
    "tests/viewer/test_edit_page.py",
    "tests/viewer/test_edit_by_hand.py",
    "tests/repo/test_scripts.py",
    "tests/gpu/test_compile.py",
    "tests/sfm/test_reconstruct.py",
    "tests/native/test_gradients.py",
    "tests/golden/test_chapter_trajectory.py",
    "tests/budget/test_plan.py",
    "tests/cli/test_train_3d.py",
    "tests/native/test_robustness.py",
    "tests/viewer/test_live.py",
    "tests/sfm/test_video.py",
    "tests/doctor/test_cameras.py",
    "tests/doctor/test_appearance.py",
    "tests/cli/test_doctor.py",
    "tests/gpu/test_render.py",
    "tests/runs/test_extension.py",
    "tests/cli/test_view.py",
)
"""The slowest files. Each runs in one process, so the slow ones start first, while others remain to be shared out."""


def count(name: str, sliced: int, soak: int) -> int:
    """Return how many damaged files a fuzzer reads: the variable `name` if set, else by the kind of run."""
    return int(os.environ.get(name, soak if SOAK else sliced))


def split(items: list[pytest.Item], seed: int) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Split the tests into those to run and the cases that this seed leaves out.

    Args:
        items: The collected tests.
        seed: The seed for drawing the cases.

    Returns:
        The tests to run, in their original order, and the others.
    """
    groups: dict[str, dict[str, list[pytest.Item]]] = {}
    sizes: dict[str, int] = {}
    for item in items:
        if marker := item.get_closest_marker("sliced"):
            kind = item.callspec.params[marker.kwargs["by"]] if "by" in marker.kwargs else ""
            name = f"{marker.kwargs.get('group', item.nodeid.partition('[')[0])} {kind}"
            case = item.nodeid.partition("::")[0] if marker.kwargs.get("together") else item.nodeid
            groups.setdefault(name, {}).setdefault(case, []).append(item)
            if marker.args:
                sizes[name] = marker.args[0]
    left_out: set[pytest.Item] = set()
    for name, cases in groups.items():
        drawn = random.Random(f"{seed} {name}").sample(
            list(cases), min(sizes.get(name, len(cases)), len(cases))
        )
        left_out |= {item for case, tests in cases.items() if case not in drawn for item in tests}
    return [item for item in items if item not in left_out], [item for item in items if item in left_out]


def pytest_report_header() -> str:
    """Report which slice of the long tests runs."""
    return "sliced tests: every case" if SOAK else f"sliced tests: GSPLAT_EDU_SLICE={SEED}"


@pytest.hookimpl(trylast=True)  # after -k and -m
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the cases outside this slice, and put the slowest files first."""
    kept, left_out = (list(items), []) if SOAK else split(items, SEED)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
    ranks = {name: i for i, name in enumerate(FIRST)}
    items[:] = sorted(kept, key=lambda item: ranks.get(item.nodeid.partition("::")[0], len(FIRST)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Add instructions for repeating the slice to the report of a failed sliced test."""
    report = yield
    if report.failed and item.get_closest_marker("sliced") and not SOAK:
        report.sections.append(("slice", HOW_TO_REPEAT))
    return report
