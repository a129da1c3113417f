"""The term of depth: exact gradients, the same bits, resume, and better depth from a sensor's maps."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from data.depth_maps import exact_depths, small_camera, traced
from gsplat_edu import load_backend, recipe, training
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.given_depth import GivenDepth
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.events import StepEvent


def maps(dtype=torch.float64):
    """Return smooth depth and alpha of 9x7 px, and 40 samples between the pixels, some outside."""
    rng = np.random.default_rng(0)
    alpha = torch.tensor(rng.uniform(0.55, 1.0, (7, 9)), dtype=dtype)
    depth = alpha * torch.tensor(rng.uniform(2.0, 3.0, (7, 9)), dtype=dtype)
    pixels = torch.tensor(rng.uniform(-1, 9, (40, 2)), dtype=dtype)
    given = torch.tensor(rng.uniform(2.0, 3.0, 40), dtype=dtype)
    weights = torch.tensor(rng.uniform(0.1, 1.0, 40), dtype=dtype)
    return depth, alpha, pixels, given, weights


RULES = [DepthRule(0.7), DepthRule(0.7, bend=0.5), DepthRule(0.3, extent=2.5)]


@pytest.mark.parametrize("rule", RULES)
def test_gradients_are_those_of_finite_differences(rule):
    """No sample lies at a kink: at zero difference, at |r| = delta, or at the least alpha."""
    depth, alpha, *samples = maps()
    depth.requires_grad_()
    alpha.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d, a: 3.0 * depth_error(d, a, *samples, rule), (depth, alpha), eps=1e-7
    )


@pytest.mark.parametrize("rule", RULES)
def test_value_is_its_definition(rule):
    """A loop over the samples gives the same."""
    depth, alpha, pixels, given, weights = (each.numpy() for each in maps())
    total = 0.0
    for (u, v), z, w in zip(pixels, given, weights, strict=True):
        if not (0 <= u <= 8 and 0 <= v <= 6):
            continue
        i, j = min(int(v), 5), min(int(u), 7)
        shares = np.outer([1 - (v - i), v - i], [1 - (u - j), u - j])
        A, D = (shares * alpha[i : i + 2, j : j + 2]).sum(), (shares * depth[i : i + 2, j : j + 2]).sum()
        if A < 0.5:
            continue
        if rule.extent is not None:
            total += w * rule.extent * abs(A / D - 1 / z)
            continue
        r = abs(D / A - z) / z
        total += w * (r * r / (2 * rule.bend) if r <= rule.bend else r - rule.bend / 2)
    found = depth_error(*maps(), rule).item()
    assert found == pytest.approx(rule.weight * total / weights.sum(), rel=1e-12) and found > 0


def test_holes_and_samples_outside_add_nothing():
    depth, alpha, pixels, given, weights = maps()
    assert depth_error(0 * depth, 0 * alpha, pixels, given, weights, RULES[0]) == 0
    assert depth_error(depth, 0.4 * alpha, pixels, given, weights, RULES[0]) == 0
    assert depth_error(depth, alpha, pixels - 100, given, weights, RULES[0]) == 0
    assert depth_error(depth, alpha, pixels, given, 0 * weights, RULES[0]) == 0
    assert depth_error(depth, alpha, pixels[:0], given[:0], weights[:0], RULES[0]) == 0


def test_bits_do_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(0)
    depth, alpha = (torch.tensor(rng.uniform(1, 2, (120, 160)), dtype=torch.float32) for _ in range(2))
    pixels = torch.tensor(rng.uniform(0, 119, (50_001, 2)), dtype=torch.float32)
    given, weights = (torch.tensor(rng.uniform(1, 2, 50_001), dtype=torch.float32) for _ in range(2))
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            leaves = [depth.clone().requires_grad_(), alpha.clone().requires_grad_()]
            value = depth_error(*leaves, pixels, given, weights, DepthRule())
            value.backward()
            results.append([value.detach(), *(leaf.grad for leaf in leaves)])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def test_bad_arguments_are_named():
    depth, alpha, pixels, given, weights = maps()
    with pytest.raises(ArgumentError, match="given: is torch.float32"):
        depth_error(depth, alpha, pixels, given.float(), weights, RULES[0])
    with pytest.raises(ArgumentError, match="at least 2x2"):
        depth_error(depth[:1], alpha[:1], pixels, given, weights, RULES[0])


@dataclass
class Capture:
    """What `training` reads of a dataset."""

    train: list
    points: np.ndarray
    colors: np.ndarray


@pytest.fixture(scope="module")
def bare():
    """Ten traced photos, 64x48, and few points off the surface."""
    made = traced()
    off = made.points + 0.05 * np.random.default_rng(0).normal(size=made.points.shape)
    return Capture(made.views, off[::4], made.colors[::4])


def with_maps(capture, sparse=False):
    """Return the capture with the exact depth of a sensor of twice the size."""
    views = []
    for view, depth in zip(capture.train, exact_depths(), strict=True):
        small = small_camera(view.camera)
        v, u = np.nonzero(depth)
        rays = np.stack([(u - small.cx) / small.fx, (v - small.cy) / small.fy], axis=1)
        given = GivenDepth(rays, depth[v, u], sparse=sparse)
        views.append(view.with_depth(lambda given=given: given))
    return Capture(views, capture.points, capture.colors)


def run(capture, iterations=100, threads=2, **changes):
    config = recipe(iterations, strategy="fast", max_gaussians=1_500, **changes)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        trainer = training(config, capture, load_backend("cpu"))
        trainer.run()
    finally:
        torch.set_num_threads(before)
    return trainer


def error_of(trainer, capture):
    """Return the median relative error of the rendered depth."""
    errors = []
    for view, true in zip(capture.train, exact_depths((64, 48)), strict=True):
        settings = RenderSettings(jacobian_limit=1.3)
        depth = (
            render_maps(trainer.gaussians, view.camera, ("depth",), settings, "cpu")[0]["depth"]
            .detach()
            .numpy()
        )
        both = (true > 0) & (depth > 0)
        errors.append(np.abs(depth - true)[both] / true[both])
    return np.median(np.concatenate(errors))


@pytest.mark.slow
@pytest.mark.parametrize("sparse", [False, True])
def test_depth_makes_the_rendered_depth_better(bare, sparse):
    """From points 5 cm off the surface, exact depth lowers the median error by a fifth at least."""
    changes = {"points_weight": 0.1} if sparse else {}
    without, given = run(bare), run(with_maps(bare, sparse), **changes)
    assert error_of(given, bare) < 0.8 * error_of(without, bare)


def test_the_term_is_logged_and_due_in_every_second_step(bare):
    values = []
    config = recipe(12, strategy="fast", max_gaussians=1_000)
    trainer = training(
        config,
        with_maps(bare),
        load_backend("cpu"),
        callbacks=[
            lambda trainer, event: values.append(event.terms) if isinstance(event, StepEvent) else None
        ],
    )
    trainer.run()
    depth = [float(terms["depth"]) for terms in values]
    assert all(value > 0 for value in depth[::2]) and not any(depth[1::2])


def test_bits_of_a_training_with_depth_depend_on_nothing(bare, tmp_path):
    """1, 2 and 5 threads, and a run that is stopped and resumed, end with the same bits."""
    capture = with_maps(bare)
    results = [run(capture, 30, threads, surface=True).gaussians.tensors() for threads in (1, 2, 5)]
    config = recipe(30, strategy="fast", max_gaussians=1_500, surface=True)
    first = training(config, capture, load_backend("cpu"))
    first.run(stop=lambda: first.iteration == 17)
    path = save_checkpoint(tmp_path, first, seconds=0.0)
    second = training(config, capture, load_backend("cpu"))
    load_checkpoint(path, second)
    second.run()
    results.append(second.gaussians.tensors())
    for other in results[1:]:
        assert all(torch.equal(tensor, other[name]) for name, tensor in results[0].items())


def test_views_without_depth_and_dropped_samples_are_fine(bare):
    capture = with_maps(bare)
    capture.train[1:] = bare.train[1:]
    assert run(capture, 12).gaussians.means.isfinite().all()
    empty = GivenDepth(np.zeros((0, 2)), np.zeros(0))
    capture.train[0] = capture.train[0].with_depth(lambda: empty)
    trainer, plain = run(capture, 12), run(bare, 12)
    assert torch.equal(trainer.gaussians.means, plain.gaussians.means)


def test_given_depth_is_checked():
    for rays, depths, weights in (
        (np.zeros((2, 2)), [1.0, 0.0], None),
        (np.zeros((1, 2)), [1.0], [-1.0]),
        (np.full((1, 2), np.nan), [1.0], None),
    ):
        with pytest.raises(ArgumentError):
            GivenDepth(rays, depths, weights)
