"""The chapters redefine no name of the package, and the shipped notebooks were executed from their sources."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import jupytext
import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbclient.exceptions import CellExecutionError

import build_notebooks
import chapter_figures
from chapters import CHAPTERS, LINK, ROOT, SOURCES, redefinitions

LONGEST = 540  # largest number of lines of a chapter's source


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
        "from gsplat_edu import render_gaussians as rg",
        "from gsplat_edu2 import Camera",
        "lambda Camera: 1",
        "match 1:\n    case Camera: pass",
        "gsplat_edu.scene.camera.Camera = 1",
    ],
)
def test_a_redefinition_is_found(text):
    assert redefinitions(text)


def draws_without_show(node: ast.AST) -> bool:
    """Return whether a statement may draw a figure without plt.show()."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "plt":
        return node.attr not in ("subplots", "subplot_mosaic", "figure", "show", "setp")
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id == "display"
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Name)


def violations(text: str) -> list[str]:
    """List the rules that a chapter's source breaks."""
    nodes = list(ast.walk(ast.parse(text)))
    names = [node.attr for node in nodes if isinstance(node, ast.Attribute)]
    made = sum(name in ("subplots", "figure", "subplot_mosaic") for name in names)
    found = {
        "it asserts nothing": not any(isinstance(node, ast.Assert) for node in nodes),
        f"it is longer than {LONGEST} lines": text.count("\n") > LONGEST,
        "it has no figure": not made,
        "a figure is not shown by plt.show()": names.count("show") < made,
        "a figure is drawn past plt.subplots()": any(map(draws_without_show, nodes)),
        "it hides output": "%%capture" in text,
        "it swallows errors": any(isinstance(node, ast.Try | ast.TryStar) for node in nodes)
        or any(
            isinstance(node, ast.Name | ast.Attribute) and "suppress" in ast.unparse(node) for node in nodes
        ),
        "it silences warnings": bool({"simplefilter", "filterwarnings", "catch_warnings"} & set(names)),
        "it does not end by naming the next failure": "\n# ## The next failure\n" not in text,
        "it links no module": "](../src/gsplat_edu/" not in text,
    }
    return [what for what, holds in found.items() if holds]


GOOD = """# %% [markdown]
# [a module](../src/gsplat_edu/scene/camera.py)
# %%
import matplotlib.pyplot as plt
fig, ax = plt.subplots()
plt.show()
assert 1 + 1 == 2
# %% [markdown]
# ## The next failure
"""


@CHAPTERS
def test_chapters_follow_the_rules(source):
    assert violations(source.read_text()) == []


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("assert 1 + 1 == 2", "1 + 1", "it asserts nothing"),
        ("# %%\n", "# %%\n" + "#\n" * LONGEST, f"it is longer than {LONGEST} lines"),
        ("fig, ax = plt.subplots()\nplt.show()\n", "", "it has no figure"),
        ("plt.show()", "", "a figure is not shown by plt.show()"),
        ("assert", "plt.plot([1, 2])\nassert", "a figure is drawn past plt.subplots()"),
        ("assert", "fig\nassert", "a figure is drawn past plt.subplots()"),
        ("assert", "display(fig)\nassert", "a figure is drawn past plt.subplots()"),
        ("assert", "# %%capture\nassert", "it hides output"),
        ("assert", "try:\n    pass\nexcept* ValueError:\n    pass\nassert", "it swallows errors"),
        (
            "assert",
            "with warnings.catch_warnings(action='ignore'):\n    pass\nassert",
            "it silences warnings",
        ),
        ("assert", "try:\n    pass\nexcept ValueError:\n    pass\nassert", "it swallows errors"),
        ("assert", "with contextlib.suppress(OSError):\n    pass\nassert", "it swallows errors"),
        ("assert", "warnings.simplefilter('ignore')\nassert", "it silences warnings"),
        ("# ## The next failure", "# ## Summary", "it does not end by naming the next failure"),
        ("../src/gsplat_edu/scene/camera.py", "https://example.org", "it links no module"),
    ],
)
def test_a_chapter_that_breaks_a_rule_is_rejected(old, new, what):
    assert violations(GOOD) == []
    assert violations(GOOD.replace(old, new, 1)) == [what]


def figure(**settings):
    """Draw a line with a title and labels, or with the given settings."""
    made, axes = plt.subplots()
    axes.plot([0, 1])
    axes.set(**({"title": "a line", "xlabel": "x, px", "ylabel": "y, px"} | settings))
    return made


@pytest.fixture
def faults():
    yield chapter_figures.faults
    plt.close("all")


@pytest.mark.parametrize("lacking", ["title", "xlabel", "ylabel"])
def test_a_figure_without_title_or_labels_is_rejected(faults, lacking):
    assert faults(figure()) == []
    assert len(faults(figure(**{lacking: ""}))) == 1


def test_images_need_titles_and_colour_bars_labels_but_inner_axes_nothing(faults):
    assert faults(figure(xlabel="", ylabel="", xticks=[], yticks=[])) == []
    made, axes = plt.subplots(1, 2, sharey=True)
    for ax in axes:
        ax.plot([0, 1])
        ax.set(title="one of two", xlabel="x")
    axes[0].set_ylabel("y")
    assert faults(made) == []
    bar = made.colorbar(axes[0].imshow(np.eye(2)), ax=axes[0])
    assert len(faults(made)) == 1
    bar.set_label("transmittance")
    assert faults(made) == []
    assert faults(plt.figure()) == ["the figure has no axes"]
    made = figure(title=" ")
    twin = made.axes[0].twinx()
    twin.plot([1, 0])
    twin.set(ylabel="the other, px")
    assert len(faults(made)) == 2, "each axis needs a title"
    twin.set_title("two lines")
    assert faults(made) == []


@pytest.mark.slow
def test_a_chapter_whose_figure_lacks_labels_is_not_built(tmp_path):
    source = tmp_path / "00_bad.py"
    header = (ROOT / "notebooks" / "source" / "09_train_in_3d.py").read_text().split("# %%")[0]
    source.write_text(header + GOOD)
    with pytest.raises(CellExecutionError, match="no title"):
        build_notebooks.build(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@CHAPTERS
def test_links_of_chapters_lead_somewhere_and_modules_link_back(source):
    prose = "\n".join(c.source for c in jupytext.read(source).cells if c.cell_type == "markdown")
    for link in LINK.findall(prose):
        if link.startswith("https://"):
            continue
        target = (ROOT / "notebooks" / link.partition("#")[0]).resolve()
        assert target.is_file(), f"{source.name}: {link} leads nowhere"
        if target.is_relative_to(ROOT / "src") or target.is_relative_to(ROOT / "lab"):
            documented = ast.get_docstring(ast.parse(target.read_text())) or ""
            said = re.search(r"^Chapters?: (.*)$", documented, flags=re.MULTILINE)
            assert said and source.stem in said[1].rstrip(".").split(", "), (
                f"{link} does not name {source.stem}"
            )


def test_chapters_that_modules_name_link_them():
    for module in [*(ROOT / "src" / "gsplat_edu").rglob("*.py"), *(ROOT / "lab").rglob("*.py")]:
        documented = ast.get_docstring(ast.parse(module.read_text())) or ""
        for named in re.findall(r"^Chapters?: (.*)$", documented, flags=re.MULTILINE):
            for chapter in named.rstrip(".").split(", "):
                text = (ROOT / "notebooks" / "source" / f"{chapter}.py").read_text()
                assert f"(../{module.relative_to(ROOT)})" in text, f"{chapter} does not link {module}"


def prose_numbers(markdown: str) -> set[str]:
    """Find the numbers in prose that have to be measured: those with a decimal point, a % or three digits."""
    for skipped in (
        r"\$\$.*?\$\$",
        r"\$.*?\$",
        r"`[^`]*`",
        r"\]\([^)]*\)",
        r"^#+ .*$",
        r"\bet al\. \d{4}|\b(19|20)\d\d\b",
    ):
        markdown = re.sub(skipped, " ", markdown, flags=re.DOTALL | re.MULTILINE)
    found = re.findall(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?(?: ?%)?(?!\w)", markdown)
    return {n.rstrip(",") for n in found if "." in n or "%" in n or sum(c.isdigit() for c in n) > 2}


@CHAPTERS
def test_numbers_in_the_prose_are_printed_on_the_page(source):
    shipped = nbformat.read(ROOT / "notebooks" / f"{source.stem}.ipynb", as_version=4)
    page = "".join(
        cell.source + "".join(str(output.get("text", "")) for output in cell.outputs)
        for cell in shipped.cells
        if cell.cell_type == "code"
    )
    page = page.replace(",", "").replace("_", "")
    equations = "".join(re.findall(r"\$.*?\$", "".join(c.source for c in shipped.cells), flags=re.DOTALL))
    for cell in shipped.cells:
        if cell.cell_type == "markdown":
            for number in prose_numbers(cell.source):
                bare = number.replace(",", "").rstrip("% ")
                assert re.search(rf"(?<![\d.]){re.escape(bare)}(?!\d)", page + equations), (
                    f"{number} is not printed"
                )


def test_sixteen_chapters():
    assert [path.stem[:2] for path in SOURCES] == [f"{n:02d}" for n in range(1, 17)]


@CHAPTERS
def test_shipped_notebooks_match_their_source_and_were_executed(source):
    shipped = nbformat.read(ROOT / "notebooks" / f"{source.stem}.ipynb", as_version=4)
    cells = build_notebooks.assembled(source).cells
    assert [(c.cell_type, c.source) for c in shipped.cells] == [(c.cell_type, c.source) for c in cells]
    code = build_notebooks.executed(shipped)
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), (
        "executed from top to bottom"
    )
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any({"image/png", "image/jpeg"} & set(output.get("data", {})) for output in outputs)
    assert not any("(reduced)" in output.get("text", "") for output in outputs), "it has the full budget"


@pytest.mark.slow
@CHAPTERS
def test_chapters_execute_on_a_reduced_budget(source, tmp_path):
    """Those that do not say that they need a clone run outside of it, where no compiler is found."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    # one thread, because torch's threads wait minutes for one another on a busy machine
    environment = os.environ | {"GSPLAT_EDU_BUDGET": "reduced", "OMP_NUM_THREADS": "1"}
    words = [sys.executable, str(ROOT / "course" / "build_notebooks.py"), source.stem, "--out", str(out)]
    if "> **Needs.** A clone" not in source.read_text():
        words += ["--folder", str(elsewhere)]
        environment["PATH"] = str(Path(sys.executable).parent)
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in out.iterdir()] == [f"{source.stem}.ipynb"]
    assert not any(elsewhere.iterdir()), "a chapter leaves nothing in its folder"
    notebook = nbformat.read(out / f"{source.stem}.ipynb", as_version=4)
    text = "".join(
        o.text for cell in notebook.cells for o in cell.get("outputs", []) if o.output_type == "stream"
    )
    assert "(reduced)" in text


def test_a_chapter_that_does_not_exist_is_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, str(ROOT / "course" / "build_notebooks.py"), "99", "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
