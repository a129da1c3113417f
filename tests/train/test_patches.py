"""The term `patches`: which views are neighbours, and what it does to a training."""

import numpy as np
import pytest
import torch

from gsplat_edu import load_backend, recipe, training
from gsplat_edu.parts.surface import patches
from gsplat_edu.parts.surface.patches import NEIGHBOURS, PATCHES, Neighbourhood, neighbours_of
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.events import StepEvent
from gsplat_edu.train.view_model import Identity
from lab.captures.textured_box import box_orbit, photograph_box


class Box:
    """What `training` reads of a dataset: photos of the textured box."""

    def __init__(self):
        cameras = box_orbit(12, size=(64, 48))
        self.train = [View(c, photograph_box(c), name=f"{i}.png") for i, c in enumerate(cameras)]
        rng = np.random.default_rng(0)
        self.points = rng.uniform((-0.7, -1.0, -0.5), (0.7, 0.1, 0.5), (400, 3))
        self.colors = rng.uniform(size=(400, 3))


@pytest.fixture(scope="module")
def box():
    return Box()


def run(box, until=None, load=None, **changes):
    """Train; return the trainer and the values of the term."""
    changes = {"strategy": "fast", "max_gaussians": 400, "sh_degree": 0, "surface": True} | changes
    trainer, values = training(recipe(60, **changes), box, load_backend("cpu")), []
    if load is not None:
        load_checkpoint(load, trainer)
    trainer.run(
        stop=lambda: trainer.iteration == until,
        callbacks=[lambda _, e: isinstance(e, StepEvent) and values.append(float(e.terms.get(PATCHES, -1)))],
    )
    return trainer, values


def bits(trainer):
    return b"".join(t.detach().numpy().tobytes() for t in trainer.gaussians.tensors().values())


def looking(x, towards=0.0):
    return Camera.looking_at((x, 0, -3), (x + towards, 0, 0), 50, 50, 40, 40)


def test_neighbours_look_the_same_way_from_elsewhere():
    cameras = [looking(0.0), looking(0.001), looking(0.5), looking(-0.2), looking(0.1, towards=3.0)]
    found = neighbours_of(cameras, extent=1.0)
    assert found[0] == (3, 2), "not the one at the same place, nor the one that is turned by 45 degrees"
    assert found[4] == ()
    many = neighbours_of([looking(0.1 * k) for k in range(40)], extent=1.0)
    assert all(len(found) == NEIGHBOURS for found in many)
    assert many[0][0] == 1 and many[0][-1] == 39, "from the nearest to the farthest"
    assert neighbours_of([looking(0)], 1.0) == [()]


def test_the_term_is_logged_from_its_start_in_every_nth_step_and_changes_the_training(box):
    trainer, values = run(box, surface_start=20, surface_every=2)
    assert not any(values[:20]) and not any(values[21::2])
    assert all(value > 0 for value in values[20::2]), "with photos of reduced size too"
    plain, without = run(box, surface_start=20, surface_every=2, patch_weight=0.0)
    assert set(without) == {-1.0} and bits(plain) != bits(trainer)


@pytest.mark.parametrize("refine", ["none", "poses"])
def test_the_same_bits_resumed_and_for_any_number_of_threads(box, tmp_path, refine):
    seen, before = set(), torch.get_num_threads()
    changes = {"refine": refine, "surface_start": 10, "surface_every": 2}
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            seen.add(bits(run(box, **changes)[0]))
    finally:
        torch.set_num_threads(before)
    half, _ = run(box, until=31, **changes)
    path = save_checkpoint(tmp_path, half, seconds=0.0)
    seen.add(bits(run(box, load=path, **changes)[0]))
    assert len(seen) == 1


def test_photos_beyond_the_room_are_read_again(box, monkeypatch):
    monkeypatch.setattr(patches, "PHOTO_ROOM", 2 * 64 * 48)
    reads = []
    views = [View.stored(v.camera, lambda v=v: reads.append(v.name) or v.read(), v.name) for v in box.train]
    around = Neighbourhood(views, Identity(), 1.0)
    for other in (1, 2, 1, 3):
        photo, seen = around.photos(0, views[0], other)
        assert (photo.pixels == around.photos(0, views[0], other)[0].pixels).all()
        assert seen.camera is views[other].camera
    assert reads == ["0.png", "1.png", "2.png", "1.png", "3.png"], "the photo used longest ago goes"


def test_patches_without_weight_are_no_term():
    run = training(recipe(10, surface=True, patch_weight=0), Box(), load_backend("cpu"))
    assert {"normal", "flat"} < set(run.stepper.parts.objective.terms)
    assert PATCHES not in run.stepper.parts.objective.terms
