"""Compile kernels for a GPU, which this machine may lack: compile_kernels.py CAPABILITY least|most
gaussians|lenses|pixels|loss

Kernels that have variants are compiled without their options (least) or with all of them (most), for the pinhole and
for lenses.

Prints the name of each kernel and the bytes per thread that it spills from registers, as the assembler reports.
test_compile.py runs this in a new process, because importing a kernel fixes the choice of the interpreter.
"""

import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

from triton.backends import nvidia
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile as compiled

from gsplat_edu.render.cuda import adam, composite, intersect, loss, project, sight

INTEGERS = {"n", "width", "height", "tiles_x", "W", "H"}
KINDS = {
    **dict.fromkeys(("pairs_of", "tiles", "gaussians", "tile_begin"), "*i32"),
    **dict.fromkeys(("order", "begin", "slot_begin", "perm"), "*i64"),
}
FLOATS = "*fp32"
SIZE = ("i32", "i32")
CAPABILITY, MOST = int(sys.argv[1]), sys.argv[2] == "most"


def spilled(ptx: str) -> int:
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "kernel.ptx"
        file.write_text(ptx)
        for tool in sorted((Path(nvidia.__file__).parent / "bin").glob("ptxas*")):
            architecture = f"-arch=sm_{CAPABILITY}{'a' if CAPABILITY == 90 else ''}"
            command = [tool, "-v", architecture, file, "-o", file.with_suffix(".cubin")]
            done = subprocess.run(command, check=False, capture_output=True, text=True)
            if done.returncode == 0:
                return sum(int(number) for number in re.findall(r"(\d+) bytes spill", done.stderr))
    raise RuntimeError(done.stderr)


def build(kernel, kinds, constants=None, warps=4) -> None:
    places = {
        (place,): constants[name] for place, name in enumerate(kernel.arg_names) if name in (constants or {})
    }
    source = ASTSource(kernel, kinds | dict.fromkeys(constants or {}, "constexpr"), places)
    made = compiled(source, target=GPUTarget("cuda", CAPABILITY, 32), options={"num_warps": warps})
    assert made.asm["cubin"] and made.metadata.shared < 96 * 1024, made.metadata.name
    print(made.metadata.name, spilled(made.asm["ptx"]))


def stage(kernel, warps=4, **constants) -> None:
    kinds = {name: "i32" if name in INTEGERS else KINDS.get(name, FLOATS) for name in kernel.arg_names}
    kinds |= {"most": "fp32"} if "most" in kinds else {}
    build(kernel, kinds, constants, warps)


def main() -> None:
    warnings.simplefilter("ignore")
    {"gaussians": of_gaussians, "lenses": of_lenses, "pixels": of_pixels, "loss": of_loss}[sys.argv[3]]()


def of_gaussians() -> None:
    shape = {"DEGREE": 3 * MOST, "REST": 15 * MOST, "ANTIALIASED": MOST, "DILATION": 0.3}
    for lens in (0, 1 + MOST):  # with motion blur
        stage(project.project_kernel, **shape, LENS=lens, WRAPS=lens > 0 and MOST, BLOCK=128)
        stage(
            project.project_backward_kernel, 2, **shape, LENS=lens, WITH_CAMERA=MOST and lens == 0, BLOCK=64
        )
        stage(intersect.count_kernel, WRAPS=lens > 0, BLOCK=128)
        stage(intersect.emit_kernel, WRAPS=lens > 0, BLOCK=128)
    arrays = dict.fromkeys(("parameter", "m", "v", "gradient"), FLOATS)
    build(adam.adam_kernel, {**arrays, "count": "i32", "numbers": ("fp32",) * 8})


def of_lenses() -> None:
    """Every projection: plain and at rest, or with a rolling shutter, blur and, if it can, all terms and bounds."""
    for number in range(4):
        optics = number + 32 * (number % 2) + (16 + 128 + 12 * (number < 2) + 64 * (number == 0)) * MOST
        stage(sight.sight_kernel, 2, OPTICS=optics, BLOCK=64)
        stage(sight.sight_backward_kernel, 2, OPTICS=optics, WITH_CAMERA=MOST, BLOCK=64)


def of_pixels() -> None:
    for wraps in (False, True):
        depths = {"WITH_DEPTH": MOST, "WITH_MEDIAN": MOST, "PRECISION": "ieee"}
        stage(composite.composite_kernel, **depths, WRAPS=wraps, BATCH=16)
        stage(composite.composite_backward_kernel, 8, WITH_DEPTH=MOST, WITH_T=MOST, WRAPS=wraps, BATCH=16)


def of_loss() -> None:
    image = {"image": FLOATS, "target": "*u8", "planes": FLOATS}
    sums = {"sums": FLOATS, "size": SIZE}
    build(loss.moments_kernel, image | {"size": SIZE, "scale": "fp32"}, warps=16)
    build(loss.similarity_kernel, {"planes": FLOATS, "maps": FLOATS, **sums, "each": "fp32"}, warps=16)
    build(loss.maps_kernel, {"maps": FLOATS, "planes": FLOATS, "size": SIZE}, warps=16)
    last = {**image, "gradient": FLOATS, **sums, "numbers": ("fp32", "fp32", "fp32")}
    build(loss.gradient_kernel, last, warps=16)
    build(loss.gradient_kernel, last, {"planes": None}, warps=16)
    build(loss.add_kernel, {"sums": FLOATS, "count": "i32", "total": FLOATS})


if __name__ == "__main__":
    main()
