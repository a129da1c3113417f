"""The repository is within the house limits, and the tool that checks them finds violations."""

import ast
import re
from pathlib import Path

import pytest

import house_limits

ROOT = Path(__file__).parents[2]

MOST_REPLACEMENTS, MOST_INTIMATE_FILES = 188, 14
"""Calls of `monkeypatch.setattr` in the tests, and test files that use a name of ours with an underscore. These limits
only go down: a new test uses an argument, an environment variable, a small file or a public name."""

NOT_OURS = {"_native", "_version", "_fields"}
"""The compiled module, whose boundary has tests of its own, and names of torch and of tuples."""


def test_the_repository_is_within_its_limits(capsys):
    assert house_limits.main(list(house_limits.FOLDERS)) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1\n" * 801, "801 lines"),
        ("def f():\n" + "    x = 1\n" * 60, "f: 61 lines"),
        ("def f(a, b, c, d, e, f, g, h, i):\n    pass\n", "9 parameters"),
        ("class A:\n    def f(self, a, b, c, d, e, f, *, g, h, i):\n        pass\n", "9 parameters"),
    ],
)
def test_a_violation_is_named(tmp_path, text, says):
    path = tmp_path / "new.py"
    path.write_text(text)
    (line,) = house_limits.breaches(path, "new.py")
    assert line.startswith("new.py") and says in line


@pytest.mark.parametrize(
    "text",
    [
        "x = 1\n" * 800,
        "def f():\n" + "    x = 1\n" * 59,
        "class A:\n    def f(self, a, b, c, d, e, f, g, h):\n        pass\n",
    ],
)
def test_the_limit_itself_is_allowed(tmp_path, text):
    path = tmp_path / "new.py"
    path.write_text(text)
    assert list(house_limits.breaches(path, "new.py")) == []


def test_exceptions_name_functions_that_exist():
    for key in house_limits.EXCEPTIONS:
        file, function = key.split(":")
        assert f"def {function}(" in (ROOT / file).read_text()


def test_no_test_waits_for_a_time():
    """A state is awaited by `tests/waiting.py`; so does a program or a page's script in a test. A window's new size is
    a state, too."""
    clocks = (r"\bsleep\(", r"import sleep", "wait_for_timeout", "setTimeout")
    waits = re.compile("|".join((*clocks, "set_viewport_size")))
    files = [path for kind in ("*.py", "*.js") for path in sorted((ROOT / "tests").rglob(kind))]
    ours = [
        path
        for path in files
        if "npm" not in path.parts and path.name not in ("waiting.py", Path(__file__).name)
    ]
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in ours
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if waits.search(line)
    ]
    assert len(ours) > 400 and found == []


def underscored(tree):
    """Return the names with an underscore that Python code defines."""
    named = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    names = {node.name for node in ast.walk(tree) if isinstance(node, named)}
    stored = [node for node in ast.walk(tree) if isinstance(getattr(node, "ctx", None), ast.Store)]
    names |= {node.id for node in stored if isinstance(node, ast.Name)}
    names |= {node.attr for node in stored if isinstance(node, ast.Attribute)}
    return {name for name in names if re.match(r"_[A-Za-z]", name)} - NOT_OURS


def replacements(tree):
    """Return the calls of `monkeypatch.setattr`."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return [one for one in calls if isinstance(one.func, ast.Attribute) and one.func.attr == "setattr"]


def intimacies(tree, names):
    """Return the lines of a test that import, read or replace one of these names."""
    lines = []
    for node in ast.walk(tree):
        match node:
            case ast.ImportFrom(names=imported):
                used = {one.name for one in imported}
            case ast.Attribute(value=ast.Name(id="self" | "cls")):
                used = set()
            case ast.Attribute(attr=name):
                used = {name}
            case ast.Call(func=ast.Attribute(attr="setattr"), args=given):
                used = {str(one.value).rpartition(".")[2] for one in given if isinstance(one, ast.Constant)}
            case _:
                used = set()
        lines += [node.lineno] if used & names else []
    return lines


def test_tests_use_public_seams():
    """Both limits only go down. See `MOST_REPLACEMENTS`."""
    rooms = ("src", "lab", "tools", "course", "benchmarks")
    ours = [path for folder in rooms for path in (ROOT / folder).rglob("*.py")]
    names = set().union(*(underscored(ast.parse(path.read_text(encoding="utf-8"))) for path in ours))
    tests = {
        str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding="utf-8"))
        for path in (ROOT / "tests").rglob("*.py")
        if "npm" not in path.parts
    }
    assert len(names) > 1000 and len(tests) > 400
    assert sum(len(replacements(tree)) for tree in tests.values()) <= MOST_REPLACEMENTS
    intimate = {name: found for name, tree in tests.items() if (found := intimacies(tree, names))}
    assert len(intimate) <= MOST_INTIMATE_FILES, intimate


@pytest.mark.parametrize(
    ("text", "replaced", "intimate"),
    [
        ("from gsplat_edu.a import _b, c\n", 0, 1),
        ("a._b()\n", 0, 1),
        ("class Own:\n    def f(self):\n        return self._b, cls._b\n", 0, 0),
        ("monkeypatch.setattr(a, '_b', 1)\npatch.setattr('gsplat_edu.a.C', 1)\n", 2, 1),
        ("a._other, a.b\n", 0, 0),
    ],
)
def test_what_a_test_reaches_into_is_found(text, replaced, intimate):
    assert underscored(ast.parse("def _b(): ...\nclass C: ...\na._native = _ = 1\n")) == {"_b"}
    tree = ast.parse(text)
    assert (len(replacements(tree)), len(intimacies(tree, {"_b"}))) == (replaced, intimate)
