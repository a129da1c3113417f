"""Execute the chapters: notebooks/source/NN_name.py (jupytext percent) -> notebooks/NN_name.ipynb.

    python course/build_notebooks.py                      every chapter, with the full budget
    python course/build_notebooks.py 09 --out DIR         chapters whose names start with 09, into another folder
    python course/build_notebooks.py --prose 02           only the text: outputs stay, because no code has changed

A chapter's exercises are in notebooks/exercises/NN_name.py: a markdown cell for each question, behind it a code cell
with the solution. The solutions run in the kernel after the chapter's cells, and appear at the end of the notebook,
folded.

GSPLAT_EDU_BUDGET=reduced in the environment shortens the trainings. A cell that raises, or a figure without titles and
labels (course/chapter_figures.py), stops the build with exit code 1 and leaves the existing notebook unchanged.
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
EXERCISES = ROOT / "notebooks" / "exercises"
HERE = str(ROOT / "course")
STRICT_FIGURES = f"import sys; sys.path.append({HERE!r}); import chapter_figures; chapter_figures.install()"
"""Code that the kernel executes before the first cell."""

CELL_TIMEOUT = 3600  # seconds; the full training of chapter 09 takes minutes on two cores


FOLDED = """{question}

<details>
<summary>Solution</summary>

```python
{code}
```

</details>"""
"""An exercise in the notebook; blank lines end the HTML, so that Jupyter and the site highlight the code."""


def solutions(source: Path) -> list[tuple[str, str]]:
    """Read a chapter's exercises.

    Args:
        source: The chapter; its exercises have the same file name in notebooks/exercises.

    Returns:
        Question (markdown) and solution (Python) of each; empty if the chapter has none.

    Raises:
        ValueError: a question without a solution, or a solution without a question.
    """
    path = EXERCISES / source.name
    if not path.exists():
        return []
    cells = jupytext.read(path, fmt="py:percent").cells
    if [cell.cell_type for cell in cells] != ["markdown", "code"] * (len(cells) // 2):
        raise ValueError(f"{path}: write a markdown cell for each question, behind it one code cell")
    return [(ask.source, answer.source) for ask, answer in zip(cells[::2], cells[1::2], strict=True)]


def assembled(source: Path) -> nbformat.NotebookNode:
    """Return the notebook that a chapter becomes, without outputs: its cells, and its exercises folded."""
    notebook = jupytext.read(source)
    folded = [FOLDED.format(question=ask, code=answer) for ask, answer in solutions(source)]
    notebook.cells += [nbformat.v4.new_markdown_cell(text) for text in folded]
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02d}"  # random by default
        cell["metadata"] = {}  # a tag could allow a cell to raise
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"], "language_info": {"name": "python"}}
    return notebook


def execute(notebook: nbformat.NotebookNode) -> None:
    """Execute the cells of a notebook in place, with the root as their folder and strict about figures.

    Raises:
        CellExecutionError: a cell raised.
    """
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


def build(source: Path, out: Path) -> None:
    """Execute one chapter and the solutions of its exercises, and write it atomically.

    Args:
        source: The chapter, jupytext percent.
        out: Folder of the notebook.

    Raises:
        CellExecutionError: a cell or a solution raised.
        ValueError: see `solutions`.
    """
    notebook = assembled(source)
    length = len(notebook.cells)
    notebook.cells += [nbformat.v4.new_code_cell(answer) for _, answer in solutions(source)]
    execute(notebook)
    del notebook.cells[length:]
    _write(notebook, source, out)


def renew_prose(source: Path, out: Path) -> None:
    """Replace the markdown of an executed notebook and keep its outputs.

    Args:
        source: The chapter, jupytext percent.
        out: Folder with its notebook.

    Raises:
        ValueError: the code has changed since the notebook was executed, or there is no notebook.
    """
    existing = out / f"{source.stem}.ipynb"
    if not existing.exists():
        raise ValueError(f"{existing} does not exist; build it without --prose")
    notebook, executed = assembled(source), nbformat.read(existing, as_version=4)
    before = [cell for cell in executed.cells if cell.cell_type == "code"]
    after = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if [cell.source for cell in before] != [cell.source for cell in after]:
        raise ValueError(f"{source.stem}: its code has changed; build it without --prose")
    for old, new in zip(before, after, strict=True):
        new.outputs, new.execution_count = old.outputs, old.execution_count
    notebook.metadata = executed.metadata
    _write(notebook, source, out)


def _write(notebook: nbformat.NotebookNode, source: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    aside = out / f".{source.stem}.ipynb"
    nbformat.write(notebook, aside)
    aside.replace(out / f"{source.stem}.ipynb")


def main() -> int:
    """Build the requested chapters."""
    parser = argparse.ArgumentParser(description="Execute the chapters into notebooks.")
    parser.add_argument("names", nargs="*", help="beginnings of chapter names, for example 09 (default: all)")
    parser.add_argument("--prose", action="store_true", help="replace the text only; refused if code changed")
    parser.add_argument("--out", type=Path, default=ROOT / "notebooks", help="folder (default: notebooks)")
    arguments = parser.parse_args()
    chosen = tuple(arguments.names) or ("",)
    sources = [path for path in sorted(SOURCES.glob("*.py")) if path.stem.startswith(chosen)]
    if not sources:
        print(
            f"build_notebooks.py: no chapter of {SOURCES} starts with {' or '.join(chosen)}", file=sys.stderr
        )
        return 2
    for source in sources:
        start = time.perf_counter()
        print(f"{source.stem}: {'replacing the text' if arguments.prose else 'executing'}", flush=True)
        try:
            (renew_prose if arguments.prose else build)(source, arguments.out)
        except (CellExecutionError, ValueError) as error:
            print(f"build_notebooks.py: {error}", file=sys.stderr)
            return 1
        print(f"{source.stem}: done in {time.perf_counter() - start:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
