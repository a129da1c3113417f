"""The documents' examples run, and the documents name all commands, constants, targets and benchmarks."""

import ast
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu import load_backend
from gsplat_edu.base import constants
from gsplat_edu.cli.main import build_parser
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.scene import projection, projection_formulas, shutter, sight
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.events import StepEvent
from gsplat_edu.train.initialize import random_ball

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "gsplat_edu"
README = (ROOT / "README.md").read_text()
TOUR = ROOT / "docs" / "TOUR.md"
HOW_TOS = sorted((ROOT / "docs" / "howto").glob("*.md"))
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


def the_log():
    """Return the source of `logging_to` in PYTHON.md, and the function."""
    (example,) = [text for text in EXAMPLES.values() if "def logging_to(" in text]
    (function,) = [each for each in ast.parse(example).body if isinstance(each, ast.FunctionDef)]
    names = {"StepEvent": StepEvent}
    source = ast.get_source_segment(example, function)
    exec(compile(source, "PYTHON.md", "exec"), names)
    return source, names["logging_to"]


class Recorder:
    """Takes what the `SummaryWriter` of torch.utils.tensorboard takes, and keeps it."""

    def __init__(self):
        self.rows = {}

    def add_scalar(self, tag, scalar_value, global_step=None):
        assert isinstance(tag, str) and isinstance(scalar_value, (int, float)), "what TensorBoard can write"
        self.rows.setdefault(tag, []).append((global_step, scalar_value))


@pytest.mark.parametrize("every", [1, 4])
def test_ten_lines_log_every_loss_and_count_of_a_training(every):
    source, logging_to = the_log()
    assert len([line for line in source.splitlines() if line.strip()]) <= 10
    capture, writer = sphere_capture(size=16), Recorder()
    start = Start(random_ball(40, torch.Generator().manual_seed(0)), extent=EXTENT)
    result = training(
        course_config(iterations=9).changed(strategy="none"),
        Views(capture.train),
        load_backend("cpu"),
        start,
        callbacks=[logging_to(writer, every)],
    ).run()
    steps = range(0, 9, every)
    assert set(writer.rows) == {"loss/photo", "gaussians"}
    assert writer.rows["loss/photo"] == [(step, result.losses[step]) for step in steps]
    assert writer.rows["gaussians"] == [(step, 40) for step in steps]


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
    """Shell lines of the README, the tour and the how-tos, without running them."""
    shown = 0
    for path in (ROOT / "README.md", TOUR, *HOW_TOS):
        for block in re.findall(r"^```\w*\n(.*?)^```$", path.read_text(), flags=re.DOTALL | re.MULTILINE):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.sub(r"^torchrun .* -m gsplat_edu ", "gsplat-edu ", line)
                if command.startswith("gsplat-edu "):
                    words = shlex.split(command, comments=True)[1:]
                    build_parser(words).parse_args(words)
                    shown += 1
    assert shown > 80


def test_the_options_that_the_tour_and_the_how_tos_name_exist():
    existing = set(re.findall(r"`(--[a-z-]+)", (ROOT / "docs" / "CLI.md").read_text()))
    named = {option for path in (TOUR, *HOW_TOS) for option in re.findall(r"`(--[a-z-]+)", path.read_text())}
    assert len(named) > 50
    assert named - existing == {"--max-restarts"}, "which is torchrun's"


def test_the_tour_and_the_how_tos_are_short():
    assert len(HOW_TOS) > 20
    for path in (TOUR, *HOW_TOS):
        text = path.read_text()
        assert len(text.split()) <= (1500 if path == TOUR else 700), path.name
        assert longest_line(text) <= 120, path.name


def test_the_index_names_every_how_to():
    index = ROOT / "docs" / "howto" / "README.md"
    named = re.findall(r"\]\(([\w-]+\.md)\)", index.read_text())
    assert sorted([*named, "README.md"]) == [path.name for path in HOW_TOS]


def test_every_make_target_is_explained_by_make_help():
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.search(r"\.PHONY: (.*)", makefile)[1].split()) - {"help"}
    assert targets == set(re.findall(r'"make ([a-z-]+) ', makefile))


def test_every_constant_is_in_the_decisions():
    decisions = (ROOT / "docs" / "DECISIONS.md").read_text()
    names = [name for name in vars(constants) if name.isupper()]
    assert len(names) > 8
    assert [name for name in names if name not in decisions] == []
    for name in ("DILATION", "ALPHA_MAX", "Z_NEAR", "TILE", "LAMBDA_FLOOR", "C0", "SH_OFFSET"):
        assert f"| `{name}` | {getattr(constants, name)}" in decisions, name


def test_every_constant_of_lenses_is_in_the_decisions():
    decisions = (ROOT / "docs" / "DECISIONS.md").read_text()
    for module in (projection, projection_formulas, shutter, sight):
        named = re.findall(
            r"^([A-Z][A-Z_]+) = [\w.]+(?:\(.*\))?$", Path(module.__file__).read_text(), re.MULTILINE
        )
        numbers = [name for name in named if isinstance(getattr(module, name), (int, float))]
        assert numbers, module.__name__
        for name in numbers:
            value = getattr(module, name)
            angle = np.degrees(value) if name.startswith("STEEPEST") else value
            shown = "cos 89 degrees" if name == "POLE" else f"{angle:g}"
            assert re.search(rf"\| `{name}` \| {shown}", decisions.replace("1e-9", "1e-09")), name
    assert pytest.approx(np.cos(np.radians(89))) == projection_formulas.POLE


def test_the_architecture_shows_the_layers_of_the_contract():
    with (ROOT / "pyproject.toml").open("rb") as file:
        (layers,) = (
            contract["layers"]
            for contract in tomllib.load(file)["tool"]["importlinter"]["contracts"]
            if contract["type"] == "layers"
        )
    text = (ROOT / "ARCHITECTURE.md").read_text()
    block = text[text.index("```\ncli ") + 4 :].split("\n```")[0]
    assert [re.split(r"\s{2,}", line)[0] for line in block.splitlines()] == layers


def test_the_architecture_is_short():
    lines = (ROOT / "ARCHITECTURE.md").read_text().splitlines()
    assert len(lines) <= 130 and max(map(len, lines)) <= 160


def longest_line(text):
    """Return the length of the longest line that is not a row of a table."""
    return max(len(line) for line in text.splitlines() if not line.startswith("|"))


def test_the_results_are_short_and_every_table_has_its_machine_and_date():
    text = (ROOT / "benchmarks" / "RESULTS.md").read_text()
    assert text.count("\n") <= 160 and longest_line(text) <= 160
    sections = text.split("\n## ")[1:]
    assert len(sections) > 5
    for section in sections:
        title = section.splitlines()[0]
        assert "\n|---|" in section, title
        assert re.search(r"\b(EPYC|Xeon)\b", section) and "2026-" in section, title


def test_every_benchmark_is_named_in_the_results():
    """Modules that benchmarks import measure nothing."""
    folder = ROOT / "benchmarks"
    results = (folder / "RESULTS.md").read_text()
    scripts = [path for path in folder.glob("*.py") if 'if __name__ == "__main__":' in path.read_text()]
    scripts += [path.parent for path in folder.glob("*/__main__.py")]
    assert len(scripts) > 15
    for path in scripts:
        assert re.search(rf"benchmarks/{re.escape(path.name)}(?![\w/])", results), path.name


def test_the_changelog_is_short():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert text.count("\n") <= 40 and longest_line(text) <= 160


def test_sections_that_documents_name_are_in_the_results():
    """The patterns are: "Glare" in RESULTS.md, and: section "Glare" of [RESULTS.md](...)."""
    headings = re.findall(r"^## ([^(\n]+?)(?: \(|$)", (ROOT / "benchmarks" / "RESULTS.md").read_text(), re.M)
    named = set()
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]:
        text = " ".join(path.read_text().split())
        named |= set(re.findall(r'"([\w ]+)" (?:in|of) \[?(?:benchmarks/)?RESULTS\.md', text))
    assert len(named) > 5
    assert named <= set(headings)


DOCUMENTS = sorted(
    [
        *ROOT.glob("*.md"),
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("conformance/*.md"),
        *ROOT.glob("benchmarks/**/*.md"),
    ]
)


def anchors(text):
    """Return the anchors of a document's headings, as GitHub and the site name them."""
    headings = re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_sections_that_links_name_exist():
    links = 0
    for path in DOCUMENTS:
        for target, anchor in re.findall(r"\]\(([\w./-]*)#([\w-]+)\)", path.read_text()):
            named = path.parent / target if target else path
            if named.suffix == ".md":
                assert anchor in anchors(named.read_text()), f"{path.relative_to(ROOT)}: {target}#{anchor}"
                links += 1
    assert links > 50


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_documents_name_exist(path):
    text = path.read_text()
    linked = re.findall(r"\]\(([^)#]+)\)", text)
    named = re.findall(
        r"`((?:src|docs|tools|course|tests|benchmarks|notebooks|train|conformance)/[\w./-]+)`", text
    )
    for target in linked:
        assert target.startswith("https://") or (path.parent / target).exists(), target
    for target in named:
        assert (ROOT / target).exists() or (PACKAGE / target).exists(), target
    for room, target in re.findall(r"`((?:gsplat_edu/)?(\w+)/[\w/]+\.py)`", text):
        if (PACKAGE / target).is_dir():
            assert any((root / room).exists() for root in (ROOT, PACKAGE, PACKAGE.parent)), room
