"""Trainings with depth of photos that keep their lens: better depth, the same bits, and the lens that is learned."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import torch

from data.test_lens_depths import given, write_room_maps
from gsplat_edu import load_backend, recipe, training
from gsplat_edu.data.depths import DepthSource
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.projection import Projection
from lens_captures import FISHEYE, room_depth, write_room

LENSES = {"fisheye": FISHEYE, "panorama": Projection("equirectangular")}


@pytest.fixture(scope="module", params=LENSES)
def room(request, tmp_path_factory):
    """Photos of a room through a wide lens with exact distances; two photos are held out."""
    folder = tmp_path_factory.mktemp(request.param)
    cameras = write_room(folder / "room", LENSES[request.param], 12, 48)
    maps = write_room_maps(folder / "maps", cameras, factor=1)
    return given(folder / "room", DepthSource(maps, unit=1.0), DataSettings(lens="native"))[0]


def run(dataset, iterations=150, threads=2, backend="cpu", **changes):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        config = recipe(iterations, strategy="fast", max_gaussians=1_500, **changes)
        trainer = training(config, dataset, load_backend(backend))
        trainer.run()
    finally:
        torch.set_num_threads(before)
    return trainer


def without_depth(dataset):
    return dataclasses.replace(dataset, train=tuple(view.with_depth(None) for view in dataset.train))


def depth_error_of(gaussians, views):
    """Return the median relative error of the depth of held-out views."""
    errors = []
    for view in views:
        with torch.no_grad():
            out = render(gaussians, view.camera, settings=RenderSettings(depth=True), backend="cpu")
        found, true = (out.depth / out.alpha.clamp(min=1e-6)).numpy(), room_depth(view.camera)
        seen = (true > 0) & (out.alpha.numpy() > 0.5)
        errors.append(np.abs(found - true)[seen] / true[seen])
    return float(np.median(np.concatenate(errors)))


@pytest.mark.slow
def test_depth_of_held_out_views_becomes_better(room):
    """With maps, the median error of held-out depth is a sixth smaller at least, and photos are hardly worse."""
    plain, guided = run(without_depth(room)), run(room)
    errors = [depth_error_of(trainer.gaussians, room.test) for trainer in (plain, guided)]
    scores = [
        summarize(score_views(t.gaussians, room.test, partial(render, backend="cpu"), (0, 0, 0)))["psnr"]
        for t in (plain, guided)
    ]
    print(f"median error of depth {errors[0]:.4f} without maps, {errors[1]:.4f} with; PSNR {scores}")
    assert errors[1] < 0.83 * errors[0] and scores[1] > scores[0] - 0.5


def test_bits_do_not_depend_on_the_number_of_threads(room):
    first, *others = (run(room, 24, threads).gaussians.tensors() for threads in (1, 2, 5))
    for other in others:
        assert all(torch.equal(tensor, other[name]) for name, tensor in first.items())


def test_a_lens_is_learned_with_depth(room):
    """Samples stay at the photo's pixels while the lens changes."""
    panorama = room.train[0].camera.projection.kind == "equirectangular"  # whose focal lengths are given
    trainer = run(room, 12, refine="poses" if panorama else "lens")
    assert trainer.gaussians.means.isfinite().all()
