"""A run that is taken up again goes on to the bit; what cannot be read or written says so."""

import dataclasses

import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.errors import CheckpointError
from gsplat_edu.render.api import render
from gsplat_edu.train.checkpoint import list_checkpoints, load_checkpoint, read_seconds, save_checkpoint
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.initialize import from_points, make_strategy
from gsplat_edu.train.trainer import Trainer

COMMON = {"densify_start": 5, "densify_every": 10, "densify_stop": 60, "mcmc_stop": 60, "sh_every": 15}
CONFIGS = {
    "adc": recipe(
        64, reset_every=20, grad_threshold=5e-5, prune_screen_size=40.0, random_background=True, **COMMON
    ),
    "mcmc": recipe(64, strategy="mcmc", max_gaussians=400, **COMMON),
    "with replacement": recipe(64, view_order="random", **COMMON),
}


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(32, 8)


def trainer(capture, config: TrainConfig) -> Trainer:
    views, points, colors = capture
    start = from_points(points, colors, config)
    return Trainer(start, views, config, render=render, extent=2.0, density=make_strategy(config, 2.0, start))


def steps(run: Trainer, count: int) -> None:
    end = run.iteration + count
    run.run(lambda: run.iteration >= end)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("at", [1, 20, 33])
def test_a_resumed_run_ends_with_the_same_bits(capture, tmp_path, name, at):
    """33: in the middle of an epoch, between densifications; 20: right after one (and after a reset)."""
    whole, first = trainer(capture, CONFIGS[name]), trainer(capture, CONFIGS[name])
    whole.run()
    steps(first, at)
    path = save_checkpoint(tmp_path, first, 1.0)
    second = trainer(capture, CONFIGS[name])
    load_checkpoint(path, second)
    assert second.iteration == at
    second.run()
    assert second.iteration == whole.iteration == 64
    tensors, numbers = whole.state()
    resumed, resumed_numbers = second.state()
    assert resumed_numbers == numbers
    assert tensors.keys() == resumed.keys()
    for key, tensor in tensors.items():
        assert torch.equal(tensor, resumed[key]), key
    assert len(whole.gaussians) != len(capture[1]), "density control took part"


def test_the_last_two_are_kept_and_the_time_comes_back(capture, tmp_path):
    run = trainer(capture, CONFIGS["adc"])
    for _ in range(4):
        steps(run, 3)
        save_checkpoint(tmp_path, run, run.iteration / 2)
    assert [path.name for path in list_checkpoints(tmp_path)] == [
        "iteration_9.safetensors",
        "iteration_12.safetensors",
    ]
    assert read_seconds(list_checkpoints(tmp_path)[-1]) == 6.0
    assert list_checkpoints(tmp_path / "nowhere") == []


@pytest.mark.parametrize("damage", ["truncated", "empty", "text", "header", "foreign"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_too(capture, tmp_path, damage):
    run = trainer(capture, CONFIGS["adc"])
    for _ in range(2):
        steps(run, 3)
        save_checkpoint(tmp_path, run, 1.0)
    older, newer = list_checkpoints(tmp_path)
    whole = newer.read_bytes()
    contents = {
        "truncated": whole[:-100],
        "empty": b"",
        "text": b"not a checkpoint",
        "header": whole[:40],
        "foreign": whole.replace(b'"format":"1"', b'"format":"0"'),
    }
    newer.write_bytes(contents[damage])
    fresh = trainer(capture, CONFIGS["adc"])
    with pytest.raises(CheckpointError, match=r"^\S*iteration_6.safetensors: [^\n]+$") as raised:
        load_checkpoint(newer, fresh)
    if damage != "foreign":
        assert "iteration_3.safetensors" in str(raised.value)
    load_checkpoint(older, fresh)
    assert fresh.iteration == 3


def test_a_checkpoint_of_another_kind_of_run_is_refused(capture, tmp_path):
    path = save_checkpoint(tmp_path, trainer(capture, CONFIGS["mcmc"]), 0.0)
    other = trainer(capture, dataclasses.replace(CONFIGS["adc"]))
    with pytest.raises(CheckpointError, match=r"iteration_0.safetensors: is damaged"):
        load_checkpoint(path, other)


def test_what_cannot_be_written_leaves_the_last_one_alone(capture, tmp_path):
    run = trainer(capture, CONFIGS["adc"])
    steps(run, 3)
    good = save_checkpoint(tmp_path, run, 0.0)
    before = good.read_bytes()
    steps(run, 3)
    (
        tmp_path / "iteration_6.safetensors"
    ).mkdir()  # nothing can be renamed onto a folder with something in it
    (tmp_path / "iteration_6.safetensors" / "x").touch()
    with pytest.raises(CheckpointError, match="earlier checkpoints are unharmed"):
        save_checkpoint(tmp_path, run, 0.0)
    assert good.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "iteration_3.safetensors",
        "iteration_6.safetensors",
    ]
