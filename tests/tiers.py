"""The tiers of the suite: which tests are slow, and how large a soak is.

A test is slow if it opens a browser (its fixture `browser`), or if it is marked so, because it trains to a quality,
finds the poses of photos, kills and resumes a run, builds the site, or runs a chapter or a benchmark. `make test` runs
the others, `make test-slow` the slow ones, and `.ci/run` both, whole, whatever the change.

A test marked `soak` runs in `make soak` only. Fuzzers and hypothesis try more cases there.

    GSPLAT_EDU_SOAK   1: the soak's sizes, and the tests marked `soak`
    GSPLAT_EDU_SEED   the seed of a fuzzer's first damaged file; 0 without it

conftest.py imports the hooks from here.
"""

import os

import pytest

SOAK = os.environ.get("GSPLAT_EDU_SOAK", "") not in ("", "0")
SEED = int(os.environ.get("GSPLAT_EDU_SEED", "0"))


def count(name: str, usual: int, soak: int) -> int:
    """Return how many cases a fuzzer tries.

    Args:
        name: The environment's variable that overrides the number.
        usual: The number outside soaks.
        soak: The number in `make soak`.
    """
    return int(os.environ.get(name, soak if SOAK else usual))


def pytest_report_header() -> str:
    """Report the seed, with which a soak's failure can be repeated."""
    return f"fuzzers: {'a soak' if SOAK else 'usual sizes'}, GSPLAT_EDU_SEED={SEED}"


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark a test with a browser as slow, and leave a soak's tests to soaks."""
    if "browser" in getattr(item, "fixturenames", ()):
        item.add_marker(pytest.mark.slow)
    if not SOAK and item.get_closest_marker("soak"):
        item.add_marker(pytest.mark.skip(reason="for soaks: GSPLAT_EDU_SOAK=1"))
