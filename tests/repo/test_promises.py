"""CONTRIBUTING.md names the tests of each promise of README and SECURITY.md."""

import ast
import re
import socket
from pathlib import Path

import pytest

from outside import OutsideError

ROOT = Path(__file__).parents[2]


def promises(text, heading):
    """Return the promises of a section: the bold texts of its list, without a full stop."""
    section = re.search(rf"^## {re.escape(heading)}\n(.*?)^(?:## |What )", text, re.MULTILINE | re.DOTALL)[1]
    return [
        re.sub(r"\s+", " ", title).rstrip(".")
        for title in re.findall(r"^- \*\*(.+?)\*\*", section, re.M | re.S)
    ]


def table():
    """Return the tests of each promise."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    section = re.search(r"^## Promises\n(.*?)^## ", text, re.MULTILINE | re.DOTALL)[1]
    rows = re.findall(r"^\| ([^|]+) \| (`[^|]+`) \|$", section, re.MULTILINE)
    return {title: re.findall(r"`([^`]+)`", tests) for title, tests in rows}


def test_every_promise_has_tests_and_every_row_a_promise():
    made = promises((ROOT / "README.md").read_text(), "What is guaranteed")
    made += promises((ROOT / "SECURITY.md").read_text(), "What is promised")
    assert len(made) > 10
    assert sorted(made) == sorted(table())


def test_the_tests_of_promises_exist():
    for title, tests in table().items():
        assert tests, title
        for test in tests:
            file, name = test.split("::")
            tree = ast.parse((ROOT / "tests" / file).read_text())
            defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            assert name in defined, test


def names_used(path):
    """Return the names that a module calls or imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


FORBIDDEN = {
    "eval",
    "exec",
    "pickle",
    "cloudpickle",
    "marshal",
    "shelve",
    "torch.load",
    "np.load",
    "numpy.load",
    "os.system",
}
"""Names whose use could execute the contents of a file."""


def test_nothing_is_unpickled_or_evaluated():
    used = {name for path in (ROOT / "src").rglob("*.py") for name in names_used(path)}
    assert "json.loads" in used, "`names_used` finds names"
    assert not used & FORBIDDEN


def test_a_connection_to_another_computer_fails_any_test():
    """The hook is installed in all tests. 192.0.2.1 is reserved for documentation (RFC 5737), and no packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams:
        for attempt in (
            lambda: datagrams.connect(("192.0.2.1", 9)),
            lambda: datagrams.sendto(b"x", ("192.0.2.1", 9)),
        ):
            with pytest.raises(OutsideError, match="contacts another computer"):
                attempt()
        datagrams.connect(("127.0.0.1", 9))
