"""The slice of the long tests that one commit runs.

A test marked `sliced(n)` has more cases than a change should wait for: a run takes n of them, drawn by a seed that is
the commit's hash, so that the choice differs from commit to commit and is the same in every process of one run. Fuzzers
take the seed of their first damaged file from it. With GSPLAT_EDU_SOAK=1 (`make soak`) every case runs.
"""

import os
import random
import subprocess
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
        if item.get_closest_marker("sliced"):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    left_out: set[pytest.Item] = set()
    for name, all_of_it in cases.items():
        (size,) = all_of_it[0].get_closest_marker("sliced").args or (len(all_of_it),)
        drawn = random.Random(f"{seed} {name}").sample(all_of_it, min(size, len(all_of_it)))
        left_out |= set(all_of_it) - set(drawn)
    return [item for item in items if item not in left_out], [item for item in items if item in left_out]
