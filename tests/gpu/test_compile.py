"""Every kernel compiles for real GPUs, here, without one: the interpreter forgives what the compiler does not.

The compiler ships with triton; nothing is run. sm_80 is an A100 or any RTX 30, sm_90 an H100.
"""

import os
import subprocess
import sys

import pytest

COMPILE = """
import warnings
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from gsplat_edu.render.triton import composite, intersect, project

INTEGERS = {"n", "width", "height", "tiles_x", "W", "H"}
KINDS = {
    "pairs_of": "*i32", "tiles": "*i32", "gaussians": "*i32", "tile_begin": "*i32",
    "order": "*i64", "begin": "*i64", "slot_begin": "*i64", "perm": "*i64",
}

def build(kernel, capability, **constants):
    kinds, values = {}, {}
    for place, name in enumerate(kernel.arg_names):
        if name in constants:
            kinds[name], values[(place,)] = "constexpr", constants[name]
        else:
            kinds[name] = "i32" if name in INTEGERS else KINDS.get(name, "*fp32")
    made = compile(ASTSource(kernel, kinds, values), target=GPUTarget("cuda", capability, 32))
    assert made.asm["cubin"] and made.metadata.shared < 96 * 1024, kernel.arg_names
    print(made.metadata.name)

warnings.simplefilter("ignore")
capability = int(__import__("sys").argv[1])
for degree, rest in ((0, 0), (3, 15)):
    shape = {"DEGREE": degree, "REST": rest, "ANTIALIASED": degree == 3}
    build(project.project_kernel, capability, **shape, BLOCK=128)
    build(project.project_backward_kernel, capability, **shape, BLOCK=64)
build(intersect.count_kernel, capability, BLOCK=128)
build(intersect.emit_kernel, capability, BLOCK=128)
for both in (False, True):
    build(composite.composite_kernel, capability, WITH_DEPTH=both, BATCH=16, PRECISION="ieee")
    build(composite.composite_backward_kernel, capability, WITH_DEPTH=both, WITH_T=both, BATCH=16, PRECISION="ieee")
"""


@pytest.mark.own_process
@pytest.mark.parametrize("capability", [80, 90])
def test_every_kernel_compiles(capability, tmp_path):
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, "-c", COMPILE, str(capability)]
    done = subprocess.run(words, env=environment, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(done.stdout.split()) == 10
