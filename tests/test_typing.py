"""The types that a user's editor and checkers see: mypy, strict, and pyright."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import numpy as np
import torch

from gsplat_edu import Camera, Gaussians, load_backend, load_dataset, read_scene, recipe, render, training, write_scene

scene: Gaussians = read_scene("scene.ply").gaussians
camera = Camera.looking_at(np.array([0.0, 0.0, -4.0]), np.zeros(3), 300.0, 300.0, 200, 300)
output = render(scene, camera)
image: torch.Tensor = output.image
output.save("image.png")
dataset = load_dataset("capture")
trainer = training(recipe(300), dataset, load_backend("cpu"))
losses = trainer.run().losses
write_scene("scene.spz", trainer.gaussians[:10])
groups = scene.parameter_groups({"means": 1e-3})
wrong: int = output.image
"""
PYRIGHT = Path(__file__).parent / "npm/node_modules/pyright/index.js"


@pytest.fixture
def program(tmp_path):
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    return file


@pytest.mark.slow
def test_mypy_finds_the_one_error_of_a_users_program(program):
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--cache-dir",
        str(program.parent / "cache"),
        program.name,
    ]
    done = subprocess.run(
        command, cwd=program.parent, capture_output=True, text=True, timeout=600, check=False
    )
    line = PROGRAM[: PROGRAM.index("wrong:")].count("\n") + 1
    (found,) = [each for each in done.stdout.splitlines() if ": error: " in each]
    assert found.startswith(
        f'program.py:{line}: error: Incompatible types in assignment (expression has type "Tensor"'
    )


@pytest.mark.slow
def test_pyright_finds_the_one_error_of_a_users_program(program):
    if shutil.which("node") is None or not PYRIGHT.exists():
        pytest.skip("pyright is not installed: npm ci --prefix tests/npm")
    command = ["node", str(PYRIGHT), "--outputjson", "--pythonpath", sys.executable, program.name]
    done = subprocess.run(
        command, cwd=program.parent, capture_output=True, text=True, timeout=600, check=False
    )
    (found,) = json.loads(done.stdout)["generalDiagnostics"]
    assert found["message"].startswith('Type "Tensor" is not assignable to declared type "int"')
