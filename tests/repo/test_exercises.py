"""Every chapter asks for a prediction and ends with three exercises, whose solutions run.

`course/build_notebooks.py` executes the solutions after the chapter's cells, so that
`test_notebooks.py::test_chapters_execute_on_a_reduced_budget` runs them and a wrong one stops the build.
"""

import ast
import itertools
import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient.exceptions import CellExecutionError

import build_notebooks
from chapters import CHAPTERS, LINK, ROOT, SOURCES, redefinitions

KINDS = ("a line", "a function", "open")
PREDICTION = re.compile(r"(?:^|\n\n)> \*\*Predict\.\*\* [^\n]+(\n> [^\n]+)*$")
EXERCISE = re.compile(r"^\*\*Exercise (\d) \((.*)\)\.\*\* ", flags=re.MULTILINE)


def answered_predictions(cells) -> int:
    """Count predictions at the end of a markdown cell that a code cell follows."""
    return sum(
        ask.cell_type == "markdown" and answer.cell_type == "code" and bool(PREDICTION.search(ask.source))
        for ask, answer in itertools.pairwise(cells)
    )


def faults(exercises: list[tuple[str, str]]) -> list[str]:
    """List what a chapter's exercises lack."""
    asked = [EXERCISE.findall(question) for question, _ in exercises]
    if asked != [[(str(n), kind)] for n, kind in enumerate(KINDS, 1)]:
        return [f"the questions have to be {KINDS}, numbered from 1, but are {asked}"]
    found = []
    for (kind, (question, answer)), heading in zip(
        zip(KINDS, exercises, strict=True), (True, False, False), strict=True
    ):
        body = ast.parse(answer).body
        checks = [node for statement in body for node in ast.walk(statement) if isinstance(node, ast.Assert)]
        if not any(
            isinstance(node, ast.Name | ast.Attribute) for check in checks for node in ast.walk(check.test)
        ):
            found.append(f"{kind}: the solution asserts nothing")
        if kind == "a line" and isinstance(body[0], ast.FunctionDef | ast.For | ast.While):
            found.append(f"{kind}: the solution does not begin with its line")
        if kind == "a function" and not any(isinstance(node, ast.FunctionDef) for node in body):
            found.append(f"{kind}: the solution defines no function")
        if question.startswith("## Exercises\n") != heading:
            found.append(f"{kind}: only the first question begins with the heading")
    return found


@CHAPTERS
def test_a_chapter_asks_for_a_prediction_and_answers_it(source):
    predictions = answered_predictions(jupytext.read(source).cells)
    assert predictions > 0


def test_a_prediction_that_no_cell_answers_does_not_count():
    def cells(text):
        return jupytext.reads(text, fmt="py:percent").cells

    asked = "# %% [markdown]\n# A story.\n#\n# > **Predict.** Which?\n# > Why?\n"
    assert answered_predictions(cells(asked + "# %%\n1 + 1\n")) == 1
    assert answered_predictions(cells(asked + "# %% [markdown]\n# More.\n# %%\n1 + 1\n")) == 0
    assert answered_predictions(cells(asked + "#\n# More.\n# %%\n1 + 1\n")) == 0
    assert answered_predictions(cells("# %% [markdown]\n# Predict.\n# %%\n1 + 1\n")) == 0


@CHAPTERS
def test_a_chapter_has_three_exercises_with_checked_solutions(source):
    exercises = build_notebooks.solutions(source)
    assert faults(exercises) == []
    assert set().union(*(redefinitions(answer) for _, answer in exercises)) == set()
    for question, _ in exercises:
        for link in LINK.findall(question):
            target = (ROOT / "notebooks" / link.partition("#")[0]).resolve()
            assert "://" in link or target.is_file(), link


def test_exercises_belong_to_chapters():
    written = {path.name for path in (ROOT / "notebooks" / "exercises").glob("*")}
    assert written == {path.name for path in SOURCES}


ASKED = [
    ("## Exercises\n\n**Exercise 1 (a line).** What?", "x = 1\nassert x"),
    ("**Exercise 2 (a function).** What?", "def f():\n    return 1\n\n\nassert f()"),
    ("**Exercise 3 (open).** What?", "y = 1\nassert y"),
]


@pytest.mark.parametrize(
    ("number", "question", "answer", "what"),
    [
        (0, ASKED[0][0], "x = 1\nassert True", "a line: the solution asserts nothing"),
        (0, ASKED[0][0], "def f():\n    assert x", "a line: the solution does not begin with its line"),
        (
            0,
            "**Exercise 1 (a line).** What?",
            "assert x",
            "a line: only the first question begins with the heading",
        ),
        (1, ASKED[1][0], "assert x", "a function: the solution defines no function"),
        (2, ASKED[2][0], "y = 1", "open: the solution asserts nothing"),
    ],
)
def test_an_exercise_that_breaks_a_rule_is_found(number, question, answer, what):
    assert faults(ASKED) == []
    broken = [*ASKED[:number], (question, answer), *ASKED[number + 1 :]]
    assert faults(broken) == [what]
    assert len(faults(ASKED[:2])) == 1


@pytest.mark.slow
def test_a_wrong_solution_stops_the_build(tmp_path, monkeypatch):
    monkeypatch.setattr(build_notebooks, "EXERCISES", tmp_path / "exercises")
    (tmp_path / "exercises").mkdir()
    header = (ROOT / "notebooks" / "source" / "09_train_in_3d.py").read_text().split("# %%")[0]
    chapter = header + "# %%\nassert 1 + 1 == 2\n"
    source = tmp_path / "00_short.py"
    source.write_text(chapter + "# %%\nx = 41\n")
    asked = tmp_path / "exercises" / "00_short.py"
    asked.write_text("# %% [markdown]\n# What is x?\n# %%\nassert x == 42\n")
    with pytest.raises(CellExecutionError, match="assert x == 42"):
        build_notebooks.build(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()

    asked.write_text("# %% [markdown]\n# What is x?\n# %%\nassert x == 41\n")
    build_notebooks.build(source, tmp_path / "out")
    shipped = tmp_path / "out" / "00_short.ipynb"
    last = nbformat.read(shipped, as_version=4).cells[-1]
    assert last.cell_type == "markdown" and last.source.startswith("What is x?\n\n<details>")
    assert "```python\nassert x == 41\n```" in last.source

    # The text may change without a run; the code may not.
    asked.write_text("# %% [markdown]\n# And x?\n# %%\nassert x == 41\n")
    build_notebooks.renew_prose(source, tmp_path / "out")
    renewed = nbformat.read(shipped, as_version=4)
    assert renewed.cells[-1].source.startswith("And x?")
    assert [cell.execution_count for cell in renewed.cells if cell.cell_type == "code"] == [1, 2]
    source.write_text(chapter + "# %%\nx = 42\n")
    with pytest.raises(ValueError, match="its code has changed"):
        build_notebooks.renew_prose(source, tmp_path / "out")


def test_a_question_without_a_solution_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(build_notebooks, "EXERCISES", tmp_path)
    (tmp_path / "00_short.py").write_text("# %% [markdown]\n# What?\n# %% [markdown]\n# And what else?\n")
    with pytest.raises(ValueError, match="behind it one code cell"):
        build_notebooks.solutions(Path("00_short.py"))
