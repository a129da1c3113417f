"""A training on webgpu is measured, forecast, limited and chosen; on a software adapter with a browser's limits."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError, BackendWarning
from gsplat_edu.budget import trial
from gsplat_edu.budget.choice import Prospect, choose_backend, decide
from gsplat_edu.budget.costs import TRAINED_PAIRS, Facts, Footprint, Measurements, Speed, step_profile
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.forecast import predict
from gsplat_edu.budget.on_device import check_room
from gsplat_edu.budget.pace import Pace
from gsplat_edu.budget.plan import Limits, Request, choose
from gsplat_edu.budget.probe import probe
from gsplat_edu.cli.main import main
from gsplat_edu.cli.train import with_backend
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.engine import host
from gsplat_edu.engine.adapters import adapters, listed_outside
from gsplat_edu.engine.frame import Pool
from gsplat_edu.engine.passes import LIMITS, WORD
from gsplat_edu.engine.resident import PHOTO_ROOM
from gsplat_edu.engine.room import Load, Room, kept_photos, room_of
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.webgpu.render import rendering_with
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.scene.given_depth import GivenDepth
from gsplat_edu.train.compose import Start, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.events import StepEvent
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.resident import ResidentStepper, leaves_device

pytestmark = pytest.mark.usefixtures("webgpu")

MIB = 2**20
SMALL = recipe(30, strategy="fast", max_gaussians=120, sh_degree=1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 34))
    return folder


@pytest.fixture(scope="module")
def dataset(capture):
    return load_dataset(capture)


def options(capture, out, config=SMALL, **changes):
    return RunOptions(capture, out, config, DataSettings(), backend="webgpu", **changes)


def test_a_forecast_counts_the_buffers_that_a_training_makes(dataset):
    """Both follow from one description. The training has settled on the pairs that its steps needed."""
    config = SMALL.changed(fast_start_factor=1.0)
    start = Start(from_points(dataset.points, dataset.colors, config.changed(max_gaussians=100)), extent=1.0)
    run = training(config, dataset, load_backend("webgpu"), start)
    run.run()
    resident = run.stepper.device_run.resident
    run.stepper.device_run.load(run.stepper.device_run.read())
    made = resident.memory.program.words(resident.memory.counts)
    pairs = resident.most_pairs_each * resident.count / 1.25
    tiles = 4  # 24 x 18 px
    load = Load(resident.count, 3, 24 * 18, tiles, math.floor(pairs))
    assert load.step_words() == made
    assert load.bytes() >= WORD * sum(made.values())


def test_the_most_that_fits_fits_and_one_more_does_not(device):
    room = room_of(device)
    assert room.largest == LIMITS["max-storage-buffer-binding-size"]
    assert room.shared == (device.name.kind != "DiscreteGPU")
    for pairs_each in (0.5, TRAINED_PAIRS):
        most = room.most_gaussians(15, pairs_each)
        for gaussians, fits in ((most, True), (most + 1, False)):
            load = Load(gaussians, 15, 1, 1, round(pairs_each * gaussians))
            words = load.step_words()
            assert (WORD * max(words.values()) <= room.largest) == fits
            assert (room.too_large(load) is None) == fits
    assert room.most_gaussians(15, TRAINED_PAIRS) == 503_316, "docs/KERNELS.md"
    # 45 harmonics of 4 bytes each bind a scene of few pairs
    assert room.most_gaussians(15, 0.5) == 128 * MIB // 180
    pixels = room.most_pixels()
    assert room.too_large(Load(1, 0, pixels, 1, 1)) is None
    assert room.too_large(Load(1, 0, pixels + 1, 1, 1))[0] == "maps"


def test_the_trial_times_no_compilation(capture, dataset, monkeypatch):
    """The clock of this test counts the pipelines that are compiled, on a device that has none."""
    pool = Pool(host.Device(limits=LIMITS))
    compiled, right = [], pool.device.device.create_compute_pipeline

    def counted(**options):
        compiled.append(options["compute"]["entry_point"])
        return right(**options)

    class Clock:
        @staticmethod
        def perf_counter():
            return float(len(compiled))

    monkeypatch.setattr(pool.device.device, "create_compute_pipeline", counted)
    monkeypatch.setattr(trial, "time", Clock)
    scene, views = from_points(dataset.points, dataset.colors, SMALL), dataset.train[:2]
    with rendering_with(pool):
        found = trial.run_trial(scene, views, SMALL, 1.0, load_backend("webgpu"))
    assert compiled and found.seconds == [0.0] * trial.TIMED_STEPS and found.exchange == 0.0
    assert found.pairs > 0 and found.gaussians == len(scene)


def test_a_probe_measures_the_steps_on_the_device(dataset, monkeypatch):
    monkeypatch.setattr(trial, "TRIAL_SECONDS", 0.1)
    measured = probe(dataset, SMALL, "webgpu")
    assert measured.backend == "webgpu" and measured.pairs > 0 and measured.exchange > 0.0
    assert measured.room is not None and measured.room.largest == 128 * MIB
    assert measured.speed.seconds(100, 24 * 24) > 0.0
    found = predict(Facts.of(dataset), measured, SMALL)
    assert "on webgpu" in found.lines()[0] and found.seconds["density"] > 0.0
    assert ("device" in found.memory) == measured.room.shared


FACTS = Facts(84, 13, 25_784, 734_580.0, 734_580.0, 734_580.0, 213_762_780, 2)
INTEGRATED = Room("Apple M2", 2**32 - 4, True)
DISCRETE = Room("NVIDIA GeForce RTX 4070", 2**31, False)


def measured_on(room):
    return Measurements(
        "webgpu", Speed(0.002, 2e-8, 2e-8), 0.01, 1.5e-7, 3e-7, 250_000, 310 * MIB, 380 * MIB, 1.0, 1e-6, room
    )


def planned(capture, room, memory=None, seconds=None, given=(), **changes):
    limits = Limits(None if memory is None else memory * MIB, None if seconds is None else Deadline(seconds))
    chosen = options(capture, capture, recipe(7_000, **({"strategy": "fast"} | changes)))
    request = Request(
        chosen, limits, frozenset(given), True, FACTS, (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0), room=room
    )
    return choose(request, measured_on(room), 8.0)


@pytest.mark.parametrize("limit", [700, 1_000, 2_000, 8_000])
def test_memory_that_is_shared_counts_together(capture, limit):
    """With memory of its own, a GPU leaves the processor's to photos and Gaussians: never less of them."""
    shared, apart = (planned(capture, room, limit) for room in (INTEGRATED, DISCRETE))
    assert shared.forecast.peak <= limit * MIB and apart.forecast.peak <= limit * MIB
    assert shared.forecast.memory["device"] > 0 and shared.forecast.apart == 0
    assert "device" not in apart.forecast.memory and apart.forecast.apart > 0
    assert "on the GPU" in apart.forecast.lines()[2]
    assert (apart.resolution or 1.0) <= (shared.resolution or 1.0)
    if apart.resolution == shared.resolution:
        assert apart.max_gaussians >= shared.max_gaussians
    footprint = Footprint(FACTS, 0, 250_000, 3, room=INTEGRATED)
    assert footprint.on_device(100_000, 50 * MIB) - footprint.on_device(100_000, 0) == 50 * MIB
    alone = Footprint(FACTS, 0, 250_000, 3)
    assert alone.on_device(100_000, 0) == 0
    photos = [each.parts(100_000, 50 * MIB)["photos"] for each in (alone, footprint)]
    assert photos == [50 * MIB, FACTS.photo_bytes], "photos decoded anew stay for steps to be taken again"


def test_photos_keep_to_the_budget_of_the_run(capture, tmp_path):
    assert [kept_photos(room) for room in (None, 5, 2 * PHOTO_ROOM)] == [PHOTO_ROOM, 5, PHOTO_ROOM]
    chosen = options(capture, tmp_path / "run", save_every=0, eval_every=0)
    chosen = dataclasses.replace(chosen, data_settings=DataSettings(image_memory=5 * 4 * 24 * 18))
    run = CaptureRun(chosen)
    run.train()
    kept = run.trainer.stepper.device_run.resident.photos
    assert sum(sent.kept.nbytes for _, sent in kept.values()) <= 5 * 4 * 24 * 18
    assert len(kept) == 5


@pytest.mark.parametrize("strategy", ["fast", "adc"])
def test_a_plan_that_does_not_fit_the_buffers_is_reduced_in_one_line(capture, strategy):
    small = Room("llvmpipe", 2 * MIB, True)
    found = planned(capture, small, 4_000, strategy=strategy)
    most = small.most_gaussians(15, TRAINED_PAIRS)
    assert most / 1.2 < found.max_gaussians <= most
    (said,) = [line for line in found.sentences if "llvmpipe" in line]
    assert said.startswith(
        f"--max-gaussians {found.max_gaussians}: llvmpipe has buffers of up to 2 MiB, which hold"
    )
    assert said.endswith("--backend cpu has no such limit")
    assert not [
        line for line in planned(capture, INTEGRATED, 4_000, strategy=strategy).sentences if "buffers" in line
    ]


def test_a_cap_or_photos_that_do_not_fit_are_refused_before_the_training(capture, dataset, tmp_path, capsys):
    command = [
        "train",
        str(capture),
        "--out",
        str(tmp_path / "run"),
        "--backend",
        "webgpu",
        "--iterations",
        "3",
    ]
    assert main([*command, "--max-gaussians", "600000"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "--max-gaussians: is 600,000, but" in line and "give at most that, or --backend cpu" in line
    assert not (tmp_path / "run/config.json").exists()
    small = Room("llvmpipe", 36 * 16 * 16, True)
    with pytest.raises(ArgumentError, match=r"photos have 24x18; give --resolution 10, or --backend cpu"):
        check_room(small, recipe(5, strategy="none"), dataset)


def test_a_run_in_time_repeats_its_decisions_and_its_bits(capture, tmp_path):
    """The clock is simulated: steps become twice as slow in mid-run. The second run takes the first one's tempo."""
    plain = dataclasses.replace(options(capture, tmp_path / "run"), save_every=0, eval_every=0)
    run = CaptureRun(plain)
    profile = step_profile(plain.config, Facts.of(run.dataset), Speed(0.4, 2e-4, 1e-3))
    now = 20.0

    def clock(trainer=None, event=None):
        nonlocal now
        if isinstance(event, StepEvent):
            now += (2.0 if event.iteration > 12 else 1.0) * float(profile[min(trainer.position, 29)])
        return now

    limit = 1.2 * (20.0 + 6.0 + float(profile.sum()))
    pace = Pace(run, Deadline(limit, clock), profile=profile)
    run.train(pace.over, [clock, pace])
    run.finish()
    assert run.options.config.tempo and run.options.config.iterations < 30
    again = CaptureRun(dataclasses.replace(plain, out=tmp_path / "again", config=run.options.config))
    again.train()
    again.finish()
    scenes = [RunFolder(tmp_path / name).latest_scene()[0].read_bytes() for name in ("run", "again")]
    assert scenes[0] == scenes[1]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"strategy": "mcmc"},
        {"strategy": "adc"},
        {"appearance": "exposure"},
        {"refine": "poses"},
        {"transients": "mask"},
        {"outside_masks": "empty"},
        {"batch": 2},
        {"surface": True},
        {"given_depth": "points"},
    ],
    ids=lambda changes: ",".join(f"{name}={value}" for name, value in changes.items()) or "plain",
)
def test_what_leaves_the_device_is_known_beforehand(dataset, changes):
    settings = {"strategy": "fast", "max_gaussians": 120} | changes
    asked = {name: settings.pop(name) for name in ("given_depth",) if name in settings}
    config = recipe(30, **settings)
    if asked:
        depth = GivenDepth(np.zeros((1, 2)), np.ones(1))
        dataset = dataclasses.replace(
            dataset, train=tuple(v.with_depth(lambda: depth) for v in dataset.train)
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BackendWarning)
        run = training(config, dataset, load_backend("webgpu"))
    reason = leaves_device(config, asked)
    assert isinstance(run.stepper, ResidentStepper) == (reason is None)
    assert (reason is None) == (not changes.keys() - {"strategy"})


def test_auto_decides_by_real_forecasts(capture, tmp_path, monkeypatch):
    """On an adapter that a test allows. Software is slower than the processor's own kernels."""
    monkeypatch.setattr(trial, "TRIAL_SECONDS", 0.1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    reader, said = CaptureReader(capture), []
    chosen = dataclasses.replace(options(capture, tmp_path / "run"), backend="cpu")
    assert with_backend(chosen, reader, said.append).backend == "cpu"
    if all(one.software for one in adapters()):
        assert not said, "without a GPU there is nothing to say"
    prospect = Prospect.of(chosen, reader)
    found = choose_backend(prospect, allow_software=True)
    seconds = found.decision.seconds
    assert set(found.measured) == set(seconds) == {"webgpu", "cpu"}
    assert found.backend == min(seconds, key=seconds.get)
    assert adapters()[0].name in found.decision.reason
    # the same forecasts on a computer whose processor is a thousand times slower
    slow = {"webgpu": seconds["webgpu"], "cpu": 1_000 * seconds["cpu"]}
    taken = decide(listed_outside(), None, lambda: None, slow.__getitem__, allow_software=True)
    assert taken.backend == "webgpu"
    run = CaptureRun(dataclasses.replace(chosen, backend=taken.backend, save_every=0, eval_every=0))
    run.train()
    assert isinstance(run.trainer.stepper, ResidentStepper) and run.trainer.iteration == 30
    resumed = dataclasses.replace(chosen, resume=True)
    assert with_backend(resumed, reader, said.append).backend == "webgpu", "it goes on where it began"


def test_another_process_lists_the_same_adapters():
    assert listed_outside().adapters == adapters() and listed_outside().reason is None


def test_a_device_that_fails_in_the_probe_is_one_line(dataset, monkeypatch):
    def fail(self, *given, **options):
        raise BackendUnavailableError("backend 'webgpu': the adapter is lost; use the backend cpu")

    monkeypatch.setattr(host.Memory, "submit", fail)
    with pytest.raises(BackendUnavailableError, match="the adapter is lost"):
        probe(dataset, SMALL, "webgpu")
