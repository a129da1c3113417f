"""Execute the chapters: notebooks/source/NN_name.py (jupytext percent) -> notebooks/NN_name.ipynb.

    python tools/build_notebooks.py                      every chapter, with the full budget
    python tools/build_notebooks.py 09 --out DIR         chapters whose names start with 09, into another folder
    python tools/build_notebooks.py --shard 3            an eighth of the chapters

GSPLAT_EDU_BUDGET=reduced in the environment shortens the trainings. A cell that raises, or a figure without titles and
labels (tools/chapter_figures.py), stops the build with exit code 1 and leaves the existing notebook unchanged.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "notebooks" / "source"
TOOLS = str(ROOT / "tools")
STRICT_FIGURES = f"import sys; sys.path.append({TOOLS!r}); import chapter_figures; chapter_figures.install()"
"""Code that the kernel executes before the first cell."""

CELL_TIMEOUT = 3600  # seconds; the full training of chapter 09 takes minutes on two cores


def build(source: Path, out: Path) -> None:
    """Execute one chapter and write it atomically.

    Args:
        source: The chapter, jupytext percent.
        out: Folder of the notebook.

    Raises:
        CellExecutionError: a cell raised.
    """
    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02d}"  # random by default
        cell["metadata"] = {}  # a tag could allow a cell to raise
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"], "language_info": {"name": "python"}}
    NotebookClient(
        notebook,
        timeout=CELL_TIMEOUT,
        record_timing=False,
        extra_arguments=[
            "--IPKernelApp.log_level=40",  # errors only; otherwise it warns about its own local port
            f"--IPKernelApp.exec_lines={STRICT_FIGURES}",
        ],
        resources={"metadata": {"path": str(ROOT)}},
    ).execute()
    out.mkdir(parents=True, exist_ok=True)
    aside = out / f".{source.stem}.ipynb"
    nbformat.write(notebook, aside)
    aside.replace(out / f"{source.stem}.ipynb")


def main() -> int:
    """Build the requested chapters."""
    parser = argparse.ArgumentParser(description="Execute the chapters into notebooks.")
    parser.add_argument("names", nargs="*", help="beginnings of chapter names, for example 09 (default: all)")
    parser.add_argument("--shard", type=int, choices=range(8), help="every eighth chapter, from this one on")
    parser.add_argument("--out", type=Path, default=ROOT / "notebooks", help="folder (default: notebooks)")
    arguments = parser.parse_args()
    chosen = tuple(arguments.names) or ("",)
    sources = [path for path in sorted(SOURCES.glob("*.py")) if path.stem.startswith(chosen)]
    if not sources:
        print(
            f"build_notebooks.py: no chapter of {SOURCES} starts with {' or '.join(chosen)}", file=sys.stderr
        )
        return 2
    if arguments.shard is not None:
        sources = sources[arguments.shard :: 8]
    for source in sources:
        start = time.perf_counter()
        print(f"{source.stem}: executing", flush=True)
        try:
            build(source, arguments.out)
        except CellExecutionError as error:
            print(error, file=sys.stderr)
            return 1
        print(f"{source.stem}: done in {time.perf_counter() - start:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
