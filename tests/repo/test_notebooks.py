"""The chapters: nothing the package has is defined again, and what ships was executed from its source."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "notebooks" / "source").glob("*.py"))
CHAPTERS = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def top_level_names(text: str) -> set[str]:
    """Collect the functions, classes and constants that a module of the package defines."""
    names = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    return names


def public_names() -> set[str]:
    modules = (ROOT / "src" / "gsplat_edu").rglob("*.py")
    names = {name for module in modules for name in top_level_names(module.read_text())}
    return {name for name in names if not name.startswith("_")}


def redefinitions(text: str) -> set[str]:
    """Find names of the package that a chapter binds itself, wherever and however it does."""
    bound = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del):
            bound.add(node.id)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            ours = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gsplat_edu")
            bound |= {a.asname or a.name for a in node.names if not (ours and a.asname in (None, a.name))}
    return bound & public_names()


@CHAPTERS
def test_no_chapter_redefines_a_public_name(source):
    assert redefinitions(source.read_text()) == set()


@pytest.mark.parametrize(
    "text",
    [
        "def render_gaussians(cam): pass",
        "class Camera: pass",
        "DILATION = 0.3",
        "a, quat_to_R = 1, 2",
        "from somewhere import mine as sphere_shell",
        "C0: float = 0.28",
        "def render_t(means): pass",
        "from elsewhere import Camera",
        "if True:\n    Z_NEAR = 1",
        "def f():\n    def l1(a, b): pass",
        "for Camera in range(3): pass",
        "with open('x') as sphere_shell: pass",
        "Z_NEAR += 1",
        "print(T_STOP := 1)",
        "from gsplat_edu import Camera as View",
    ],
)
def test_a_redefinition_would_be_found(text):
    assert redefinitions(text)


@CHAPTERS
def test_chapters_assert_and_stay_short(source):
    tree = ast.parse(source.read_text())
    assert any(isinstance(node, ast.Assert) for node in ast.walk(tree))
    assert source.read_text().count("\n") <= 400


@CHAPTERS
def test_what_ships_comes_from_the_source_and_was_executed(source):
    shipped = nbformat.read(ROOT / "notebooks" / f"{source.stem}.ipynb", as_version=4)
    cells = jupytext.read(source).cells
    assert [(c.cell_type, c.source) for c in shipped.cells] == [(c.cell_type, c.source) for c in cells]
    code = [cell for cell in shipped.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "from top to bottom"
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any("(reduced)" in output.get("text", "") for output in outputs), "ships on the full budget"


@pytest.mark.slow
@CHAPTERS
def test_chapters_execute_on_a_reduced_budget(source, tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "build_notebooks.py"), source.stem, "--out", str(tmp_path)],
        env=os.environ | {"GSPLAT_EDU_BUDGET": "reduced"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [f"{source.stem}.ipynb"]
    notebook = nbformat.read(tmp_path / f"{source.stem}.ipynb", as_version=4)
    text = "".join(
        o.text for cell in notebook.cells for o in cell.get("outputs", []) if o.output_type == "stream"
    )
    assert "(reduced)" in text


def test_a_chapter_that_does_not_exist_is_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "build_notebooks.py"), "99", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
