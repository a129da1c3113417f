"""Every kernel compiles for real GPUs, because the compiler is stricter than the interpreter. The compiler and the
assembler ship with triton, so this needs no GPU, and no kernel is run. sm_80 is an A100, sm_90 an H100.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SPILLED = 64
"""Bytes per thread that may spill to memory. A kernel that spills thousands is tens of times slower."""


@pytest.mark.own_process
@pytest.mark.parametrize(("kernels", "count"), [("gaussians", 9), ("lenses", 8), ("pixels", 4), ("loss", 6)])
@pytest.mark.parametrize(
    ("capability", "variant"),
    [
        (90, "most"),
        pytest.param(80, "least", marks=pytest.mark.soak),
        pytest.param(80, "most", marks=pytest.mark.soak),
        pytest.param(90, "least", marks=pytest.mark.soak),
    ],
)
def test_every_kernel_compiles_with_few_spills(capability, variant, kernels, count, tmp_path):
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, str(Path(__file__).with_name("compile_kernels.py"))]
    command += [str(capability), variant, kernels]
    done = subprocess.run(
        command, env=environment, check=False, capture_output=True, text=True, timeout=1_800
    )
    assert done.returncode == 0, done.stderr[-2000:]
    spills = [line.split() for line in done.stdout.splitlines()]
    assert len(spills) == count
    assert [name for name, number in spills if int(number) > SPILLED] == []
