"""Rules for the native source files."""

import re
from pathlib import Path

import generate_constants

ROOT = Path(__file__).parents[2]
NATIVE = ROOT / "native"
ISA_FREE = {
    *("arguments.h", "bindings.cpp", "cell_cases.cpp", "structures.h"),
    *(
        f"{name}.{end}"
        for name in (
            *(
                "bindings_screen",
                "bindings_surface",
                "bindings_surfels",
                "bindings_volume",
                "buffers",
                "dispatch",
                "frame",
                "loss",
                "marching_cubes",
                "patches",
                "scan",
                "sort",
            ),
            *("system", "threads", "volume"),
        )
        for end in ("cpp", "h")
    ),
}
"""Files that are compiled once, for the oldest processor. All others are compiled once per instruction set."""


def test_the_constants_are_generated_from_constants_py():
    assert (NATIVE / "constants.h").read_text() == generate_constants.header()
    assert generate_constants.WGSL.read_text() == generate_constants.shader()


def test_only_the_bindings_include_python_and_nothing_includes_torch():
    for path in NATIVE.iterdir():
        includes = re.findall(r"#include [<\"](.*)[>\"]", path.read_text())
        assert not [i for i in includes if "torch" in i or "ATen" in i], path.name
        if not path.name.startswith("bindings") and path.name not in ("structures.h", "arguments.h"):
            assert not [i for i in includes if "nanobind" in i or "Python" in i], path.name


def test_kernel_files_include_only_c_standard_headers():
    allowed = {"math.h", "stddef.h", "stdint.h", "string.h", "immintrin.h", "arm_neon.h"}
    files = [path for path in NATIVE.iterdir() if path.name not in ISA_FREE]
    assert len(files) > 8
    for path in files:
        assert set(re.findall(r"#include <(.*)>", path.read_text())) <= allowed, path.name


def test_only_one_file_asks_the_operating_system():
    """A port to another system then changes only that file."""
    asked = re.compile(
        r"#include <(pthread|unistd|time|sys/.*|windows|malloc)\.h>|\b(aligned_alloc|getpid|_WIN32|__APPLE__)\b"
    )
    found = {path.name for path in NATIVE.iterdir() if asked.search(path.read_text())}
    assert found == {"system.cpp"}
