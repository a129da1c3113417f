"""Smoothing of meshes: noise goes, sizes and borders stay."""

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.mesh.smooth import smoothed
from gsplat_edu.mesh.topology import vertex_normals
from gsplat_edu.scene.mesh import Mesh
from known_surfaces import torus


def noisy(mesh, amount, seed=0):
    rng = np.random.default_rng(seed)
    return Mesh(mesh.vertices + amount * rng.normal(size=mesh.vertices.shape), mesh.faces)


def distances(mesh, major=1.0, minor=0.4):
    """Return the signed distance of each vertex from a torus around z."""
    x, y, z = mesh.vertices.T
    return np.hypot(np.hypot(x, y) - major, z) - minor


def test_noise_of_a_torus_goes_and_its_size_stays():
    """White noise s leaves about s / 3 (the mean of seven vertices and less); the ring's waves are 96 and 48 edges."""
    true = torus(96, 48)
    before = noisy(true, 0.01)
    after = smoothed(before)
    wrong = [np.abs(distances(mesh)) for mesh in (before, after)]
    assert wrong[1].mean() < 0.45 * wrong[0].mean()
    assert abs(distances(after).mean()) < 0.002, "it neither shrinks nor grows"
    normals = [(vertex_normals(mesh) * vertex_normals(true)).sum(axis=1) for mesh in (before, after)]
    angles = [np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() for cosine in normals]
    assert angles[1] < 0.4 * angles[0]
    assert (after.faces == before.faces).all()


def test_the_border_stays_where_it_is():
    true = torus(48, 24)
    vertices = np.concatenate([true.vertices, np.ones((1, 3))])  # no face has the last one
    open_mesh = noisy(Mesh(vertices, true.faces[200:]), 0.01)
    after = smoothed(open_mesh)
    edges = np.concatenate([open_mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    given = {tuple(edge) for edge in edges.tolist()}
    border = sorted({v for a, b in given if (b, a) not in given for v in (a, b)})
    assert len(border) > 20
    assert (after.vertices[border] == open_mesh.vertices[border]).all()
    assert (after.vertices[-1] == open_mesh.vertices[-1]).all()
    moved = np.setdiff1d(open_mesh.faces, border)
    assert (np.abs(after.vertices - open_mesh.vertices).max(axis=1)[moved] > 0).all()


def test_nothing_to_smooth():
    true = torus(12, 8)
    assert smoothed(true, 0) is true
    empty = Mesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int64))
    assert smoothed(empty) is empty
    with pytest.raises(ArgumentError, match="rounds"):
        smoothed(true, -1)


def test_the_same_bytes_each_time():
    mesh = noisy(torus(96, 48), 0.01)
    assert smoothed(mesh).vertices.tobytes() == smoothed(mesh).vertices.tobytes()
