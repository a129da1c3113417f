"""`surface`: the terms, their schedule, and what they do to a scene."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_edu import load_backend, recipe, training
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.options import train as train_options
from gsplat_edu.parts.surface.terms import FLAT, NORMAL, FlatTerm, NormalTerm, Turns
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.views import View
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.events import StepEvent
from gsplat_edu.train.far import Shell
from gsplat_edu.train.rendered import Rendered
from lab.captures.textured_box import BOX_FACES, box_orbit, photograph_box


@dataclass
class Capture:
    """What `training` reads of a dataset."""

    train: list
    points: np.ndarray
    colors: np.ndarray


@pytest.fixture(scope="module")
def capture():
    return Capture(*procedural_capture(size=32, count=12, splats=120))


def run(capture, iterations=60, backend="cpu", **changes):
    """Train; return the trainer and the terms of every step."""
    config = recipe(iterations, **({"strategy": "fast", "max_gaussians": 300, "sh_degree": 0} | changes))
    trainer, terms = training(config, capture, load_backend(backend)), []
    trainer.run(
        callbacks=[
            lambda _, event: (
                terms.append({name: float(value) for name, value in event.terms.items()})
                if isinstance(event, StepEvent)
                else None
            )
        ]
    )
    return trainer, terms


def bits(trainer):
    return b"".join(t.detach().numpy().tobytes() for t in trainer.gaussians.tensors().values())


def rendered(**values):
    """Return a `Rendered` that has only some of its fields."""
    made = object.__new__(Rendered)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def test_normals_are_compared_from_the_start_in_every_fourth_step(capture):
    _, terms = run(capture, surface=True)
    start = recipe(60, strategy="fast", surface=True).surface_start
    assert start == round(9_000 * 60 / 30_000)
    compared = [i for i, values in enumerate(terms) if values[NORMAL] > 0]
    assert compared == [i for i in range(60) if i >= start and i % 4 == 0]
    assert compared == [i for i, values in enumerate(terms) if values[FLAT] > 0]
    assert not {NORMAL, FLAT} & set(run(capture, 3)[1][0])


def test_batches_compare_in_every_fourth_step_too(capture):
    _, terms = run(capture, 24, surface=True, surface_start=0, batch=2)
    assert [i for i, values in enumerate(terms) if values[NORMAL] > 0] == [0, 4, 8]


def box_capture(size=(120, 90), count=16):
    """Photos of the textured box, and 5,000 points on its faces, 0.01 off."""
    rng, parts = np.random.default_rng(0), []
    for number, (corner, a, b) in enumerate(BOX_FACES):
        at = rng.random((2500 if number == 0 else 500, 2))
        parts.append(corner + at[:, :1] * a + at[:, 1:] * b)
    points = np.concatenate(parts)
    points += 0.01 * rng.normal(size=points.shape)
    cameras = box_orbit(count, size=size)
    views = [View(camera, photograph_box(camera), name=f"{i:02d}.png") for i, camera in enumerate(cameras)]
    return Capture(views, points, np.full_like(points, 0.5))


def box_normals(camera):
    """Return the normals of the box and the floor within 6 units of the camera, (H, W, 3); 0 beyond."""
    rays = camera.rays()
    nearest, normals = np.full(rays.shape[:2], 6.0), np.zeros_like(rays)
    for corner, a, b in BOX_FACES:
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        slope = rays @ normal
        z = ((corner - camera.eye) @ normal) / np.where(slope == 0, np.inf, slope)
        at = camera.eye + z[..., None] * rays - corner
        s, t = at @ a / (a @ a), at @ b / (b @ b)
        hit = (z > 0) & (z < nearest) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        nearest[hit], normals[hit] = z[hit], (-np.sign(slope)[..., None] * normal)[hit]
    return normals


@pytest.mark.slow
def test_normals_are_nearer_to_the_truth_with_a_surface():
    """On a textured box, the mean angle to the true normals falls by more than a fifth (11.0 to 7.9 degrees)."""
    capture = box_capture()
    angles = []
    for surface in (False, True):
        changes = {"fast_start_factor": 1.0, "max_gaussians": 5_000}
        trainer, _ = run(capture, 400, surface=surface, **changes)
        found = []
        for view in capture.train[::4]:
            maps, _ = render_maps(
                trainer.gaussians.map(torch.Tensor.detach),
                view.camera,
                ["normal"],
                settings=RenderSettings(jacobian_limit=1.3),
            )
            truth = box_normals(view.camera)
            cosines = (maps["normal"].numpy() * truth).sum(axis=-1)[truth.any(axis=-1)]
            found.append(np.degrees(np.arccos(cosines.clip(-1, 1))))
        angles.append(np.concatenate(found).mean())
    assert angles[1] < 0.8 * angles[0], angles


def test_the_same_bits_for_any_number_of_threads_and_after_a_resume(capture, tmp_path):
    whole, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            whole.append(bits(run(capture, 40, surface=True, surface_start=5)[0]))
    finally:
        torch.set_num_threads(before)
    assert len(set(whole)) == 1
    config = recipe(40, strategy="fast", max_gaussians=300, sh_degree=0, surface=True, surface_start=5)
    first = training(config, capture, load_backend("cpu"))
    first.run(stop=lambda: first.iteration == 20)
    path = save_checkpoint(tmp_path, first, seconds=0.0)
    second = training(config, capture, load_backend("cpu"))
    load_checkpoint(path, second)
    second.run()
    assert bits(second) == whole[0]


def test_cpu_and_dense_torch_have_the_same_terms(capture):
    changes = {
        "surface": True,
        "surface_start": 0,
        "surface_every": 1,
        "strategy": "none",
        "max_gaussians": None,
    }
    found = [run(capture, 2, backend, **changes)[1] for backend in ("cpu", "torch")]
    for one, other in zip(*found, strict=True):
        assert math.isclose(one[NORMAL], other[NORMAL], rel_tol=1e-3)  # float32, and a step of Adam apart
        assert math.isclose(one[FLAT], other[FLAT], rel_tol=1e-5)


def test_flatness_has_its_gradient_and_leaves_the_sky_alone(capture):
    trainer, _ = run(capture, 1)
    gaussians = trainer.gaussians

    rows = torch.tensor([3, 5, 8])
    given = rendered(gaussians=gaussians, output=SimpleNamespace(visible=rows), iteration=0)
    value = FlatTerm(0.6, 2.0, Turns(0))(given)
    smallest = gaussians.log_scales.detach().exp().min(dim=1).values
    assert math.isclose(float(value.detach()), 0.3 * float(smallest[rows].mean()), rel_tol=1e-6)
    (gradient,) = torch.autograd.grad(value, gaussians.log_scales)
    expected = torch.zeros_like(gradient)
    expected[rows, gaussians.log_scales[rows].argmin(dim=1)] = 0.1 * smallest[rows]
    torch.testing.assert_close(gradient, expected)
    everything_far = Shell(gaussians.means.detach()[0].double().numpy() + 1e6, 1.0)
    assert FlatTerm(0.6, 2.0, Turns(0), everything_far)(given) == 0


def test_a_step_without_normals_is_refused(capture):
    term = NormalTerm(1.0, Turns(0))

    given = rendered(
        output=SimpleNamespace(features=None, depth=torch.ones(2, 2), alpha=torch.ones(2, 2)), iteration=0
    )
    with pytest.raises(ArgumentError, match="facing_normals"):
        term(given)


def test_settings_of_a_surface_need_the_option(tmp_path):
    import argparse

    parser = argparse.ArgumentParser()
    train_options.add_arguments(parser)
    words = [str(tmp_path), "--out", str(tmp_path / "run"), "--set", "normal_weight=0.1"]
    with pytest.raises(ArgumentError, match="only --surface uses it"):
        train_options.check(parser.parse_args(words))
    train_options.check(parser.parse_args([*words, "--surface"]))
