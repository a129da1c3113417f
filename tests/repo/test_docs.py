"""The documents are tested: their examples run, and they name everything there is."""

import re
from pathlib import Path

import pytest

from gsplat_edu import constants
from gsplat_edu.cli.main import COMMANDS, main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
RECIPE = (ROOT / "docs" / "RECIPE.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_readmes_examples_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})


def test_there_are_examples():
    assert len(EXAMPLES) >= 2


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_and_option_is_in_the_readme(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    options = set(re.findall(r"--[a-z0-9-]+", capsys.readouterr().out)) - {"--help"}
    assert f"`gsplat-edu {command}`" in README
    recipe = {
        f"--{name.replace('_', '-')}" for name in re.findall(r"^\| `(\w+)` \|", RECIPE, flags=re.MULTILINE)
    }
    assert options - recipe - set(re.findall(r"--[a-z0-9-]+", README)) == set()


def test_every_make_target_is_in_the_readme_and_explained_by_make_help():
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.search(r"\.PHONY: (.*)", makefile)[1].split()) - {"help"}
    assert targets == set(re.findall(r"`make ([a-z]+)`", README))
    assert targets == set(re.findall(r'"make ([a-z]+) ', makefile))


def test_every_benchmark_has_its_results():
    results = (ROOT / "benchmarks" / "RESULTS.md").read_text()
    scripts = {path.name for path in (ROOT / "benchmarks").glob("*.py")} - {"captures.py", "hardware.py"}
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
