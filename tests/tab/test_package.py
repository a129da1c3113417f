"""The package for JavaScript: its files, its types, and the example of its README."""

import json
import re
import shutil
import subprocess

import pytest

import build_wasm
import gsplat_edu

WEB, NPM = build_wasm.FOLDER, build_wasm.ROOT / "tests" / "npm" / "node_modules"
README = (WEB / "README.md").read_text()
PACKAGE = json.loads((WEB / "package.json").read_text())

WRONG = {
    'loadModule("a.wasm", { thread: 2 })': "'thread' does not exist",
    "new Trainer(module, { points: [0, 0, 0], colors: [0, 0, 0], views: [] })": "'settings' is missing",
    "render(module, { ...scene, means: [0] }, camera)": "Type 'number[]' is missing",
}
"""Calls that TypeScript refuses, and what it says."""


@pytest.fixture
def project(tmp_path):
    """A folder in which the package is installed: only the files that it lists."""
    installed = tmp_path / "node_modules" / PACKAGE["name"]
    installed.mkdir(parents=True)
    for name in ("package.json", *PACKAGE["files"]):
        shutil.copy(WEB / name, installed / name)
    return tmp_path


def test_the_package_has_the_version_and_the_modules():
    assert PACKAGE["version"] == gsplat_edu.__version__
    assert {build_wasm.MODULE.name, build_wasm.THREADED.name} <= set(PACKAGE["files"])
    exported = {
        path for entry in PACKAGE["exports"].values() for path in (entry if isinstance(entry, str) else "")
    }
    assert all((WEB / name).exists() for name in PACKAGE["files"]), exported


def test_the_example_of_the_readme_learns(node, project):
    (example,) = re.findall(r"```js\n(.*?)```", README, flags=re.DOTALL)
    shutil.copy(build_wasm.MODULE, project / build_wasm.MODULE.name)
    (project / "example.mjs").write_text(example)
    done = subprocess.run([node, "example.mjs"], cwd=project, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    before, after = float(done.stdout.split()[0]), float(done.stdout.split()[-1])
    assert after > before + 10


def test_the_types_accept_the_example_and_refuse_wrong_calls(node, project):
    compiler = NPM / "typescript" / "bin" / "tsc"
    if not compiler.exists():
        pytest.skip("typescript is not installed: npm ci --prefix tests/npm")
    (example,) = re.findall(r"```js\n(.*?)```", README, flags=re.DOTALL)
    example = example.replace('readFileSync("gsplat_edu.wasm")', '"gsplat_edu.wasm"').replace(
        'import { readFileSync } from "node:fs";\n', ""
    )
    good = example.replace("const one", "const scene").replace("module, one,", "module, scene,")
    options = ["--noEmit", "--strict", "--module", "nodenext", "--target", "es2022", "--lib", "es2022,dom"]

    def messages(text):
        (project / "use.mts").write_text(text)
        words = [node, str(compiler), *options, "use.mts"]
        done = subprocess.run(words, cwd=project, capture_output=True, text=True, check=False)
        return done.stdout

    assert messages(good) == ""
    for call, message in WRONG.items():
        assert message in messages(f"{good}\n{call};\n"), call
