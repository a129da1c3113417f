"""Every script runs to the end at a tiny size and gives readable results."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsplat_edu.render.backends import unavailable
from processes import Program

ROOT = Path(__file__).parents[2]
BENCHMARKS = sorted((ROOT / "benchmarks").glob("*.py")) + sorted((ROOT / "benchmarks").glob("*/__main__.py"))
SHARED = {"captures.py", "hardware.py", "kernel_operations.py"}
"""Modules that the benchmarks and chapters import."""

MADE = {f"benchmarks/{name}" for name in ("sphere.py", "dense.py", "ladder", "train_step.py")}
"""Benchmarks that `make bench` runs."""

TRAININGS = {
    "own_loop.py": ("--iters", "3"),
    "train_2d.py": ("--splats", "5", "--iters", "2", "--size", "12"),
    "train_3d.py": ("--iters", "3", "--size", "16", "--k0", "10"),
}

PATHS = [p.parent if p.name == "__main__.py" else p for p in BENCHMARKS if p.name not in SHARED]
TRIED = [
    pytest.param(path, id=name, marks=() if name in MADE else pytest.mark.soak)
    for path in PATHS
    for name in [str(path.relative_to(ROOT))]
]
"""Outside of soaks, only those that `make bench` runs."""

SMALLEST = {"surfaces.py": ("--captures", "box")}
"""What makes a benchmark's trial run shorter than `--smoke` alone."""

ELSEWHERE = {
    "build_cli_reference.py": "tests/repo/test_cli_reference.py",
    "build_example.py": "tests/studio/test_example.py",
    "build_recipe_table.py": "tests/repo/test_recipe_document.py",
    "build_book.py": "tests/repo/test_book.py",
    "build_slides.py": "tests/repo/test_book.py",
    "build_notebooks.py": "tests/repo/test_notebooks.py",
    "build_site.py": "tests/repo/test_site.py",
    "build_wasm.py": "tools/set_up.sh",
    "build_wheels.py": "tests/repo/test_wheels.py",
    "chapter_figures.py": "tests/repo/test_notebooks.py",
    "check_objects.py": "tools/sanitize.sh",
    "landing_scene.py": "course/build_site.py",
    "figure_data.py": "tests/repo/test_figures.py",
    "figure_photos.py": "tests/repo/test_figures.py",
    "generate_recipe.py": "tests/tab/test_engine.py",
    "list_licences.py": "tests/repo/test_licences.py",
    "house_limits.py": "tests/repo/test_house_limits.py",
    "neon.sh": "Makefile",
    "sanitize.sh": "Makefile",
    "stress.sh": "Makefile",
    "set_up.sh": "Makefile",
    "site_figures.py": "tests/repo/test_figures.py",
    "wasm_host.py": "tests/tab/conftest.py",
}
"""By the name of a tool or of a script of the course, the file that runs it."""


SCRIPT = """
import os, runpy, sys
os.environ.pop("GSPLAT_EDU_DATA", None)
sys.argv.pop(0)
if os.path.isfile(sys.argv[0]):
    sys.path.insert(0, os.path.dirname(sys.argv[0]))
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def run(*words, cwd=ROOT):
    """Run a command without the environment of a make that runs these tests."""
    own = ("PART", "SEED", "SMOKE", "FILES", "ROUNDS", "MAKEFLAGS", "MFLAGS")
    env = {name: value for name, value in os.environ.items() if name not in own}
    return subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, check=False)


def script(path, *words, folder):
    """Run a Python script in a separate process; it finds only captures that it makes itself."""
    return Program(SCRIPT, [path, *words], folder).ended(patience=600)


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.parametrize("path", TRIED)
def test_a_benchmark_runs(path, tmp_path):
    out = tmp_path / "deep" / "figures.json"
    code, said, complained = script(
        path, "--smoke", *SMALLEST.get(path.name, ()), "--out", out, folder=tmp_path
    )
    needs = {"gpu.py": not torch.cuda.is_available(), "gpu_model.py": True}.get(path.name, False)
    if needs and unavailable("webgpu"):
        assert (code, complained.count("\n")) == (2, 1) and "no GPU" in complained
        return
    if path.name == "ladder" and "compiler" in complained:
        pytest.skip(complained.strip())
    assert code == 0, complained
    assert said.strip()
    assert json.loads(out.read_text())["hardware"]["cores"] > 0


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.parametrize("path", sorted((ROOT / "train").glob("*.py")), ids=lambda p: p.name)
def test_a_training_runs(path, tmp_path):
    out = tmp_path / "x.png"
    code, _, complained = script(path, *TRAININGS[path.name], "--out", out, folder=tmp_path)
    assert code == 0, complained
    assert out.stat().st_size > 0


def test_the_constants_are_generated(tmp_path):
    """A copy of the tool runs, because it writes next to itself."""
    made = ("native/constants.h", "src/gsplat_edu/engine/constants.wgsl")
    for name in ("tools/x", *made):
        (tmp_path / name).parent.mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "generate_constants.py", tmp_path / "tools")
    done = run(sys.executable, "tools/generate_constants.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for name in made:
        assert (tmp_path / name).read_text() == (ROOT / name).read_text()


def test_every_tool_is_run_somewhere():
    for path in (*(ROOT / "tools").iterdir(), *(ROOT / "course").iterdir()):
        if path.suffix in (".py", ".sh") and path.name != "generate_constants.py":
            assert path.stem in (ROOT / ELSEWHERE[path.name]).read_text(), path.name


def targets():
    return re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)[1].split()


def test_every_make_target_is_explained_and_run():
    """.ci/run, this file or a test of the same tool runs each target. Targets that take hours are run by hand."""
    explained = run("make", "help").stdout
    ci = (ROOT / ".ci" / "run").read_text()
    elsewhere = {
        "help",
        "clean",
        "course",
        "book",
        "slides",
        "notebooks",
        "site",
        "bench",
        "soak",
        "stress",
        "wheels",
        "sanitize",
    }
    for name in targets():
        assert name == "help" or re.search(rf"^make {name} ", explained, re.M), name
        assert name in elsewhere or re.search(rf"^make .*\b{name}\b", ci, re.M), name


@pytest.mark.parametrize(("setting", "flags"), [("", ()), ("SMOKE=1", ("--smoke",))])
def test_make_bench_runs_its_benchmarks(setting, flags):
    """`test_a_benchmark_runs` runs the same commands, but without a new process for each that imports torch."""
    done = run("make", "-n", "bench", *filter(None, [setting]))
    assert done.returncode == 0, done.stderr
    commands = [line.split()[1:] for line in done.stdout.splitlines() if "benchmarks/" in line]
    for path, *words in commands:
        stem = Path(path).stem
        assert words == [*flags, "--out", f"out/bench/{stem}.json"], path
        assert (ROOT / path).exists(), path
    assert {path for path, *_ in commands} == MADE


def soak(*settings):
    """Return the commands of `make soak` by its parts."""
    done = run("make", "-n", "soak", *settings)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if not line.lstrip().startswith("echo")]
    parts = {
        "cases": '-m "soak or fuzz"',
        "sanitize": "sanitize.sh",
        "neon": "neon.sh",
        "chapters": "build_notebooks.py",
        "wheels": "build_wheels.py",
    }
    return {part: line for part, sign in parts.items() for line in lines if sign in line}


def test_make_soak_runs_every_case_and_the_whole_budget():
    commands = soak()
    assert set(commands) == {"cases", "sanitize", "neon", "chapters", "wheels"}
    assert "GSPLAT_EDU_SOAK=1" in commands["cases"] and "GSPLAT_EDU_SOAK=1" in commands["sanitize"]
    assert "reduced" not in commands["chapters"]


def test_make_soak_runs_the_parts_that_are_named():
    assert set(soak("PART=cases sanitize")) == {"cases", "sanitize"}


def test_ci_runs_both_tiers_whole():
    """Every test belongs to one tier: `make test` deselects what `make test-slow` selects."""
    tiers = [run("make", "-n", name).stdout for name in ("test", "test-slow")]
    assert '-m "not slow"' in tiers[0] and "-m slow" in tiers[1] and "sanitize.sh" in tiers[1]
    assert {"make test", "make test-slow"} <= set((ROOT / ".ci" / "run").read_text().splitlines())


def test_make_clean_keeps_the_source(tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in (".venv/bin", "out/run", "build", "src"):
        (tmp_path / name).mkdir(parents=True)
    assert run("make", "clean", cwd=tmp_path).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Makefile", "src"]
