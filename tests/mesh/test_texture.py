"""Textures: a layout without overlap, and photos that paint what they see."""

import sys

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.mesh.texture import GUTTER, TextureSettings, TextureView, covered_texels, laid_out, textured
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.mesh import Mesh

SIZE = 96
SMALL = TextureSettings(size=192)


def ball(count=24):
    """A sphere of radius 1 of quads cut in two, without poles of many faces: a cube blown up."""
    axis = np.linspace(-1, 1, count // 2 + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    n = len(axis)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.concatenate([np.stack([i, i + n, i + n + 1], 1), np.stack([i, i + n + 1, i + 1], 1)])
    vertices, faces = [], []
    for k in range(3):
        for side in (1.0, -1.0):
            face = np.roll(np.stack([np.full(len(u), side), u * side, v], axis=1), k, axis=1)
            faces.append(quads + len(u) * len(vertices))
            vertices.append(face)
    points = np.concatenate(vertices)
    _, first, inverse = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    directions = points[first] / np.linalg.norm(points[first], axis=1, keepdims=True)
    return Mesh(directions, inverse.ravel()[np.concatenate(faces)])


def paint(points):
    """The colour of places, 0 to 255."""
    return 127.5 + 100 * np.sin(3 * points + [0, 1, 2])


def cameras(count=12):
    for k in range(count):
        height = 1 - 2 * (k + 0.5) / count
        turn = k * 2.399963
        eye = 3.2 * np.array(
            [np.cos(turn) * np.sqrt(1 - height**2), height, np.sin(turn) * np.sqrt(1 - height**2)]
        )
        yield Camera.looking_at(eye, [0.0, 0, 0], 130.0, 130.0, SIZE, SIZE)


def photo(camera, blocker=None):
    """A photo and depth map of the sphere, and of a black sphere in front of it."""
    v, u = np.mgrid[:SIZE, :SIZE].astype(float)
    rays = (
        np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
        @ camera.R
    )
    depth, image = np.full((SIZE, SIZE), np.inf), np.full((SIZE, SIZE, 3), 90.0)
    for centre, radius in [((0, 0, 0), 1.0)] + ([blocker] if blocker else []):
        b, c = rays @ (camera.eye - centre), ((camera.eye - centre) ** 2).sum() - radius**2
        a = (rays**2).sum(axis=-1)
        root = b**2 - a * c
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        hit = (root > 0) & (t < depth)
        depth = np.where(hit, t, depth)
        shade = paint(camera.eye + t[..., None] * rays) if radius == 1.0 else 0.0
        image = np.where(hit[..., None], shade, image)
    return TextureView(camera, np.rint(image).astype(np.uint8), depth.astype(np.float32))


def errors(mesh):
    """Return random places on the mesh, and how far the texture there is from their colours."""
    rng = np.random.default_rng(0)
    face = rng.integers(0, len(mesh.faces), 4000)
    weights = rng.dirichlet([2, 2, 2], len(face))
    points = np.einsum("nk,nkd->nd", weights, mesh.corners[face])
    uvs = np.einsum("nk,nkd->nd", weights, mesh.texture.uvs[face])
    h, w = mesh.texture.image.shape[:2]
    found = mesh.texture.image[(uvs[:, 1] * h).astype(int), (uvs[:, 0] * w).astype(int)]
    return points, np.abs(found - paint(points / np.linalg.norm(points, axis=1, keepdims=True))).max(axis=1)


def test_the_layout_has_no_overlap_and_room_for_gutters():
    mesh = ball()
    uvs, height, width = laid_out(mesh, 192)
    assert uvs.shape == (len(mesh.faces), 3, 2) and uvs.min() >= 0 and uvs.max() <= 1
    corners = uvs * [width, height]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    rows, columns = np.mgrid[:height, :width]
    covered = np.zeros((height, width), int)
    for one, two, three in corners:
        sides = [
            (q[0] - p[0]) * (rows + 0.5 - p[1]) - (q[1] - p[1]) * (columns + 0.5 - p[0])
            for p, q in ((one, two), (two, three), (three, one))
        ]
        covered += (np.min(sides, axis=0) > 1e-3) | (np.max(sides, axis=0) < -1e-3)
    assert covered.max() == 1 and covered.sum() == pytest.approx(areas.sum(), rel=0.1)
    ratio = areas / np.linalg.norm(mesh.face_normals(), axis=1)
    assert np.ptp(ratio) < 0.8 * ratio.mean()


def test_photos_paint_the_mesh():
    mesh = ball()
    views = [photo(camera) for camera in cameras()]
    done = textured(mesh, views, SMALL)
    assert np.array_equal(done.faces, mesh.faces) and np.array_equal(done.vertices, mesh.vertices)
    _, wrong = errors(done)
    assert np.median(wrong) < 4 and np.quantile(wrong, 0.99) < 16
    again = textured(mesh, iter(views), SMALL)
    assert again.texture.image.tobytes() == done.texture.image.tobytes()
    assert again.texture.uvs.tobytes() == done.texture.uvs.tobytes()


def test_what_stands_in_front_paints_nothing_if_the_depth_says_so():
    """A black ball hides part of every photo of one side; without it in the depth, it would paint the mesh."""
    blocker = ((0.0, 0.9, 0.9), 0.25)
    mesh = ball()
    views = [photo(camera, blocker) for camera in cameras()]
    _, wrong = errors(textured(mesh, views, SMALL))
    assert np.quantile(wrong, 0.9) < 16
    blind = [TextureView(view.camera, view.image, photo(view.camera).depth) for view in views]
    points, worse = errors(textured(mesh, blind, SMALL))
    near = np.linalg.norm(points - [0, 0.7, 0.7], axis=1) < 0.2
    assert np.median(worse[near]) > 40 and np.median(wrong[near]) < 0.5 * np.median(worse[near])


def test_unseen_places_take_colours_of_vertices_or_of_their_neighbours():
    mesh = ball()
    views = [photo(camera) for camera in cameras() if camera.eye[2] < 1]
    colors = np.tile(np.float32([1, 0, 0]), (len(mesh.vertices), 1))
    done = textured(Mesh(mesh.vertices, mesh.faces, colors), views, SMALL)
    back = done.corners.mean(axis=1)[:, 2] > 0.97
    h, w = done.texture.image.shape[:2]
    uvs = done.texture.uvs[back].mean(axis=1)
    found = done.texture.image[(uvs[:, 1] * h).astype(int), (uvs[:, 0] * w).astype(int)]
    assert len(found) and (found == [255, 0, 0]).all()
    _, wrong = errors(textured(mesh, views, SMALL))
    assert np.quantile(wrong, 0.7) < 16
    with pytest.raises(ArgumentError, match="no photo sees"):
        textured(mesh, [], SMALL)


def test_charts_are_surrounded_by_their_own_colour():
    mesh = ball()
    white = [
        TextureView(
            v.camera,
            np.full_like(v.image, 200),
            np.where(np.isfinite(v.depth), v.depth, 0).astype(np.float32),
        )
        for v in map(photo, cameras())
    ]
    done = textured(mesh, white, SMALL)
    assert (done.texture.image == 200).all()
    colors = (0.3 * mesh.vertices + 0.5).astype(np.float32)
    image = textured(Mesh(mesh.vertices, mesh.faces, colors), [], SMALL).texture.image
    height, width = image.shape[:2]
    _, _, place = covered_texels(done.texture.uvs, height, width)
    inside = np.zeros(height * width, dtype=bool)
    inside[place] = True
    inside = inside.reshape(height, width)
    distance, (rows, columns) = distance_transform_edt(~inside, return_indices=True)
    near, far = distance <= GUTTER, distance > GUTTER
    assert np.array_equal(image[near], image[rows, columns][near])
    assert (image[far] == np.rint(image[inside].mean(axis=0))).all() and far.any()


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("size: is 3", {"size": 3}),
        ("best: is 0", {"best": 0}),
        ("tolerance", {"tolerance": 0.0}),
        ("steepest", {"steepest": 90}),
    ],
)
def test_settings_out_of_range_are_named(words, change):
    with pytest.raises(ArgumentError, match=words):
        TextureSettings(**change)


def test_wrong_calls_are_named(monkeypatch):
    mesh = ball(8)
    view = photo(next(iter(cameras())))
    with pytest.raises(ArgumentError, match="96x96 px, but its photo"):
        textured(mesh, [TextureView(view.camera, view.image[:9], view.depth[:9])], SMALL)
    with pytest.raises(ArgumentError, match="no faces"):
        textured(Mesh(mesh.vertices, mesh.faces[:0]), [], SMALL)
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(ArgumentError, match=r"needs xatlas.*pip install"):
        textured(mesh, [view], SMALL)
