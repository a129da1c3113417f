"""`training` honours every field of a configuration, or refuses it; it ignores none."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.parts.exposure.model import Exposure
from gsplat_edu.parts.poses.refinement import LENSES, TWISTS, Refinement, refinement_of
from gsplat_edu.render.backend import FEATURES
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.density.fast import PlannedDensity
from gsplat_edu.train.density.mcmc import MCMC
from gsplat_edu.train.far import Shell
from gsplat_edu.train.initialize import random_ball

CPU = load_backend("cpu")


class Capture:
    """A dataset in memory: eight views of 24 px and 60 points."""

    def __init__(self):
        views, self.points, self.colors = procedural_capture(24, 8, splats=60)
        self.train = tuple(views)


@pytest.fixture(scope="module")
def capture():
    return Capture()


@pytest.mark.parametrize(
    ("strategy", "kind"),
    [("adc", AdaptiveDensityControl), ("mcmc", MCMC), ("fast", PlannedDensity), ("none", type(None))],
)
def test_the_strategy_is_made(capture, strategy, kind):
    cap = {"max_gaussians": 80} if strategy == "mcmc" else {}
    assert type(training(recipe(4, strategy=strategy, **cap), capture, CPU).density) is kind


def test_fast_without_a_cap_plans_one_and_densifies(capture):
    views = list(sphere_capture(64).train)
    planned = training(
        recipe(4, strategy="fast"), Views(views), CPU, Start(random_ball(40, torch.Generator()))
    )
    assert planned.config.max_gaussians == planned_gaussians(64 * 64, len(views))
    run = training(recipe(60, strategy="fast", densify_every=5, densify_start=5), capture, CPU)
    run.run()
    assert len(run.gaussians) > len(capture.points)


def test_mcmc_without_a_cap_is_refused(capture):
    with pytest.raises(ArgumentError, match="^max_gaussians: mcmc"):
        training(recipe(4, strategy="mcmc"), capture, CPU)


@pytest.mark.parametrize(
    ("refine", "names"), [("poses", {TWISTS}), ("intrinsics", {LENSES}), ("both", {TWISTS, LENSES})]
)
def test_refine_is_made_and_learned(capture, refine, names):
    run = training(recipe(12, strategy="none", refine=refine), capture, CPU)
    assert isinstance(refinement_of(run.view_model), Refinement)
    run.run()
    for name in names:
        assert run.view_model.parameters()[name].abs().max() > 0, name


@pytest.mark.parametrize("appearance", ["exposure", "vignetting"])
def test_appearance_is_made_and_measured(capture, appearance):
    run = training(recipe(12, strategy="none", appearance=appearance), capture, CPU)
    assert isinstance(run.view_model, Exposure)
    run.run()
    (state,) = run.view_model.parameters().values()
    assert state.shape == (8, 4 if appearance == "exposure" else 5) and state[:, -1].sum() > 0


def test_refine_and_appearance_together(capture):
    run = training(recipe(12, strategy="none", refine="both", appearance="exposure"), capture, CPU)
    assert set(run.view_model.parameters()) == {TWISTS, LENSES, "exposures"}
    assert refinement_of(run.view_model) is not None
    run.run()


def test_transients_are_found(capture):
    run = training(recipe(20, strategy="none", transients="mask"), capture, CPU)
    assert "transients" in run.maskers
    found = []
    run.maskers["transients"].find = lambda *arguments: found.append(run.iteration)
    run.run()
    assert found == [2, 4, 7, 10]
    few = Views(capture.train[:3])
    with pytest.raises(ArgumentError, match="3 training photos are too few"):
        training(
            recipe(4, strategy="none", transients="mask"), few, CPU, Start(random_ball(5, torch.Generator()))
        )


def test_outside_masks_is_a_term_of_the_objective(capture):
    views = []
    for view in capture.train:
        image = view.read().image
        mask = np.zeros(image.shape[:2], dtype=bool)
        mask[6:18, 6:18] = True
        views.append(View(view.camera, image, mask=mask, name=view.name))
    masked = Capture()
    masked.train = tuple(views)
    terms = []
    for outside in ("ignore", "empty"):
        run = training(recipe(1, strategy="none", outside_masks=outside), masked, CPU)
        run.run(callbacks=[lambda _, event: terms.append(set(event.terms))])
    assert terms == [{"photo"}, {"photo", "outside"}]


def test_a_sky_needs_its_splats(capture):
    config = recipe(4, strategy="mcmc", max_gaussians=80, sky="shell")
    with pytest.raises(ArgumentError, match="^sky: is 'shell', but start has no shell"):
        training(config, capture, CPU)
    shell = Shell(np.zeros(3), 50.0)
    start = Start(random_ball(30, torch.Generator()), shell)
    run = training(config, capture, CPU, start)
    assert run.stepper.parts.objective.terms["scale"].shell is shell and run.density.shell is shell


def test_the_extent_and_generator_of_a_start_are_used(capture):
    generator = torch.Generator().manual_seed(7)
    run = training(
        recipe(4), capture, CPU, Start(random_ball(30, generator), extent=7.0, generator=generator)
    )
    assert run.extent == 7.0 and run.density.generator is generator
    rates = run.stepper.optimizer.groups["means"].rate_at(0)
    assert rates == pytest.approx(7.0 * run.config.means_rate)


def test_every_kernel_of_the_backend_is_used(capture):
    """The kernels count their calls; a training with exposures and noise calls each kernel."""
    calls = dict.fromkeys(("rasterize", "loss", "adam", "add_noise", "recolored"), 0)

    def counted(name):
        kernel = getattr(CPU, name)

        def call(*arguments, **options):
            calls[name] += 1
            return kernel(*arguments, **options)

        return call

    backend = replace(CPU, **{name: counted(name) for name in calls})
    config = recipe(6, strategy="mcmc", max_gaussians=80, appearance="exposure")
    training(config, capture, backend, fused=False).run()
    assert calls["rasterize"] == calls["loss"] == calls["add_noise"] == calls["recolored"] == 6
    assert calls["adam"] == 6 * 6, "Adam steps each raw parameter in each step"


@pytest.mark.parametrize("feature", FEATURES)
def test_features_that_a_backend_lacks_are_refused_by_name(feature):
    lacking = replace(CPU, name="toy", lacks=frozenset({feature}))
    with pytest.raises(
        ArgumentError, match=f"^{feature}: 3 needs a backend that .* toy does not; use the backend cpu"
    ):
        lacking.require(feature, f"{feature}: 3")
    CPU.require(feature, "anything")


def test_the_backends_give_the_same_training(capture):
    """Native and dense kernels take the same two steps. Adam divides a gradient by its size, so where a gradient is
    only rounding, a step differs by up to a rate. The loss depends on all Gaussians and differs by far less than the
    bound of 1e-4.
    """
    config = recipe(2, strategy="mcmc", max_gaussians=80, appearance="exposure", sh_degree=1)
    losses = [training(config, capture, load_backend(name)).run().losses for name in ("cpu", "torch")]
    assert losses[0] == pytest.approx(losses[1], abs=1e-4)
