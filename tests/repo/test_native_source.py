"""What the native source promises about itself."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
NATIVE = ROOT / "native"
ISA_FREE = {
    *("arguments.h", "bindings.cpp"),
    *(
        f"{name}.{end}"
        for name in ("buffers", "dispatch", "frame", "loss", "sort", "threads")
        for end in ("cpp", "h")
    ),
}
"""Compiled once, for the oldest machine; all others are compiled once per instruction set."""


def test_the_constants_header_is_made_from_constants_py():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "tools" / "generate_constants.py")
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    assert (NATIVE / "constants.h").read_text() == generate.header()


def test_only_the_bindings_know_python_and_nothing_knows_torch():
    for path in NATIVE.iterdir():
        includes = re.findall(r"#include [<\"](.*)[>\"]", path.read_text())
        assert not [i for i in includes if "torch" in i or "ATen" in i], path.name
        if path.name not in ("bindings.cpp", "arguments.h"):
            assert not [i for i in includes if "nanobind" in i or "Python" in i], path.name


def test_kernel_files_include_nothing_of_the_standard_library_but_c():
    allowed = {"math.h", "stdint.h", "string.h", "immintrin.h"}
    files = [path for path in NATIVE.iterdir() if path.name not in ISA_FREE]
    assert len(files) > 8
    for path in files:
        assert set(re.findall(r"#include <(.*)>", path.read_text())) <= allowed, path.name
