"""Every kernel compiles for real GPUs, because the compiler is stricter than the interpreter. The compiler and the
assembler ship with triton, so this needs no GPU, and no kernel is run. sm_80 is an A100, sm_90 an H100.
"""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SPILLED = 64
"""Bytes per thread that may spill to memory. A kernel that spills thousands is tens of times slower."""

COUNTS = {"gaussians": 9, "lenses": 8, "pixels": 4, "loss": 6}
USUAL = {"gaussians": (80, "least"), "lenses": (80, "least"), "pixels": (90, "most"), "loss": (90, "most")}
"""What is compiled outside of soaks. Gaussians and lenses with all variants take a minute and more each."""

CASES = [
    pytest.param(
        *of, kernels, count, marks=() if of == USUAL[kernels] else pytest.mark.soak, id=f"{kernels}-{of}"
    )
    for kernels, count in COUNTS.items()
    for of in itertools.product((80, 90), ("least", "most"))
]


@pytest.mark.own_process
@pytest.mark.parametrize(("capability", "variant", "kernels", "count"), CASES)
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
