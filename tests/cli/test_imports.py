"""What costs seconds to import is not imported for a mistake, `--help` or a value that is out of range."""

import subprocess
import sys

import pytest

from gsplat_edu.cli.main import COMMANDS

HEAVY = ("torch", "scipy", "cv2", "matplotlib", "PIL")

ASKS = """
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
    "sfm": "a b",
    "eval": "a",
    "render": "a",
    "convert": "a b.ply",
    "view": "a",
    "doctor": "a",
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
    "eval nowhere",
    "eval CAPTURE",
    "render a --backend gpu",
    "sfm a b --matcher none",
    "sfm a b --frames 0",
]


@pytest.mark.own_process
def test_mistakes_and_help_import_nothing_heavy(tmp_path):
    assert set(NEEDED) == set(COMMANDS)
    lines = ["--version", "--help", "--verison", "trian", "train --help-all"]
    for name, words in NEEDED.items():
        lines += [f"{name} --help", f"{name} {words} --backendd cpu", f"{name} {words} --iteration 10"]
    lines += OUT_OF_RANGE
    (tmp_path / "photos").mkdir()
    asked = (
        "\n".join(lines).replace("CAPTURE", str(tmp_path / "photos")).replace("RUN", str(tmp_path / "run"))
    )
    done = subprocess.run(
        [sys.executable, "-c", ASKS % (HEAVY,)], input=asked, capture_output=True, text=True, check=True
    )
    answers = done.stdout.splitlines()
    assert len(answers) == len(lines)
    for line, answer in zip(lines, answers, strict=True):
        wanted = "0" if line.endswith(("--help", "--help-all", "--version")) else "2"
        assert answer.startswith(f"{wanted} |"), (line, answer)
    assert not (tmp_path / "run").exists()
    said = dict(zip(lines, answers, strict=True))
    assert (
        "gsplat-edu train: unrecognized argument --iteration: did you mean --iterations? see gsplat-edu train"
        in (said["train CAPTURE --out RUN --iteration 10"])
    )
    assert "--backendd: did you mean --backend?" in said["eval a --backendd cpu"]
