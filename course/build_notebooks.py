"""Execute the chapters: notebooks/source/NN_name.py (jupytext percent) -> notebooks/NN_name.ipynb.

    python course/build_notebooks.py                      every chapter, with the full budget
    python course/build_notebooks.py 09 --out DIR         chapters whose names start with 09, into another folder
    python course/build_notebooks.py --prose 02           text and exercises: the outputs stay

A chapter's exercises are in notebooks/solutions/NN_name.py: a markdown cell for each question, behind it a code cell
with the solution and one that checks it; an open one has another answer in a further cell. The notebook gets the
question, the names and signatures of the solution, and the check. Behind the chapter's cells the build runs every check
on the answers, and on others that it must refuse.

An assignment's answers are in notebooks/solutions/assignments; `--assignments` writes its file without them to
notebooks/assignments.

GSPLAT_EDU_BUDGET=reduced in the environment shortens the trainings. A cell that raises, or a figure without titles and
labels (course/chapter_figures.py), stops the build with exit code 1 and leaves the existing notebook unchanged.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "notebooks" / "source"
SOLUTIONS = ROOT / "notebooks" / "solutions"
ASSIGNMENTS = ROOT / "notebooks" / "assignments"
HERE = str(ROOT / "course")
STRICT_FIGURES = f"import sys; sys.path.append({HERE!r}); import chapter_figures; chapter_figures.install()"
"""Code that the kernel executes before the first cell."""

CELL_TIMEOUT = 3600  # seconds; the full training of chapter 09 takes minutes on two cores


class Exercise(NamedTuple):
    """An exercise of a chapter.

    Attributes:
        question: Markdown.
        solution: Python that defines what the question asks for.
        check: Python that raises unless the solution's names have the properties that were asked for.
        other: Python of an answer that differs and is right as well; empty if there is none.
    """

    question: str
    solution: str
    check: str
    other: str = ""


CHECKED = '{check}\nprint("Exercise {number} is solved.")'
"""The cell behind a reader's answer."""

SOLVED = "One solution of each exercise is in [solutions/{name}](solutions/{name})."
"""The end of a notebook."""

REFUSED = """def refuses(code):
    try:
        exec(code, dict(globals()))
    except Exception:
        return True
    return False


assert refuses({code!r}), {complaint!r}
"""
"""A cell of the build: code with a wrong answer has to raise."""

CONSTANTS = ("None", "0.0", "1.0", "True")
"""Answers that no check may accept."""


def exercises(source: Path) -> list[Exercise]:
    """Read a chapter's exercises.

    Args:
        source: The chapter; its exercises have the same file name in notebooks/solutions.

    Raises:
        ValueError: the cells are not questions, each with a solution and a check behind it.
    """
    path = SOLUTIONS / source.name
    if not path.exists():
        return []
    cells = jupytext.read(path, fmt="py:percent").cells
    kinds = "".join(cell.cell_type[0] for cell in cells)
    if not re.fullmatch("(mccc?)*", kinds):
        raise ValueError(
            f"{path}: write a markdown cell for each question, behind it one code cell with the solution and one that "
            "checks it; then one with another answer, if there is one"
        )
    texts = [cell.source for cell in cells]
    return [Exercise(*texts[found.start() : found.end()]) for found in re.finditer("mc+", kinds)]


def stub(solution: str, value: str | None = None) -> str:
    """Return what a reader begins with: the solution's imports, names and signatures without what they are.

    Args:
        solution: Python: imports, assignments to a name, and functions.
        value: Code of a constant which the names are, and which the functions return; by default, names are `...`
            and functions raise NotImplementedError.

    Raises:
        ValueError: the solution has another statement, whose stub would be unclear.
    """
    lines = []
    for node in ast.parse(solution).body:
        match node:
            case ast.Import() | ast.ImportFrom():
                lines.append(ast.unparse(node))
            case ast.Assign(targets=[ast.Name(name)]):
                lines.append(f"{name} = {value or '...'}")
            case ast.FunctionDef(name):
                node.body = node.body[:1] if ast.get_docstring(node) else []
                node.body += ast.parse(
                    f"return {value}" if value else f"raise NotImplementedError({f'write {name}'!r})"
                ).body
                lines.append(f"\n\n{ast.unparse(node)}" if lines else ast.unparse(node))
            case _:
                raise ValueError(f"a solution has imports, names and functions, not: {ast.unparse(node)}")
    return "\n".join(lines)


def assembled(source: Path) -> nbformat.NotebookNode:
    """Return the notebook that a chapter becomes, without outputs: its cells, then those of its exercises."""
    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02d}"  # random by default
        cell["metadata"] = {}  # a tag could allow a cell to raise
    asked = exercises(source)
    for number, exercise in enumerate(asked, 1):
        check = CHECKED.format(check=exercise.check, number=number)
        notebook.cells += [
            nbformat.v4.new_markdown_cell(exercise.question, id=f"exercise-{number}-question"),
            nbformat.v4.new_code_cell(stub(exercise.solution), id=f"exercise-{number}-answer"),
            nbformat.v4.new_code_cell(check, id=f"exercise-{number}-check"),
        ]
    if asked:
        text = SOLVED.format(name=source.name)
        notebook.cells.append(nbformat.v4.new_markdown_cell(text, id="exercise-solutions"))
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"], "language_info": {"name": "python"}}
    return notebook


def template(solution: str) -> str:
    """Return an assignment without the answers: its functions raise NotImplementedError behind their docstrings."""
    lines = solution.splitlines()
    functions = [node for node in ast.parse(solution).body if isinstance(node, ast.FunctionDef)]
    for node in reversed(functions):
        begin = node.body[0].end_lineno if ast.get_docstring(node) else node.lineno
        lines[begin : node.end_lineno] = [f'    raise NotImplementedError("write {node.name}")']
    return "\n".join(lines) + "\n"


def write_assignments() -> None:
    """Write notebooks/assignments: the files of notebooks/solutions/assignments without the answers."""
    for path in sorted((SOLUTIONS / "assignments").glob("*.py")):
        (ASSIGNMENTS / path.name).write_text(template(path.read_text("utf-8")), "utf-8")


def executed(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """Return the cells of a chapter's notebook that the build executes: its code, without that of the exercises."""
    return [cell for cell in notebook.cells if cell.cell_type == "code" and cell["id"].startswith("cell-")]


def proofs(source: Path) -> list[str]:
    """Return code that runs behind a chapter: checks refuse empty and constant answers, and accept the others."""
    code = []
    for number, (_, solution, check, other) in enumerate(exercises(source), 1):
        for value in (None, *CONSTANTS):
            complaint = f"the check of exercise {number} accepts {value or 'the stub'} as an answer"
            code.append(REFUSED.format(code=f"{stub(solution, value)}\n{check}", complaint=complaint))
        code += [solution, check, *([other, check] if other else [])]
    return code


def execute(notebook: nbformat.NotebookNode, folder: Path = ROOT) -> None:
    """Execute the cells of a notebook in place, strict about figures.

    Args:
        notebook: The notebook.
        folder: The kernel's folder.

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
        resources={"metadata": {"path": str(folder)}},
    ).execute()


def build(source: Path, out: Path, folder: Path = ROOT) -> None:
    """Execute one chapter and the proofs of its exercises, and write it atomically.

    Args:
        source: The chapter, jupytext percent.
        out: Folder of the notebook.
        folder: The kernel's folder.

    Raises:
        CellExecutionError: a cell or a proof raised.
        ValueError: see `exercises`.
    """
    notebook = assembled(source)
    whole = notebook.cells
    kept = [cell for cell in whole if cell["id"].startswith("cell-")]
    notebook.cells = kept + [nbformat.v4.new_code_cell(code) for code in proofs(source)]
    execute(notebook, folder)
    notebook.cells = kept + whole[len(kept) :]
    _write(notebook, source, out)


def renew_prose(source: Path, out: Path) -> None:
    """Replace the markdown and the exercises of an executed notebook and keep its outputs.

    Args:
        source: The chapter, jupytext percent.
        out: Folder with its notebook.

    Raises:
        ValueError: the code has changed since the notebook was executed, or there is no notebook.
    """
    existing = out / f"{source.stem}.ipynb"
    if not existing.exists():
        raise ValueError(f"{existing} does not exist; build it without --prose")
    notebook, shipped = assembled(source), nbformat.read(existing, as_version=4)
    before, after = executed(shipped), executed(notebook)
    if [cell.source for cell in before] != [cell.source for cell in after]:
        raise ValueError(f"{source.stem}: its code has changed; build it without --prose")
    for old, new in zip(before, after, strict=True):
        new.outputs, new.execution_count = old.outputs, old.execution_count
    notebook.metadata = shipped.metadata
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
    parser.add_argument(
        "--prose",
        action="store_true",
        help="replace the text and the exercises only; refused if code changed",
    )
    parser.add_argument("--assignments", action="store_true", help="write the assignments only")
    parser.add_argument("--out", type=Path, default=ROOT / "notebooks", help="folder (default: notebooks)")
    parser.add_argument("--folder", type=Path, default=ROOT, help="the kernel's folder (default: the clone)")
    arguments = parser.parse_args()
    if arguments.assignments:
        write_assignments()
        return 0
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
            if arguments.prose:
                renew_prose(source, arguments.out)
            else:
                build(source, arguments.out, arguments.folder)
        except (CellExecutionError, ValueError) as error:
            print(f"build_notebooks.py: {error}", file=sys.stderr)
            return 1
        print(f"{source.stem}: done in {time.perf_counter() - start:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
