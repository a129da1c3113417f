"""The course's script, run as a user runs it."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.image import imread

from processes import Program
from waiting import until

SCRIPT = Path(__file__).parents[2] / "train" / "train_3d.py"
RUN = """
import runpy, sys
sys.argv.pop(0)
sys.stdout.reconfigure(line_buffering=True)
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def run(*arguments, **options):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.mark.soak
def test_the_default_budget_trains_end_to_end(tmp_path):
    """The dense backend's reduced budget cuts the held-out error at least threefold.

    This takes minutes; tests/golden checks the first iteration on every run, and the first hundred with the kernels.
    """
    out = tmp_path / "new" / "folder" / "sphere.png"
    # Use one thread: torch's threads wait for each other, which takes minutes on a busy machine.
    done = run("--backend", "torch", "--out", out, cwd=tmp_path, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert (
        "reduced to --iters 300 --cap 800 --size 64 (the chapter uses --iters 800 --cap 1600 --size 128)"
        in lines[0]
    )
    assert re.fullmatch(r"iter    0  L1 0\.\d{4}  K 400", lines[1])
    assert re.fullmatch(r"  densify: \+\d+ cloned, \+\d+ split children, -\d+ pruned -> K=\d+", lines[3])
    assert re.fullmatch(r"300 iters in \d+\.\d s -> \d+\.\d{3} ms/iter at 64 px, K~800", lines[-3])
    scores = re.fullmatch(r"held-out L1: init (0\.\d{4}) -> final (0\.\d{4})", lines[-2])
    before, after = (float(number) for number in scores.groups())
    assert before > 3 * after

    written = {path.name for path in out.parent.iterdir()}
    assert written == {"sphere.png", "sphere_curves.png", "sphere.ply"}
    figure = imread(out)
    assert figure.shape[1] > 3 * figure.shape[0], "four panels side by side"
    ply = out.with_suffix(".ply").read_bytes()
    assert b"element vertex 800\n" in ply and len(ply.split(b"end_header\n", 1)[1]) == 800 * 17 * 4


def test_the_budget_on_the_command_line(tmp_path):
    budget = ["--iters", 3, "--k0", 12, "--cap", 20, "--size", 16, "--seed", 4, "--backend", "torch"]
    code, said, complained = Program(RUN, [SCRIPT, *budget, "--out", tmp_path / "x.png"], tmp_path).ended()
    assert code == 0, complained
    assert "reduced" not in said, "no given option was changed"
    assert "ms/iter at 16 px, K~12" in said
    assert said.splitlines()[-1] == "wrote " + ", ".join(
        str(tmp_path / name) for name in ("x.png", "x_curves.png", "x.ply")
    )


def test_an_interrupt_is_one_line_and_exit_code_130(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    words = [SCRIPT, "--iters", 100_000, "--size", 16, "--out", out / "x.png"]
    program, said = Program(RUN, words, tmp_path), tmp_path / "stdout.txt"
    until(lambda: not program.runs or (said.exists() and "\niter " in "\n" + said.read_text()))
    assert program.runs, program.ended()
    program.send(signal.SIGINT)
    code, _, complained = program.ended()
    assert (code, complained) == (130, "train_3d.py: interrupted\n")
    assert list(out.iterdir()) == []
