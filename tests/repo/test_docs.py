"""The documents' examples run, and the documents name everything that exists."""

import re
import shlex
from pathlib import Path

import pytest

from gsplat_edu.base import constants
from gsplat_edu.cli.main import build_parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = {
    f"{name}-{number}": example
    for name in ("README.md", "docs/PYTHON.md", "docs/GSPLAT.md")
    for number, example in enumerate(
        re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL)
    )
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_the_documents_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], name, "exec"), {})


def test_there_are_examples():
    assert {name.split("-")[0] for name in EXAMPLES} == {"README.md", "docs/PYTHON.md", "docs/GSPLAT.md"}
    assert len(EXAMPLES) >= 7


def test_the_readme_stays_short_and_shows_two_pictures():
    assert README.count("\n") <= 130
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert len(pictures) == 2
    for picture in pictures:
        assert (ROOT / picture).stat().st_size < 150_000, picture


def test_the_commands_that_the_documents_show_parse():
    """Shell lines of the README and the guide, without running them."""
    shown = 0
    for name in ("README.md", "docs/GUIDE.md"):
        for block in re.findall(r"```\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL):
            for line in block.splitlines():
                if line.startswith("gsplat-edu "):
                    words = shlex.split(line, comments=True)[1:]
                    build_parser(words).parse_args(words)
                    shown += 1
    assert shown > 10


def test_every_make_target_is_explained_by_make_help():
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.search(r"\.PHONY: (.*)", makefile)[1].split()) - {"help"}
    assert targets == set(re.findall(r'"make ([a-z]+) ', makefile))


def test_every_constant_is_in_the_decisions():
    decisions = (ROOT / "docs" / "DECISIONS.md").read_text()
    names = [name for name in vars(constants) if name.isupper()]
    assert len(names) > 8
    assert [name for name in names if name not in decisions] == []
    for name in ("DILATION", "ALPHA_MAX", "Z_NEAR", "TILE", "LAMBDA_FLOOR", "C0", "SH_OFFSET"):
        assert f"| `{name}` | {getattr(constants, name)}" in decisions, name


def undescribed(architecture, modules):
    """Find the modules that the tree of ARCHITECTURE.md does not name in their folder.

    Args:
        architecture: The document. Its first indented tree has a line for each top-level module or package; the
            contents of a package follow on that line or further to the right.
        modules: Paths within src/gsplat_edu, without the __init__ files.
    """
    (tree,) = re.findall(r"^src/gsplat_edu/\n(.*?)^\S", architecture, flags=re.MULTILINE | re.DOTALL)
    entries = {}
    for entry in re.split(r"^  (?=\S)", tree, flags=re.MULTILINE)[1:]:
        entries[entry.split()[0]] = entry
    missing = []
    for path in modules:
        *folders, name = path.parts
        text = entries.get(f"{folders[0]}/" if folders else name, "")
        for folder in folders[1:]:
            text = re.split(rf"(?<![\w./]){folder}/", text, maxsplit=1)[-1] if f"{folder}/" in text else ""
        if not re.search(rf"(?<![\w.-]){re.escape(name)}", text):
            missing.append(str(path))
    return missing


def test_every_module_is_in_the_architecture():
    package = ROOT / "src" / "gsplat_edu"
    modules = [path.relative_to(package) for path in package.rglob("*.py") if path.name != "__init__.py"]
    # The tree states once that a command's options are in a module of the command's name.
    modules = [path for path in modules if path.parts[:2] != ("cli", "options")]
    assert len(modules) > 100
    assert undescribed((ROOT / "ARCHITECTURE.md").read_text(), modules) == []


def test_a_module_named_in_another_folder_counts_as_missing():
    tree = "src/gsplat_edu/\n  camera.py  x\n  io/  ply.py, zip.py\n    sog/  files.py\n  runs/  log.py\ntests/\n"
    paths = ["camera.py", "io/ply.py", "io/sog/files.py", "runs/log.py"]
    assert undescribed(tree, map(Path, paths)) == []
    others = ["ply.py", "io/log.py", "runs/files.py", "io/sog/zip.py", "render/camera.py", "io/y.py"]
    assert undescribed(tree, map(Path, others)) == others


DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("conformance/*.md")])


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_documents_name_exist(path):
    text = path.read_text()
    linked = re.findall(r"\]\(([^)#]+)\)", text)
    named = re.findall(r"`((?:src|docs|tools|tests|benchmarks|notebooks|train|conformance)/[\w./-]+)`", text)
    for target in linked:
        assert (path.parent / target).exists(), target
    for target in named:
        assert (ROOT / target).exists(), target
