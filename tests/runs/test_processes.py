import hashlib
import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import checkpoints
from gsplat_edu.base.errors import CheckpointError, ProcessLostError, SplatError
from gsplat_edu.cli.main import main
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.points import write_points_ply
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.runs.options import DataSettings, RunOptions
from gsplat_edu.runs.processes import check_alike, facts, pack, unpack
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from gsplat_edu.train.team import ALONE
from lab.captures.textured_box import box_orbit, photograph_box
from ranks import together
from waiting import HERE, PATIENCE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 9, splats=900))
    return folder


def options(capture, out, **changes):
    config = recipe(48, batch=4, densify_start=3, densify_every=10, densify_stop=40, grad_threshold=1e-5)
    given = RunOptions(capture, out, config, DataSettings(), eval_every=24, save_every=16)
    return replace(given, **changes)


def train(settings, team=ALONE, until=None):
    """Train as the command does: every rank trains, and the first rank also finishes the run."""
    own = settings if team.rank == 0 else replace(settings, out=Path("/nowhere"), resume=False)
    run = CaptureRun(own, team=team)
    stopped = run.train((lambda: run.trainer.iteration >= until) if until else lambda: False)
    if team.rank == 0 and not stopped:
        run.finish()
    return stopped


def scene(out):
    return (out / "point_cloud/iteration_48/point_cloud.ply").read_bytes()


def contents(out, iteration):
    tensors, metadata = checkpoints.read(out / f"checkpoints/iteration_{iteration}.safetensors")
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, metadata["state"]


@pytest.fixture(scope="module")
def alone(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "alone"
    train(options(capture, out))
    return out


def test_messages_are_received_unchanged():
    sent = [
        torch.arange(5, dtype=torch.int64),
        torch.tensor([[True, False]]),
        torch.zeros(0, 15, 3),
        torch.tensor(1.5, dtype=torch.float64),
        torch.tensor([float("nan"), -0.0]),
        torch.arange(7, dtype=torch.uint8)[::2],
    ]
    for received in (unpack(pack(sent)), together(2, lambda team: team.exchange([sent] * 2))[1][0]):
        assert len(received) == len(sent)
        for ours, theirs in zip(sent, received, strict=True):
            assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
            assert ours.numpy().tobytes() == theirs.numpy().tobytes()


def test_every_rank_receives_the_messages_of_all_others():
    def work(team):
        found = team.exchange([[torch.tensor([10 * team.rank + rank])] for rank in range(team.size)])
        return (
            [int(part) for (part,) in found],
            team.shared(team.rank + 7),
            team.any(team.rank == 1),
            team.sent,
        )

    results = together(3, work)
    assert [found for found, *_ in results] == [[0, 10, 20], [1, 11, 21], [2, 12, 22]]
    assert all((shared, any_) == (7, True) for _, shared, any_, _ in results)
    assert all(sent > 0 for *_, sent in results)


def test_the_other_ranks_report_a_rank_that_sends_nothing():
    def work(team):
        if team.rank == 0:
            team.exchange([[torch.zeros(3)]] * 2)

    with pytest.raises(
        ProcessLostError, match="^torchrun: another process of this run ended or cannot be reached"
    ):
        together(2, work, patience=1.0)


@pytest.mark.parametrize("name", [*facts()])
def test_processes_with_different_arithmetic_are_refused(name):
    def work(team):
        found = facts()
        check_alike(team, "compute alike", found)
        check_alike(team, "compute alike", found | ({name: "other"} if team.rank == 1 else {}))

    with pytest.raises(
        SplatError, match="torchrun: the processes have to compute alike: .* but other in process 1 on"
    ):
        together(2, work)


@pytest.mark.parametrize("size", [2, 4])
def test_a_run_of_several_processes_has_the_bytes_of_one(capture, alone, tmp_path, size):
    together(size, lambda team: train(options(capture, tmp_path / "run"), team))
    assert scene(tmp_path / "run") == scene(alone)
    assert contents(tmp_path / "run", 48) == contents(alone, 48)


def test_a_run_is_resumed_by_another_number_of_processes(capture, alone, tmp_path):
    """The run has one process, then four, then two; a rank interrupts it after 20 and 32 images."""
    out = tmp_path / "run"
    assert train(options(capture, out), until=20)
    assert (out / "checkpoints/iteration_20.safetensors").exists()
    resumed = options(capture, out, resume=True)
    assert together(4, lambda team: train(resumed, team, until=32 if team.rank == 2 else None)) == [True] * 4
    assert together(2, lambda team: train(resumed, team)) == [False] * 2
    assert scene(out) == scene(alone)
    assert contents(out, 48) == contents(alone, 48)


def test_the_log_and_the_milestones_count_images(alone):
    """Steps have four images. Lines follow every tenth image, an evaluation the 24th, a checkpoint each 16th."""
    lines = [json.loads(line) for line in (alone / "log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines if "loss" in line] == [12, 20, 32, 40]
    assert [line["iteration"] for line in lines if "psnr" in line] == [24]
    assert [line["iteration"] for line in lines if line.get("event") == "densify"] == [12, 24, 32]
    assert [path.name for path in sorted((alone / "checkpoints").iterdir())] == [
        f"iteration_{done}.safetensors" for done in (32, 48)
    ]


def test_resuming_with_another_batch_is_refused(capture, alone):
    config = recipe(48, batch=2, densify_start=3, densify_every=10, densify_stop=40, grad_threshold=1e-5)
    with pytest.raises(CheckpointError, match="was started with batch = 4, not 2"):
        CaptureRun(options(capture, alone, config=config, resume=True))


def test_processes_with_different_captures_are_refused(capture, tmp_path):
    other = tmp_path / "other"
    write_colmap(other, *procedural_capture(24, 9, splats=600))

    def work(team):
        train(options(other if team.rank == 1 else capture, tmp_path / "run"), team)

    with pytest.raises(SplatError, match="the processes have to start alike: "):
        together(2, work)


WORDS = (
    "--batch",
    "4",
    "--iterations",
    "240",
    "--max-gaussians",
    "700",
    "--eval-every",
    "0",
    "--save-every",
    "40",
)


KILLED = """
import os, signal, sys

from gsplat_edu.cli.main import main
from gsplat_edu.runs.training import CaptureRun
from waiting import until

save = CaptureRun.save


def save_and_die(run):
    save(run)
    until(lambda: any(run.folder.checkpoints.glob("*.safetensors")))  # the first rank writes it
    os.kill(os.getpid(), signal.SIGKILL)


if os.environ["RANK"] == os.environ["VICTIM"] and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
    CaptureRun.save = save_and_die
sys.exit(main(sys.argv[1:]))
"""
"""The command line as a program, whose rank VICTIM is killed once there is a checkpoint. The others wait for its part
of the next step, so the run cannot end before.
"""


@pytest.mark.own_process
@pytest.mark.parametrize(
    ("size", "victim"),
    [*(pytest.param(*case, marks=pytest.mark.soak) for case in ((2, 0), (4, None), (4, 3))), (2, 1)],
)
def test_torchrun_trains_to_the_same_bytes_although_a_rank_is_killed(capture, tmp_path, size, victim):
    assert main(["train", str(capture), "--out", str(tmp_path / "alone"), *WORDS]) == 0
    out, program = tmp_path / "several", tmp_path / "program.py"
    program.write_text(KILLED)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={size}"]
    command = [*launcher, "--max-restarts=1", str(program), "train", str(capture), "--out", str(out)]
    done = subprocess.run(
        [*command, *WORDS, "--resume"],
        env={**os.environ, "OMP_NUM_THREADS": "1", "VICTIM": str(victim), "PYTHONPATH": HERE},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    path = "point_cloud/iteration_240/point_cloud.ply"
    found = [
        hashlib.sha256((tmp_path / name / path).read_bytes()).hexdigest() for name in ("alone", "several")
    ]
    assert found[0] == found[1]
    assert ("resuming after" in done.stdout) == (victim is not None), done.stdout


@pytest.mark.own_process
def test_points_that_one_process_triangulates_start_all(tmp_path):
    pytest.importorskip("pycolmap")
    views = [
        View(camera, photograph_box(camera), name=f"{i:02d}.png")
        for i, camera in enumerate(box_orbit(16, turn=math.pi))
    ]
    write_transforms(tmp_path / "box", views, [])
    words = ["train", str(tmp_path / "box"), "--batch", "2", "--iterations", "20", "--max-gaussians", "900"]
    words += ["--eval-every", "0"]
    assert main([*words, "--out", str(tmp_path / "alone")]) == 0
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*launcher, "-m", "gsplat_edu", *words, "--out", str(tmp_path / "several")],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "start points from the given poses" in done.stdout
    for path in ("points.ply", "point_cloud/iteration_20/point_cloud.ply"):
        assert (tmp_path / "several" / path).read_bytes() == (tmp_path / "alone" / path).read_bytes(), path


def test_the_first_process_gives_the_start_points(capture, tmp_path):
    cloud = load_dataset(capture)
    chosen = tmp_path / "chosen.ply"
    write_points_ply(chosen, Cloud(cloud.points[::2] + cloud.origin, cloud.colors[::2]))
    train(options(capture, tmp_path / "alone", points=chosen))

    def work(team):
        train(options(capture, tmp_path / "run", points=chosen if team.rank == 0 else None), team)

    together(2, work)
    assert scene(tmp_path / "run") == scene(tmp_path / "alone")


@pytest.mark.own_process
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["train", "CAPTURE", "--batch", "3"],
            "gsplat-edu train: --batch: is 3, but has to be a multiple of the 2 ",
        ),
        pytest.param(
            ["train", "CAPTURE", "--batch", "2", "--time-limit", "9s"],
            "gsplat-edu train: --time-limit: cannot choose",
            marks=pytest.mark.soak,
        ),
        pytest.param(
            ["train", "CAPTURE", "--batch", "2", "--view"],
            "gsplat-edu train: --view: shows the training of one process",
            marks=pytest.mark.soak,
        ),
        pytest.param(
            ["train", "CAPTURE", "--batch", "two"],
            "gsplat-edu train: argument --batch: 'two' is not a whole number",
            marks=pytest.mark.soak,
        ),
        (["doctor", "CAPTURE"], "gsplat-edu: doctor: runs in one process"),
    ],
)
def test_a_mistake_is_reported_once(capture, tmp_path, words, line):
    words = [str(capture) if word == "CAPTURE" else word for word in words]
    words += ["--out", str(tmp_path / "run")] if words[0] == "train" else []
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*launcher, "-m", "gsplat_edu", *words],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    ours = [found for found in done.stderr.splitlines() if found.startswith("gsplat-edu")]
    assert len(ours) == 1 and ours[0].startswith(line), done.stderr
    assert "exitcode  : 2" in done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("names", "allowed"), [({}, False), ({"TORCHELASTIC_MAX_RESTARTS": "2"}, True)])
def test_restarts_need_resume(capture, tmp_path, monkeypatch, capsys, names, allowed):
    """A restart without --resume fails, because the folder has a run."""
    for name, value in {
        "RANK": "0",
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": "x",
    }.items():
        monkeypatch.setenv(name, value)
    for name, value in names.items():
        monkeypatch.setenv(name, value)
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--batch", "2" if allowed else "3"]
    assert main(words) == 2
    said = "--resume: is needed with --max-restarts" if allowed else "--batch: is 3"
    assert capsys.readouterr().err.startswith(f"gsplat-edu train: {said}")
