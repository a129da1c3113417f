"""A resumed run gives the same bits as an uninterrupted one; unusable checkpoints are reported."""

import dataclasses
import json

import pytest
import torch

from checkpoints import Maker, read, write
from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train.checkpoint import list_checkpoints, load_checkpoint, read_seconds, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.trainer import Trainer

COMMON = {"densify_start": 5, "densify_every": 10, "densify_stop": 60, "mcmc_stop": 60, "sh_every": 15}
CONFIGS = {
    "adc": recipe(64, reset_every=20, grad_threshold=5e-5, random_background=True, **COMMON),
    "mcmc": recipe(64, strategy="mcmc", max_gaussians=400, **COMMON),
    "with replacement": recipe(64, view_order="random", **COMMON),
}


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(32, 8)


def trainer(capture, config: TrainConfig) -> Trainer:
    views, points, colors = capture
    start = from_points(points, colors, config)
    return training(config, Views(views), load_backend("cpu"), Start(start, extent=2.0))


def steps(run: Trainer, count: int) -> None:
    end = run.iteration + count
    run.run(lambda: run.iteration >= end)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("at", [1, 20, 33])
def test_a_resumed_run_ends_with_the_same_bits(capture, tmp_path, name, at):
    """Iteration 33 is within an epoch, between densifications. Iteration 20 follows a densification and a reset."""
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
    assert len(whole.gaussians) != len(capture[1]), "densification changed the count"


def test_the_last_two_checkpoints_and_the_training_time_are_kept(capture, tmp_path):
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
def test_the_error_of_a_damaged_checkpoint_names_the_previous_one(capture, tmp_path, damage):
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


def test_a_failed_write_leaves_the_previous_checkpoint(capture, tmp_path):
    run = trainer(capture, CONFIGS["adc"])
    steps(run, 3)
    good = save_checkpoint(tmp_path, run, 0.0)
    before = good.read_bytes()
    steps(run, 3)
    (tmp_path / "iteration_6.safetensors").mkdir()  # no file can be renamed onto a folder
    (tmp_path / "iteration_6.safetensors" / "x").touch()
    with pytest.raises(CheckpointError, match="earlier checkpoints are unharmed"):
        save_checkpoint(tmp_path, run, 0.0)
    assert good.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "iteration_3.safetensors",
        "iteration_6.safetensors",
    ]


def half_moments(tensors, state):
    tensors |= {k: t.half() for k, t in tensors.items() if k.startswith(("first.", "second."))}


def double_gaussians(tensors, state):
    tensors |= {k: t.double() for k, t in tensors.items() if k.startswith("gaussians.")}


def generator_past_its_end(tensors, state):
    """Declare 500 numbers left from position 600 of 624, so that torch would read past its block."""
    words = tensors["density.generator"].numpy().view("<i4")
    words[2], words[4] = 500, 600


def put(tensors, **changes):
    tensors |= {name.replace("__", "."): value for name, value in changes.items()}


HOSTILE = {
    r"second\.means: is torch.float32 of shape \(0, 3\)": lambda t, s: put(
        t, second__means=torch.zeros(0, 3)
    ),
    r"first\.\w+: is torch.float16": half_moments,
    r"gaussians\.\w+: is torch.float64": double_gaussians,
    r"gaussians\.sh_rest: is .* shape \(40, 15, 3\)": lambda t, s: put(
        t, gaussians__sh_rest=torch.zeros(40, 15, 3)
    ),
    r"gaussians\.quats: is .* shape \(3, 4\)": lambda t, s: put(t, gaussians__quats=torch.zeros(3, 4)),
    "second.quats: holds negative": lambda t, s: t["second.quats"].sub_(1.0),
    "gaussians: means is missing": lambda t, s: t.pop("gaussians.means"),
    "first: 'colour' is unknown": lambda t, s: put(t, first__colour=torch.zeros(40)),
    "'secret.x': is unknown": lambda t, s: put(t, secret__x=torch.zeros(40)),
    "density.norm_sums: is": lambda t, s: put(t, density__norm_sums=torch.zeros(2)),
    "density.times_visible: holds negative": lambda t, s: t["density.times_visible"].sub_(9.0),
    "density.generator: is torch": lambda t, s: put(t, density__generator=torch.zeros(9, dtype=torch.uint8)),
    "density.generator: is not the state": generator_past_its_end,
    "density: is_over: has to be": lambda t, s: s["density"].update(is_over="yes"),
    "iteration: has to be": lambda t, s: s.update(iteration=65),
    "steps: has to be a whole": lambda t, s: s.update(steps=10**300),
    "steps: has to equal the iteration": lambda t, s: s.update(steps=2),
    "feed: queue: has to be a whole": lambda t, s: s["feed"].update(queue=[0, 3]),
    "feed: queue: contains": lambda t, s: s["feed"].update(queue=[1, 1]),
    "feed: generator: bit_generator": lambda t, s: s["feed"]["generator"].update(bit_generator="MT19937"),
    "feed: generator: state: inc": lambda t, s: s["feed"]["generator"]["state"].update(inc=2**128),
    "backgrounds: uinteger": lambda t, s: s["backgrounds"].update(uinteger=-1),
    "backgrounds: has to be an object": lambda t, s: s.update(backgrounds=[1]),
    "state: feed is missing": lambda t, s: s.pop("feed"),
    "state: is not JSON": lambda t, s: "[" * 100_000,
    "state: has to be an object": lambda t, s: "[]",
    "seconds: has to be": lambda t, s: {"seconds": "NaN"},
    "seconds: has to be a number": lambda t, s: {"seconds": "true"},
    "seconds: is missing": lambda t, s: {"seconds": None},
}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    make = Maker("adc")
    run = make()
    steps(run, 3)
    return make, read(save_checkpoint(tmp_path_factory.mktemp("tiny"), run, 1.0))


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("message", HOSTILE)
def test_a_hostile_checkpoint_changes_nothing(tiny, tmp_path, message):
    make, (tensors, metadata) = tiny
    assert len(tensors["gaussians.means"]) == 40
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    state = json.loads(metadata["state"])
    changed = HOSTILE[message](tensors, state)
    entries = changed if isinstance(changed, dict) and "seconds" in changed else {}
    entries = metadata | {"state": changed if isinstance(changed, str) else json.dumps(state)} | entries
    path = tmp_path / "iteration_3.safetensors"
    write(path, tensors, {key: value for key, value in entries.items() if value is not None})
    fresh = make()
    start, numbers = fresh.gaussians, json.dumps(fresh.state()[1])
    with pytest.raises(CheckpointError, match=rf"iteration_3.safetensors: is damaged \({message}") as raised:
        load_checkpoint(path, fresh)
    assert str(raised.value).isprintable()
    assert fresh.gaussians is start and json.dumps(fresh.state()[1]) == numbers
    steps(fresh, 1)


def test_a_checkpoint_with_nan_parameters_is_resumed(tiny, tmp_path):
    """Only a densification prunes Gaussians that are not finite, so checkpoints may contain them."""
    make, (tensors, metadata) = tiny
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    for name in ("gaussians.means", "first.means", "second.means"):
        tensors[name][3] = float("nan")
    path = tmp_path / "iteration_3.safetensors"
    write(path, tensors, metadata)
    resumed = make()
    load_checkpoint(path, resumed)
    steps(resumed, 1)
    assert resumed.iteration == 4


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_running_out_of_memory_is_not_reported_as_damage(tiny, tmp_path, monkeypatch, error):
    """A user would delete a damaged file, but this file is intact."""
    make, (tensors, metadata) = tiny
    path = tmp_path / "iteration_3.safetensors"
    write(path, tensors, metadata)

    def refuse(tensor, **options):
        raise error

    monkeypatch.setattr(torch.Tensor, "clone", refuse)
    with pytest.raises(type(error)) as raised:
        load_checkpoint(path, make())
    assert raised.value is error
