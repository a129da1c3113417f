"""Build the WebAssembly module src/gsplat_edu/tab/web/gsplat_edu.wasm with zig.

    python tools/build_wasm.py [--check]

It compiles native/ and wasm/ with the ziglang of the extra `dev`, a minute of processor time at first, and does nothing
if the module was made from these sources. `--check` compiles nothing, and exits with 1 if the module is missing or old.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULE = ROOT / "src" / "gsplat_edu" / "tab" / "web" / "gsplat_edu.wasm"
BUILD = ROOT / "build" / "wasm"

KERNELS = (
    *(
        "project",
        "intersect",
        "composite",
        "composite_backward",
        "project_backward",
        "ssim",
        "adam",
        "adam_backward",
    ),
    *("noise", "recolor", "screen", "sight", "surface", "surfels", "table"),
)
"""Files of native/ with the flags of kernels; CMakeLists.txt says why they have these."""

ONCE = ("native/frame", "native/loss", "native/scan", "native/sort")
OWN = ("wasm/platform", "wasm/scene", "wasm/trainer", "wasm/module")

TARGET = (
    "-target",
    "wasm32-wasi",
    "-std=c++20",
    "-msimd128",
    "-mbulk-memory",
    "-O3",
    "-fno-exceptions",
    "-fno-rtti",
)
WARNINGS = ("-Wall", "-Wextra", "-Wno-psabi", "-Werror")
MATH = ("-fno-math-errno", "-fno-trapping-math")
KERNEL_MATH = ("-fno-signed-zeros", "-ffp-contract=fast", "-DGSPLAT_ISA=wasm")

MOST_MEMORY = 65_535 << 16
"""Largest memory of a module of 32 bits; the page chooses less."""

STACK = 1 << 20
"""Bytes of the stack: kernels keep tiles and strips on it."""


class NotBuiltError(Exception):
    """The module cannot be built; the message says why."""


def sources() -> list[Path]:
    """Return every file that the module is made of."""
    found = [
        *(ROOT / "native").iterdir(),
        *(ROOT / "wasm").iterdir(),
        Path(__file__),
        ROOT / "constraints.txt",
    ]
    return sorted(path for path in found if path.is_file())


def stamp() -> str:
    """Return a digest of the sources."""
    digest = hashlib.sha256()
    for path in sources():
        digest.update(f"{path.relative_to(ROOT).as_posix()}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def is_built() -> bool:
    """Return whether the module was made from these sources."""
    mark = BUILD / "stamp"
    return MODULE.exists() and mark.exists() and mark.read_text() == stamp()


def build() -> None:
    """Compile and link the module, which replaces the last one when it is complete.

    Raises:
        NotBuiltError: zig is missing, or it refuses a source.
    """
    BUILD.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        jobs = [pool.submit(_compile, f"native/{name}", KERNEL_MATH) for name in KERNELS]
        jobs += [pool.submit(_compile, name, ()) for name in (*ONCE, *OWN)]
        objects = [job.result() for job in jobs]
    made = BUILD / "gsplat_edu.wasm"
    linked = (f"-Wl,--max-memory={MOST_MEMORY}", f"-Wl,-z,stack-size={STACK}", "-Wl,--import-memory")
    _zig("-target", "wasm32-wasi", "-mexec-model=reactor", "-s", *linked, *map(str, objects), "-o", str(made))
    made.chmod(0o644)
    MODULE.parent.mkdir(parents=True, exist_ok=True)
    partial = MODULE.with_suffix(".partial")
    partial.write_bytes(made.read_bytes())
    partial.replace(MODULE)
    (BUILD / "stamp").write_text(stamp())


def _compile(name: str, options: tuple[str, ...]) -> Path:
    made = BUILD / f"{Path(name).name}.o"
    _zig(*TARGET, *WARNINGS, *MATH, *options, "-c", f"{name}.cpp", "-o", str(made))
    return made


def _zig(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ziglang", "c++", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower() or "No module" in line]
        raise NotBuiltError(lines[0] if lines else f"zig ended with {done.returncode}: {done.stderr[-300:]}")


def main(arguments: list[str] | None = None) -> int:
    """Build the module, or check it; return the exit code."""
    parser = argparse.ArgumentParser(description="Build the WebAssembly module with zig.")
    parser.add_argument(
        "--check", action="store_true", help="compile nothing; exit with 1 if the module is missing or old"
    )
    options = parser.parse_args(arguments)
    if is_built():
        print(f"{MODULE.relative_to(ROOT)}: is up to date")
        return 0
    if options.check:
        print(
            f"{MODULE.relative_to(ROOT)}: is missing or older than its sources; run python tools/build_wasm.py"
        )
        return 1
    try:
        build()
    except NotBuiltError as error:
        print(f"build_wasm: {error}", file=sys.stderr)
        return 2
    print(f"{MODULE.relative_to(ROOT)}: {MODULE.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
