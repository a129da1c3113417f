"""The module offers the instruction sets of this machine."""

import platform
import re
from pathlib import Path

import pytest

from gsplat_edu import _native

LEVELS = {
    "v2": "cx16 lahf_lm popcnt pni sse4_1 sse4_2 ssse3",
    "v3": "abm avx avx2 bmi1 bmi2 f16c fma movbe xsave",
    "v4": "avx512bw avx512cd avx512dq avx512f avx512vl",
}
"""Linux's names for the features that each level of the x86-64 psABI adds."""


@pytest.mark.skipif(
    not Path("/proc/cpuinfo").exists() or platform.machine() != "x86_64", reason="Linux on x86-64 only"
)
def test_the_instruction_sets_are_those_that_the_system_reports():
    flags = set(re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.M)[1].split())
    offered = []
    for name, needed in LEVELS.items():
        if not set(needed.split()) <= flags:
            break
        offered.append(name)
    assert _native.isas() == offered
