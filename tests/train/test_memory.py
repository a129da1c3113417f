"""Training takes as much memory in its last iteration as in its first ones."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import soak

WARM_UP = 120
"""Iterations until every size of photo, every strategy's work and the log's buffers have been there several times."""

IMAGE = 320 * 240 * 3 * 4
"""Bytes of a float image of the smaller kind; the photos of mixed sizes have as many pixels or more, on average."""


@pytest.mark.sliced(1)
@pytest.mark.own_process
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
@pytest.mark.parametrize("case", soak.CASES)
def test_memory_is_flat_after_the_warm_up(tmp_path, case):
    """RSS grows by less than four images in 120 iterations.

    What is kept per step, or makes a hole per step that nothing fits into, has the size of an image: 120 of them.
    The heap may still settle by what a single step takes from it besides the buffers: a photo as it is decoded and put
    over its background, which is below 4 images (bytes: RGBA a third of a float image, twice while it is copied).
    """
    run = [sys.executable, soak.__file__, case, str(tmp_path / "capture")]
    done = subprocess.run(run, check=False, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-2000:]
    resident = json.loads(done.stdout)
    assert len(resident) == soak.ITERATIONS
    growth = max(resident[WARM_UP:]) - max(resident[: WARM_UP + 1])
    assert growth < 4 * IMAGE, [round(value / 2**20, 1) for value in resident[::20]]
