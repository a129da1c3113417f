"""The modules of a page's script become one classic script, in the order in which an engine runs modules."""

import json
import re
import shutil
import subprocess
from importlib.resources import files

import pytest

from gsplat_edu.viewer import capture_page, modules, page_parts

ENTRIES = {
    "plain": page_parts.PLAIN.entries,
    "levels": page_parts.LEVELS.entries,
    "live": page_parts.LIVE.entries,
    "pictured": page_parts.PICTURED.entries,
    "editor": page_parts.EDITOR.entries,
    "capture": capture_page.ENTRIES,
    "sort worker": ("sort_worker.js",),
    "levels worker": ("lod_worker.js",),
}

CYCLE = {
    "entry.js": 'import { left } from "./left.js";\nimport "./last.js";\n\nran.push("entry", left());\n',
    "left.js": 'import { right } from "./right.js";\n\nran.push("left");\nexport const two = 2;\n'
    "export function left() {\n  return right();\n}\n",
    "right.js": 'import {\n  two,\n} from "./left.js";\n\nran.push("right");\nexport const right = () => two;\n',
    "last.js": 'ran.push("last");\nexport class Unused {}\n',
}
"""`left.js` and `right.js` import each other."""


@pytest.fixture
def join(monkeypatch):
    """Return a function that makes the script of given modules, whose entry is entry.js."""

    def joined(texts):
        monkeypatch.setattr(modules, "web", texts.__getitem__)
        return modules.script.__wrapped__(("entry.js",))

    return joined


@pytest.mark.parametrize("name", ENTRIES)
def test_the_script_of_each_page_is_a_classic_one(name):
    script = modules.script(ENTRIES[name])
    assert script.startswith('"use strict";\n') and script.count('"use strict"') == 1
    lines = script.splitlines()
    assert not [line for line in lines if line.startswith(("import ", "export "))]


def test_a_page_has_only_the_modules_that_it_reaches():
    plain, editor = (modules.script(ENTRIES[name]) for name in ("plain", "editor"))
    for word in ("class EditTools ", "class EditFloaters ", "class Levels "):
        assert word not in plain
    assert "class EditTools " in editor and "class EditFloaters " in editor
    assert "class EditTools " not in modules.script(ENTRIES["capture"])


@pytest.mark.parametrize("package", ["studio", "viewer"])
def test_no_script_replaces_nodes(package):
    """They use the renderer, which keeps presses, focus and what is unfolded."""
    scripts = {
        path.name: path.read_text("utf-8") for path in (files("gsplat_edu") / package / "web").iterdir()
    }
    assert [name for name, text in scripts.items() if re.search(r"\.replace(Children|With)\(", text)] == []


def test_modules_run_after_those_they_import(join):
    script = join(CYCLE)
    places = [script.index(f'ran.push("{name}"') for name in ("right", "left", "last", "entry")]
    assert places == sorted(places)


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_order_is_that_of_an_engine(join, tmp_path):
    """The same modules as ES modules in node, and as one classic script, run in the same order with the same values."""
    prints = "console.log(JSON.stringify(ran));"
    for name, text in CYCLE.items():
        (tmp_path / name.replace(".js", ".mjs")).write_text(text.replace('.js"', '.mjs"'))
    (tmp_path / "modules.mjs").write_text(f'globalThis.ran = [];\nawait import("./entry.mjs");\n{prints}\n')
    (tmp_path / "classic.cjs").write_text(f"const ran = [];\n{join(CYCLE)}\n{prints}\n")
    ran = [
        json.loads(subprocess.run(["node", tmp_path / name], capture_output=True, check=True).stdout)
        for name in ("modules.mjs", "classic.cjs")
    ]
    assert ran[0] == ran[1] == ["right", "left", "last", "entry", 2]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("last.js", "export const left = 1;\n", "left.js, on the same page, defines left too"),
        ("last.js", "let [one, two] = [1, 2];\n", "left.js, on the same page, defines two too"),
        ("left.js", "function left() {}\nexport const two = 2;\n", "left.js does not export left"),
        ("last.js", 'import * as all from "./left.js";\n', "has another form"),
        ("last.js", 'import { two as deux } from "./left.js";\n', "left.js does not export as"),
        ("last.js", 'import { two } from "../left.js";\n', "has another form"),
        ("last.js", "export default 3;\n", "has another form"),
        ("last.js", "const a = 1;\nexport { a };\n", "has another form"),
    ],
)
def test_a_page_is_refused_whose_modules_do_not_fit(join, name, text, message):
    with pytest.raises(ValueError, match="entry.js|last.js|left.js") as error:
        join(CYCLE | {name: text})
    assert message in str(error.value) and "\n" not in str(error.value)
