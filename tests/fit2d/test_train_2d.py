"""The course's script train_2d.py, run as a user runs it."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "train" / "train_2d.py"
QUICK = ("--splats", "30", "--iters", "60", "--size", "32")


@pytest.fixture(scope="module")
def main():
    spec = importlib.util.spec_from_file_location("train_2d", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["train_2d"] = module  # dataclasses look up annotations in sys.modules
    spec.loader.exec_module(module)
    yield module.main
    del sys.modules["train_2d"]


def test_the_portrait_is_fitted_and_written(main, tmp_path, capsys):
    out = tmp_path / "new" / "folder" / "portrait.png"
    assert main([*QUICK, "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "grace_hopper.jpg: 27x32 px, 30 splats"
    assert [
        re.fullmatch(r"iter +(\d+)  MSE 0\.\d{6}  PSNR \d+\.\d\d dB", line)[1] for line in lines[1:3]
    ] == [
        "0",
        "50",
    ]
    assert re.fullmatch(r"60 iters in \d+\.\d s -> \d+\.\d ms/iter", lines[3])
    before, after = map(float, re.fullmatch(r"PSNR: start ([\d.]+) -> end ([\d.]+) dB", lines[4]).groups())
    assert after > before + 5
    assert lines[5] == f"wrote {out}, {out.with_name('portrait_curves.png')}"
    assert {path.name for path in out.parent.iterdir()} == {"portrait.png", "portrait_curves.png"}
    with Image.open(out) as picture:
        assert picture.size == (2 * 16 * 27 + 4, 16 * 32), (
            "target and fit side by side, each pixel enlarged to 16 x 16"
        )
    with Image.open(out.with_name("portrait_curves.png")) as curves:
        assert curves.width > 2 * curves.height


def test_the_same_seed_gives_the_same_bytes(main, tmp_path, capsys):
    written = []
    for name in ("one", "two"):
        out = tmp_path / name / "x.png"
        assert main([*QUICK, "--iters", "15", "--seed", "3", "--out", str(out)]) == 0
        lines = capsys.readouterr().out.splitlines()
        written.append(([line for line in lines if line.startswith(("iter ", "PSNR"))], out.read_bytes()))
    assert written[0] == written[1] and len(written[0][0]) == 2


FIT = """
import hashlib, sys
import numpy as np
from gsplat_edu.fit2d.fit import Fit2DSettings, fit_2d
from gsplat_edu.fit2d.splats import random_splats_2d
rng = np.random.default_rng(1)
fit = fit_2d(rng.uniform(size=(60, 50, 3)), random_splats_2d(50, 60, 50, rng), Fit2DSettings(8))
assert "torch" not in sys.modules
print(hashlib.sha256(b"".join(array.tobytes() for array in fit.splats.arrays().values())).hexdigest())
"""


@pytest.mark.own_process
def test_a_fit_does_not_depend_on_threads():
    """The loop never calls BLAS, whose sums depend on the threads, and needs no torch."""
    digests = set()
    for threads in ("1", "4"):
        many = {f"{name}_NUM_THREADS": threads for name in ("OMP", "OPENBLAS", "MKL")}
        path = {"PYTHONPATH": str(ROOT / "src")}
        done = subprocess.run(
            [sys.executable, "-c", FIT],
            env=os.environ | many | path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        digests.add(done.stdout)
    assert len(digests) == 1


def test_transparent_and_gray_pictures_are_fitted(main, tmp_path, capsys):
    pixels = np.zeros((6, 9, 4), dtype=np.uint8)
    pixels[..., 0], pixels[:3, :, 3] = 200, 255
    Image.fromarray(pixels).save(tmp_path / "half.png")
    Image.fromarray(pixels[..., 0]).save(tmp_path / "gray.png")
    for name in ("half", "gray"):
        image, out = tmp_path / f"{name}.png", tmp_path / f"{name}_out.png"
        assert main(["--image", str(image), "--splats", "3", "--iters", "1", "--out", str(out)]) == 0
        with Image.open(out) as picture:
            left = np.asarray(picture)[:, : 9 * (512 // 9)]
        assert (left[0, 0] == ((200, 0, 0) if name == "half" else (200, 200, 200))).all()
        assert (left[-1, 0] == ((0, 0, 0) if name == "half" else (200, 200, 200))).all()
    assert "half.png: 9x6 px, 3 splats" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--image", "nowhere.jpg"], "--image: nowhere.jpg does not exist; give an image file"),
        (["--image", "."], "--image: . is a folder; give an image file"),
        (["--image", "text.png"], "--image: text.png: cannot be decoded"),
        (["--image", "short.png"], "--image: short.png: cannot be decoded"),
        (["--splats", "0"], "--splats: is 0, but has to be a whole number from 1"),
        (["--iters", "-4"], "--iters: is -4, but has to be a whole number from 1"),
        (["--size", "1000000"], "--size: is 1000000, but has to be a whole number from 1"),
        (["--seed", "-1"], "--seed: is -1, but has to be a whole number of at least 0"),
        (["--out", "picture.jpg"], "--out: 'picture.jpg' must end in .png"),
        (["--out", "text.png/x.png"], "--out: cannot write text.png/x.png"),
        (["--image", "good.png", "--out", "good.png"], "--out: good.png is the picture itself"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(main, tmp_path, monkeypatch, capsys, arguments, line):
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0).integers(0, 256, (25, 40, 3), dtype=np.uint8)
    Image.fromarray(noise).save("good.png")
    Path("text.png").write_text("no image\n")
    Path("short.png").write_bytes(Path("good.png").read_bytes()[:200])
    before = sorted(path.name for path in Path().iterdir())
    assert main(["--iters", "1", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"train_2d.py: {line}") and err.count("\n") == 1
    assert sorted(path.name for path in Path().iterdir()) == before


@pytest.mark.parametrize("arguments", [["--splats", "many"], ["--sizes", "4"], ["x.jpg"]])
def test_a_bad_command_line_gives_one_line_and_exit_code_2(main, capsys, arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("train_2d.py: ") and err.count("\n") == 1


def test_the_options_of_the_script(main, capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    options = set(re.findall(r"--[a-z]+", capsys.readouterr().out)) - {"--help", "--debug"}
    assert options == {"--image", "--splats", "--iters", "--size", "--seed", "--out"}
