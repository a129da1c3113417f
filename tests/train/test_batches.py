import functools
import math

import numpy as np
import pytest
import torch

import checkpoints
from gsplat_edu import ArgumentError
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.metrics import score_views
from gsplat_edu.parts.transients.search import Transients
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.views import View
from gsplat_edu.train.batches import PartialSums
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.events import DensifyEvent, RelocateEvent, ResetEvent, StepEvent
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.objective import Objective, PhotoTerm
from gsplat_edu.train.optimizer import Adam, ParameterGroup
from gsplat_edu.train.schedule import milestone
from gsplat_edu.train.step import mean_over_views
from gsplat_edu.train.team import ALONE
from ranks import together

SCHEDULE = {"densify_start": 3, "densify_every": 10, "sh_every": 20, "random_background": True}
CONFIGS = {
    "adc": {"densify_stop": 70, "reset_every": 30, "grad_threshold": 1e-5},
    "mcmc": {"strategy": "mcmc", "max_gaussians": 700, "mcmc_stop": 70, "min_opacity": 0.05},
    "fast": {"strategy": "fast", "max_gaussians": 700},
}
ITERATIONS = 48


def config(name="adc", batch=4, **changes):
    return recipe(ITERATIONS, batch=batch, **{**SCHEDULE, **CONFIGS[name], **changes})


def trainer(settings, team=ALONE, splats=900, callbacks=(), stored=lambda view: view, **parts):
    """Make a training of a procedural capture whose 600 Gaussians fill two pages and a part of a third."""
    views, points, colors = procedural_capture(24, 6, splats=splats)
    start = from_points(points, colors, settings)
    return training(
        settings,
        Views([stored(view) for view in views]),
        load_backend("cpu"),
        Start(start, extent=2.0),
        callbacks=callbacks,
        team=team,
        **parts,
    )


def bits(run):
    """Return the whole state as comparable values; all ranks have to call this together."""
    tensors, numbers = run.state()
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, numbers


def trained(settings, team=ALONE, **parts):
    run = trainer(settings, team, **parts)
    losses = run.run().losses
    return losses, bits(run)


def contents_of(path):
    """Return the contents of a checkpoint, because safetensors writes the header's entries in a random order."""
    tensors, metadata = checkpoints.read(path)
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, metadata


@pytest.mark.parametrize("count", [1, 2, 3, 6, 8, 12, 16, 17])
def test_partial_sums_of_any_ranges_have_the_bits_of_the_whole_sum(count):
    """The numbers have very different sizes, so that another order of the sum gives other bits."""
    rng = np.random.default_rng(count)
    values = torch.from_numpy(rng.normal(size=(count, 64)) * 10.0 ** rng.integers(-6, 6, (count, 64))).float()

    def sums(places):
        found = PartialSums(count)
        most = 0
        for place in places:
            found.add((0, place), {"a": values[place].clone()})
            most = max(most, len(found.nodes))
        assert most <= math.log2(count) + 1 if places == range(count) else True
        return found

    whole = sums(range(count)).total["a"]
    assert torch.allclose(
        whole.double(), values.double().sum(dim=0), rtol=0, atol=float(values.abs().sum()) * 1e-6
    )
    for parts in [n for n in range(1, count + 1) if count % n == 0]:
        completed = PartialSums(count)
        for rank in range(parts):
            for node, value in sums(range(rank * count // parts, (rank + 1) * count // parts)).nodes.items():
                completed.add(node, value)
        assert torch.equal(completed.total["a"], whole), parts


def test_a_sum_with_missing_terms_is_refused():
    found = PartialSums(3)
    found.add((0, 1), {})
    with pytest.raises(ArgumentError, match="^batch: places of its 3 views are missing"):
        _ = found.total


def test_the_gradient_of_a_batch_is_the_mean_over_its_views():
    """In float64, a sum of four rounds three times by at most 2^-53 of the sum of magnitudes, and the mean is exact."""
    settings = config(random_background=False, densify_start=40)
    views, points, colors = procedural_capture(24, 6, splats=60)
    start = from_points(points, colors, settings).map(torch.Tensor.double)
    objective = Objective({"photo": PhotoTerm(0.2)})
    views = [View(view.camera, view.read().image.astype(np.float32) / 255) for view in views]

    def make():
        config = settings.changed(strategy="none")
        return training(
            config, Views(views), load_backend("cpu"), Start(start, extent=1.0), objective=objective
        )

    single, alone = [], make()
    for view in alone.step_views():
        terms = alone.stepper.gradients([view], 0)
        single.append(
            {name: tensor.grad for name, tensor in alone.stepper.parameters().items()}
            | {"loss": terms["photo"]}
        )
        for tensor in alone.stepper.parameters().values():
            tensor.grad = None
    batch = make()
    loss = batch.stepper.gradients(list(batch.step_views()), 0)["photo"]
    mean_over_views(batch.stepper.parameters(), 4)
    for name, tensor in batch.stepper.parameters().items():
        parts = torch.stack([view[name] for view in single])
        bound = 3 * 2.0**-53 * parts.abs().sum(dim=0) / 4
        assert bool((parts.sum(dim=0) != 0).any()) or name == "sh_rest"
        assert bool(((tensor.grad - parts.sum(dim=0) / 4).abs() <= 2 * bound).all()), name
    assert float(loss) == pytest.approx(float(sum(view["loss"] for view in single)) / 4, rel=1e-12)


def test_adam_follows_the_rule_for_batches():
    """The test computes the rule of Zhao et al. 2024 in float64: rate sqrt(B), eps / sqrt(B), b^B."""
    p, g, B, rate, eps, b1, b2 = 1.0, 0.3, 4, 0.01, 1e-3, 0.9, 0.999
    tensors = {"p": torch.tensor([p], dtype=torch.float64, requires_grad=True)}
    adam = Adam(tensors, {"p": ParameterGroup(rate, eps, (b1, b2))})
    m = v = 0.0
    for step in range(1, 4):
        adam.schedule(0, B)
        tensors["p"].grad = torch.tensor([g], dtype=torch.float64)
        adam.step(tensors)
        m, v = b1**B * m + (1 - b1**B) * g, b2**B * v + (1 - b2**B) * g * g
        t = B * step
        p -= rate * 2 * (m / (1 - b1**t)) / (math.sqrt(v / (1 - b2**t)) + eps / 2)
        assert float(tensors["p"].detach()) == pytest.approx(p, rel=1e-12)
    assert adam.steps == 12


def test_milestones_count_images():
    assert [milestone(i, 10, 1) for i in (0, 9, 10, 11)] == [0, None, 10, None]
    assert [milestone(i, 10, 4) for i in (3, 7, 11, 15, 19, 23)] == [0, None, 10, None, None, 20]
    assert milestone(7, 3, 8) == 6


@pytest.mark.parametrize("batch", [1, 3, 4])
def test_the_number_of_densifications_per_image_does_not_depend_on_the_batch(batch):
    changes = []
    watch = [lambda _, event: changes.append(event)]
    run = trainer(config("adc", batch), callbacks=watch)
    run.run()
    due = [10, 20, 30, 40]
    densified = [event.iteration for event in changes if isinstance(event, DensifyEvent)]
    assert densified == [i // batch * batch + batch - 1 for i in due]
    resets = [event.iteration for event in changes if isinstance(event, ResetEvent)]
    assert resets == [30 // batch * batch + batch - 1]
    steps = [event.iteration + 1 for event in changes if isinstance(event, StepEvent)]
    assert steps == list(range(batch, ITERATIONS + 1, batch)) and run.iteration == ITERATIONS


@pytest.mark.parametrize("strategy", ["mcmc", "fast"])
def test_the_other_strategies_count_images_too(strategy):
    changes = []
    run = trainer(config(strategy), callbacks=[lambda _, event: changes.append(event)])
    run.run()
    kind = RelocateEvent if strategy == "mcmc" else DensifyEvent
    assert [event.iteration for event in changes if isinstance(event, kind)] == [11, 23, 31, 43]
    assert len(run.gaussians) > changes[0].num_gaussians


def test_masks_of_things_that_move_are_found_before_the_step_that_has_their_image():
    views, _, _ = procedural_capture(24, 6, splats=30)
    found = Transients(views, 20, render)
    due = [first for first in range(0, 24, 4) if found.is_due(first, 4)]
    assert due == [0, 4, 8]  # images 2, 4, 7 and 10
    assert [i for i in range(24) if found.is_due(i)] == [2, 4, 7, 10]


MODELS = {"appearance": "exposure", "refine": "both", "random_background": False}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "batch", "changes", "sizes"),
    [("adc", 6, {}, (2, 3)), ("mcmc", 4, MODELS, (4,)), ("fast", 4, {}, (2,)), ("fast", 4, MODELS, (4,))],
    ids=["sixes", "models", "fast", "fast with models"],
)
def test_ranks_train_to_the_same_bits(name, batch, changes, sizes):
    """The number of Gaussians changes, and with it the range of each rank."""
    settings = config(name, batch, **changes)
    losses, expected = trained(settings)
    for size in sizes:
        for found_losses, found in together(size, lambda team: trained(settings, team)):
            assert found_losses == losses
            assert found == expected


def test_the_number_of_threads_does_not_change_a_batch():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        _, expected = trained(config())
        torch.set_num_threads(5)
        assert trained(config())[1] == expected
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_a_run_is_resumed_by_another_number_of_ranks(tmp_path):
    settings = config("adc", appearance="exposure", random_background=False)
    _, expected = trained(settings)

    def first(team):
        run = trainer(settings, team)
        run.run(lambda: run.iteration >= 24)
        save_checkpoint(tmp_path / str(team.rank), run, 1.0)

    together(4, first)
    paths = [tmp_path / str(rank) / "iteration_24.safetensors" for rank in range(4)]
    contents = [contents_of(path) for path in paths]
    alone = trainer(settings)
    alone.run(lambda: alone.iteration >= 24)
    assert contents == 4 * [contents_of(save_checkpoint(tmp_path / "alone", alone, 1.0))]

    def second(team):
        run = trainer(settings, team)
        load_checkpoint(paths[0], run)
        run.run()
        return bits(run)

    assert together(2, second) == [expected] * 2
    assert second(ALONE) == expected


def test_moments_are_divided_among_ranks():
    def held(team):
        run = trainer(config(), team)
        return len(run.stepper.optimizer.first["means"]), len(run.stepper.optimizer.first["sh_rest"])

    assert together(2, held) == [(256, 256), (344, 344)]


def test_views_of_a_batch_do_not_see_each_others_measurements():
    settings = config("adc", appearance="exposure", random_background=False)
    run = trainer(settings)
    views = list(run.step_views())
    rows = run.view_model.parameters()["exposures"]
    before, measure = rows.clone(), run.view_model.measure

    def watching(*arguments):
        assert torch.equal(rows, before), "no view uses a measurement of another view of its batch"
        return measure(*arguments)

    run.view_model.measure = watching
    run.stepper.gradients(views, 4)  # after the warm-up
    drawn = [view.draw.index for view in views]
    assert len(set(drawn)) == 4
    assert all((rows[i] != before[i]).any() == (i in drawn) for i in range(6))


def test_after_an_unreadable_photo_all_views_of_the_batch_are_drawn_again():
    reads = []

    def stored(view):
        def read():
            reads.append(view.name)
            if len(reads) == 3:
                raise DatasetError("photo: is gone")
            return view.read()

        return View.stored(view.camera, read, view.name)

    run = trainer(config(), stored=stored)
    before = run.state()[1]["feed"]
    with pytest.raises(DatasetError):
        run.run()
    assert run.state()[1]["feed"]["generator"] == before["generator"] or before["queue"] == []
    assert run.iteration == 0
    run.run()
    assert bits(run) == trained(config())[1]


@pytest.mark.usefixtures("as_shipped")
def test_options_that_contradict_a_batch_are_refused():
    with pytest.raises(ArgumentError, match="^iterations: is 10, but .* of batch = 4, for example 12"):
        recipe(10, batch=4)
    with pytest.raises(ArgumentError, match="^batch: "):
        recipe(10, batch=0)
    with pytest.raises(ArgumentError, match="^batch: is 4, but has to be a multiple of the 3 processes"):
        together(3, lambda team: trainer(config(), team))


@pytest.mark.slow
def test_batches_learn_as_well_from_as_many_images():
    """Batches of 1, 2 and 4 gave 29.5, 29.3 and 29.3 dB; with unscaled rates 29.5, 28.5 and 27.3 dB."""
    views, points, colors = procedural_capture(24, 9, splats=300)
    found = {}
    for batch in (1, 2, 4):
        settings = recipe(400, batch=batch, strategy="fast", max_gaussians=300, fast_start_factor=1.0)
        start = from_points(points, colors, settings)
        run = training(settings, Views(views[1:]), load_backend("cpu"), Start(start, extent=2.0))
        run.run()
        (score,) = score_views(
            run.gaussians, views[:1], functools.partial(render, settings=RenderSettings()), (0.0,) * 3
        )
        found[batch] = score.psnr
    assert found[1] > 28 and min(found.values()) > found[1] - 0.8, found
