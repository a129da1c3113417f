"""Every kernel compiles for real GPUs, here, without one: the interpreter forgives what the compiler does not.

The compiler and the assembler ship with triton; nothing is run. sm_80 is an A100, sm_90 an H100.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SPILLED = 64
"""Bytes per thread that may go through memory; a kernel that spills thousands is tens of times slower."""


@pytest.mark.own_process
@pytest.mark.parametrize("capability", [80, 90])
def test_every_kernel_compiles_and_fits_into_registers(capability, tmp_path):
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, str(Path(__file__).with_name("compile_kernels.py")), str(capability)]
    done = subprocess.run(words, env=environment, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    spills = [line.split() for line in done.stdout.splitlines()]
    assert len(spills) == 17
    assert [name for name, number in spills if int(number) > SPILLED] == []
