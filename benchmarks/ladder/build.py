"""Compile a rung of the ladder once, on the machine that runs it."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from gsplat_edu.base.constants import LAMBDA_FLOOR
from gsplat_edu.base.errors import BackendUnavailableError

HERE = Path(__file__).resolve().parent
NATIVE = HERE.parents[1] / "native"
CACHE = HERE.parents[1] / "build" / "ladder"
"""Compiled libraries, named by a hash of everything that affects them; safe to delete."""

# As in CMakeLists.txt. Without -ffast-math, which would remove the rounding inside exp2.
FLAGS = (
    "-O3",
    "-std=c++20",
    "-shared",
    "-fPIC",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
)
FLAGS += (
    "-ffp-contract=fast",
    "-Wall",
    "-Wextra",
    "-Wno-psabi",
    f"-I{NATIVE}",
    f"-DLAMBDA_FLOOR={LAMBDA_FLOOR}f",
)
HERE_ONLY = (
    ("-march=native", "-mprefer-vector-width=512") if platform.machine() in ("x86_64", "AMD64") else ()
)


@functools.cache
def library(source: str) -> ctypes.CDLL:
    """Load the library of benchmarks/ladder/<source>.cpp; compile it first if necessary.

    Args:
        source: Name of the file without its suffix.

    Raises:
        BackendUnavailableError: there is no C++ compiler, or it rejects the file.
    """
    compiler = _compiler()
    command = [*compiler, *FLAGS, *HERE_ONLY, str(HERE / f"{source}.cpp")]
    texts = [
        path.read_text()
        for path in (HERE / f"{source}.cpp", *sorted(HERE.glob("*.h")), NATIVE / "constants.h")
    ]
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout
    key = hashlib.sha256("\0".join([*texts, *command, version, _processor()]).encode()).hexdigest()
    built = CACHE / f"{source}-{key[:16]}.so"
    if not built.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE) as aside:
            made = Path(aside) / built.name
            done = subprocess.run([*command, "-o", str(made)], capture_output=True, text=True, check=False)
            if done.returncode:
                raise BackendUnavailableError(
                    f"benchmarks/ladder/{source}.cpp: {compiler[0]} does not compile it; it needs GCC 12 or Clang 18\n"
                    f"{done.stderr}"
                )
            made.replace(built)
    return ctypes.CDLL(str(built))


def _compiler() -> list[str]:
    asked = shlex.split(os.environ.get("CXX", ""))
    for words in [asked] if asked else [["c++"], ["g++"], ["clang++"]]:
        if found := shutil.which(words[0]):
            return [found, *words[1:]]
    wanted = f"CXX={' '.join(asked)} is not there" if asked else "no C++ compiler here"
    raise BackendUnavailableError(f"benchmarks/ladder: {wanted}; install g++ 12 or clang 18, or set CXX")


def _processor() -> str:
    """Return what -march=native depends on, so that a library built on another machine is not used."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    features = [line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))]
    return "\n".join([platform.machine(), *dict.fromkeys(features)])
