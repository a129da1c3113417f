"""The repository is within the house limits, and the tool that checks them finds violations."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def limits():
    spec = importlib.util.spec_from_file_location("house_limits", ROOT / "tools" / "house_limits.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_repository_is_within_its_limits(limits, capsys):
    assert limits.main(list(limits.FOLDERS)) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1\n" * 801, "801 lines"),
        ("def f():\n" + "    x = 1\n" * 60, "f: 61 lines"),
        ("def f(a, b, c, d, e, f, g, h, i):\n    pass\n", "9 parameters"),
        ("class A:\n    def f(self, a, b, c, d, e, f, *, g, h, i):\n        pass\n", "9 parameters"),
    ],
)
def test_a_violation_is_named(limits, tmp_path, text, says):
    path = tmp_path / "new.py"
    path.write_text(text)
    (line,) = limits.breaches(path, "new.py")
    assert line.startswith("new.py") and says in line


@pytest.mark.parametrize(
    "text",
    [
        "x = 1\n" * 800,
        "def f():\n" + "    x = 1\n" * 59,
        "class A:\n    def f(self, a, b, c, d, e, f, g, h):\n        pass\n",
    ],
)
def test_the_limit_itself_is_allowed(limits, tmp_path, text):
    path = tmp_path / "new.py"
    path.write_text(text)
    assert list(limits.breaches(path, "new.py")) == []


def test_exceptions_name_functions_that_exist(limits):
    for key in limits.EXCEPTIONS:
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
