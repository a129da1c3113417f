"""Adam in the backward pass, where the trainer chooses it, gives the bits of gradients followed by Adam."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch

from gains import Gains
from gsplat_edu import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.objective import MeanOpacity, MeanScale, Objective, PhotoTerm
from gsplat_edu.train.rendered import Needs

SCHEDULE = {"densify_start": 2, "densify_every": 6, "sh_every": 7, "grad_threshold": 5e-5}
CASES = {
    "adc": recipe(20, **SCHEDULE),
    "adc, reset, random backgrounds": recipe(20, random_background=True, reset_every=8, **SCHEDULE),
    "mcmc": recipe(20, strategy="mcmc", max_gaussians=80, mcmc_growth=1.1, min_opacity=0.4, **SCHEDULE),
    "none, antialiased": recipe(10, strategy="none", antialiased=True, sh_every=2),
    "none, degree 1": recipe(10, strategy="none", sh_degree=1, sh_every=3),
    "none, degree 0": recipe(10, strategy="none", sh_degree=0),
}


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(24, 4, splats=60)


class Deferrals:
    """Wraps a backend and records for every render whether its step was deferred.

    Args:
        name: Its kernels.
    """

    def __init__(self, name="cpu"):
        loaded, self.seen = load_backend(name), []
        self._rasterize = loaded.rasterize
        self.backend = replace(loaded, rasterize=self.rasterize)

    def rasterize(self, *arguments):
        output = self._rasterize(*arguments)
        place = len(self.seen)
        self.seen.append(False)
        if output.defer is None:
            return output
        return replace(output, defer=functools.partial(self.note, output.defer, place))

    def note(self, defer, place):
        self.seen[place] = True
        return defer()


def trainer(capture, config, parts=None, **changes):
    views, *cloud = capture
    start = from_points(*cloud, config)
    deferrals = changes.pop("deferrals", Deferrals())
    views = Views(changes.pop("views", views))
    started = Start(start, extent=2.0)
    made = training(config, views, deferrals.backend, started, **(parts or {}), **changes)
    return made, deferrals.seen


def check_same(one, other):
    tensors, numbers = one.state()
    assert numbers == other.state()[1]
    for name, tensor in other.state()[0].items():
        assert torch.equal(tensor.nan_to_num(123.0), tensors[name].nan_to_num(123.0)), name


def pair(capture, config, make_parts=dict, **changes):
    """Train both ways; return the fused trainer."""
    fused, deferred = trainer(capture, config, make_parts(fused=True), **changes)
    two_steps, stored = trainer(capture, config, make_parts(fused=False), **changes)
    assert fused.stepper.fuses and not two_steps.stepper.fuses
    assert fused.run().losses == two_steps.run().losses
    assert all(deferred) and len(deferred) == fused.iteration
    assert not any(stored)
    check_same(fused, two_steps)
    return fused


@pytest.mark.parametrize("case", CASES)
def test_a_training_has_the_same_bits(capture, case):
    run = pair(capture, CASES[case])
    assert all(parameter.grad is None for parameter in run.stepper.parameters().values())


def test_masks_depth_view_models_and_several_regularisers(capture):
    """Terms change parameters through autograd, two of them the same parameter; one reads depth and transmittance."""
    views, rng = capture[0], np.random.default_rng(0)
    masked = []
    for view in views:
        image = view.read().image
        masked.append(View(view.camera, image, mask=rng.random(image.shape[:2]) < 0.8, name=view.name))

    class Depth:
        needs = Needs(depth=True)

        def __call__(self, rendered):
            return 1e-3 * (rendered.output.depth.square().mean() + rendered.output.transmittance.mean())

    terms = {"photo": PhotoTerm(0.2), "opacity": MeanOpacity(0.3), "scale": MeanScale(0.2)}
    terms |= {"more": MeanScale(0.07), "depth": Depth()}
    # its gradient is an expanded tensor
    terms["means"] = lambda rendered: 1e-3 * rendered.gaussians.means.sum()
    make = lambda fused: {"objective": Objective(terms), "view_model": Gains(4), "fused": fused}  # noqa: E731
    run = pair(capture, CASES["adc"], make, views=masked)
    assert not torch.equal(run.stepper.parameters()["gains"].detach(), torch.ones(4))


def test_poisoned_gradients_and_parameters(capture):
    """A term returns NaN, a gradient is infinite, and some Gaussians are not finite at the start."""

    def poison(rendered):
        factors = torch.zeros_like(rendered.gaussians.log_scales)
        factors[3], factors[5] = float("nan"), float("inf")
        return (rendered.gaussians.log_scales * factors).sum()

    views, points, colors = capture
    terms = {"photo": PhotoTerm(0.2), "poison": poison}
    make = lambda fused: {"objective": Objective(terms), "fused": fused}  # noqa: E731
    config = recipe(4, strategy="none")

    def run(fused):
        start = from_points(points, colors, config)
        start.means[7], start.means[11], start.log_scales[13] = float("nan"), 1e30, float("inf")
        deferrals = Deferrals()
        made = training(config, Views(views), deferrals.backend, Start(start, extent=1.0), **make(fused))
        losses = made.run().losses
        return made, losses, deferrals.seen

    (fused, losses, deferred), (two_steps, others, _) = run(True), run(False)
    assert all(deferred) and np.array_equal(losses, others, equal_nan=True)
    assert fused.gaussians.log_scales[3].isnan().all()
    assert fused.gaussians.means[20].isfinite().all()
    check_same(fused, two_steps)


@pytest.mark.parametrize("case", ["adc", "mcmc"])
def test_a_fused_run_resumes_to_the_same_bits(capture, case, tmp_path):
    config = CASES[case]
    (whole, _), (first, _), (second, deferred) = (trainer(capture, config) for _ in range(3))
    whole.run()
    first.run(stop=lambda: first.iteration == 9)
    load_checkpoint(save_checkpoint(tmp_path, first, 1.0), second)
    second.run()
    assert all(deferred)
    check_same(whole, second)


def test_gradients_are_stored_if_something_reads_them(capture):
    class Watching:
        """A strategy that reads gradients and does not declare what it observes."""

        def __init__(self):
            self.seen = []

        def observe(self, gaussians, output):
            self.seen.append(gaussians.means.grad.abs().sum())

        def update(self, iteration, gaussians, optimizer):
            return gaussians, []

        def state(self):
            return {}, {}

        def load_state(self, tensors, numbers, gaussians):
            pass

    class Twice(Objective):
        def backward(self, rendered):
            return super().backward(rendered)

    config, strategy = recipe(2, strategy="none"), Watching()
    for parts, changes in (
        ({"objective": Twice({"photo": PhotoTerm(0.2)})}, {}),
        ({}, {"density": strategy}),
    ):
        run, deferred = trainer(capture, config, parts, **changes)
        assert not run.stepper.fuses
        run.run()
        assert deferred == [False, False]
    assert len(strategy.seen) == 2 and all(seen > 0 for seen in strategy.seen)


def test_batches_and_other_backends_take_two_steps(capture):
    config = recipe(2, strategy="none", sh_degree=0)
    dense, deferred = trainer(capture, config, deferrals=Deferrals("torch"))
    dense.run()
    assert dense.stepper.fuses and deferred == [False, False]
    batches, deferred = trainer(capture, recipe(4, strategy="none", sh_degree=0, batch=2))
    batches.run()
    assert deferred == [False] * 4


def test_a_deferred_image_takes_one_pass_and_one_step(capture):
    views, *cloud = capture
    gaussians = from_points(*cloud, recipe(1)).trainable()
    output = render(gaussians, views[0].camera, backend="cpu")
    take = output.defer()
    with pytest.raises(ArgumentError, match="has not reached this image"):
        take({})
    output.image.sum().backward(retain_graph=True)
    assert gaussians.means.grad is None
    with pytest.raises(ArgumentError, match="has no gradient"):
        output.means2d_grad_norms()
    with pytest.raises(ArgumentError, match="twice"):
        output.image.sum().backward()
    with pytest.raises(ArgumentError, match="moments: means is missing"):
        take({})


def test_only_leaves_before_a_fixed_background_can_be_deferred(capture):
    views, *cloud = capture
    raw = from_points(*cloud, recipe(1))
    camera, leaves = views[0].camera, raw.trainable()
    assert render(leaves, camera, backend="cpu").defer is not None
    assert render(raw, camera, backend="cpu").defer is None
    assert render(leaves.map(lambda t: t * 1.0), camera, backend="cpu").defer is None
    learned = torch.zeros(3, requires_grad=True)
    assert render(leaves, camera, background=learned, backend="cpu").defer is None
    strided = type(raw)(**raw.tensors() | {"means": raw.means.T.contiguous().T.requires_grad_()})
    assert render(strided, camera, backend="cpu").defer is None
