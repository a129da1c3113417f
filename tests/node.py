"""Scripts of pages in node, where they compute without a browser."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

LOOP = r"""
const vm = require("node:vm"), { readFileSync } = require("node:fs");
globalThis.window = globalThis;
globalThis.document = { addEventListener() {} };
const numbers = (name, value) => (typeof value === "number" && !Number.isFinite(value) ? `@${value}@` : value);
const answer = (text, argument) => {
  const value = vm.runInThisContext(`(${text})`);
  return { value: typeof value === "function" ? value(argument) : value };
};
for (const path of process.argv.slice(1)) vm.runInThisContext(readFileSync(path, "utf8"), path);
require("node:readline").createInterface({ input: process.stdin }).on("line", (line) => {
  let found;
  try {
    found = answer(...JSON.parse(line));
  } catch (error) {
    found = { error: error.stack };
  }
  console.log(JSON.stringify(found, numbers).replace(/"@(-?Infinity|NaN)@"/g, "$1"));
});
"""
"""Reads an expression and its argument a line, and answers with the value, in which Infinity and NaN are allowed."""


class Node:
    """A node process that has run some scripts of a page.

    Args:
        scripts: Their files, which may listen to the document's events, but get none.
    """

    def __init__(self, scripts: Sequence[Path]) -> None:
        program = shutil.which("node")
        if program is None:
            pytest.skip("node is not installed")
        command = [program, "-e", LOOP, *map(str, scripts)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def evaluate(self, expression: str, argument: Any = None) -> Any:
        """Return the value of an expression, or of a function of the argument, as a tab does."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps([expression, argument]) + "\n")
        self._process.stdin.flush()
        found = json.loads(self._process.stdout.readline())
        assert "error" not in found, found["error"]
        return found.get("value")

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
