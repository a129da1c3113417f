"""The chapter's run with its seeds reproduces the printed numbers up to the first densification. Other machines add
float32 numbers in another order. The tolerance of 2e-4 covers these roundings and the four printed digits; it is a
hundredth of the difference between the losses of two views. The count of the first densification is exact, because no
gradient norm is near the threshold of 2e-4: the nearest is 4.9e-7 away, a quarter of a per cent. The faintest
Gaussian has opacity 0.042, and only Gaussians below 0.005 are pruned.

The native kernels also stop a tile below 1e-4. Their tolerance is 1e-3, and their first densification is the same.
"""

import re

import pytest
import torch

from gsplat_edu.base.threads import one_thread
from gsplat_edu.cli.main import main
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.ops.losses import l1
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.events import DensifyEvent
from gsplat_edu.train.initialize import random_ball

pytestmark = pytest.mark.slow

CHAPTER = {0: 0.2492, 20: 0.1827, 40: 0.1315, 60: 0.1152, 80: 0.1181, 100: 0.1346}
TOLERANCE = {"torch": 2e-4, "cpu": 1e-3}


@pytest.mark.parametrize(
    ("backend", "iterations"),
    [("torch", 1), ("cpu", 101), pytest.param("torch", 101, marks=pytest.mark.soak)],
    ids=["torch", "cpu", "torch, whole"],
)
def test_the_first_iterations_give_the_numbers_of_the_chapter(backend, iterations):
    """The dense backend takes a second per iteration, so only `make soak` runs more than one."""
    capture = sphere_capture(128)
    config = course_config(iterations=iterations)
    generator = torch.Generator().manual_seed(9)
    start = random_ball(400, generator)
    densified = []
    trainer = training(
        config,
        Views(capture.train),
        load_backend(backend),
        Start(start, extent=EXTENT),
        density=AdaptiveDensityControl(config, EXTENT, generator, start),
        callbacks=[lambda _, event: densified.append(event) if isinstance(event, DensifyEvent) else None],
    )
    with torch.no_grad():
        held_out = render(trainer.gaussians, capture.held_out.camera, backend=backend).image
    assert float(l1(held_out, torch.tensor(capture.held_out.image))) == pytest.approx(
        0.2360, abs=TOLERANCE[backend]
    )

    with one_thread():  # torch's threads wait minutes for one another on a busy machine
        losses = trainer.run().losses
    expected = {i: loss for i, loss in CHAPTER.items() if i < iterations}
    assert {i: losses[i] for i in expected} == pytest.approx(expected, abs=TOLERANCE[backend])
    if iterations <= 100:
        return
    assert densified == [
        DensifyEvent(100, num_cloned=0, num_split_children=568, num_pruned=0, num_gaussians=684)
    ]
    assert len(trainer.gaussians) == 684


def test_the_whole_run_on_the_kernels(tmp_path, capsys):
    """800 iterations end at 1,600 Gaussians and a held-out L1 of at most 0.0100.

    Five seeds gave 0.0078 to 0.0090, mean 0.0084, standard deviation 0.0004 (benchmarks/RESULTS.md). The chapter's
    seed gave 0.0090. The limit of 0.0100 is more than three standard deviations above the mean.
    """
    assert main(["demo", "--backend", "cpu", "--out", str(tmp_path / "x.png")]) == 0
    printed = capsys.readouterr().out
    assert "K~1600" in printed and "800 iters" in printed
    before, after = re.search(r"held-out L1: init (0\.\d{4}) -> final (0\.\d{4})", printed).groups()
    assert float(before) == pytest.approx(0.2360, abs=2e-4)
    assert float(after) <= 0.0100
