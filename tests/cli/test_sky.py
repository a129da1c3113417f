"""`--sky`: `auto` decides by the photos; bits do not depend on threads or kills; formats keep the sky; bad input."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch

from doctor.rooms import room
from gsplat_edu.cli.main import main
from gsplat_edu.data.writers import write_blender, write_colmap
from gsplat_edu.io.formats import read_scene
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.scene.views import View
from lab.captures.outdoors import outdoor_capture

pytestmark = pytest.mark.slow

SHORT = ("--iterations", "20", "--max-gaussians", "1200", "--eval-every", "0")


@pytest.fixture(scope="module")
def made():
    return outdoor_capture(96, 72, 20, points=900)


@pytest.fixture(scope="module")
def outdoors(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp("outdoors")
    write_colmap(folder, made.views, made.points, made.colors)
    return folder


def stored(run):
    return json.loads((run / "config.json").read_text())["train"]["sky"]


def scene(run):
    (path,) = run.glob("point_cloud/*/point_cloud.ply")
    return path


def test_auto_reports_its_choice_and_a_resumed_run_keeps_it(outdoors, tmp_path, capsys):
    run = tmp_path / "run"
    assert main(["train", str(outdoors), "--out", str(run), *SHORT]) == 0
    said = capsys.readouterr().out
    (line,) = (line for line in said.splitlines() if line.startswith("--sky"))
    assert line.startswith("--sky shell: ") and "% of the pixels, in 20 of 20 photos, lie at infinity" in line
    assert "splats of the sky lie" in said and stored(run) == "shell"
    assert far_shell(read_scene(scene(run)).gaussians.means.numpy()).sum() > 50
    longer = ["train", str(outdoors), "--out", str(run), *SHORT, "--resume"]
    longer[longer.index("20")] = "24"
    assert main(longer) == 0
    assert "--sky" not in capsys.readouterr().out and stored(run) == "shell"
    assert main([*longer, "--sky", "none"]) == 2
    assert "was started with sky = shell, not none" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--sky", "none"], ["--strategy", "adc"]])
def test_adc_and_none_have_no_sky(outdoors, tmp_path, capsys, words):
    run = tmp_path / "run"
    words = ["train", str(outdoors), "--out", str(run), "--iterations", "3", "--resolution", "2", *words]
    assert main(words) == 0
    assert "of the sky" not in capsys.readouterr().out and stored(run) == "none"
    assert not far_shell(read_scene(scene(run)).gaussians.means.numpy()).any()


def test_a_room_has_no_sky_and_doctor_finds_the_one_outdoors(outdoors, tmp_path, capsys):
    views, points = room("orbit", 96)
    write_colmap(tmp_path / "room", views, points, np.full((len(points), 3), 0.5))
    assert main(["train", str(tmp_path / "room"), "--out", str(tmp_path / "run"), *SHORT]) == 0
    assert "--sky" not in capsys.readouterr().out and stored(tmp_path / "run") == "none"
    assert main(["doctor", str(outdoors)]) == 0
    said = capsys.readouterr().out
    assert "note       sky: " in said and "train with --sky shell" in said
    assert main(["doctor", str(tmp_path / "room")]) == 0
    assert "--sky" not in capsys.readouterr().out
    words = ["train", str(tmp_path / "room"), "--out", str(tmp_path / "asked"), *SHORT, "--sky", "shell"]
    assert main(words) == 2
    assert "--sky: no photo shows" in capsys.readouterr().err and not (tmp_path / "asked").exists()


def test_a_capture_without_points_has_its_sky_too(made, tmp_path, capsys):
    none = np.zeros((0, 3))
    write_colmap(tmp_path / "capture", made.views, none, none)
    assert main(["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), *SHORT]) == 0
    assert "as far as photos without points tell" in capsys.readouterr().out
    assert stored(tmp_path / "run") == "shell"


def test_transparent_and_masked_photos_get_no_sky(made, tmp_path, capsys):
    clear, masked = [], []
    for view, sky in zip(made.views, made.sky, strict=True):
        alpha = np.where(sky, 0, 255).astype(np.uint8)
        clear.append(View(view.camera, view.image, alpha=alpha, name=view.name.removesuffix(".png")))
        masked.append(View(view.camera, view.image, mask=~sky, name=view.name))
    write_blender(tmp_path / "clear", clear, clear[:1])
    write_colmap(tmp_path / "masked", masked, made.points, made.colors)
    for kind, name in (("transparent", "clear"), ("masked", "masked")):
        run = tmp_path / f"run_{name}"
        assert main(["train", str(tmp_path / name), "--out", str(run), *SHORT]) == 0
        assert f"--sky none: photos are {kind}" in capsys.readouterr().out and stored(run) == "none"


def test_bad_input_is_one_line(outdoors, tmp_path, capsys):
    words = ["train", str(outdoors), "--out", str(tmp_path / "run"), "--iterations", "3", "--sky"]
    bare = tmp_path / "scene.ply"
    assert main([*words[:-1], "--sky", "none", "--resolution", "4"]) == 0
    shutil.copy(scene(tmp_path / "run"), bare)
    capsys.readouterr()
    for more, said in (
        (["blue"], "--sky: "),
        (["shell", "--max-gaussians", "7"], "--max-gaussians 7 leaves no room for a sky"),
        (["shell", "--from", str(bare)], "--sky: only a start from points uses it"),
    ):
        out = ["--out", str(tmp_path / "other")]
        assert main([*words, *more, *out]) == 2
        complained = capsys.readouterr().err
        assert said in complained and complained.count("\n") == 1
    assert main([*words[:-1], "--from", str(bare), "--out", str(tmp_path / "other")]) == 0
    assert stored(tmp_path / "other") == "none", "the start scene brings its own sky"


def trained(capture, out, threads, *words):
    torch.set_num_threads(threads)
    assert main(["train", str(capture), "--out", str(out), *words]) == 0
    return scene(out).read_bytes()


@pytest.mark.parametrize("strategy", ["fast", "adc", "mcmc"])
def test_threads_do_not_change_the_bits(outdoors, tmp_path, strategy):
    words = [
        *SHORT,
        "--strategy",
        strategy,
        "--sky",
        "shell",
        "--set",
        "densify_start=4",
        "--set",
        "densify_every=5",
    ]
    words += {"fast": [], "adc": ["--set", "reset_every=8"], "mcmc": []}[strategy]
    before = torch.get_num_threads()
    try:
        found = [trained(outdoors, tmp_path / f"run{n}", n, *words) for n in (1, 2, 5)]
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] == found[2]


def test_a_killed_run_ends_with_the_same_bytes(outdoors, tmp_path):
    words = [*SHORT, "--sky", "shell", "--save-every", "5"]
    whole = trained(outdoors, tmp_path / "whole", torch.get_num_threads(), *words)
    killed = tmp_path / "killed"
    code = (
        "import os, sys; from gsplat_edu.runs import training as t; old = t.CaptureRun.save\n"
        "def save(self):\n    old(self)\n    self.trainer.iteration < 10 or os.kill(os.getpid(), 9)\n"
        "t.CaptureRun.save = save; from gsplat_edu.cli.main import main; main(sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, "train", str(outdoors), "--out", str(killed), *words]
    assert subprocess.run(command, check=False, env=os.environ, capture_output=True).returncode == -9
    assert not list(killed.glob("point_cloud/*")) and list((killed / "checkpoints").iterdir())
    assert trained(outdoors, killed, torch.get_num_threads(), *words, "--resume") == whole


def test_a_run_from_a_scene_keeps_its_sky_also_when_it_is_resumed(outdoors, tmp_path):
    threads = torch.get_num_threads()
    trained(outdoors, tmp_path / "first", threads, *SHORT, "--sky", "shell")
    before = far_shell(read_scene(scene(tmp_path / "first")).gaussians.means.numpy()).sum()
    words = ["--strategy", "adc", "--set", "densify_start=2", "densify_every=3"]
    words += ["--set", "densify_stop=12", "reset_every=4"]
    words += [
        "--set",
        "reset_opacity=0.5",
        "--eval-every",
        "0",
        "--save-every",
        "5",
        "--max-gaussians",
        "1500",
    ]
    start = ["--from", str(scene(tmp_path / "first"))]
    whole = trained(outdoors, tmp_path / "whole", threads, *words, *start, "--iterations", "12")
    after = far_shell(read_scene(scene(tmp_path / "whole")).gaussians.means.numpy()).sum()
    assert after >= 0.9 * before > 0, "large splats of the sky are not pruned"
    shutil.copytree(tmp_path / "whole", tmp_path / "again")
    shutil.rmtree(tmp_path / "again" / "point_cloud")
    (tmp_path / "again" / "metrics.json").unlink()
    for path in sorted((tmp_path / "again" / "checkpoints").iterdir())[1:]:
        path.unlink()
    assert trained(outdoors, tmp_path / "again", threads, *words, "--iterations", "12", "--resume") == whole


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".sog", ".splat", ".glb", ".html"])
def test_formats_keep_scene_and_sky(outdoors, tmp_path_factory, suffix, capsys):
    run = tmp_path_factory.getbasetemp() / "sky_formats"
    if not run.exists():
        words = ["--iterations", "60", "--max-gaussians", "1500", "--eval-every", "0", "--sky", "shell"]
        trained(outdoors, run, torch.get_num_threads(), *words)
    file = run / f"scene{suffix}"
    capsys.readouterr()
    assert main(["convert", str(run), str(file), "--verify"]) == 0
    said = capsys.readouterr().out
    assert float(said.split("PSNR ")[1].split()[0]) > 33, said
