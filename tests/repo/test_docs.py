"""The documents are tested: their examples run, and they name everything there is."""

import re
import shlex
from pathlib import Path

import pytest

from gsplat_edu import constants
from gsplat_edu.cli.main import build_parser

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
EXAMPLES = {
    f"{name}-{number}": example
    for name in ("README.md", "docs/PYTHON.md")
    for number, example in enumerate(
        re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL)
    )
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_the_documents_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[name], name, "exec"), {})


def test_there_are_examples():
    assert {name.split("-")[0] for name in EXAMPLES} == {"README.md", "docs/PYTHON.md"} and len(EXAMPLES) >= 5


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


def test_every_benchmark_has_its_results():
    results = (ROOT / "benchmarks" / "RESULTS.md").read_text()
    scripts = {path.name for path in (ROOT / "benchmarks").glob("*.py")} - {"hardware.py", "captures.py"}
    assert scripts
    assert [name for name in scripts if f"python benchmarks/{name}" not in results] == []


def test_every_constant_is_in_the_decisions():
    decisions = (ROOT / "docs" / "DECISIONS.md").read_text()
    names = [name for name in vars(constants) if name.isupper()]
    assert len(names) > 8
    assert [name for name in names if name not in decisions] == []
    for name in ("DILATION", "ALPHA_MAX", "Z_NEAR", "TILE", "LAMBDA_FLOOR", "C0", "SH_OFFSET"):
        assert f"| `{name}` | {getattr(constants, name)}" in decisions, name


def test_every_module_is_in_the_architecture():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    package = ROOT / "src" / "gsplat_edu"
    names = [path.name for path in package.rglob("*.py") if path.name != "__init__.py"]
    missing = [name for name in names if name not in text and name != "demo.py" and name != "arguments.py"]
    assert missing == []


DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_files_that_documents_name_exist(path):
    text = path.read_text()
    linked = re.findall(r"\]\(([^)#]+)\)", text)
    named = re.findall(r"`((?:src|docs|tools|tests|benchmarks|notebooks|train)/[\w./-]+)`", text)
    for target in linked:
        assert (path.parent / target).exists(), target
    for target in named:
        assert (ROOT / target).exists(), target
