"""Lenses and motions learned with the scene: planted errors shrink, and held-out views follow their lens."""

from typing import NamedTuple

import numpy as np
import pytest
import torch

import panorama_room
from gsplat_edu import ArgumentError, Camera, load_backend, look_at, recipe, training
from gsplat_edu.parts.poses.refinement import distortion_units, lens_key, refinement_of
from gsplat_edu.parts.poses.step import lens_flow
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.projection import COEFFICIENTS, Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.scene.views import View
from lens_captures import moving_photo, room_photo

SIDE = 80


class Room(NamedTuple):
    train: tuple
    points: np.ndarray
    colors: np.ndarray


def room(photos, cameras):
    """Return the views of the room, with exact start points."""
    rng = np.random.default_rng(0)
    points = [
        c + rng.random((200, 1)) * a + rng.random((200, 1)) * b for c, a, b in panorama_room.rectangles()
    ]
    points = np.concatenate(points)
    views = tuple(
        View(camera, photo, name=f"{i:02}.png")
        for i, (camera, photo) in enumerate(zip(cameras, photos, strict=True))
    )
    return Room(views, points, np.full_like(points, 0.5))


def poses(count=12):
    for i, eye in enumerate(panorama_room.walk(count)):
        angle = 2.4 * i
        yield look_at(eye, eye + np.array([np.sin(angle), 0.2 * np.sin(1.7 * i), np.cos(angle)])), eye


def pinhole(R, eye, focal):
    return Camera(R, eye, focal, focal, (SIDE - 1) / 2, (SIDE - 1) / 2, SIDE, SIDE)


def off(camera, truth):
    """Return by how much a camera sees points elsewhere than the true one, px, root mean square."""
    points = (truth.origins() + 2.0 * truth.rays())[4:-4:8, 4:-4:8].reshape(-1, 3)
    a, b = truth.sight(points), camera.sight(points)
    both = a.valid & b.valid
    return float(np.sqrt(((a.u - b.u) ** 2 + (a.v - b.v) ** 2)[both].mean()))


def refined(data, refine, iterations=700):
    config = recipe(iterations, strategy="fast", max_gaussians=6000, refine=refine, seed=0)
    trainer = training(config, data, load_backend("cpu"))
    trainer.run()
    return refinement_of(trainer.view_model)


@pytest.mark.slow
def test_a_wrong_focal_length_and_distortion_are_corrected():
    """Planted: 2 % of the focal length and k1 = -0.06, together 1.3 px."""
    lens = Projection(distortion=Distortion.of(k1=-0.06))
    truth = [pinhole(R, eye, 0.8 * SIDE).through(lens) for R, eye in poses()]
    given = [pinhole(R, eye, 0.8 * SIDE * 1.02) for R, eye in poses()]
    found = refined(room([room_photo(camera) for camera in truth], given), "lens", 1200)
    before, after = off(given[3], truth[3]), off(found.refined(3, given[3]), truth[3])
    assert before > 1.2 and after < 0.6 * before
    held_out = found.with_refined_lens(pinhole(*next(poses()), 0.8 * SIDE * 1.02))
    assert held_out.projection == found.refined(3, given[3]).projection


@pytest.mark.slow
def test_the_motion_of_a_rolling_shutter_is_found():
    """Planted: a turn that moves the image by 12 px from its first row to its last."""
    rng, truth = np.random.default_rng(1), []
    for R, eye in poses():
        axis = rng.normal(size=3)
        shutter = RollingShutter(12 / (0.8 * SIDE) * axis / np.linalg.norm(axis), (0, 0, 0))
        truth.append(pinhole(R, eye, 0.8 * SIDE).through(shutter=shutter))
    given = [camera.through() for camera in truth]
    found = refined(room([moving_photo(camera) for camera in truth], given), "shutter", 900)
    before = np.mean([off(a, b) for a, b in zip(given, truth, strict=True)])
    after = np.mean([off(found.refined(i, a), b) for i, (a, b) in enumerate(zip(given, truth, strict=True))])
    assert before > 2.0 and after < 0.6 * before


@pytest.mark.parametrize("kind", ["perspective", "fisheye", "equirectangular"])
def test_a_step_of_a_pose_works_through_any_lens(kind):
    """The flow that a step assumes is the derivative of the image point by the twist."""
    R, eye = next(poses())
    if kind == "equirectangular":
        camera = Camera.panorama(R, eye, 20, 40)
    else:
        distortion = Distortion.of(k1=-0.05, k2=0.01)
        camera = Camera(R, eye, 15.0, 15.5, 19.0, 10.0, 20, 40).through(Projection(kind, distortion))
    pixels = torch.tensor([[5.0, 5.0], [19.0, 10.0], [30.0, 14.0]], dtype=torch.float64)
    depth = torch.tensor([1.0, 2.0, 1.5], dtype=torch.float64)
    flow = lens_flow(camera, pixels, depth).numpy()
    columns, rows = pixels.numpy().astype(int).T
    points = camera.eye + depth.numpy()[:, None] * camera.rays()[rows, columns]
    tensors, step = CameraTensors.of(camera), 1e-6
    for k in range(6):
        twist = torch.zeros(6, dtype=torch.float64)
        twist[k] = step
        ahead, behind = (tensors.moved(sign * twist).value().sight(points) for sign in (1, -1))
        slope = np.stack([ahead.u - behind.u, ahead.v - behind.v], axis=1) / (2 * step)
        np.testing.assert_allclose(flow[:, :, k], slope, rtol=1e-4, atol=1e-4)


def test_units_of_coefficients_move_the_corner_by_the_width():
    camera = pinhole(*next(poses()), 50.0)
    units = distortion_units(CameraTensors.of(camera)).numpy()
    free = {name for name, unit in zip(COEFFICIENTS, units, strict=True) if unit}
    assert free == {"k1"}
    corner = np.hypot(39.5, 39.5) / 50.0
    assert units[0] * corner**3 * 50.0 == pytest.approx(SIDE)
    fisheye = camera.through(Projection("fisheye"))
    lens = camera.through(Projection("fisheye", Distortion.of(k1=0.1, k3=-0.01, p1=0.1)))
    assert np.flatnonzero(distortion_units(CameraTensors.of(lens)).numpy()).tolist() == [0, 2]
    assert distortion_units(CameraTensors.of(camera.through(Projection("orthographic")))) is None
    assert lens_key(camera) != lens_key(fisheye)


def test_a_backend_without_lenses_refuses_to_learn_one():
    data = room(
        [room_photo(pinhole(R, eye, 64.0)) for R, eye in poses(4)], [pinhole(*p, 64.0) for p in poses(4)]
    )
    backend = load_backend("cpu")
    lacking = type(backend)(**(vars(backend) | {"name": "other", "lacks": frozenset({"lens"})}))
    with pytest.raises(ArgumentError, match="refine: lens needs a backend that renders other lenses"):
        training(recipe(10, refine="lens"), data, lacking)
