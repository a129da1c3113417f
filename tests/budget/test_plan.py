"""Plans keep their limits by the model, and one small run keeps its memory limit by the system's counters."""

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.budget.costs import (
    LATER,
    Facts,
    Footprint,
    Measurements,
    Speed,
    photo_copies,
)
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.plan import Limits, Request, choose, look_ahead, plan
from gsplat_edu.budget.planned import flags, taken_up
from gsplat_edu.budget.probe import resident_bytes
from gsplat_edu.cli import train
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.ply import save_ply
from gsplat_edu.options.train import options_from
from gsplat_edu.options.values import bytes_text, seconds_text
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.training import CaptureRun, RunOptions, is_finished
from gsplat_edu.train.capacity import LEAST_PLANNED, PLANNED, PLANNED_PIXELS, PLANNED_VIEWS, wanted_gaussians
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import random_ball

MIB = 2**20

FACTS = Facts(
    train=84,
    test=13,
    points=25_784,
    pixels=734_580.0,
    largest=734_580.0,
    full=734_580.0,
    photo_bytes=213_762_780,
    workers=2,
)
MEASURED = Measurements(
    backend="cpu",
    speed=Speed(fixed=0.002, per_pixel=2e-8, per_gaussian=2.4e-7),
    read=0.01,
    score=1.5e-7,
    picture=3e-7,
    pairs=250_000,
    resident=310 * MIB,
    settled=380 * MIB,
)
FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
OPTIONS = RunOptions(Path("capture"), Path("run"), recipe(), DataSettings())
SPENT = 8.0


def request(memory=None, seconds=None, given=(), factors=FACTORS, rescale=True, **changes):
    settings = {key: changes.pop(key) for key in ("resolution", "image_memory") if key in changes}
    iterations = changes.pop("iterations", 30_000)
    options = dataclasses.replace(
        OPTIONS,
        config=recipe(iterations, rescale=rescale, **changes),
        data_settings=DataSettings(**settings),
    )
    limits = Limits(None if memory is None else memory * MIB, None if seconds is None else Deadline(seconds))
    return Request(options, limits, frozenset(given), rescale, FACTS, factors)


def chosen(*arguments, **options):
    return choose(request(*arguments, **options), MEASURED, SPENT)


def peak(found):
    """Return the modelled peak memory of a plan with as many Gaussians as it allows."""
    facts, config = FACTS.smaller(found.resolution or 1.0), found.options.config
    process = MEASURED.process + photo_copies(config, facts)
    footprint = Footprint(facts, process, MEASURED.pairs, config.sh_degree)
    return footprint.peak(found.max_gaussians, found.image_memory)


@pytest.mark.parametrize("strategy", ["adc", "mcmc", "fast"])
def test_any_memory_limit_is_kept_and_more_memory_is_never_worse(strategy):
    plans = [
        chosen(limit, strategy=strategy) for limit in (560, 640, 800, 1_024, 1_500, 2_048, 4_096, 16_384)
    ]
    limits = (560, 640, 800, 1_024, 1_500, 2_048, 4_096, 16_384)
    for limit, found in zip(limits, plans, strict=True):
        assert peak(found) <= limit * MIB, limit
    sizes = [found.resolution or 1.0 for found in plans]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > 1.0 and sizes[-1] == 1.0
    for less, more in itertools.pairwise(found for found in plans if found.resolution is None):
        assert more.max_gaussians >= less.max_gaussians and more.image_memory >= less.image_memory
    assert plans[-1].image_memory == FACTS.photo_bytes, "all photos are kept if there is room"
    assert all(found.iterations == 30_000 and not found.by_time for found in plans)


def test_any_time_limit_is_kept_and_more_time_is_never_worse():
    limits = (40, 60, 120, 240, 600, 1_800, 7_200, 36_000)
    plans = [chosen(None, seconds) for seconds in limits]
    for seconds, found in zip(limits, plans, strict=True):
        assert found.forecast.total + SPENT <= seconds
        assert found.by_time
    assert [found.iterations for found in plans] == sorted(found.iterations for found in plans)
    assert plans[-1].iterations == 30_000, "the recipe's maximum"
    sizes = [found.resolution or 1.0 for found in plans]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > 1.0 and sizes[-1] == 1.0
    # The schedule uses most of the time. Rounding the iterations down to two digits loses up to 9 %, as does the cap.
    assert plans[4].forecast.total + SPENT > 0.7 * 600


def test_both_limits_are_kept_together():
    found = chosen(700, 300.0)
    assert peak(found) <= 700 * MIB and found.forecast.total + SPENT <= 300


def test_the_milestones_scale_with_the_chosen_iterations():
    config = chosen(None, 240.0).options.config
    stretched = recipe(config.iterations)
    assert config == dataclasses.replace(stretched, max_gaussians=config.max_gaussians)
    kept = chosen(None, 240.0, rescale=False).options.config
    assert kept.adc.densify_stop == 15_000 and kept.iterations < 15_000
    given = chosen(None, 240.0, given=["densify_stop"], densify_stop=900).options.config
    assert given.adc.densify_stop == 900 and given.sh_every == recipe(given.iterations).sh_every


@pytest.mark.parametrize(
    ("name", "value"),
    [("resolution", 3.0), ("image_memory", 50 * MIB), ("max_gaussians", 60_000), ("iterations", 700)],
)
def test_given_options_are_kept(name, value):
    factors = (1.0,) if name == "resolution" else FACTORS
    found = chosen(900, 240.0, given=[name], factors=factors, **{name: value})
    assert getattr(found, name) == value
    flag = f"--{name.replace('_', '-')}"
    assert flag not in found.sentences[0], "the user gave it, so the plan did not choose it"
    assert found.by_time == (name != "iterations")


def test_a_given_cap_fits_or_is_refused():
    found = chosen(900, given=["max_gaussians"], max_gaussians=100_000)
    footprint_holds = peak(found) <= 900 * MIB
    assert footprint_holds and found.max_gaussians == 100_000
    with pytest.raises(ArgumentError, match="MiB would do"):
        chosen(900, given=["max_gaussians"], max_gaussians=5_000_000)


@pytest.mark.parametrize("given", [{}, {"max_gaussians": 500_000}, {"image_memory": 200 * MIB}])
def test_too_little_memory_is_one_line_and_the_amount_it_names_is_enough(given):
    with pytest.raises(ArgumentError) as refused:
        chosen(64, given=list(given), **given)
    said = str(refused.value)
    assert said.startswith("--max-memory 64 MiB") and "\n" not in said
    enough = int(said.split("; ")[-1].removesuffix("MiB would do"))
    assert peak(chosen(enough, given=list(given), **given)) <= enough * MIB
    with pytest.raises(ArgumentError):
        chosen(enough - 2, given=list(given), **given)


def test_too_little_time_is_one_line_and_the_time_it_names_is_enough():
    with pytest.raises(ArgumentError) as refused:
        chosen(None, 9.0)
    said = str(refused.value)
    assert said.startswith("--time-limit 9 s: is too short") and "\n" not in said
    enough = seconds_text(said.rsplit("at least ", 1)[1].replace(" ", "").replace("min", "m"))
    assert chosen(None, enough).iterations >= 50


def test_a_limit_that_leaves_no_usable_scene_is_called_so_with_the_time_that_would_do():
    """84 photos are a standard training of 3,000 iterations, whatever the strategy; a tenth is the least."""
    one_size = {"factors": (1.0,), "strategy": "fast"}
    enough, short = chosen(None, 600.0, **one_size), chosen(None, 33.0, **one_size)
    assert enough.full_length == short.full_length == 3_000
    assert enough.iterations > 300 and not any("usable" in line for line in enough.sentences)
    assert short.iterations < 300
    said = short.sentences[-1]
    assert f"it leaves {short.iterations} iterations of 3,000" in said and "far too short" in said
    named = seconds_text(said.rsplit("about ", 1)[1].replace(" ", "").replace("min", "m"))
    assert 2_900 <= chosen(None, named, **one_size).iterations <= 3_500
    assert chosen(None, 33.0, given=["iterations"], iterations=40, **one_size).full_length == 40


def test_the_sentences_name_what_was_chosen():
    found = chosen(1_024, 240.0)
    first, *forecast = found.sentences
    assert first.startswith("--max-memory 1 GiB and --time-limit 4 min 0 s: chosen ")
    for flag, value in (("--iterations", found.iterations), ("--max-gaussians", found.max_gaussians)):
        assert f"{flag} {value}" in first
    assert f"--image-memory {-(-found.image_memory // MIB)}MiB" in first
    assert any("memory: up to" in line for line in forecast) and all("\n" not in line for line in forecast)


def test_the_options_in_the_sentence_give_the_same_run():
    """The plan and the options in its sentence have the same recipe and photo size."""
    found = chosen(700, 240.0)
    words = found.sentences[0].split("chosen ")[1].split()
    parsed = build_parser(["train"]).parse_args(
        ["train", "capture", "--out", "run", "--strategy", "adc", *words]
    )
    again = options_from(parsed)
    assert again.config == found.options.config
    assert again.data_settings.resolution == found.resolution
    assert bytes_text(words[words.index("--image-memory") + 1]) >= found.image_memory


def test_large_photos_leave_a_useful_cap_and_are_kept_if_that_is_cheaper():
    """Once 60 photos of 12 MP are downscaled, keeping all of them takes less memory than decoding one of them again."""
    facts = dataclasses.replace(
        FACTS, train=52, test=8, pixels=12e6, largest=12e6, full=12e6, photo_bytes=60 * 36_000_000
    )
    for memory in (800, 1_024, 1_500):
        found = choose(dataclasses.replace(request(memory), facts=facts), MEASURED, SPENT)
        smaller = facts.smaller(found.resolution)
        footprint = Footprint(smaller, MEASURED.process, MEASURED.pairs, found.options.config.sh_degree)
        assert footprint.peak(found.max_gaussians, found.image_memory) <= memory * MIB
        every = footprint.most_gaussians(int(0.95 * memory * MIB), smaller.photo_bytes)
        assert found.image_memory >= smaller.photo_bytes or every < found.max_gaussians
        assert found.max_gaussians >= 1_000


def test_a_capture_is_not_read_if_nothing_has_to_be_planned(tmp_path):
    """The capture does not exist, so reading it would fail."""
    options = dataclasses.replace(OPTIONS, data=tmp_path / "nothing")
    assert plan(options, Limits()).options is options
    assert plan(options, Limits(time=Deadline(3.0)), ["iterations"]).options is options
    with pytest.raises(ArgumentError, match="--backend torch"):
        plan(dataclasses.replace(options, backend="torch"), Limits(memory=2**30))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(64, 16))
    return folder


def options(capture, out, iterations=20, **changes):
    return RunOptions(capture, out, recipe(iterations, **changes), DataSettings(), save_every=0, eval_every=0)


def trained(run, callbacks=(), stop=lambda: False):
    run.train(stop, callbacks)
    run.finish()
    return run.folder


def test_a_capture_is_planned_from_its_files(capture, tmp_path):
    """The chosen values depend on this machine's speed; the asserted bounds hold on any machine."""
    found = plan(
        dataclasses.replace(OPTIONS, data=capture, out=tmp_path / "run"), Limits(2**32, Deadline(3_600.0))
    )
    assert found.resolution is None and found.by_time and found.forecast.peak < 2**32
    assert found.max_gaussians > 200 and 50 <= found.iterations <= 30_000


@pytest.mark.parametrize(
    ("strategy", "limits"), [("adc", Limits(2**32)), ("mcmc", Limits(None, Deadline(3_600.0)))]
)
def test_a_start_scene_is_planned_with_its_own_gaussians(strategy, limits, capture, tmp_path):
    """A cap selects some of a capture's points, but a start scene must fit entirely."""
    scene = tmp_path / "scene.ply"
    save_ply(scene, random_ball(5_000, torch.Generator().manual_seed(0)))
    run = dataclasses.replace(options(capture, tmp_path / "run", strategy=strategy), scene=scene)
    found = plan(run, limits)
    assert found.forecast.gaussians[0] == 5_000 and found.max_gaussians >= 5_000
    assert len(CaptureRun(found.options).trainer.gaussians) == 5_000


def test_the_fast_recipe_plans_its_number_without_limits_and_a_resumed_run_keeps_it(capture, tmp_path):
    """The number follows from pixels and views, but is at least that of a start scene. A given number is kept."""
    run = dataclasses.replace(options(capture, tmp_path / "run", 20), config=recipe(20, strategy="fast"))
    found = plan(run, Limits())
    facts = Facts.of(load_dataset(capture))
    assert found.max_gaussians == facts.wanted(run.config)
    assert found.max_gaussians == 64 * 48 and found.iterations == 20, "at most one Gaussian per pixel"
    assert found.sentences == (
        f"the recipe plans {found.max_gaussians:,} Gaussians; --max-gaussians changes that",
    )
    trained(CaptureRun(found.options))
    again = plan(dataclasses.replace(run, resume=True), Limits())
    assert again.max_gaussians == found.max_gaussians and is_finished(again.options)
    scene = tmp_path / "scene.ply"
    save_ply(scene, random_ball(5_000, torch.Generator().manual_seed(0)))
    other = dataclasses.replace(run, scene=scene, out=tmp_path / "other")
    assert plan(other, Limits()).max_gaussians == 5_000
    fixed = dataclasses.replace(other, config=recipe(20, strategy="fast", max_gaussians=7_000))
    assert plan(fixed, Limits()).options == fixed and not plan(fixed, Limits()).sentences


def test_the_planned_number_grows_with_pixels_and_views_and_has_a_minimum():
    def wanted(pixels, views):
        return wanted_gaussians(recipe(20, strategy="fast"), 200, pixels, views)

    assert wanted(PLANNED_PIXELS, PLANNED_VIEWS) == PLANNED
    assert (
        wanted(8 * PLANNED_PIXELS, PLANNED_VIEWS) == wanted(PLANNED_PIXELS, 4 * PLANNED_VIEWS) == 2 * PLANNED
    )
    assert wanted(64 * 48, 14) == 64 * 48, "never more than one Gaussian per pixel"
    assert wanted(1, 1) == LEAST_PLANNED


def test_a_start_scene_that_does_not_fit_is_refused(capture, tmp_path):
    """The capture's points would fit this limit, at least in part; the far larger start scene does not."""
    scene = tmp_path / "scene.ply"
    save_ply(scene, random_ball(200_000, torch.Generator().manual_seed(0)))
    run = options(capture, tmp_path / "run", strategy="none")
    limits = Limits(resident_bytes() + LATER + 150 * MIB)
    assert plan(run, limits).max_gaussians < 200_000
    with pytest.raises(ArgumentError, match=r"--max-memory .*: is too little for .*; \d+MiB would do"):
        plan(dataclasses.replace(run, scene=scene), limits)


def test_the_time_before_the_plan_counts(capture, tmp_path):
    """An hour is enough for any plan, but all of it except one second is spent."""
    late = Limits(time=Deadline(3_600.0, lambda: 3_599.0))
    with pytest.raises(ArgumentError, match="--time-limit 1 h 0 min: is too short"):
        plan(dataclasses.replace(OPTIONS, data=capture, out=tmp_path / "run"), late)


def test_a_limit_that_cannot_be_kept_is_refused_before_any_trial(capture, tmp_path, monkeypatch, capsys):
    """Nothing can be done in a millisecond, which has passed before the command reads its options."""
    monkeypatch.setattr(train, "chosen_by_pilots", lambda *words: pytest.fail("trials were made"))
    monkeypatch.setattr(train, "remedies_for", lambda *words: pytest.fail("all photos were read"))
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--refine", "auto", "--time-limit"]
    assert main([*words, "0.001s"]) == 2
    said = capsys.readouterr().err
    assert "--time-limit" in said and "give at least" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_one_measurement_serves_the_outlook_and_the_plan(capture, tmp_path):
    run = dataclasses.replace(OPTIONS, data=capture, out=tmp_path / "run")
    limits, reader = Limits(time=Deadline(3_600.0, lambda: 0.0)), CaptureReader(capture)
    ahead = look_ahead(run, limits, (), rescale=True, reader=reader)
    assert ahead.warning == "" and 0.0 < ahead.shortest < 3_600.0
    first, second = (plan(run, limits, reader=reader, outlook=ahead) for _ in range(2))
    assert first == second, "measured anew, the forecasts would differ"
    assert look_ahead(run, limits, ["iterations"], rescale=True, reader=reader) is None
    assert look_ahead(run, Limits(2**32), (), rescale=True, reader=reader) is None


def test_a_resumed_run_keeps_the_numbers_of_its_config(capture, tmp_path):
    started = dataclasses.replace(
        options(capture, tmp_path / "run", 20, max_gaussians=333), data_settings=DataSettings(resolution=2)
    )
    trained(CaptureRun(started))
    plain = dataclasses.replace(started, config=recipe(), data_settings=DataSettings(), resume=True)
    again = plan(plain, Limits(2**30, Deadline(100.0)))
    assert again.options.config == started.config and again.resolution == 2 and not again.by_time
    assert is_finished(again.options)
    assert len(again.sentences) == 1 and "memory is not planned again" in again.sentences[0]
    assert plan(plain, Limits(time=Deadline(100.0))).sentences == ()
    assert not is_finished(taken_up(plain, ["iterations"])), (
        "a run is extended by more iterations than its config has"
    )


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("stored", "named"),
    [
        ({"data": {}}, "lacks the section train"),
        ({"train": {}, "data": None}, "lacks the section train or data"),
        ({"train": {"iterations": "many"}, "data": {}}, 'train.iterations: is "many"'),
        ({"train": {}, "data": {"resolution": -1.0}}, "resolution: is -1"),
    ],
)
def test_a_damaged_config_is_one_line(capture, tmp_path, stored, named):
    resumed = dataclasses.replace(options(capture, tmp_path / "run"), resume=True)
    resumed.folder.write_config(stored)
    with pytest.raises(CheckpointError, match="(restore|correct|fix or remove) the file") as refused:
        plan(resumed, Limits(memory=2**30))
    assert named in str(refused.value) and "\n" not in str(refused.value)


def test_flags_include_milestones_that_differ_from_the_recipe():
    config = dataclasses.replace(recipe(3_400), iterations=4_000)
    words = flags(dataclasses.replace(OPTIONS, config=config))
    assert words.startswith("--iterations 4000 --set means_rate_iterations=3400 ")
    assert flags(dataclasses.replace(OPTIONS, config=recipe(4_000))) == "--iterations 4000"
    stretched = recipe(3_400).changed(iterations=4_000, tempo="3400,200:4000")
    words = "--iterations 4000 --set tempo=3400,200:4000"
    assert flags(dataclasses.replace(OPTIONS, config=stretched)) == words, "milestones of 3,400 iterations"


RUN = """
import sys
from pathlib import Path
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.train.config import recipe
config = recipe(150, rescale=False, densify_start=0, densify_every=5, densify_stop=120, grad_threshold=0.0)
options = RunOptions(Path(sys.argv[1]), Path(sys.argv[2]), config, DataSettings(), save_every=50, eval_every=50)
chosen = plan(options, Limits(memory=int(sys.argv[3])), ["iterations"])
run = CaptureRun(chosen.options)
run.train()
run.finish()
"""

MEASURE = """
import os, sys
child = os.posix_spawn(sys.executable, [sys.executable, "-c", *sys.argv[1:]], os.environ)
_, status, usage = os.wait4(child, 0)
print(usage.ru_maxrss * 1024)
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""The training gets a small parent process, because Linux includes the parent's memory in the child's peak."""


@pytest.mark.slow
@pytest.mark.own_process
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ru_maxrss is in KiB on Linux")
def test_a_training_stays_below_its_memory_limit_as_the_system_counts_it(capture, tmp_path):
    """Every Gaussian is cloned or split, so the run reaches the chosen cap and uses the memory that was planned."""
    limit = 560 * MIB
    words = [sys.executable, "-c", MEASURE, RUN, str(capture), str(tmp_path / "run"), str(limit)]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    folder = RunFolder(tmp_path / "run")
    cap = json.loads(folder.config.read_text())["train"]["max_gaussians"]
    assert folder.read_metrics()["num_gaussians"] > 0.9 * cap, "the run came near its limit"
    assert int(done.stdout) <= limit
