"""Every script runs: at a tiny size, to the end, with results that can be read."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
BENCHMARKS = sorted((ROOT / "benchmarks").glob("*.py")) + sorted((ROOT / "benchmarks").glob("*/__main__.py"))
SHARED = {"captures.py", "hardware.py"}
"""What the others import."""

TRAININGS = {
    "train_2d.py": ("--splats", "5", "--iters", "2", "--size", "12"),
    "train_3d.py": ("--iters", "3", "--size", "12", "--k0", "10"),
}

ELSEWHERE = {
    "build_cli_reference.py": "tests/repo/test_cli_reference.py",
    "build_recipe_table.py": "tests/repo/test_recipe_document.py",
    "build_notebooks.py": "tests/repo/test_notebooks.py",
    "build_site.py": "tests/repo/test_site.py",
    "chapter_figures.py": "tests/repo/test_notebooks.py",
    "check_objects.py": "tools/sanitize.sh",
    "house_limits.py": "tests/repo/test_house_limits.py",
    "sanitize.sh": "Makefile",
    "set_up.sh": "Makefile",
}
"""Tools, and where each is run."""


def run(*words, cwd=ROOT):
    environment = {key: value for key, value in os.environ.items() if key != "GSPLAT_EDU_DATA"}
    return subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def script(*words):
    return run(sys.executable, *map(str, words))


@pytest.mark.own_process
@pytest.mark.parametrize(
    "path", [p for p in BENCHMARKS if p.name not in SHARED], ids=lambda p: str(p.relative_to(ROOT))
)
def test_a_benchmark_runs(path, tmp_path):
    out = tmp_path / "deep" / "figures.json"
    done = script(path.parent if path.name == "__main__.py" else path, "--smoke", "--out", out)
    if path.name == "gpu.py" and not torch.cuda.is_available():
        assert (done.returncode, done.stderr.count("\n")) == (2, 1) and "no GPU" in done.stderr
        return
    if path.parent.name == "ladder" and "compiler" in done.stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    assert json.loads(out.read_text())["hardware"]["cores"] > 0


@pytest.mark.own_process
@pytest.mark.parametrize("path", sorted((ROOT / "train").glob("*.py")), ids=lambda p: p.name)
def test_a_training_runs(path, tmp_path):
    out = tmp_path / "x.png"
    done = script(path, *TRAININGS[path.name], "--out", out)
    assert done.returncode == 0, done.stderr
    assert out.stat().st_size > 0


def test_the_constants_are_generated(tmp_path):
    """A copy of the tool writes beside itself."""
    for name in ("tools", "native"):
        (tmp_path / name).mkdir()
    shutil.copy(ROOT / "tools" / "generate_constants.py", tmp_path / "tools")
    done = run(sys.executable, "tools/generate_constants.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    made = (tmp_path / "native" / "constants.h").read_text()
    assert made == (ROOT / "native" / "constants.h").read_text()


def test_every_tool_is_run_somewhere():
    for path in (ROOT / "tools").iterdir():
        if path.suffix in (".py", ".sh") and path.name != "generate_constants.py":
            assert path.stem in (ROOT / ELSEWHERE[path.name]).read_text(), path.name


def targets():
    return re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)[1].split()


def test_every_target_is_explained_and_run():
    """By .ci/run, by this file, or with the same tool by another test."""
    told = run("make", "help").stdout
    ci = (ROOT / ".ci" / "run").read_text()
    elsewhere = {"help", "clean", "notebooks", "site"}
    for name in targets():
        assert name == "help" or re.search(rf"^make {name} ", told, re.M), name
        assert name in elsewhere or re.search(rf"^make {name}\b", ci, re.M), name


def test_make_bench_smoke_passes_the_option_to_every_script():
    done = run("make", "-n", "bench", "SMOKE=1")
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if "benchmarks/" in line]
    assert len(lines) >= 5 and all("--smoke" in line for line in lines)


def test_make_clean_leaves_the_source(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (".venv/bin", "out/run", "build", "src"):
        (tmp_path / name).mkdir(parents=True)
    assert run("make", "clean", cwd=tmp_path).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Makefile", "src"]
