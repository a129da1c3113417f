"""Modules of the page in node, which computes what they export."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

WEB = Path(__file__).parents[1] / "src" / "gsplat_edu" / "tab" / "web"

PROGRAM = """
import {{ readFileSync }} from "node:fs";
import {{ {names} }} from "{module}";
const given = JSON.parse(readFileSync(0, "utf8"));
const answer = async (given) => {{ {body} }};
console.log(JSON.stringify(await answer(given)));
"""


def answer(module: str, names: str, body: str, given: Any = None) -> Any:
    """Run a function of `given` that uses what a module exports, and return what it returns.

    Args:
        module: A file in `tab/web`.
        names: The names that it imports of it.
        body: The function's body.
        given: Its argument; passed and returned as JSON.
    """
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    program = PROGRAM.format(names=names, module=(WEB / module).as_uri(), body=body)
    command = [node, "--no-warnings", "--input-type=module", "--eval", program]
    ran = subprocess.run(command, input=json.dumps(given), capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)
