"""From splats to a mesh: a ball of flat splats becomes a closed ball; what is left out is said."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, Camera, Gaussians, load_backend
from gsplat_edu.base.errors import NotEnoughMemoryError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.evaluate.surface import Comparison, score_surface
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.mesh.depths import checked, neighbours_of, render_depths
from gsplat_edu.mesh.extract import MeshSettings, default_voxel, extract_mesh, views_of_vertices
from gsplat_edu.mesh.tidy import TidySettings
from gsplat_edu.render.settings import RenderSettings

RADIUS = 0.8
SETTINGS = RenderSettings(jacobian_limit=1.3)
COUNT = 3_000


def ball(opacity_logit=4.0):
    """Return flat splats on a ball, in stripes of two colours."""
    index = np.arange(COUNT) + 0.5
    z, turn = 1 - 2 * index / COUNT, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    # the rotation that takes the z axis, which is the shortest, to the normal
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(COUNT)], axis=1)
    shade = np.where(np.sin(8 * normals[:, 1]) > 0, 1.0, -1.0)
    as_tensor = torch.tensor
    return Gaussians(
        means=as_tensor(RADIUS * normals, dtype=torch.float32),
        quats=as_tensor(quats, dtype=torch.float32),
        log_scales=as_tensor(np.log(np.tile([0.035, 0.035, 0.002], (COUNT, 1))), dtype=torch.float32),
        sh0=as_tensor(shade[:, None, None] * np.array([1.0, 0.0, -1.0]), dtype=torch.float32),
        sh_rest=torch.zeros(COUNT, 0, 3),
        logit_opacities=torch.full((COUNT,), float(opacity_logit)),
    )


def orbit(count=24, size=120):
    """Return cameras around the ball, from all sides."""
    index = np.arange(count) + 0.5
    y, turn = 0.9 * (1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - y * y)
    eyes = 3.0 * np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)
    return [
        (f"{i:02d}", Camera.looking_at(eye, (0, 0, 0), 1.4 * size, 1.4 * size, size, size))
        for i, eye in enumerate(eyes)
    ]


@pytest.fixture(scope="module")
def result():
    return extract_mesh(ball(), orbit(), SETTINGS, load_backend("cpu"))


def test_a_ball_of_splats_becomes_a_closed_ball(result):
    mesh = result.mesh
    shape = topology(mesh)
    assert shape.components == 1 and shape.boundary_edges == 0 and shape.euler == 2 and shape.manifold
    off = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
    # A splat's depth is that of its mean: between splats 0.045 apart, the surface is up to 0.3 mm below the ball.
    assert off.mean() < 0.3 * result.voxel and off.max() < 1.5 * result.voxel
    assert abs(shape.volume / (4 / 3 * np.pi * RADIUS**3) - 1) < 0.02
    outward = (mesh.face_normals() * mesh.corners.mean(axis=1)).sum(axis=1)
    assert (outward > 0).mean() > 0.999


def test_colours_are_those_of_the_splats(result):
    y = np.sin(8 * result.mesh.vertices[:, 1] / RADIUS)
    red, blue = result.mesh.colors[:, 0], result.mesh.colors[:, 2]
    clear = np.abs(y) > 0.8
    assert ((red > blue) == (y > 0))[clear].mean() > 0.98


def test_the_same_bits_for_any_number_of_threads(result):
    before, seen = torch.get_num_threads(), set()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            mesh = extract_mesh(ball(), orbit(8, 64), SETTINGS, load_backend("cpu")).mesh
            seen.add((mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.colors.tobytes()))
    finally:
        torch.set_num_threads(before)
    assert len(seen) == 1


def test_scores_against_the_truth_and_views_of_each_vertex(result):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scores = score_surface(result.mesh, (RADIUS * normals, normals), Comparison(result.voxel, samples=20_000))
    assert scores.distances.f1 > 0.98 and scores.normal_degrees < 8
    views = views_of_vertices(result.mesh, result.views, result.truncation)
    assert np.median(views) >= 5 and views.min() >= 1


def test_a_floater_that_other_views_see_through_is_left_out():
    gaussians = ball()
    cameras = orbit(24, 64)
    front = cameras[10][1]
    place = torch.tensor(0.45 * front.eye, dtype=torch.float32)
    more = gaussians[:1].map(torch.clone)
    floater = dataclasses.replace(more, means=place[None], log_scales=torch.full((1, 3), float(np.log(0.05))))
    both = Gaussians(
        **{name: torch.cat([t, getattr(floater, name)]) for name, t in gaussians.tensors().items()}
    )
    with one_thread():
        views = render_depths(both, cameras, SETTINGS, load_backend("cpu"))
    kept, counts = checked(views)
    near = views[10].depth < 2.0
    assert (near & (views[10].depth > 0)).sum() > 5
    assert not ((kept[10].depth > 0) & near).any() and counts.contradicted > 0
    assert (kept[10].depth > 0).sum() > 0.9 * ((views[10].depth > 2.0).sum())
    assert max(float(view.weight.max()) for view in kept) <= 1


def test_voxels_grow_until_the_volume_fits_and_a_given_size_does_not(result):
    small = extract_mesh(
        ball(), orbit(), SETTINGS, load_backend("cpu"), MeshSettings(max_bytes=result.volume_bytes // 3)
    )
    assert small.voxel > result.voxel and small.volume_bytes <= result.volume_bytes // 3
    assert any("so that the volume fits" in note for note in small.notes)
    with pytest.raises(NotEnoughMemoryError):
        extract_mesh(
            ball(),
            orbit(),
            SETTINGS,
            load_backend("cpu"),
            MeshSettings(voxel=result.voxel, max_bytes=result.volume_bytes // 3),
        )


def test_bounds_leave_a_hole_and_faces_are_reduced():
    bounds = np.array([[-2.0, -2, -2], [0.2, 2, 2]])
    settings = MeshSettings(bounds=bounds, tidy=TidySettings(faces=500))
    found = extract_mesh(ball(), orbit(), SETTINGS, load_backend("cpu"), settings)
    assert found.mesh.vertices[:, 0].max() < 0.2 + 3 * found.voxel
    assert topology(found.mesh).boundary_edges > 0 and len(found.mesh.faces) <= 500


def test_nothing_to_mesh_is_said():
    backend = load_backend("cpu")
    with pytest.raises(ArgumentError, match="at least one camera"):
        extract_mesh(ball(), [], SETTINGS, backend)
    with pytest.raises(ArgumentError, match="no view has a pixel with an alpha"):
        extract_mesh(ball(-6.0), orbit(4, 48), SETTINGS, backend)


def test_neighbours_look_at_the_same_from_elsewhere():
    cameras = [camera for _, camera in orbit(12, 32)]
    cameras.append(cameras[3])  # the same place
    for index in (0, 3, 7):
        found = neighbours_of(index, cameras, 3)
        assert index not in found and len(found) == 3
        apart = [float(np.linalg.norm(camera.eye - cameras[index].eye)) for camera in cameras]
        assert min(apart[i] for i in found) > 0
        nearest = sorted(distance for distance in apart if distance > 0)[:6]
        assert max(apart[i] for i in found) <= nearest[-1]
    assert default_voxel(render_depths(ball(), orbit(2, 32), SETTINGS, load_backend("cpu"))) > 0
