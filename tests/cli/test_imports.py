"""Modules that take seconds to import are not imported for a mistake, `--help` or an out-of-range value."""

import subprocess
import sys

import pytest

from gsplat_edu.cli.main import COMMANDS, main

HEAVY = ("torch", "scipy", "cv2", "matplotlib", "PIL", "dask", "distributed", "starlette", "uvicorn")

PROBE = """
import contextlib, io, sys
from gsplat_edu.cli.main import main
for line in sys.stdin.read().splitlines():
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            code = main(line.split())
        except SystemExit as stop:
            code = stop.code
    print(code, *sorted(set(%r) & set(sys.modules)), "|", err.getvalue().strip())
"""

NEEDED = {
    "train": "CAPTURE --out RUN",
    "block": "a 0",
    "merge": "a",
    "sfm": "a b",
    "eval": "a",
    "render": "a",
    "convert": "a b.ply",
    "clean": "a",
    "mesh": "a b.glb",
    "view": "a",
    "studio": "",
    "web": "",
    "doctor": "a",
    "leave-out": "a",
    "mask": "a b",
    "grade": "a",
    "info": "a",
    "demo": "",
}

OUT_OF_RANGE = [
    "train CAPTURE --out RUN --iterations -5",
    "train CAPTURE --out RUN --max-gaussians 0",
    "train CAPTURE --out RUN --strategy best",
    "train CAPTURE --out RUN --resolution -2",
    "train CAPTURE --out RUN --backend gpu",
    "train CAPTURE --out RUN --from nowhere.ply",
    "train nowhere --out RUN",
    "train CAPTURE --out RUN --blocks 0",
    "train CAPTURE --out RUN --workers 2",
    "train CAPTURE --out RUN --blocks 3 --until split --time-limit 5m",
    "block nowhere 0",
    "merge nowhere",
    "eval nowhere",
    "eval CAPTURE",
    "render a --backend gpu",
    "sfm a b --matcher none",
    "sfm a b --frames 0",
    "clean a --max-loss -1",
    "clean a --dry-run --out b.ply",
    "mesh a b.stl",
    "mesh a b.glb --voxel 0",
    "studio --jobs 0",
    "grade nowhere.py",
]


@pytest.mark.own_process
def test_mistakes_and_help_import_nothing_heavy(tmp_path):
    assert set(NEEDED) == set(COMMANDS)
    lines = ["--version", "--help", "--verison", "trian", "train --help-all"]
    for name, words in NEEDED.items():
        lines += [f"{name} --help", f"{name} {words} --backendd cpu", f"{name} {words} --iteration 10"]
    lines += OUT_OF_RANGE
    (tmp_path / "photos").mkdir()
    commands = (
        "\n".join(lines).replace("CAPTURE", str(tmp_path / "photos")).replace("RUN", str(tmp_path / "run"))
    )
    finished = subprocess.run(
        [sys.executable, "-c", PROBE % (HEAVY,)], input=commands, capture_output=True, text=True, check=True
    )
    answers = finished.stdout.splitlines()
    assert len(answers) == len(lines)
    for line, answer in zip(lines, answers, strict=True):
        wanted = "0" if line.endswith(("--help", "--help-all", "--version")) else "2"
        assert answer.startswith(f"{wanted} |"), (line, answer)
    assert not (tmp_path / "run").exists()
    answer_to = dict(zip(lines, answers, strict=True))
    assert (
        "gsplat-edu train: unrecognized argument --iteration: did you mean --iterations? see gsplat-edu train"
        in (answer_to["train CAPTURE --out RUN --iteration 10"])
    )
    assert "--backendd: did you mean --backend?" in answer_to["eval a --backendd cpu"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("eval -m a", "-m: it is RUN here, which is written without an option"),
        ("train --source_path a -m b", "--source_path: it is DATA here, which is written without an option"),
        ("train a -m b", "-m: it is --out here"),
        ("train a --out b --max_steps 9", "--max_steps: it is --iterations here"),
        ("convert -m a", "-m: it is IN here, which is written without an option"),
    ],
)
def test_options_of_other_programs_lead_to_ours(capsys, words, said):
    with pytest.raises(SystemExit) as left:
        main(words.split())
    assert left.value.code == 2
    assert f"unrecognized argument {said};" in capsys.readouterr().err
