"""Trainings of a surface from photos that keep their lens: better normals, neighbours, bits, what is refused."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, load_backend, recipe, training
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.parts.surface.patches import neighbours_of
from gsplat_edu.render.maps import render_maps
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.views import View
from lens_captures import FISHEYE, room_cameras, room_depth, write_room
from panorama_room import rectangles

LENSES = {"fisheye": FISHEYE, "panorama": Projection("equirectangular")}


@pytest.fixture(scope="module", params=LENSES)
def room(request, tmp_path_factory):
    """Photos of a room through a wide lens; two photos are held out."""
    folder = tmp_path_factory.mktemp(request.param)
    write_room(folder, LENSES[request.param], 16, 64)
    return load_dataset(folder, DataSettings(lens="native"))


def run(dataset, iterations=300, threads=2, **changes):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        config = recipe(iterations, strategy="fast", max_gaussians=2_000, **changes)
        trainer = training(config, dataset, load_backend("cpu"))
        trainer.run()
    finally:
        torch.set_num_threads(before)
    return trainer


def true_normals(camera):
    """Return the normals of the room where a camera's rays end, towards the camera."""
    rays, depth = camera.rays(), room_depth(camera)
    points = camera.eye + depth[..., None] * np.where(np.isfinite(rays), rays, 0.0)
    found, least = np.zeros_like(points), np.full(depth.shape, 1e-6)
    for corner, a, b in rectangles():
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        at = points - corner
        s, t = at @ a / (a @ a), at @ b / (b @ b)
        off = np.abs(at @ normal)
        on = (off < least) & (s > -1e-6) & (s < 1 + 1e-6) & (t > -1e-6) & (t < 1 + 1e-6) & (depth > 0)
        found[on], least[on] = np.copysign(1.0, (camera.eye - corner) @ normal) * normal, off[on]
    return found


def errors_of(gaussians, views):
    """Return the mean angle of rendered to true normals, degrees, and the median relative error of depth."""
    angles, depths = [], []
    for view in views:
        with torch.no_grad():
            names = ("alpha", "normal", "depth")
            maps, _ = render_maps(gaussians, view.camera, names, backend="cpu")
        alpha, normals, depth = (maps[name] for name in names)
        normals, true = normals.numpy(), true_normals(view.camera)
        seen = (alpha.numpy() > 0.5) & true.any(axis=-1)
        cosine = np.clip((normals * true).sum(axis=-1)[seen], -1, 1)
        angles.append(np.degrees(np.arccos(cosine)))
        z = room_depth(view.camera)
        depths.append(np.abs(depth.numpy() - z)[seen] / z[seen])
    return float(np.concatenate(angles).mean()), float(np.median(np.concatenate(depths)))


@pytest.mark.slow
def test_normals_of_held_out_views_become_better(room):
    """The mean angle to the traced normals shrinks by a seventh at least, and depth becomes no worse."""
    plain, learned = (errors_of(run(room, surface=surface).gaussians, room.test) for surface in (False, True))
    print(f"normals {plain[0]:.2f} and {learned[0]:.2f} degrees, depth {plain[1]:.4f} and {learned[1]:.4f}")
    assert learned[0] < 0.86 * plain[0] and learned[1] < 1.05 * plain[1]


def test_bits_do_not_depend_on_the_number_of_threads(room):
    first, *others = (
        run(room, 24, threads, surface=True, surface_start=0, surface_every=1).gaussians.tensors()
        for threads in (1, 2, 5)
    )
    for other in others:
        assert all(torch.equal(tensor, other[name]) for name, tensor in first.items())


def test_panoramas_are_neighbours_whatever_their_heading():
    panoramas = room_cameras(LENSES["panorama"], 30)
    assert all(len(found) == 8 for found in neighbours_of(panoramas, 2.0))
    nearest = np.argsort([np.linalg.norm(c.eye - panoramas[0].eye) for c in panoramas])[1:17]
    assert set(neighbours_of(panoramas, 2.0)[0]) <= set(nearest.tolist())


def test_fisheyes_may_differ_by_a_larger_angle():
    def pair(projection, degrees):
        a = np.radians(degrees)
        turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
        R = (np.eye(3), turn)
        return [Camera(R[i], (i, 0, 0), 20, 20, 20, 20, 40, 40).through(projection) for i in (0, 1)]

    for projection, degrees, neighbours in (
        (FISHEYE, 50, [(1,), (0,)]),
        (FISHEYE, 70, [(), ()]),
        (Projection(), 50, [(), ()]),
        (Projection(), 20, [(1,), (0,)]),
    ):
        assert neighbours_of(pair(projection, degrees), 1.0) == neighbours


def test_orthographic_photos_are_refused(room):
    view = room.train[0]
    flat = Camera(np.eye(3), (0, 0, 0), 9, 9, 9, 9, view.camera.H, view.camera.W)
    flat = View(flat.through(Projection("orthographic")), view.read().image)
    with pytest.raises(ArgumentError, match="surface: needs rays that meet .* orthographic"):
        training(recipe(10, surface=True), dataclasses.replace(room, train=(flat,)), load_backend("cpu"))
