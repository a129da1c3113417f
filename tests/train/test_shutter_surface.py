"""A surface from photos of a rolling shutter, from the capture's files to the terms: what the shutter tells is used."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import load_backend, recipe, training
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.scene.views import View
from gsplat_edu.train.events import StepEvent
from lens_captures import FISHEYE, moving_photo, room_cameras
from panorama_room import rectangles
from train.test_lens_surface import errors_of, run

SIDE, TURN, SHIFT = 64, 0.4, 0.3
"""Width of the photos, px; turn and shift of a camera while a photo is read, radians and world units. The room is
5 wide; the turn moves the image by 8 px from its first row to its last."""


def flat_splats(spacing=0.2):
    """Return places and rotations of flat splats on the rectangles of the room."""
    places, quats = [], []
    for corner, a, b in rectangles():
        steps = [np.arange(0.5, n) / n for n in (max(2, round(np.linalg.norm(e) / spacing)) for e in (a, b))]
        s, t = (grid.ravel() for grid in np.meshgrid(*steps))
        found = corner + s[:, None] * a + t[:, None] * b
        n = np.cross(a, b) / np.linalg.norm(np.cross(a, b))  # the way from the z axis, which is the shortest
        places.append(found)
        quats.append(np.tile([1 + n[2], -n[1], n[0], 0.0] if n[2] > -1 else [0.0, 1, 0, 0], (len(found), 1)))
    return np.concatenate(places), np.concatenate(quats)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Return the capture as its files describe it, and the same with the shutter ignored."""
    rng, views = np.random.default_rng(1), []
    for i, still in enumerate(room_cameras(FISHEYE, 18, SIDE)):
        ways = rng.normal(size=(2, 3))
        turn, shift = np.array([[TURN], [SHIFT]]) * ways / np.linalg.norm(ways, axis=1, keepdims=True)
        camera = still.through(FISHEYE, RollingShutter(turn, shift))
        views.append(View(camera, moving_photo(camera), name=f"{i:02}.png"))
    folder, (points, _) = tmp_path_factory.mktemp("moving"), flat_splats()
    write_transforms(folder, views, points, np.full_like(points, 0.5))
    known = load_dataset(folder, DataSettings(test_every=0, lens="native"))
    turns = [[view.camera.shutter.turn for view in each] for each in (known.train, views)]
    np.testing.assert_allclose(*turns, atol=1e-12)
    resting = tuple(View(v.camera.through(FISHEYE), v.read().image, name=v.name) for v in known.train)
    return known, dataclasses.replace(known, train=resting)


def terms_of_the_true_surface(dataset):
    """Return the mean of the normals' and the patches' terms over all photos, in a training of splats on the walls."""
    config = recipe(
        2_000, strategy="fast", max_gaussians=8_000, surface=True, surface_start=0, surface_every=1
    )
    trainer = training(config, dataset, load_backend("cpu"))
    places, quats = flat_splats()
    start = trainer.gaussians
    with torch.no_grad():
        start.means.copy_(torch.from_numpy(places))
        start.quats.copy_(torch.from_numpy(quats))
        start.log_scales.copy_(torch.tensor([0.12, 0.12, 0.002]).log())
        start.logit_opacities.fill_(3.0)
    found, count = [], len(dataset.train)

    def heard(trainer, event):
        if isinstance(event, StepEvent):
            found.append([float(event.terms[name]) for name in ("normal", "patches")])

    trainer.run(stop=lambda: len(found) >= count, callbacks=(heard,))
    return np.mean(found, axis=0)


def test_the_terms_of_the_true_surface_know_the_shutter(captures):
    """Splats on the walls agree with the depth as well as those of cameras at rest, and photos agree through them.

    Normals taken from rays of a camera at rest raise the first term by a third. Patches whose rays ignore the shutter
    raise the second one as much as photos that are taken for those of cameras at rest, nearly twofold.
    """
    known, ignored = (terms_of_the_true_surface(dataset) for dataset in captures)
    print(f"normals {known[0]:.3e} and {ignored[0]:.3e}, patches {known[1]:.5f} and {ignored[1]:.5f}")
    assert known[0] < 1.15 * ignored[0] and known[1] < 0.7 * ignored[1]


@pytest.mark.slow
def test_the_learned_surface_is_better_if_the_shutter_is_known(captures):
    """The angle to the true normals shrinks by the terms of a surface, and depth is better than without the shutter."""
    known, ignored = captures
    views = [View(c, np.zeros((SIDE, SIDE, 3), np.uint8)) for c in room_cameras(FISHEYE, 24, SIDE)[1::2]]
    plain, surface, resting = (
        errors_of(run(data, 400, surface=on).gaussians, views)
        for data, on in ((known, False), (known, True), (ignored, True))
    )
    print("degrees and depth without the terms, with them, and without the shutter:", plain, surface, resting)
    assert surface[0] < 0.75 * plain[0] and surface[1] < 1.05 * plain[1]
    assert surface[0] < 0.9 * resting[0] and surface[1] < 0.8 * resting[1]
