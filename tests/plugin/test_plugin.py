"""A package adds a part, a strategy, a reader, a format and a command; nothing of ours knows it."""

import json
import shutil
import signal

import cv2
import numpy as np
import pytest

from gsplat_edu.data.procedural import procedural_capture
from plugin.package import command, files, install, python

TRAINING = ("--strategy", "sieve", "--crisp-weight", "0.01", "--set", "sieve_least=0.05")
LENGTH = ("--iterations", "60", "--save-every", "20", "--points", "random")

KILLED = """
import os, signal, sys
from gsplat_edu.cli.main import main
from gsplat_edu.runs.training import CaptureRun
train = CaptureRun.train

def until_30(run, stop, callbacks=()):
    def kill(trainer, event):
        if trainer.iteration == 30:
            os.kill(os.getpid(), signal.SIGKILL)
    return train(run, stop, [*callbacks, kill])

CaptureRun.train = until_30
main()
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    install(folder)
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture in the layout of the package: photos, and their places as text."""
    folder, lines = tmp_path_factory.mktemp("captures") / "egg", []
    folder.mkdir()
    views, _, _ = procedural_capture(24, 8, splats=60)
    for number, view in enumerate(views):
        name = f"{number}.png"
        cv2.imwrite(str(folder / name), np.ascontiguousarray(view.read().image[..., ::-1]))
        x, y, z = view.camera.eye.tolist()
        lines.append(f"{name} {view.camera.W} {view.camera.H} {view.camera.fx} {x} {y} {z}")
    (folder / "orbit.txt").write_text("\n".join(lines))
    return folder


@pytest.fixture(scope="module")
def run(site, capture, tmp_path_factory):
    """A whole training with everything of the package."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    code, _, errors = command("train", capture, "--out", out, *TRAINING, *LENGTH, site=site)
    assert code == 0, errors
    return out


def test_the_document_is_a_page():
    lines = [line for text in files().values() for line in text.splitlines() if line.strip()]
    assert len(lines) <= 120


def test_its_options_and_command_stand_beside_ours(site):
    code, said, errors = command("train", "--help-all", site=site)
    assert code == 0, errors
    assert "--crisp-weight N" in said and "  sieve_least=0.02" in said and "solid or empty" in said
    assert "count" in command("--help", site=site)[1]
    asked = (
        "import json; from gsplat_edu.options.offers import questions; print(json.dumps(questions('train')))"
    )
    code, said, errors = python("-c", asked, site=site)
    assert code == 0, errors
    (group,) = (group for group in json.loads(said) if group["title"] == "Further settings")
    assert [(one["name"], one["label"], one["kind"]) for one in group["questions"]] == [
        ("crisp_weight", "Solid splats", "number")
    ]
    code, _, errors = command("train", "x", "--out", "y", "--crisp-weight", "-1", site=site)
    assert code == 2 and "--crisp-weight: is -1, but has to be at least 0" in errors


QUESTION = """
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.train.setting import Question

def check(path):
    if not path.is_file():
        raise ArgumentError(f"--outlines: {path} is no file; give a file of outlines")

Crisp.question = Question(name="outlines", metavar="FILE", help="keep to outlines", check=check)
"""


def test_a_part_may_ask_for_a_file(site, tmp_path):
    asking = tmp_path / "site"
    shutil.copytree(site, asking)
    with (asking / "gsplat_crisp" / "training.py").open("a") as module:
        module.write(QUESTION)
    code, said, errors = command("train", "--help-all", site=asking)
    assert code == 0, errors
    assert "--outlines FILE" in said
    photos = tmp_path / "photos"
    photos.mkdir()
    code, _, errors = command("train", photos, "--out", "y", "--outlines", "z", site=asking)
    assert code == 2 and "--outlines: z is no file; give a file of outlines" in errors
    assert "--outlines" not in command("doctor", "--help", site=asking)[1]


def test_a_package_that_cannot_be_loaded_is_named(site, tmp_path):
    spoiled = tmp_path / "site"
    shutil.copytree(site, spoiled)
    (spoiled / "gsplat_crisp" / "training.py").write_text("import a_module_that_nobody_has\n")
    code, _, errors = command("train", "--help", site=spoiled)
    assert code == 2 and errors.count("\n") == 1
    assert "plug-in crisp of gsplat-crisp 1.0 cannot be loaded" in errors and "update or remove" in errors


@pytest.mark.slow
def test_a_training_with_it_is_recorded_and_judged(site, run, tmp_path):
    config = json.loads((run / "config.json").read_text())
    assert config["plugins"] == {"crisp": "gsplat-crisp 1.0", "sieve": "gsplat-crisp 1.0"}
    assert (config["train"]["crisp_weight"], config["train"]["sieve_least"]) == (0.01, 0.05)
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert all("crisp.half_open" in line["terms"] for line in lines if "terms" in line)
    assert "were written with weight 0.01" in (run / "report.html").read_text()
    code, said, errors = command("doctor", run, site=site)
    assert code == 0 and "outweighs" not in said, errors
    config["train"]["crisp_weight"] = 2.0
    changed = shutil.copytree(run, tmp_path / "changed")
    (changed / "config.json").write_text(json.dumps(config))
    said = command("doctor", changed, site=site)[1]
    assert "warning too solid: the weight of solid splats outweighs the photos" in " ".join(said.split())
    code, _, errors = command("convert", run, tmp_path / "centres.xyz", site=site)
    assert code == 0, errors
    code, said, _ = command("count", *run.glob("point_cloud/*/*.ply"), site=site)
    assert code == 0 and said.split()[0] == str(len(np.loadtxt(tmp_path / "centres.xyz")))


@pytest.mark.slow
def test_a_training_resumes_to_the_same_bytes_after_a_kill(site, run, capture, tmp_path):
    out = tmp_path / "killed"
    words = ("train", capture, "--out", out, *TRAINING, *LENGTH)
    assert python("-c", KILLED, *map(str, words), site=site)[0] == -signal.SIGKILL
    code, _, errors = command(*words, "--resume", site=site)
    assert code == 0, errors
    (ours,), (whole,) = (list(folder.glob("point_cloud/*/*.ply")) for folder in (out, run))
    assert ours.read_bytes() == whole.read_bytes()


@pytest.mark.slow
def test_without_it_a_run_is_not_resumed(run, capture, tmp_path):
    copy = shutil.copytree(run, tmp_path / "run")
    code, _, errors = command("train", capture, "--out", copy, "--iterations", "80", "--resume")
    assert code == 2 and errors.count("\n") == 1
    assert "was trained with the plug-in crisp of gsplat-crisp 1.0, which is not installed" in errors
