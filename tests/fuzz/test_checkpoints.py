"""Damaged checkpoints end in a one-line error or in a training that continues. They also run on the build with
sanitizers (tools/sanitize.sh), so one step follows every loaded checkpoint.
"""

import json

import numpy as np
import pytest

import tiers
from checkpoints import Maker, mutate, step
from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.train.checkpoint import load_checkpoint, read_seconds, save_checkpoint

pytestmark = pytest.mark.fuzz

MUTATIONS = tiers.count("GSPLAT_EDU_FUZZ_CHECKPOINTS", 50, 2_000)
"""Damaged checkpoints per strategy."""

SEEDS = range(tiers.SEED, tiers.SEED + MUTATIONS)


def snapshot(trainer):
    """Return the whole state of a trainer for comparison: tensors by identity, numbers by value."""
    tensors, numbers = trainer.state()
    kept = {key: tensor.data_ptr() for key, tensor in tensors.items() if key != "density.generator"}
    drawn = tensors.get("density.generator")  # fast has no random state
    state = None if drawn is None else drawn.tolist()
    return kept, state, json.dumps(numbers), id(trainer.gaussians)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("strategy", ["adc", "mcmc", "fast"])
def test_damaged_checkpoints(tmp_path, strategy):
    make = Maker(strategy)
    trainer = make()
    step(trainer, 3)
    data = save_checkpoint(tmp_path / "whole", trainer, 1.5).read_bytes()
    path = tmp_path / "iteration_3.safetensors"
    fresh, loaded = make(), 0
    before = snapshot(fresh)
    for seed in SEEDS:
        mutate(data, path, np.random.default_rng(seed))
        try:
            load_checkpoint(path, fresh)
            read_seconds(path)
        except CheckpointError as error:
            message = str(error)
            assert str(path) in message and message.isprintable() and len(message) < 600, seed
            assert snapshot(fresh) == before, seed
        else:
            loaded += 1
            if fresh.iteration < fresh.config.iterations:
                step(fresh)
            fresh = make()
            before = snapshot(fresh)
    assert 0 < loaded < MUTATIONS
