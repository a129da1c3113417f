"""The tests of JavaScript, *.test.js, in node: one run for all, each reported under its name."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from js.vectors import VECTORS

FOLDER = Path(__file__).parent
OLDEST = (20, 19)
"""Version of node from which it reads ES modules named .js without a package.json."""


def names_in(text: str) -> list[str]:
    """Return the names of the tests in a file; a name made of parts as the text before the first one."""
    return re.findall(r'^ *test\(["`]([^"`$]+)', text, re.MULTILINE)


NAMES = [name for path in sorted(FOLDER.glob("*.test.js")) for name in names_in(path.read_text("utf-8"))]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The failure of each JavaScript test by its name; None if it passes."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if tuple(map(int, version.lstrip("v").split(".")[:2])) < OLDEST:
        pytest.skip(f"node {version.strip()} is older than {'.'.join(map(str, OLDEST))}")
    folder = tmp_path_factory.mktemp("vectors")
    for name, make in VECTORS.items():
        (folder / f"{name}.json").write_text(json.dumps(make(), allow_nan=False))
    files = sorted(map(str, FOLDER.glob("*.test.js")))
    ran = subprocess.run(
        [node, "--no-warnings", "--test", "--test-reporter=junit", *files],
        env=os.environ | {"GSPLAT_EDU_VECTORS": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    found = {}
    for case in ElementTree.fromstring(ran.stdout).iter("testcase"):
        failure = case.find("failure")
        assert case.get("name") not in found, f"two tests have one name: {case.get('name')}"
        found[case.get("name")] = None if failure is None else failure.text
    assert (ran.returncode == 0) == (not any(found.values())), ran.stdout + ran.stderr
    return found


@pytest.mark.parametrize("name", NAMES)
def test_javascript(results, name):
    """Those whose names are made of parts are reported together."""
    mine = {found: failure for found, failure in results.items() if found.startswith(name)}
    assert mine, "node ran no test of this name"
    assert not any(mine.values()), "\n".join(
        f"{found}:\n{failure}" for found, failure in mine.items() if failure
    )


def test_every_test_in_node_is_reported(results):
    assert [found for found in results if not found.startswith(tuple(NAMES))] == []
