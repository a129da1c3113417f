"""A run with all remedies has the same bits after resuming from a checkpoint, on any number of threads."""

import json

import numpy as np
import pytest
import torch

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.options import train as command
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.parts.poses.refinement import LENSES, TWISTS
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.views import View
from gsplat_edu.train.events import StepEvent
from lab.captures.outdoors import outdoor_capture
from passers_by import pasted

pytestmark = pytest.mark.slow

EVERYTHING = ("--refine", "both", "--appearance", "exposure", "--transients", "mask", "--sky", "shell")
EVERYTHING += ("--outside-masks", "empty", "--random-background")

ITERATIONS = 60
"""Masks of transients are found before the 7th, 13th, 22nd and 31st step; cameras move from the 4th step on."""

LEARNED = (TWISTS, LENSES, "exposures")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photos of 64 x 48 px under a sky, with pasted objects, and masks that exclude a corner."""
    made = outdoor_capture(64, 48, 16, points=500)
    struck, _ = pasted(made.views)
    mask = np.ones((48, 64), dtype=bool)
    mask[36:, :12] = False
    views = [View(view.camera, view.image, mask=mask, name=view.name) for view in struck]
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, views, made.points, made.colors)
    return folder


def opened(capture, folder, *more):
    words = [
        "--iterations",
        str(ITERATIONS),
        "--max-gaussians",
        "900",
        "--sh-degree",
        "1",
        "--eval-every",
        "0",
    ]
    words += ["--save-every", "0", *EVERYTHING, "--out", str(folder), *more]
    parser = OneLineParser(prog="train")
    command.add_arguments(parser)
    options = command.options_from(parser.parse_args([str(capture), *words]))
    return CaptureRun(plan(options, Limits()).options)


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """The state of an uninterrupted run with all remedies, on one thread."""
    run, outside = opened(capture, tmp_path_factory.mktemp("whole") / "run"), []

    def watch(_trainer, event):
        if isinstance(event, StepEvent):
            outside.append(float(event.terms["outside"]))

    assert run.trainer.stepper.parts.shell.holds(run.trainer.gaussians.means).sum() > 10
    run.train(callbacks=[watch])
    tensors, numbers = run.trainer.state()
    assert max(outside) > 0 and tensors["transients.masks"].any()
    for name in LEARNED:
        assert tensors[f"view_model.{name}"].abs().max() > 0, name
    return tensors, numbers


def interrupt(capture, folder, at):
    """Train to an iteration and keep only the folder, as after a kill."""
    run = opened(capture, folder)
    assert run.train(lambda: run.trainer.iteration >= at)
    assert run.trainer.state()[0]["transients.masks"].any(), "the checkpoint has masks"


@pytest.mark.parametrize("at", [12, 13], ids=["before masks are found anew", "after"])
def test_the_bits_are_those_of_a_run_without_interruption(capture, whole, tmp_path, at):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(5)
        interrupt(capture, tmp_path / "run", at)
        torch.set_num_threads(2)
        second = opened(capture, tmp_path / "run", "--resume")
        assert second.trainer.iteration == at
        second.train()
    finally:
        torch.set_num_threads(before)
    (tensors, numbers), (resumed, others) = whole, second.trainer.state()
    assert json.dumps(numbers) == json.dumps(others)
    assert tensors.keys() == resumed.keys()
    for name, tensor in tensors.items():
        assert torch.equal(tensor, resumed[name]), name
