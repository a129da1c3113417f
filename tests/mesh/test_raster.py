"""Drawing a mesh: against rays cast at single faces, with faces that cross the camera's plane, and its colours."""

import numpy as np
import pytest

import gsplat_edu.mesh.raster as raster_module
from gsplat_edu import Camera
from gsplat_edu.mesh.raster import lit, picture, rasterized
from gsplat_edu.scene.mesh import Mesh, Texture

CAMERA = Camera.looking_at(eye=(0.3, -0.4, -3.0), target=(0, 0, 0), fx=40, fy=44, H=37, W=41)


def cast(mesh, camera):
    """Return the nearest face and its depth for each pixel by Moller and Trumbore's test of every face."""
    rays = camera.rays().reshape(-1, 3)
    face, depth = np.full(len(rays), -1), np.full(len(rays), np.inf)
    for index, (a, b, c) in enumerate(mesh.corners):
        across = np.cross(rays, c - a)
        det = across @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = across @ (camera.eye - a) / det
            other = np.cross(camera.eye - a, b - a)
            v, t = rays @ other / det, (c - a) @ other / det
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < depth)
        face[hit], depth[hit] = index, t[hit]
    return face.reshape(camera.H, camera.W), depth.reshape(camera.H, camera.W)


def triangles(seed, count=60, spread=1.5):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(3 * count, 3)) * spread
    return Mesh(vertices, np.arange(3 * count).reshape(-1, 3), rng.uniform(size=(3 * count, 3)).astype("f4"))


@pytest.mark.parametrize("seed", range(3))
def test_faces_and_depths_are_those_of_cast_rays(seed, monkeypatch):
    """The spread places faces beside, behind and across the camera's plane."""
    monkeypatch.setattr(raster_module, "FACES", 17)
    monkeypatch.setattr(raster_module, "PAIRS", 500)
    mesh = triangles(seed, spread=2.5)
    z = CAMERA.world_to_cam(mesh.vertices)[:, 2][mesh.faces]
    assert ((z.min(axis=1) < 0) & (z.max(axis=1) > 0)).any()
    found = rasterized(mesh, CAMERA)
    face, depth = cast(mesh, CAMERA)
    near = depth > 0.01 * z.max()  # nearer faces are not drawn
    assert near.mean() > 0.9 and (face >= 0).mean() > 0.5
    assert np.array_equal(found.face[near], face[near])
    np.testing.assert_allclose(found.depth[near], depth[near], rtol=1e-9)


def test_weights_are_of_the_place_in_space_not_on_the_screen():
    mesh = triangles(5)
    found = rasterized(mesh, CAMERA)
    seen = found.covered
    points = found.of_vertices(mesh, mesh.vertices)[seen]
    np.testing.assert_allclose(found.weights[seen].sum(axis=-1), 1, atol=1e-9)
    np.testing.assert_allclose(points, (CAMERA.eye + found.depth[..., None] * CAMERA.rays())[seen], atol=1e-9)


def grid(n=9):
    """Return a square in the plane z = 0 whose inner vertices lie on pixels, so that edges hit pixel centres."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]))


def test_shared_edges_lose_no_pixel():
    camera = Camera(np.eye(3), (0, 0, -2), 32, 32, 20, 20, 41, 41)
    found = rasterized(grid(), camera)
    inside = np.zeros((41, 41), dtype=bool)
    inside[4:37, 4:37] = True
    assert np.array_equal(found.covered, inside)
    np.testing.assert_allclose(found.depth[inside], 2)


def test_colours_are_the_texture_the_vertices_or_grey():
    camera, mesh = Camera(np.eye(3), (0, 0, -2), 32, 32, 20, 20, 41, 41), grid()
    found = rasterized(mesh, camera)
    ramp = np.stack(
        [(mesh.vertices[:, 0] + 1) / 2, (mesh.vertices[:, 1] + 1) / 2, 0 * mesh.vertices[:, 0]], 1
    )
    colored = Mesh(mesh.vertices, mesh.faces, ramp.astype("f4"))
    image = picture(colored, found, (1, 2, 3))
    assert tuple(image[0, 0]) == (1, 2, 3) and tuple(image[20, 20]) == (128, 128, 0)
    assert tuple(image[4, 36]) == (255, 0, 0)
    # the same ramp in a texture of 6 x 6 texels, whose outer centres lie at -1 and 1
    row = np.linspace(0, 255, 6).astype(np.uint8)
    texels = np.stack([np.tile(row, (6, 1)), np.tile(row[:, None], (1, 6)), np.zeros((6, 6))], -1)
    uvs = ((ramp[:, :2] * 5 + 0.5) / 6).astype("f4")[mesh.faces]
    textured = Mesh(mesh.vertices, mesh.faces, None, Texture(texels.astype(np.uint8), uvs))
    np.testing.assert_allclose(picture(textured, found, (1, 2, 3)), image.astype(int), atol=1)
    assert (picture(mesh, found, (1, 2, 3))[found.covered] == 200).all()


def test_light_falls_off_with_the_angle():
    camera = Camera(np.eye(3), (0, 0, -2), 32, 32, 20, 20, 41, 41)
    mesh = grid()
    light = lit(mesh, rasterized(mesh, camera), camera)
    assert light[20, 20] == 1 and light[0, 0] == 0
    assert light[4, 20] == pytest.approx(2 / np.hypot(2, 1))


def test_an_empty_mesh_covers_nothing():
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert not rasterized(empty, CAMERA).covered.any()
