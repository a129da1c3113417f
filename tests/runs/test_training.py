"""Runs through the command line: the contents of the folder, and the effects of kills, full disks and mistakes."""

import dataclasses
import errno
import json
import math
import shutil
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import load_ply
from gsplat_edu.options.train import options_from
from gsplat_edu.render.api import render
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.training import CaptureRun
from processes import Program
from waiting import until

SHORT = ["--iterations", "40", "--eval-every", "20", "--save-every", "10", "--set", "densify_start=5"]
SHORT += ["--set", "densify_every=10"]

# about two seconds, long enough to be killed midway
LONG = ["--iterations", "600", "--eval-every", "150", "--save-every", "40", "--set", "densify_start=20"]
LONG += ["--set", "densify_every=20", "sh_every=100"]
ADC = ["--strategy", "adc", "--set", "densify_stop=500", "grad_threshold=5e-5"]
STRATEGIES = {
    "fast": [],  # the default
    "adc": [*ADC, "--set", "reset_every=100", "--max-gaussians", "1500", "--random-background"],
    "mcmc": ["--strategy", "mcmc", "--max-gaussians", "1200", "--set", "mcmc_stop=500"],
}
TRAIN = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"

WAITS = """
import sys
from gsplat_edu.cli.main import main
from gsplat_edu.runs.training import CaptureRun
from waiting import until
train, last = CaptureRun.train, int(sys.argv.pop(1))

def waiting(run, stop, callbacks=()):
    def wait(trainer, event):
        until(lambda: trainer.iteration < last or stop())
    return train(run, stop, [*callbacks, wait])

CaptureRun.train = waiting
sys.exit(main())
"""
"""A training that waits for a signal after the iteration that its first argument gives, so that it cannot end first."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(64, 16))
    return folder


def train(capture, out, *options):
    return main(["train", str(capture), "--out", str(out), *options])


def ply(out, iterations):
    return (out / "point_cloud" / f"iteration_{iterations}" / "point_cloud.ply").read_bytes()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A capture for trainings of which no quality is asked."""
    folder = tmp_path_factory.mktemp("captures") / "small"
    write_colmap(folder, *procedural_capture(24, 8))
    return folder


@pytest.fixture(scope="module")
def one_iteration(small, tmp_path_factory):
    """A run of `small` that a time limit ended."""
    out = tmp_path_factory.mktemp("runs") / "one"
    assert train(small, out, *SHORT, "--time-limit", "0.001s") == 0
    return out


@pytest.fixture
def begun(one_iteration, tmp_path):
    """A copy of it, which a test may spoil."""
    return Path(shutil.copytree(one_iteration, tmp_path / "run"))


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "egg"
    assert train(capture, out, *SHORT) == 0
    return out


def test_a_run_folder_has_the_expected_contents(finished):
    folder = RunFolder(finished)
    metrics = json.loads(folder.metrics.read_text())
    assert metrics["iterations"] == 40 and metrics["seconds"] > 0
    assert metrics["test"]["num_images"] == 2 and metrics["train"]["num_images"] == 14
    assert metrics["test"]["psnr"] > 12 and 0 < metrics["test"]["ssim"] <= 1
    lines = [json.loads(line) for line in folder.log_file.read_text().splitlines()]
    assert all("iteration" in line for line in lines)
    assert [line["iteration"] for line in lines if "loss" in line] == [10, 20, 30, 40]
    assert [line["iteration"] for line in lines if "psnr" in line] == [20]
    assert {line["event"] for line in lines if "event" in line} == {"densify"}
    assert len(list((finished / "checkpoints").iterdir())) == 2
    assert len(list((finished / "renders" / "test").glob("*.png"))) == 2
    assert "data:image" in folder.report.read_text()
    assert len(folder.read_cameras()) == 16
    config = folder.read_config()
    assert config["train"]["densify_start"] == 5 and config["train"]["iterations"] == 40
    assert metrics["num_gaussians"] == len(load_ply(folder.latest_scene()[0]))


def test_the_saved_scene_renders_bit_identical_images(small, tmp_path):
    """The trained and the written scene are compared at every training camera."""
    words = ["train", str(small), "--out", str(tmp_path / "run"), *SHORT, "--antialiased"]
    words += ["--max-gaussians", "500"]
    parsed = build_parser(words).parse_args(words)
    run = CaptureRun(options_from(parsed))
    trainer = run.trainer
    run.train()
    run.finish()
    scene = read_scene(run.folder.latest_scene()[0])
    assert scene.antialiased is True, "the file records it for other programs"
    loaded = scene.gaussians
    settings = render_settings(run.folder.read_config())
    cameras = {name: camera for name, _, camera in run.folder.read_cameras()}
    for view in run.dataset.train:
        with torch.no_grad():
            ours = render(trainer.gaussians, view.camera, settings=settings).image
            theirs = render(loaded, cameras[view.name], settings=settings).image
        assert torch.equal(ours, theirs), view.name


def start(capture, out, *options, threads=2):
    return Program(TRAIN, ["train", capture, "--out", out, *options], capture.parent, threads)


def start_to_signal(capture, out, *options, threads=2):
    """Start a training of `LONG` that does not pass its 590th iteration before it gets a signal."""
    return Program(WAITS, [590, "train", capture, "--out", out, *options], capture.parent, threads)


def completed(capture, out, *options, threads=2):
    code, said, complained = start(capture, out, *options, threads=threads).ended()
    assert code == 0, complained
    return said


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """Uninterrupted runs, one for each strategy, on two threads."""
    runs = {}

    def run(strategy):
        if strategy not in runs:
            runs[strategy] = tmp_path_factory.mktemp("whole") / strategy
            completed(capture, runs[strategy], *LONG, *STRATEGIES[strategy], threads=2)
        return runs[strategy]

    return run


def wait_for(condition, program):
    until(lambda: not program.runs or condition())
    assert condition(), "the run ended before it could be killed"


def checkpoints(out):
    return sorted(
        (out / "checkpoints").glob("iteration_*.safetensors"), key=lambda p: int(p.stem.split("_")[1])
    )


def newest(out):
    found = checkpoints(out)
    return int(found[-1].stem.split("_")[1]) if found else 0


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_killed_at_any_moment_and_resumed_gives_the_same_bytes(capture, whole, tmp_path, strategy):
    """kill -9 before the first checkpoint and at two later moments, alternating between one and two threads."""
    options, uninterrupted, out = [*LONG, *STRATEGIES[strategy]], whole(strategy), tmp_path / "killed"
    assert RunFolder(uninterrupted).read_metrics()["num_gaussians"] > 320
    moments = (
        (out / "log.jsonl").exists,
        lambda: newest(out) >= 80,
        lambda: newest(out) >= 400,
    )
    for k, moment in enumerate(moments):
        resume = ["--resume"] if k else []
        program = start_to_signal(capture, out, *options, *resume, threads=1 + k % 2)
        wait_for(moment, program)
        program.send(signal.SIGKILL)
        assert program.ended()[0] == -signal.SIGKILL
    completed(capture, out, *options, "--resume", threads=2)
    assert ply(out, 600) == ply(uninterrupted, 600)
    iterations = [line["iteration"] for line in RunFolder(out).log() if "loss" in line]
    assert iterations == list(range(10, 601, 10)), "the log has every line once"


DIES = """
import os, signal, sys
from pathlib import Path
from gsplat_edu.cli.main import main
name, moment = sys.argv[1], sys.argv[2]
replace = Path.replace

def dying(path, target):
    if Path(target).name == name and moment == "before":
        os.kill(os.getpid(), signal.SIGKILL)
    replace(path, target)
    if Path(target).name == name:
        os.kill(os.getpid(), signal.SIGKILL)

Path.replace = dying
sys.exit(main(sys.argv[3:]))
"""

FILES_END = """
import resource, signal, sys
from gsplat_edu.cli.main import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
sys.exit(main(sys.argv[2:]))
"""

DEATHS = (
    ("cameras.json", "before"),
    ("cameras.json", "after"),
    ("photos.json", "before"),
    ("photos.json", "after"),
    ("config.json", "before"),
    ("config.json", "after"),
    ("iteration_10.safetensors", "before"),
    ("iteration_20.safetensors", "after"),
    ("iteration_40.safetensors", "before"),
    ("point_cloud.ply", "before"),
    ("point_cloud.ply", "after"),
    ("report.html", "before"),
    ("metrics.json", "before"),
)


@pytest.mark.slow
@pytest.mark.own_process
def test_a_run_killed_around_the_renaming_of_any_file_resumes(capture, finished, tmp_path):
    """A run is killed thirteen times, just before or just after a file is renamed from its temporary name."""
    out = tmp_path / "run"
    words = ["train", str(capture), "--out", str(out), *SHORT]
    for name, moment in DEATHS:
        resume = ["--resume"] if (out / "config.json").exists() else []
        code, _, complained = Program(DIES, [name, moment, *words, *resume], tmp_path).ended()
        assert code == -signal.SIGKILL, (name, moment, complained)
    assert train(capture, out, *SHORT, "--resume") == 0
    assert ply(out, 40) == ply(finished, 40)
    names = {path.relative_to(out) for path in out.rglob("*")}
    assert names == {path.relative_to(finished) for path in finished.rglob("*")}, (
        "no file is missing and no temporary file is left"
    )


def with_another_lens(view):
    camera = view.camera
    values = {field.name: getattr(camera, field.name) for field in dataclasses.fields(camera) if field.init}
    return type(view)(type(camera)(**(values | {"fx": camera.fx * 1.01})), view.image, name=view.name)


def test_another_capture_is_refused(capture, finished, tmp_path, capsys):
    """The message names what differs: views, a camera, photos or points. A moved capture is accepted."""
    views, points, colors = procedural_capture(64, 16)
    darker = [type(view)(view.camera, view.image // 2, name=view.name) for view in views]
    captures = {
        "has 15": (views[:15], points, colors),
        "view_003.png differs": ([*views[:3], with_another_lens(views[3]), *views[4:]], points, colors),
        "different photos": (darker, points, colors),
        "start points": (views, points + 0.01, colors),
    }
    out = tmp_path / "run"
    assert train(capture, out, *SHORT, "--time-limit", "0.001s") == 0
    for said, parts in captures.items():
        write_colmap(tmp_path / said, *parts)
        capsys.readouterr()
        assert train(tmp_path / said, out, *SHORT, "--resume") == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
    write_colmap(tmp_path / "moved", views, points, colors)
    assert train(tmp_path / "moved", out, *SHORT, "--resume") == 0
    assert ply(out, 40) == ply(finished, 40)


def test_checkpoints_without_their_config_are_not_resumed(small, begun, capsys):
    (begun / "config.json").unlink()
    assert train(small, begun, *SHORT, "--seed", "5") == 2
    assert "checkpoints of a run but no config.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("metrics.json", lambda meta: meta | {"iterations": "many"}),
        ("config.json", lambda meta: meta | {"train": 5}),
        ("config.json", lambda meta: meta | {"data": [1]}),
        ("config.json", lambda meta: meta | {"fingerprint": None}),
        ("cameras.json", lambda meta: [*meta[:-1], 5]),
    ],
)
def test_a_damaged_run_folder_costs_one_line(small, begun, capsys, name, change):
    (begun / name).write_text(json.dumps(change(json.loads((begun / name).read_text()))))
    assert train(small, begun, *SHORT, "--resume") == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_scene_that_is_pruned_away_is_reported(small, tmp_path, capsys):
    assert train(small, tmp_path / "run", *SHORT, "--set", "min_opacity=1") == 2
    assert "every Gaussian was pruned" in capsys.readouterr().err


def test_evaluations_during_a_training_score_the_test_views(small, tmp_path):
    words = ["train", str(small), "--out", str(tmp_path / "run"), "--strategy", "none"]
    words += ["--iterations", "3", "--eval-every", "2"]
    run = CaptureRun(options_from(build_parser(words).parse_args(words)))
    scores = []

    def score(trainer, event):
        if trainer.iteration == 2:
            found = score_views(trainer.gaussians, run.dataset.test, run.options.renderer, (0.0, 0.0, 0.0))
            scores.append(summarize(found)["psnr"])

    run.train(callbacks=[score])
    rows = [json.loads(line) for line in run.folder.log_file.read_text().splitlines()]
    assert [row["psnr"] for row in rows if "psnr" in row] == scores[-1:]


def test_nonfinite_gaussians_are_left_out(small, tmp_path):
    words = ["train", str(small), "--out", str(tmp_path / "run"), *SHORT, "--strategy", "none"]
    said = []
    run = CaptureRun(options_from(build_parser(words).parse_args(words)), said.append)
    trainer = run.trainer
    with torch.no_grad():
        trainer.gaussians.means[3, 0] = math.nan
        trainer.gaussians.sh_rest[5, 0, 0] = math.inf
    run.train()
    run.finish()
    assert "2 Gaussians are NaN or infinite" in said[-1]
    assert len(load_ply(run.folder.latest_scene()[0])) == len(trainer.gaussians) - 2


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_saves_and_exits_with_130(capture, whole, tmp_path, number):
    out, options = tmp_path / "run", [*LONG, *STRATEGIES["adc"], "--save-every", "0"]
    program = start_to_signal(capture, out, *options)
    wait_for((out / "log.jsonl").exists, program)
    program.send(number)
    code, _, complained = program.ended()
    assert code == 130
    assert "--resume" in complained and complained.count("\n") == 1
    assert len(checkpoints(out)) == 1
    completed(capture, out, *options, "--resume")
    assert ply(out, 600) == ply(whole("adc"), 600)


def test_a_finished_run_has_nothing_to_do(capture, finished, capsys):
    before = ply(finished, 40)
    assert train(capture, finished, *SHORT, "--resume") == 0
    assert "nothing to do" in capsys.readouterr().out
    assert ply(finished, 40) == before


def test_a_run_is_not_overwritten(capture, finished, capsys):
    assert train(capture, finished, *SHORT) == 2
    assert "already holds a run; add --resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (["--iterations", "30"], "iterations"),
        (["--seed", "3"], "seed"),
        (["--test-every", "4"], "test_every"),
    ],
)
def test_another_schedule_is_refused(capture, finished, capsys, change, named):
    assert train(capture, finished, *SHORT, *change, "--resume") == 2
    said = capsys.readouterr().err
    assert named in said and said.count("\n") == 1


def test_resume_without_a_run_starts_over_and_says_so(small, tmp_path, capsys):
    assert train(small, tmp_path / "new", *SHORT, "--resume") == 0
    assert "contains no run to resume; starting from the beginning" in capsys.readouterr().out.replace(
        "\n", " "
    )


def test_resume_without_a_checkpoint_starts_over_and_says_so(capture, finished, tmp_path, capsys):
    out = tmp_path / "bare"
    out.mkdir()
    for name in ("config.json", "cameras.json", "log.jsonl"):
        (out / name).write_bytes((finished / name).read_bytes())
    assert train(capture, out, *SHORT, "--resume") == 0
    assert "contains no checkpoint; starting from the beginning" in capsys.readouterr().out.replace("\n", " ")
    assert ply(out, 40) == ply(finished, 40)


def test_a_truncated_checkpoint_costs_one_line(small, begun, capsys):
    (begun / "checkpoints" / "iteration_1.safetensors").write_bytes(b"\0" * 100)
    assert train(small, begun, *SHORT, "--resume") == 2
    said = capsys.readouterr().err
    assert "is damaged" in said and "delete it" in said and said.count("\n") == 1


def test_a_time_limit_leaves_a_scene_and_metrics_and_can_be_lifted(capture, finished, tmp_path, capsys):
    out = tmp_path / "run"
    assert train(capture, out, *SHORT, "--time-limit", "0.001s") == 0
    metrics = RunFolder(out).read_metrics()
    assert metrics["iterations"] == 1 and metrics["test"]["num_images"] == 2
    said = capsys.readouterr().out.replace("\n", " ")
    unusable = "because it was trained for only 1 of 40 iterations. Give the training more time."
    assert "time limit" in said and said.rstrip().endswith(unusable)
    assert unusable in RunFolder(out).report.read_text() and metrics["full_length"] == 40
    assert train(capture, out, *SHORT, "--resume") == 0
    assert "of 40 iterations. Give" not in capsys.readouterr().out + RunFolder(out).report.read_text()
    assert ply(out, 40) == ply(finished, 40)


@pytest.mark.own_process
def test_a_full_disk_leaves_the_last_checkpoint(capture, tmp_path):
    """A limit on file size simulates a full disk: the log fits, the larger checkpoint does not."""
    out = tmp_path / "run"
    assert train(capture, out, *LONG, "--time-limit", "0.001s") == 0
    good = checkpoints(out)[-1]
    before = good.read_bytes()
    words = [len(before) - 1000, "train", capture, "--out", out, *LONG, "--resume"]
    code, _, complained = Program(FILES_END, words, tmp_path).ended()
    assert code == 2, complained
    assert "cannot be written" in complained and complained.count("\n") == 1
    assert good.read_bytes() == before and checkpoints(out) == [good]


def test_an_unwritable_folder_costs_one_line_before_photos_are_read(capture, tmp_path, capsys, monkeypatch):
    """The test simulates a read-only folder, because root may write everywhere."""

    def refuse(*words, **options):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    monkeypatch.setattr(Dataset, "preload", lambda *words: pytest.fail("photos were read"))
    assert train(capture, tmp_path / "run", *SHORT) == 2
    said = capsys.readouterr().err
    assert "cannot write to" in said and said.count("\n") == 1 and not (tmp_path / "run").exists()


def test_a_file_in_place_of_the_run_folder_is_a_one_line_error(capture, tmp_path, capsys):
    (tmp_path / "file").write_text("x")
    assert train(capture, tmp_path / "file", *SHORT) == 2
    assert train(capture, tmp_path / "file" / "run", *SHORT) == 2
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.parametrize(
    ("strategy", "cap"),
    [("fast", 200), ("fast", 500), ("adc", 200), ("adc", 500), ("mcmc", 200), ("mcmc", 240)],
)
def test_the_cap_holds_from_the_first_iteration_to_the_last(small, tmp_path, strategy, cap):
    """The start has more points than the lower cap."""
    options = [*LONG[2:], "--iterations", "130", "--strategy", strategy, "--max-gaussians", str(cap)]
    options += ADC if strategy == "adc" else []
    assert train(small, tmp_path / "run", *options, "--eval-every", "0", "--save-every", "0") == 0
    counts = [line["num_gaussians"] for line in RunFolder(tmp_path / "run").log() if "num_gaussians" in line]
    assert max(counts) <= cap and min(counts) > 0
    if strategy == "mcmc":
        reached = counts.index(cap)
        assert set(counts[reached:]) == {cap}, "the count stays at the cap"


def test_far_coordinates_are_trained_near_the_origin_and_written_far(tmp_path):
    views, points, colors = procedural_capture(24, 8)
    shift = np.array([1e5, -2e5, 3e4])
    moved = []
    for view in views:
        camera = view.camera
        there = type(camera)(
            camera.R, camera.eye + shift, camera.fx, camera.fy, camera.cx, camera.cy, camera.H, camera.W
        )
        moved.append(type(view)(there, view.image, name=view.name))
    write_colmap(tmp_path / "near", views, points, colors)
    write_colmap(tmp_path / "far", moved, points + shift, colors)
    scores, means = [], []
    for name in ("near", "far"):
        assert train(tmp_path / name, tmp_path / f"run_{name}", *SHORT) == 0
        folder = RunFolder(tmp_path / f"run_{name}")
        scores.append(folder.read_metrics()["test"]["psnr"])
        scene = read_scene(folder.latest_scene()[0])
        assert np.abs(scene.origin - shift * (name == "far")).max() <= 5.0, "among the cameras"
        means.append(scene.gaussians.means.double().median(dim=0).values.numpy() + scene.origin)
    assert scores[0] == pytest.approx(scores[1], abs=0.3)
    np.testing.assert_allclose(means[1] - shift, means[0], atol=0.1)
