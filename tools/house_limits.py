"""Check the size limits of the code: lines per file, lines per function, parameters per function.

    python tools/house_limits.py [FOLDER ...]

Prints one line per violation and exits with 1 if there is any. An exception needs a reason in EXCEPTIONS.
Parameters of Triton kernels are not counted.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

MAX_FILE_LINES = 800
MAX_FUNCTION_LINES = 60
MAX_PARAMETERS = 8

FOLDERS = (
    *("src", "native", "tests", "tools", "course", "train"),
    *("lab", "benchmarks", "conformance", "notebooks"),
)
SUFFIXES = {".py", ".cpp", ".h", ".js", ".sh"}

EXCEPTIONS = {
    "src/gsplat_edu/render/numpy_reference.py:render_gaussians": (
        "the chapter's seven parameters stay as they are; four more make it the kernels' oracle"
    ),
    "src/gsplat_edu/compat/gsplat.py:rasterization": "gsplat's signature",
    "src/gsplat_edu/compat/tiles.py:isect_tiles": "gsplat's signature",
    "src/gsplat_edu/compat/tiles.py:rasterize_to_pixels": "gsplat's signature",
    "src/gsplat_edu/compat/projection.py:fully_fused_projection": "gsplat's signature",
    "src/gsplat_edu/compat/surfels.py:fully_fused_projection_2dgs": "gsplat's signature",
    "src/gsplat_edu/compat/surfels.py:rasterization_2dgs": "gsplat's signature",
    "src/gsplat_edu/compat/surfel_images.py:rasterize_to_pixels_2dgs": "gsplat's signature",
}
"""Functions that may have more parameters, with the reason."""


def breaches(path: Path, name: str) -> Iterator[str]:
    """Yield one line for each violation in a file.

    Args:
        path: The file.
        name: Its path relative to the root.
    """
    text = path.read_text(encoding="utf-8")
    lines = text.count("\n")
    if lines > MAX_FILE_LINES:
        yield f"{name}: {lines} lines, at most {MAX_FILE_LINES}; split it"
    if path.suffix != ".py":
        return
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        length = (node.end_lineno or node.lineno) - node.lineno + 1
        if length > MAX_FUNCTION_LINES:
            yield f"{name}:{node.lineno} {node.name}: {length} lines, at most {MAX_FUNCTION_LINES}; split it"
        count = 0 if _is_kernel(node) else _parameters(node)
        if count > MAX_PARAMETERS and f"{name}:{node.name}" not in EXCEPTIONS:
            yield f"{name}:{node.lineno} {node.name}: {count} parameters, at most {MAX_PARAMETERS}"


def _is_kernel(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Return whether Triton compiles a function; such kernels take pointers, which cannot be bundled."""
    return any(ast.unparse(decorator) == "triton.jit" for decorator in node.decorator_list)


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    return len([n for i, n in enumerate(names) if not (i == 0 and n in ("self", "cls"))])


def main(folders: list[str]) -> int:
    """Check every file below the folders and print the violations."""
    root = Path(__file__).resolve().parent.parent
    found_files = (
        f for folder in folders for f in sorted((root / folder).rglob("*")) if f.suffix in SUFFIXES
    )
    files = [f for f in found_files if "node_modules" not in f.parts]
    found = [line for file in files for line in breaches(file, file.relative_to(root).as_posix())]
    print("\n".join(found) if found else f"{len(files)} files are within the limits")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or list(FOLDERS)))
