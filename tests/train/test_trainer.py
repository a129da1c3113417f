import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, ShapeError
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.initialize import random_ball

RENDER, DENSE = functools.partial(render, backend="torch"), load_backend("torch")
SHORT = course_config(iterations=12, max_gaussians=80).changed(densify_stop=12, densify_every=4)


def fixed(iterations, **changes):
    """The course's configuration with a fixed number of Gaussians."""
    return course_config(iterations, **changes).changed(strategy="none")


@pytest.fixture(scope="module")
def views():
    return sphere_capture(24).train


def trainer(views, callbacks=()):
    generator = torch.Generator().manual_seed(9)
    start = random_ball(60, generator)
    control = AdaptiveDensityControl(SHORT, EXTENT, generator, start)
    return training(
        SHORT, Views(views), DENSE, Start(start, extent=EXTENT), callbacks=callbacks, density=control
    )


@pytest.fixture
def set_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("threads", [1, 2])
def test_two_runs_give_the_same_bits(set_threads, threads):
    """64 px and chunks of 16 splats are 65,536 numbers per operation, twice as many as torch needs to use threads."""
    set_threads(threads)
    views = sphere_capture(64).train
    runs = [trainer(views) for _ in range(2)]
    losses = [run.run().losses for run in runs]
    assert losses[0] == losses[1]
    assert len(runs[0].gaussians) > 60, "densification changed the count"
    for name, tensor in runs[0].gaussians.tensors().items():
        assert torch.equal(tensor, runs[1].gaussians.tensors()[name]), name


def test_callbacks_get_every_step_and_densification_in_order(views):
    received = []
    result = trainer(views, [lambda t, event: received.append((event, len(t.gaussians)))]).run()
    steps = [event for event, _ in received if isinstance(event, StepEvent)]
    changes = [(event, count) for event, count in received if isinstance(event, DensifyEvent)]
    assert [s.iteration for s in steps] == list(range(12))
    assert [s.loss for s in steps] == result.losses and [s.num_gaussians for s in steps] == result.counts
    assert [event.iteration for event, _ in changes] == [4, 8]
    assert all(event.num_gaussians == count for event, count in changes)
    assert result.counts[5] == changes[0][0].num_gaussians
    assert result.seconds > 0


def test_stop_is_asked_after_every_step_and_a_stopped_run_goes_on_with_the_same_bits(views):
    whole, stopped, asked = trainer(views), trainer(views), []

    def fifth():
        asked.append(stopped.iteration)
        return stopped.iteration == 5

    expected, first = whole.run().losses, stopped.run(stop=fifth)
    assert asked == [1, 2, 3, 4, 5] and stopped.iteration == 5
    assert first.losses == expected[:5] and len(first.counts) == 5
    rest = stopped.run(stop=lambda: False)
    assert stopped.iteration == SHORT.iterations and rest.losses == expected[5:]
    for name, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, stopped.gaussians.tensors()[name]), name
    assert stopped.run().losses == [], "the budget is spent"


def test_what_callbacks_saw_decides_when_a_run_ends(views):
    """The stop sees the loss of the step that has just been taken."""
    seen = []
    run = trainer(views, [lambda _, event: seen.append(event) if isinstance(event, StepEvent) else None])
    losses = run.run(stop=lambda: seen[-1].iteration >= 2 and seen[-1].loss < seen[0].loss).losses
    assert 3 <= len(losses) < SHORT.iterations and losses[-1] < losses[0]
    assert all(loss >= losses[0] for loss in losses[2:-1])


def test_the_start_is_not_modified(views):
    start = random_ball(20, torch.Generator().manual_seed(0))
    before = start.map(torch.clone)
    training(fixed(2), Views(views), DENSE, Start(start)).run()
    for name, tensor in start.tensors().items():
        assert torch.equal(tensor, before.tensors()[name])


def test_views_are_drawn_with_the_seed(views):
    seen = []

    def watching(gaussians, camera, settings, extra):
        seen.append(next(i for i, view in enumerate(views) if view.camera is camera))
        return DENSE.rasterize(gaussians, camera, settings, extra)

    watched = replace(DENSE, rasterize=watching)
    training(fixed(6, seed=3), Views(views), watched, Start(random_ball(10, torch.Generator()))).run()
    rng = np.random.default_rng(3)
    assert seen == [int(rng.integers(24)) for _ in range(6)]


def test_one_gaussian_fits_one_blob(views):
    """The loop fits a view of a single blob whose raw parameters are all off by 0.05. Adam's slowest rate, 1e-3,
    needs 50 steps for that. With a wrong gradient, or none, the loss would not fall tenfold in 150 steps.
    """
    camera = views[0].camera
    blob = Gaussians(
        means=torch.tensor([[0.1, -0.1, 0.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), -1.5),
        sh0=torch.full((1, 1, 3), 1.0),
        sh_rest=torch.zeros(1, 0, 3),
        logit_opacities=torch.zeros(1),
    )
    target = View(camera, RENDER(blob, camera).image.numpy())
    start = blob.map(lambda t: t + 0.05)
    result = training(fixed(150), Views([target]), DENSE, Start(start, extent=EXTENT)).run()
    assert result.losses[-1] < 0.1 * result.losses[0]


def test_a_scene_that_vanishes_does_not_stop_the_run(views):
    faint = random_ball(3, torch.Generator()).map(torch.clone)
    faint.logit_opacities.fill_(-9.0)
    config = course_config(iterations=4).changed(densify_stop=3, densify_every=1)
    control = AdaptiveDensityControl(config, EXTENT, torch.Generator(), faint)
    run = training(config, Views(views), DENSE, Start(faint, extent=1.0), density=control)
    assert run.run().counts == [3, 3, 0, 0]


def test_no_views_or_no_gaussians_are_refused(views):
    some = random_ball(3, torch.Generator())
    with pytest.raises(ArgumentError, match="^dataset: has no training views"):
        training(SHORT, Views([]), DENSE, Start(some))
    with pytest.raises(ArgumentError, match="^gaussians: "):
        training(SHORT, Views(views), DENSE, Start(random_ball(0, torch.Generator())))
    with pytest.raises(ArgumentError, match="^part: "):
        training(SHORT, Views(views), DENSE, Start(some), gradient=None)


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda: TrainConfig(iterations=0), "iterations"),
        (lambda: TrainConfig(seed=-1), "seed"),
        (lambda: TrainConfig(means_rate=-1.0), "means_rate"),
        (lambda: TrainConfig(densify_every=0), "densify_every"),
        (lambda: recipe(densify_start=50, densify_stop=49), "densify_stop"),
        (lambda: TrainConfig(strategy="best"), "strategy"),
        (lambda: TrainConfig(view_order="sorted"), "view_order"),
        (lambda: TrainConfig(background=(1.0, 1.0)), "background"),
        (lambda: recipe(0), "iterations"),
        (lambda: recipe(100, densify_end=5), "field"),
        (lambda: TrainConfig(iterations=2.0), "iterations"),
        (lambda: TrainConfig(max_gaussians=0), "max_gaussians"),
        (lambda: TrainConfig(min_opacity=2.0), "min_opacity"),
        (lambda: random_ball(-1, torch.Generator()), "count"),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_numbers_out_of_range_are_refused(make, names):
    with pytest.raises(ArgumentError, match=f"^{names}: "):
        make()


def test_a_photo_of_another_size_is_refused(views):
    with pytest.raises(ShapeError, match="^image: "):
        View(views[0].camera, np.zeros((24, 25, 3)))


def test_photos_are_uint8_or_floats_from_0_to_1(views):
    camera = views[0].camera
    photo = np.random.default_rng(0).integers(0, 256, (24, 24, 3), dtype=np.uint8)
    np.testing.assert_array_equal(View(camera, photo).image, photo)
    np.testing.assert_array_equal(View(camera, photo / 255).image, (photo / 255).astype(np.float32))
    for wrong in (photo.astype(float), photo / 255 - 1):
        with pytest.raises(ArgumentError, match="^image\\[.*uint8"):
            View(camera, wrong)


def test_random_ball_is_the_documented_start():
    gaussians = random_ball(5000, torch.Generator().manual_seed(0), torch.float64)
    radii = gaussians.means.norm(dim=-1)
    assert radii.max() <= 1
    # For a uniform density, the median radius is 0.5^(1/3) = 0.794, with a standard error below 0.006.
    assert abs(float(radii.median()) - 0.5 ** (1 / 3)) < 0.02
    torch.testing.assert_close(gaussians.scales, torch.full((5000, 3), 0.09, dtype=torch.float64))
    assert gaussians.sh_degree == 0
    assert abs(float(gaussians.sh0.std()) - 0.2) < 0.01
