"""Every chapter asks for a prediction and ends with three exercises to type, whose checks accept the solutions only.

`course/build_notebooks.py` runs every check behind the chapter's cells: on the stub and on constants, which it must
refuse, and on the solution. `test_notebooks.py::test_chapters_execute_on_a_reduced_budget` does so for all chapters.
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
from chapters import CHAPTERS, LINK, ROOT, SOURCES, redefinitions, top_level_names

KINDS = ("a line", "a function", "open")
PREDICTION = re.compile(r"(?:^|\n\n)> \*\*Predict\.\*\* [^\n]+(\n> [^\n]+)*$")
EXERCISE = re.compile(r"^\*\*Exercise (\d) \((.*)\)\.\*\* ", flags=re.MULTILINE)


def answered_predictions(cells) -> int:
    """Count predictions at the end of a markdown cell that a code cell follows."""
    return sum(
        ask.cell_type == "markdown" and answer.cell_type == "code" and bool(PREDICTION.search(ask.source))
        for ask, answer in itertools.pairwise(cells)
    )


def faults(exercises: list[build_notebooks.Exercise]) -> list[str]:
    """List what a chapter's exercises lack."""
    asked = [EXERCISE.findall(exercise.question) for exercise in exercises]
    if asked != [[(str(n), kind)] for n, kind in enumerate(KINDS, 1)]:
        return [f"the questions have to be {KINDS}, numbered from 1, but are {asked}"]
    found = []
    for kind, exercise in zip(KINDS, exercises, strict=True):
        question, solution, check, other = exercise
        checks = [node for node in ast.walk(ast.parse(check)) if isinstance(node, ast.Assert)]
        names = top_level_names(solution)
        read = {node.id for node in ast.walk(ast.parse(check)) if isinstance(node, ast.Name)}
        signatures = {node.name for node in ast.parse(solution).body if isinstance(node, ast.FunctionDef)}
        if not any(node.msg for node in checks):
            found.append(f"{kind}: no assertion of the check says what is wrong")
        found += [
            f"{kind}: the check does not use {name}"
            for name in sorted(names - read)
            if name in asked_for(question)
        ]
        found += [
            f"{kind}: the question does not ask for {name}"
            for name in sorted(names & read - asked_for(question))
        ]
        if names & top_level_names(check):
            found.append(f"{kind}: the check redefines what was asked for")
        if kind == "a function" and not signatures:
            found.append(f"{kind}: the solution defines no function")
        if bool(other) != (kind == "open") or (
            other and names & asked_for(question) - top_level_names(other)
        ):
            found.append(
                f"{kind}: an open exercise has another answer, with the same names, and only an open one"
            )
        if question.startswith("## Exercises\n") != (kind == KINDS[0]):
            found.append(f"{kind}: only the first question begins with the heading")
    return found


def asked_for(question: str) -> set[str]:
    """Return the names in a question: `name` or `name(arguments)`."""
    return set(re.findall(r"`(\w+)(?:\([\w, ]*\))?`", question))


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
    exercises = build_notebooks.exercises(source)
    assert faults(exercises) == []
    for question, solution, check, other in exercises:
        assert redefinitions(f"{solution}\n{check}\n{other}") == set()
        for link in LINK.findall(question):
            target = (ROOT / "notebooks" / link.partition("#")[0]).resolve()
            assert "://" in link or target.is_file(), link


@CHAPTERS
def test_a_notebook_asks_and_checks_without_the_answer(source):
    shipped = nbformat.read(ROOT / "notebooks" / f"{source.stem}.ipynb", as_version=4).cells
    text = "\n".join(cell.source for cell in shipped if cell["id"].startswith("exercise-"))
    for number, (question, solution, check, _) in enumerate(build_notebooks.exercises(source), 1):
        cells = {c["id"]: c for c in shipped if c["id"].startswith(f"exercise-{number}-")}
        asked, answer, checked = cells.values()
        assert asked.source == question and checked.source.startswith(check)
        assert answer.execution_count is None and checked.execution_count is None
        for name in top_level_names(solution):
            assert name in answer.source
        # Longer statements of the solution are nowhere on the page.
        for node in ast.parse(solution).body:
            body = node.body if isinstance(node, ast.FunctionDef) else [node]
            for statement in body:
                line = ast.unparse(statement).splitlines()[0]
                assert len(line) < 24 or isinstance(node, ast.Import | ast.ImportFrom) or line not in text, (
                    line
                )


def test_exercises_belong_to_chapters():
    written = {path.name for path in (ROOT / "notebooks" / "solutions").glob("*.py")}
    assert written == {path.name for path in SOURCES}


SOLUTION = """import math
from math import pi

x = 41


def twice(a, b=2, *, c):
    \"\"\"Return a times two.\"\"\"
    return 2 * a
"""


def test_a_stub_has_names_and_signatures_and_no_answer():
    wanted = """import math
from math import pi
x = ...


def twice(a, b=2, *, c):
    \"\"\"Return a times two.\"\"\"
    raise NotImplementedError('write twice')"""
    assert build_notebooks.stub(SOLUTION) == wanted
    constant = build_notebooks.stub(SOLUTION, "0.0")
    assert "\nx = 0.0\n" in constant and constant.endswith("    return 0.0")
    for statement in ("print(1)", "a, b = 1, 2", "x += 1", "class A: pass", "for i in (): pass"):
        with pytest.raises(ValueError, match="imports, names and functions"):
            build_notebooks.stub(statement)


ASKED = [
    build_notebooks.Exercise(*cells)
    for cells in (
        ("## Exercises\n\n**Exercise 1 (a line).** What is `x`?", "x = 1", "assert x == 1, 'not 1'"),
        ("**Exercise 2 (a function).** Write `f()`.", "def f():\n    return 1", "assert f() == 1, 'not 1'"),
        ("**Exercise 3 (open).** Find `y`.", "y = 1", "assert y < 2, 'too large'", "y = 0"),
    )
]


ANOTHER = "open: an open exercise has another answer, with the same names, and only an open one"


@pytest.mark.parametrize(
    ("number", "change", "what"),
    [
        (0, {"check": "assert x == 1"}, "a line: no assertion of the check says what is wrong"),
        (0, {"check": "assert 1 == 1, 'odd'"}, "a line: the check does not use x"),
        (0, {"check": "x = 1\nassert x == 1, 'odd'"}, "a line: the check redefines what was asked for"),
        (
            0,
            {"question": "**Exercise 1 (a line).** What is `x`?"},
            "a line: only the first question begins with the heading",
        ),
        (1, {"solution": "f = int"}, "a function: the solution defines no function"),
        (2, {"question": "**Exercise 3 (open).** Find one."}, "open: the question does not ask for y"),
        (2, {"other": ""}, ANOTHER),
        (2, {"other": "z = 0"}, ANOTHER),
    ],
)
def test_an_exercise_that_breaks_a_rule_is_found(number, change, what):
    assert faults(ASKED) == []
    broken = [*ASKED[:number], ASKED[number]._replace(**change), *ASKED[number + 1 :]]
    assert faults(broken) == [what]
    assert len(faults(ASKED[:2])) == 1


@pytest.fixture
def short(tmp_path, monkeypatch):
    """A chapter of two cells and its exercise: the paths of both."""
    monkeypatch.setattr(build_notebooks, "SOLUTIONS", tmp_path / "solutions")
    (tmp_path / "solutions").mkdir()
    header = (ROOT / "notebooks" / "source" / "09_train_in_3d.py").read_text().split("# %%")[0]
    source = tmp_path / "00_short.py"
    source.write_text(header + "# %%\nassert 1 + 1 == 2\n# %%\nhidden = 41\n")
    return source, tmp_path / "solutions" / "00_short.py"


def written(solution, check):
    """Return an exercise's cells as text."""
    return f"# %% [markdown]\n# What is `x`?\n# %%\n{solution}\n# %%\n{check}\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solution", "check", "what"),
    [
        ("x = 42", "assert x == hidden, 'not it'", "not it"),
        ("x = 41", "assert x is not ..., 'empty'", "accepts None as an answer"),
        ("x = 41", "assert True", "accepts the stub as an answer"),
        ("def x():\n    return 41", "assert x() < 41.5, 'large'", "accepts 0.0 as an answer"),
        ("x = 41", "assert x == hidden, 'not it'\n# %%\nx = 40", "not it"),
    ],
)
def test_a_wrong_solution_and_a_check_that_accepts_anything_stop_the_build(short, solution, check, what):
    source, asked = short
    asked.write_text(written(solution, check))
    with pytest.raises(CellExecutionError, match=what):
        build_notebooks.build(source, source.parent / "out")
    assert not (source.parent / "out").exists()


@pytest.mark.slow
def test_a_chapter_is_built_with_its_exercises_and_their_text_may_change_without_a_run(short):
    source, asked = short
    out = source.parent / "out"
    asked.write_text(written("x = 41", "assert x == hidden, 'not it'"))
    build_notebooks.build(source, out)
    shipped = nbformat.read(out / "00_short.ipynb", as_version=4)
    texts = [cell.source for cell in shipped.cells[2:]]
    assert texts == [
        "What is `x`?",
        "x = ...",
        "assert x == hidden, 'not it'\nprint(\"Exercise 1 is solved.\")",
        "One solution of each exercise is in [solutions/00_short.py](solutions/00_short.py).",
    ]
    counts = [cell.execution_count for cell in shipped.cells if cell.cell_type == "code"]
    assert counts == [1, 2, None, None]

    asked.write_text(written("z = 41", "assert z == hidden, 'not it'").replace("`x`", "`z`"))
    build_notebooks.renew_prose(source, out)
    renewed = nbformat.read(out / "00_short.ipynb", as_version=4)
    assert renewed.cells[2].source == "What is `z`?" and renewed.cells[3].source == "z = ..."
    assert [cell.execution_count for cell in renewed.cells if cell.cell_type == "code"] == counts
    source.write_text(source.read_text().replace("41", "42"))
    with pytest.raises(ValueError, match="its code has changed"):
        build_notebooks.renew_prose(source, out)


def test_a_question_without_a_solution_and_a_check_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(build_notebooks, "SOLUTIONS", tmp_path)
    (tmp_path / "00_short.py").write_text("# %% [markdown]\n# What?\n# %%\nx = 1\n# %% [markdown]\n# And?\n")
    with pytest.raises(ValueError, match="behind it one code cell with the solution"):
        build_notebooks.exercises(Path("00_short.py"))
