"""A backend may have its own stepper, which keeps a run on its device and reads back only on request."""

from dataclasses import replace

import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.stepper import Stepper, TensorStepper

CPU = load_backend("cpu")


class Resident(TensorStepper):
    """Keeps its Gaussians separate, as on a device, and counts how often they are read back."""

    def __init__(self, *arguments):
        self.reads, self._inside = 0, True
        super().__init__(*arguments)
        self._inside = False

    @property
    def gaussians(self):
        if not self._inside:
            self.reads += 1
        return self._held

    @gaussians.setter
    def gaussians(self, value):
        self._held = value

    @property
    def count(self):
        return len(self._held)

    def step(self, views, iteration):
        self._inside = True
        terms = super().step(views, iteration)
        self._inside = False
        return terms

    def change(self, iteration):
        self._inside = True
        events = super().change(iteration)
        self._inside = False
        return events


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(24, 6, splats=80)


@pytest.mark.parametrize(
    "changes",
    [
        {"strategy": "adc", "densify_start": 3, "densify_every": 5, "grad_threshold": 5e-5},
        {"strategy": "mcmc", "max_gaussians": 120, "densify_start": 3, "densify_every": 5},
        {"strategy": "fast", "max_gaussians": 120, "appearance": "exposure"},
    ],
    ids=["adc", "mcmc", "fast"],
)
def test_a_stepper_of_the_backend_trains_to_the_same_bits_without_reading_back(capture, changes):
    views, points, colors = capture
    config = recipe(30, **changes)
    start = Start(sorted_in_space(from_points(points, colors, config)), extent=2.0)
    plain = training(config, Views(views), CPU, start)
    resident = training(config, Views(views), replace(CPU, stepper=Resident), start)
    stepper = resident.stepper
    assert plain.run().losses == resident.run().losses
    assert stepper.reads == 1, "read once for the dtype of the losses, and never in 30 steps"
    assert isinstance(stepper, Resident) and isinstance(stepper, Stepper)
    for name, tensor in plain.gaussians.tensors().items():
        assert torch.equal(tensor, resident.gaussians.tensors()[name]), name
