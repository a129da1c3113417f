"""A run with a time limit uses nearly all of the time and never more, also if the machine's speed changes in mid-run.
The clock is simulated: a step takes the modelled seconds times a factor that changes during the run.
"""

import dataclasses
import math
import shutil

import pytest

from gsplat_edu.budget.costs import Facts, Speed, step_profile
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.forecast import ENDING_SECONDS
from gsplat_edu.budget.pace import Pace
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.training import CaptureRun, RunOptions, is_finished
from gsplat_edu.train.config import recipe
from gsplat_edu.train.events import StepEvent

pytestmark = pytest.mark.slow

SPEED = Speed(fixed=0.4, per_pixel=2e-4, per_gaussian=1e-3)
"""Speed of the simulated machine, as the plan expects it."""

BEFORE = 20.0
"""Seconds that the command has taken before it trains."""


GIVEN = ["--save-every", "0", "--eval-every", "0", "--sh-degree", "0"]
GIVEN += [f"--{name}=none" for name in ("appearance", "sky", "transients", "refine")]
"""The command-line options that stand for what `options` sets."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(size=40, count=16))
    return folder


class SimulatedClock:
    """Counts the seconds of a machine whose steps take `slowness(seconds)` times the modelled seconds."""

    def __init__(self, profile, slowness=lambda seconds: 1.0):
        self.profile, self.slowness, self.seconds = profile, slowness, BEFORE

    def __call__(self, trainer=None, event=None):
        if isinstance(event, StepEvent):
            position = trainer.tempo.position(event.iteration)
            expected = float(self.profile[min(position, len(self.profile) - 1)])
            self.seconds += self.slowness(self.seconds) * expected
        return self.seconds


def options(capture, out, iterations, strategy="fast", **changes):
    config = recipe(iterations, strategy=strategy, max_gaussians=400, sh_degree=0, **changes)
    return RunOptions(capture, out, config, DataSettings(), save_every=0, eval_every=0)


def paced(chosen, limit, slowness=lambda seconds: 1.0, *, stretches=True, **arguments):
    """Train within a limit; return the run, the seconds of the whole command, and the pace."""
    run = CaptureRun(chosen, **arguments)
    profile = step_profile(chosen.config, Facts.of(run.dataset), SPEED)
    clock = SimulatedClock(profile, slowness)
    pace = Pace(run, Deadline(limit, clock), profile=profile if stretches else None)
    run.train(pace.over, [clock, pace])
    run.finish()
    return run, clock.seconds + ENDING_SECONDS, pace


SPEEDS = {
    "as planned": lambda limit: lambda now: 1.0,
    "slower by 3 from the start": lambda limit: lambda now: 3.0,
    "faster by 3 from the start": lambda limit: lambda now: 1 / 3,
    "slower by 3 in mid-run": lambda limit: lambda now: 3.0 if now > limit / 2 else 1.0,
    "faster by 3 in mid-run": lambda limit: lambda now: 1 / 3 if now > limit / 2 else 1.0,
    "slower by 3 for the middle third": lambda limit: (
        lambda now: 3.0 if limit / 3 < now < 2 * limit / 3 else 1.0
    ),
    "slower and slower": lambda limit: lambda now: 1.0 + 2.0 * now / limit,
    "unsteady": lambda limit: lambda now: 1.0 + 0.9 * math.sin(now),
}


@pytest.mark.parametrize(
    ("speed", "strategy"), [*((speed, "fast") for speed in SPEEDS), ("slower by 3 in mid-run", "adc")]
)
def test_between_92_and_100_percent_of_the_limit_are_used(capture, tmp_path, speed, strategy):
    chosen = options(capture, tmp_path / "run", 200, strategy)
    facts = Facts.of(CaptureRun(chosen).dataset)
    limit = 1.1 * (float(step_profile(chosen.config, facts, SPEED).sum()) + BEFORE + ENDING_SECONDS)
    run, used, _ = paced(dataclasses.replace(chosen, resume=True), limit, SPEEDS[speed](limit))
    assert 0.92 * limit <= used <= limit
    done = run.trainer.iteration
    assert run.folder.read_metrics()["iterations"] == run.folder.read_config()["train"]["iterations"] == done
    assert run.trainer.position >= 0.9 * 200, "the schedule is completed in fewer or more iterations"
    assert is_finished(dataclasses.replace(run.options, resume=True))


def test_a_run_that_scores_nothing_reads_no_held_out_photo(capture, tmp_path):
    """The held-out photos are gone before training begins, and all photos before it ends."""
    shutil.copytree(capture, tmp_path / "capture")
    chosen = options(tmp_path / "capture", tmp_path / "run", 30, appearance="exposure")
    chosen = dataclasses.replace(chosen, data_settings=DataSettings(image_memory=0))
    run = CaptureRun(chosen)
    held_out = {view.name for view in run.dataset.test}
    photos = {path.name: path for path in (tmp_path / "capture" / "images").iterdir()}
    assert len(held_out) == 2
    for name in held_out:
        photos.pop(name).unlink()
    profile = step_profile(chosen.config, Facts.of(run.dataset), SPEED)
    clock = SimulatedClock(profile)
    pace = Pace(run, Deadline(100.0, clock), profile=profile)
    run.train(pace.over, [clock, pace])
    for path in photos.values():
        path.unlink()
    run.finish()
    metrics = run.folder.read_metrics()
    assert metrics["not_scored"] == {"test": 2, "train": 14}
    assert not {"test", "train", "test_views", "psnr_aligned"} & metrics.keys()
    assert not run.folder.renders.exists()


def test_the_printed_options_repeat_the_run_exactly(capture, tmp_path):
    chosen = options(capture, tmp_path / "run", 200)
    run, _, pace = paced(chosen, 300.0, lambda now: 2.0 if now > 100 else 0.5)
    assert f"200 iterations were planned, {run.trainer.iteration} fitted" in pace.outcome
    words = pace.outcome.split("to repeat the run: ")[1].split()
    fixed = [
        "--save-every",
        "0",
        "--eval-every",
        "0",
        "--sh-degree",
        "0",
        "--appearance",
        "none",
        "--sky",
        "none",
    ]
    fixed += ["--transients", "none", "--refine", "none"]
    assert main(["train", str(capture), "--out", str(tmp_path / "again"), *fixed, *words]) == 0
    scenes = [RunFolder(tmp_path / name).latest_scene()[0].read_bytes() for name in ("run", "again")]
    assert scenes[0] == scenes[1]


def test_a_killed_run_repeats_its_decisions_when_resumed(capture, tmp_path):
    """The checkpoint is older than the last decisions, all of which are in config.json."""

    def slowness(now):
        return 3.0 if now > 120 else 1.0

    class KilledError(Exception):
        pass

    def kill(trainer, event):
        if isinstance(event, StepEvent) and event.iteration == 110:
            raise KilledError

    paced(options(capture, tmp_path / "whole", 200), 300.0, slowness)
    chosen = dataclasses.replace(options(capture, tmp_path / "run", 200), save_every=50)
    run = CaptureRun(chosen)
    profile = step_profile(chosen.config, Facts.of(run.dataset), SPEED)
    clock = SimulatedClock(profile, slowness)
    pace = Pace(run, Deadline(300.0, clock), profile=profile)
    with pytest.raises(KilledError):
        run.train(pace.over, [clock, pace, kill])
    stored = run.folder.read_config()["train"]
    assert stored["tempo"] and not run.folder.read_metrics()
    resumed = ["train", str(capture), "--out", str(tmp_path / "run"), "--resume"]
    assert main([*resumed, *GIVEN, "--max-gaussians", "400"]) == 0
    first, second = (RunFolder(tmp_path / name).read_config()["train"]["tempo"] for name in ("run", "whole"))
    assert second.startswith(first), "the decisions before the kill are those of the uninterrupted run"
    assert RunFolder(tmp_path / "run").read_metrics()["iterations"] == stored["iterations"]


def test_a_run_of_given_length_keeps_its_schedule_and_stops_in_time(capture, tmp_path):
    chosen = options(capture, tmp_path / "run", 200)
    run, used, pace = paced(chosen, 100.0, stretches=False)
    assert used <= 100.0 and pace.outcome is None
    stored = run.folder.read_config()["train"]
    assert (stored["iterations"], stored["tempo"]) == (200, ""), "it can be resumed"
    assert 0 < run.folder.read_metrics()["iterations"] < 200
