"""The memory of a training does not grow after its first iterations."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import soak

WARM_UP = 120
"""Iterations after which every photo size, step of the strategy and log buffer has occurred repeatedly."""

IMAGE = 320 * 240 * 3 * 4
"""Bytes of a float image of 320 x 240 px. Photos of mixed sizes have at least as many pixels on average."""


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
@pytest.mark.parametrize("case", soak.CASES)
def test_memory_is_flat_after_the_warm_up(tmp_path, case):
    """RSS grows by less than four images in 120 iterations. A leak, or an unusable hole in the heap, of one image per
    step would add 120 images. The heap may still grow by the memory that a step allocates besides the buffers, to
    decode a photo and composite it over its background. This is below 4 images, because RGBA bytes are a third of a
    float image and are held twice while they are copied.
    """
    run = [sys.executable, soak.__file__, case, str(tmp_path / "capture")]
    done = subprocess.run(run, check=False, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr[-2000:]
    resident = json.loads(done.stdout)
    assert len(resident) == soak.ITERATIONS
    growth = max(resident[WARM_UP:]) - max(resident[: WARM_UP + 1])
    assert growth < 4 * IMAGE, [round(value / 2**20, 1) for value in resident[::20]]
