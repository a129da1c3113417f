"""Results are the same to the bit on any number of threads, and from run to run."""

import pytest
import torch

from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.initialize import random_ball
from native_scenes import random


def test_300_training_iterations_do_not_depend_on_threads(set_threads):
    """The runs include two densifications. They use 1, 2 and 5 threads."""
    views, config = sphere_capture(64).train, course_config(iterations=300, max_gaussians=800)
    runs = []
    for threads in (1, 2, 5):
        set_threads(threads)
        generator = torch.Generator().manual_seed(9)
        start = random_ball(400, generator)
        control = AdaptiveDensityControl(config, EXTENT, generator, start)
        trainer = training(
            config, Views(views), load_backend("cpu"), Start(start, extent=EXTENT), density=control
        )
        trainer.run()
        runs.append(trainer.gaussians.tensors())
    assert len(runs[0]["means"]) == 800
    for run in runs[1:]:
        for name, tensor in run.items():
            assert torch.equal(tensor, runs[0][name]), name


def test_a_render_of_many_blocks_does_not_depend_on_threads(set_threads):
    """12,000 Gaussians at 400 x 260 px are dozens of blocks to project, and a dozen chunks to sort into 425 tiles."""
    scene = random(12_000, (400, 260), seed=1)
    results = []
    for threads in (1, 2, 5):
        set_threads(threads)
        gaussians = scene.gaussians(torch.float32).trainable()
        out = render(gaussians, scene.camera, backend="cpu")
        (out.image.square().sum() + out.depth.sum()).backward()
        found = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
        results.append(found | {"image": out.image.detach(), "T": out.transmittance.detach()})
    for other in results[1:]:
        for name, tensor in results[0].items():
            assert torch.equal(tensor, other[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_gaussian_does_not_depend_on_its_neighbours(isa, dtype):
    """A Gaussian has the same bits alone and at any place among Gaussians that are not drawn."""
    scene = random(300, (48, 32), seed=2)
    one = scene.gaussians(dtype)
    outside = one.means + torch.tensor(scene.camera.R[0], dtype=dtype) * 1e4
    outside[::7] = float("nan")
    results = []
    for place in (None, 0, 1, 63, 64, 130, 255, 256, 299):
        rows = torch.arange(300) if place is not None else torch.tensor([5])
        tensors = {name: tensor[rows].clone() for name, tensor in one.tensors().items()}
        if place is not None:
            tensors["means"] = outside.clone()
            for name, tensor in one.tensors().items():
                tensors[name][place] = tensor[5]
        gaussians = Gaussians(**tensors).trainable()
        out = render(gaussians, scene.camera, backend="cpu")
        assert out.num_pairs > 0
        (out.image.square().sum() + out.depth.sum()).backward()
        row = 0 if place is None else place
        found = {name: tensor.grad[row] for name, tensor in gaussians.tensors().items()}
        results.append(found | {"image": out.image.detach()})
    for other in results[1:]:
        for name, tensor in results[0].items():
            assert torch.equal(tensor, other[name]), name
