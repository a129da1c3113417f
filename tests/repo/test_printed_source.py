"""Source that a shipped notebook prints is the source of today: notebooks are rebuilt when it changes."""

import ast
import io
import re
from collections.abc import Sequence
from contextlib import redirect_stdout

import nbformat
import pytest

from chapters import CHAPTERS, ROOT, SOURCES

READERS = {"getsource", "getsourcelines", "getdoc", "help"}
"""Functions that return or print source or documentation."""

SOURCE_FILE = re.compile(r"\.(py|cpp|h|js|wgsl|glsl)$")


def reads_source(node: ast.AST) -> bool:
    """Return whether code reads source: by `inspect` or `help`, as `__doc__`, or from a file of the repository."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Attribute) and inner.attr == "__doc__":
            return True
        if not isinstance(inner, ast.Call):
            continue
        called = inner.func.attr if isinstance(inner.func, ast.Attribute) else ast.unparse(inner.func)
        if called in READERS:
            return True
        names = [part.value for part in ast.walk(inner.func) if isinstance(part, ast.Constant)]
        if called == "read_text" and any(SOURCE_FILE.search(str(name)) for name in names):
            return True
    return False


def prints(node: ast.AST) -> bool:
    """Return whether a statement prints when it runs; a function prints where it is called."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return False
    calls = (inner.func for inner in ast.walk(node) if isinstance(inner, ast.Call))
    return any(isinstance(called, ast.Name) and called.id in ("print", "help") for called in calls)


def bound(node: ast.stmt) -> set[str]:
    """Return the names that a statement binds."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    names = {
        alias.asname or alias.name.split(".")[0]
        for n in ast.walk(node)
        for alias in getattr(n, "names", [])
        if isinstance(alias, ast.alias)
    }
    stored = (n for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store))
    return names | {name.id for name in stored}


class Statements:
    """The top-level statements of a notebook so far, and which of them bind a name."""

    def __init__(self) -> None:
        self.all: list[ast.stmt] = []
        self.bindings: dict[str, list[int]] = {}

    def add(self, statement: ast.stmt) -> None:
        """Append a statement."""
        for name in bound(statement):
            self.bindings.setdefault(name, []).append(len(self.all))
        self.all.append(statement)

    def needed_by_last(self) -> list[ast.stmt]:
        """Return what the last statement needs, and itself: for each name the latest statement that binds it."""
        waiting = [len(self.all) - 1]
        chosen = set(waiting)
        while waiting:
            at = waiting.pop()
            for node in ast.walk(self.all[at]):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                    before = [i for i in self.bindings.get(node.id, ()) if i < at]
                    if before and before[-1] not in chosen:
                        chosen.add(before[-1])
                        waiting.append(before[-1])
        return [self.all[i] for i in sorted(chosen)]


def printed_source(cells: Sequence[nbformat.NotebookNode]) -> list[tuple[str, str, str]]:
    """Run what prints source in a notebook, and nothing else of it.

    Args:
        cells: The notebook's cells.

    Returns:
        For each statement that prints source its code, what it prints today, and what its cell printed when the
        notebook was built.
    """
    statements, found = Statements(), []
    for cell in cells:
        if cell.cell_type != "code":
            continue
        stored = "".join(output.text for output in cell.outputs if output.output_type == "stream")
        for statement in ast.parse(cell.source).body:
            statements.add(statement)
            program = statements.needed_by_last() if prints(statement) else []
            if any(map(reads_source, program)):
                with redirect_stdout(io.StringIO()) as now:
                    exec(compile(ast.Module(program, []), "<chapter>", "exec"), {"__name__": "__main__"})
                found.append((ast.unparse(statement), now.getvalue(), stored))
    return found


def stale(cells: Sequence[nbformat.NotebookNode]) -> list[str]:
    """List the statements whose stored output is not what they print today."""
    return [code for code, now, stored in printed_source(cells) if not now.strip() or now not in stored]


@CHAPTERS
def test_source_on_the_page_is_the_source_of_the_package(source, monkeypatch):
    monkeypatch.chdir(ROOT)  # where chapters are built
    cells = nbformat.read(ROOT / "notebooks" / f"{source.stem}.ipynb", as_version=4).cells
    assert stale(cells) == [], f"rebuild the chapter: python course/build_notebooks.py {source.stem[:2]}"


def test_source_is_found_in_the_chapters_that_print_it(monkeypatch):
    monkeypatch.chdir(ROOT)
    printed = {}
    for source in SOURCES:
        path = ROOT / "notebooks" / f"{source.stem}.ipynb"
        printed[source.stem[:2]] = len(printed_source(nbformat.read(path, as_version=4).cells))
    assert {chapter for chapter, count in printed.items() if count} == {"10", "11", "12"}


def notebook(*codes: str, output: str) -> list[nbformat.NotebookNode]:
    """Return the cells of a notebook whose last cell printed this output."""
    cells = [nbformat.v4.new_code_cell(code) for code in codes]
    cells[-1].outputs = [nbformat.v4.new_output("stream", text=output)]
    return cells


IMPORTS = "import inspect\nfrom pathlib import Path\nfrom gsplat_edu.base.text import spelled_bytes\nROOT = Path.cwd()"
WAYS = {
    "directly": ("print(inspect.getsource(spelled_bytes))",),
    "by a name": ("text = inspect.getsource(spelled_bytes)", "print(text)"),
    "in a loop": ("for thing in (spelled_bytes,):\n    print(inspect.getsource(thing))",),
    "by a function": (
        "def show(thing):\n    print(inspect.getsource(thing))",
        "print('so:')\nprint(show(spelled_bytes))",
    ),
    "the docstring": ("print(spelled_bytes.__doc__)",),
    "help": ("help(spelled_bytes)",),
    "from the file": ("print((ROOT / 'src/gsplat_edu/base/text.py').read_text())",),
    "in part": ("print(inspect.getsource(spelled_bytes).splitlines()[0])",),
}


@pytest.mark.parametrize("way", WAYS)
def test_source_that_changed_after_the_build_is_found(way, monkeypatch):
    monkeypatch.chdir(ROOT)
    [(_, now, _)] = printed_source(notebook(IMPORTS, *WAYS[way], output=""))
    assert now.strip()
    assert stale(notebook(IMPORTS, *WAYS[way], output=f"before\n{now}after\n")) == []
    assert len(stale(notebook(IMPORTS, *WAYS[way], output=now.replace("e", "E")))) == 1


def test_nothing_else_of_a_chapter_runs():
    codes = (
        "import json, pathlib\nfolder = 1 / 0",
        "table = json.loads((folder / 'stages.json').read_text())\nprint(table)",
        "print(folder, 'is not source')",
    )
    assert printed_source(notebook(*codes, output="")) == []
