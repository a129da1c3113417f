"""Training on the backend cuda is deterministic, follows the native backend, and can resume on another backend."""

import pytest
import torch

from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.trainer import Trainer

ITERATIONS = 4


@pytest.fixture(scope="module")
def views():
    return sphere_capture(24).train


def trainer(views, backend, device, config: TrainConfig | None = None) -> Trainer:
    config = config or course_config(iterations=ITERATIONS, max_gaussians=80)
    start = random_ball(40, torch.Generator().manual_seed(9)).to(torch.device(device))
    return training(config, Views(views), load_backend(backend), Start(start, extent=EXTENT))


def tensors(run):
    return {name: tensor.detach().cpu() for name, tensor in run.gaussians.tensors().items()}


@pytest.fixture(scope="module")
def trained(views, device):
    """Train on the backend cuda; return the run and its losses."""
    run = trainer(views, "cuda", device)
    return run, run.run().losses


@pytest.mark.slow
def test_a_training_is_reproducible(views, device, trained):
    run, losses = trained
    again = trainer(views, "cuda", device)
    assert again.run().losses == losses
    for name, tensor in tensors(again).items():
        assert torch.equal(tensor, tensors(run)[name]), name


def test_a_training_follows_the_native_backend(views, trained):
    """Gradients agree to 3e-4 (test_render.py), and Adam divides by their size. So a step differs by at most one rate
    where a gradient is pure rounding, and by 3e-4 of it elsewhere. After 4 steps at rates up to 5e-2, few parameters
    differ by more than 1 % of the distance they could have moved, and the loss differs by far less.
    """
    (ours, losses), native = trained, trainer(views, "cpu", "cpu")
    assert losses == pytest.approx(native.run().losses, rel=1e-3)
    rates = native.config.learning_rates
    start = random_ball(40, torch.Generator().manual_seed(9)).tensors()
    for name, expected in tensors(native).items():
        if not expected.numel():
            continue
        reach = ITERATIONS * rates[name] * (EXTENT if name == "means" else 1.0)
        difference = (tensors(ours)[name] - expected).abs()
        assert float(difference.median()) < 1e-3 * reach, name
        assert float((difference > 0.01 * reach).float().mean()) < 0.05, name
        assert float((expected - start[name]).abs().max()) > 0.1 * reach, "training moved the parameters"


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_checkpoints_resume_on_either_backend(views, device, tmp_path, strategy):
    config = TrainConfig().changed(
        iterations=8,
        strategy=strategy,
        max_gaussians=60,
        densify_start=1,
        densify_stop=7,
        mcmc_stop=7,
        densify_every=2,
        reset_every=5,
        ssim_weight=0.2,
        grad_threshold=1e-5,
        sh_degree=0,
    )
    first = trainer(views, "cuda", device, config)
    first.run(lambda: first.iteration >= 4)
    path = save_checkpoint(tmp_path, first, 1.0)
    for backend, where in (("cuda", device), ("cpu", "cpu")):
        second = trainer(views, backend, where, config)
        load_checkpoint(path, second)
        result = second.run()
        assert second.iteration == 8 and len(result.losses) == 4
        assert 40 < len(second.gaussians) <= 60
        assert second.gaussians.means.device.type == where
        if backend == "cuda":
            first.run()
            for name, tensor in tensors(first).items():
                assert torch.equal(tensor, tensors(second)[name]), name
