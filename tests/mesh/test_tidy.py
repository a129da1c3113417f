"""Tidying: components, holes, decimation, and what must not happen to a closed mesh."""

import sys

import numpy as np
import pytest
from skimage.measure import marching_cubes

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.mesh.tidy import (
    TidySettings,
    decimated,
    flipped_faces,
    tidied,
    with_filled_holes,
    with_large_components,
    without_spoiled_faces,
)
from gsplat_edu.mesh.topology import boundary_loops, component_labels, opposite_half_edges, separated
from gsplat_edu.scene.mesh import Mesh, Texture
from gsplat_edu.scene.polygons import triangles_of


def edges_by_faces(mesh):
    """Count edges with one face, with more than two, and directed edges that two faces have."""
    half = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = np.unique(np.sort(half, axis=1), axis=0, return_counts=True)
    _, directed = np.unique(half, axis=0, return_counts=True)
    return int((counts == 1).sum()), int((counts > 2).sum()), int((directed > 1).sum())


CLOSED = (0, 0, 0)


def volume(mesh):
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


def euler(mesh):
    return len(np.unique(mesh.faces)) - mesh.faces.size // 2 + len(mesh.faces)


def level_set(field, count=40, noise=0.0, seed=0):
    """The surface where a signed distance in a cube of side 2 is zero."""
    axis = np.linspace(-1, 1, count)
    values = field(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)) + 1e-9
    values += noise * 2 / count * np.random.default_rng(seed).normal(size=values.shape)
    vertices, faces, _, _ = marching_cubes(np.pad(values, 1, constant_values=1.0), 0.0)
    mesh = Mesh((vertices.astype(np.float64) - 1) * 2 / (count - 1) - 1, faces[:, ::-1].astype(np.int64))
    return mesh if volume(mesh) > 0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def sphere(X):
    return np.linalg.norm(X, axis=-1) - 0.7


def torus(X):
    return np.hypot(np.hypot(X[..., 0], X[..., 1]) - 0.6, X[..., 2]) - 0.2


def maze(X):
    x, y, z = np.moveaxis(6 * X, -1, 0)
    walls = np.abs(np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)) - 0.4
    return np.maximum(walls, np.linalg.norm(X, axis=-1) - 0.9)


def with_hole(mesh, keep):
    return Mesh(mesh.vertices, mesh.faces[keep(mesh.corners.mean(axis=1))], mesh.colors).used()


def painted(mesh):
    return Mesh(mesh.vertices, mesh.faces, (mesh.vertices * 0.3 + 0.5).astype(np.float32))


def box(size, start=(0, 0, 0)):
    """A closed box of twelve faces."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], *pair] for q in quads for pair in (q[1:3], q[2:4])])
    return Mesh(corners * np.array(size, np.float64) + start, faces)


def both(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def test_the_box_of_these_tests_is_closed():
    assert edges_by_faces(box((1, 2, 3))) == CLOSED and volume(box((1, 2, 3))) == pytest.approx(6)


@pytest.mark.parametrize("reach", [0.06, 0.12])
@pytest.mark.parametrize("bent", [False, True])
def test_a_small_hole_of_a_sphere_is_closed(reach, bent):
    """The hole is about a corner of the box or on a slope; its loop is bent by marching cubes."""
    whole = painted(level_set(sphere))
    towards = np.array([1, 1, 1]) / np.sqrt(3) if bent else np.array([0, 0, 1.0])
    holed = with_hole(whole, lambda centres: np.linalg.norm(centres - 0.7 * towards, axis=1) > reach)
    assert len(boundary_loops(holed)) == 1
    limits = {} if reach < 0.1 else {"short": 0.5}
    filled = with_filled_holes(holed, **limits)
    assert edges_by_faces(filled) == CLOSED and euler(filled) == 2
    assert volume(filled) == pytest.approx(volume(whole), rel=5e-3)
    assert np.abs(filled.colors - (filled.vertices * 0.3 + 0.5)).max() < 0.01
    assert np.array_equal(filled.faces[: len(holed.faces)], holed.faces)
    again = with_filled_holes(holed, **limits)
    assert filled.faces.tobytes() == again.faces.tobytes()
    assert filled.vertices.tobytes() == again.vertices.tobytes()


def test_rooms_patches_and_dishes_stay_open():
    room = Mesh(box((4, 3, 5)).vertices, box((4, 3, 5)).faces[:-2])
    assert with_filled_holes(room).faces.shape == (10, 3)
    ball = level_set(sphere)
    door = with_hole(ball, lambda centres: centres[:, 2] < 0.5)
    assert len(boundary_loops(door)) == 1 and len(with_filled_holes(door).faces) == len(door.faces)
    # a small flat patch has a short rim, and so has a small dish, both beside a large ball
    patch = Mesh(np.array([[3.0, 0, 0], [3.05, 0, 0], [3, 0.05, 0]]), np.array([[0, 1, 2]]))
    dish = with_hole(ball, lambda centres: centres[:, 2] > 0.65)
    assert len(dish.faces) > 10
    scene = both(ball, patch, Mesh(dish.vertices * 0.1 + [0, 3, 0], dish.faces))
    assert len(boundary_loops(scene)) == 2
    assert len(with_filled_holes(scene).faces) == len(scene.faces)


def test_a_hole_that_no_fan_fills_gets_the_triangles_of_least_area():
    """A loop in the shape of a U, in a plane and bent."""
    u = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]])
    for bend in (0.0, 0.3):
        ring = np.concatenate([u, bend * (u[:, :1] - 1.5) ** 2], axis=1)
        triangles = triangles_of(ring)
        normals = Mesh(ring, triangles).face_normals()
        assert len(triangles) == 6 and (normals[:, 2] > 0).all()
        assert normals[:, 2].sum() / 2 == pytest.approx(7)
    # the same loop at the top of walls that lean inward; the loop at their foot is the rim of a dish
    top = np.concatenate([u, np.zeros((8, 1))], axis=1)
    foot = (top - [1.5, 1.5, 0]) * 1.2 + [1.5, 1.5, -4]
    rim, after = np.arange(8), (np.arange(8) + 1) % 8
    walls = np.concatenate(
        [np.stack([after, rim, rim + 8], axis=1), np.stack([after, rim + 8, after + 8], axis=1)]
    )
    scene = both(Mesh(np.concatenate([top, foot]), walls), box((200, 1, 1), (9, 9, 9)))
    assert len(boundary_loops(scene)) == 2
    filled = with_filled_holes(scene)
    assert len(filled.faces) == len(scene.faces) + 6 and edges_by_faces(filled) == (8, 0, 0)
    assert len(filled.vertices) == len(scene.vertices)


def test_components_are_judged_by_area():
    large, small, tiny = box((2, 2, 2)), box((0.5, 0.5, 0.5), (5, 0, 0)), box((0.1, 0.1, 0.1), (0, 5, 0))
    scene = both(tiny, large, small)
    assert component_labels(scene).tolist() == [0] * 12 + [1] * 12 + [2] * 12
    kept = with_large_components(scene)  # 24, 1.5 and 0.06
    assert len(kept.faces) == 24 and np.array_equal(kept.corners[:12], large.corners)
    assert len(with_large_components(scene, 0.06).faces) == 12
    assert len(with_large_components(scene, 0.0).faces) == 36
    alone = with_large_components(scene, 0.0, largest=True)
    assert np.array_equal(alone.vertices, large.vertices)
    image = Texture(np.zeros((2, 2, 3), np.uint8), np.arange(36 * 6, dtype=np.float32).reshape(36, 3, 2))
    textured = Mesh(scene.vertices, scene.faces, None, image)
    assert np.array_equal(with_large_components(textured).texture.uvs, image.uvs[12:])


def test_two_boxes_that_touch_are_two_components():
    """At a corner, and along an edge where four faces meet: each keeps its own vertices."""
    corner = without_spoiled_faces(both(box((1, 1, 1)), box((1, 1, 1), (1, 1, 1))))
    assert len(corner.vertices) == 15 and len(separated(corner).vertices) == 16
    edge = without_spoiled_faces(both(box((1, 1, 1)), box((1, 1, 1), (1, 1, 0))))
    assert len(edge.vertices) == 14 and edges_by_faces(edge) == (0, 1, 2)
    apart = separated(edge)
    assert edges_by_faces(apart) == CLOSED and len(apart.vertices) == 16
    assert volume(apart) == pytest.approx(2) and component_labels(apart).max() == 1
    assert (opposite_half_edges(apart) >= 0).all()


def blocks(filled):
    """The surface of cubes: those of a grid that are filled."""
    sides = []
    padded = np.pad(filled, 1)
    for cell in np.argwhere(filled):
        cube = box((1, 1, 1), cell)
        for axis in range(3):
            for step in (-1, 1):
                if not padded[tuple(cell + 1 + step * np.eye(3, dtype=int)[axis])]:
                    first = 4 * axis + (step > 0) * 2
                    sides.append(Mesh(cube.vertices, cube.faces[first : first + 2]))
    return without_spoiled_faces(both(*sides))


def test_an_edge_that_one_fan_meets_twice_is_halved():
    """Two pillars between floor and ceiling touch along an edge: all faces at each of its ends are one fan."""
    filled = np.ones((2, 2, 3), dtype=bool)
    filled[[0, 1], [0, 1], 1] = False
    pinched = painted(blocks(filled))
    assert edges_by_faces(pinched) == (0, 1, 2)
    whole = separated(pinched)
    assert edges_by_faces(whole) == CLOSED and volume(whole) == pytest.approx(10)
    added = whole.vertices[len(pinched.vertices) :]
    assert added.tolist() == [[1, 1, 1.5]] and len(whole.faces) == len(pinched.faces) + 2
    assert np.allclose(whole.colors, whole.vertices * 0.3 + 0.5)


def test_spoiled_faces_go_and_the_rest_stays_closed():
    whole = box((1, 1, 1))
    faces = np.concatenate(
        [whole.faces, whole.faces[:3], whole.faces[5:6, ::-1], whole.faces[5:6], [[0, 0, 1]]]
    )
    assert np.array_equal(without_spoiled_faces(Mesh(whole.vertices, faces)).faces, whole.faces)
    flap = Mesh(
        np.concatenate([whole.vertices, [[9.0, 9, 9]]]), np.concatenate([whole.faces, [[0, 1, 8], [1, 0, 8]]])
    )
    assert np.array_equal(without_spoiled_faces(flap).faces, whole.faces)
    soup = Mesh(whole.corners.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert (
        len(without_spoiled_faces(soup).vertices) == 8
        and edges_by_faces(without_spoiled_faces(soup)) == CLOSED
    )
    # a needle between two faces of the box: its third corner lies on the edge that they shared
    a, b, c = whole.faces[0]
    middle = whole.vertices[[a, b]].mean(axis=0)
    needle = np.array([[a, 8, c], [8, b, c], [a, b, 8]])
    cut = Mesh(np.concatenate([whole.vertices, [middle]]), np.concatenate([whole.faces[1:], needle]))
    assert edges_by_faces(cut) == CLOSED
    clean = without_spoiled_faces(cut)
    assert edges_by_faces(clean) == CLOSED and volume(clean) == pytest.approx(1)
    assert np.linalg.norm(clean.face_normals(), axis=1).min() > 0.1


@pytest.mark.parametrize(("field", "noise"), [(sphere, 0), (torus, 0.3), (maze, 0), (maze, 0.3)])
@pytest.mark.parametrize("share", [0.2, 0.05])
def test_closed_meshes_stay_closed_when_decimated(field, noise, share):
    whole = tidied(level_set(field, noise=noise))
    assert edges_by_faces(whole) == CLOSED
    wanted = int(share * len(whole.faces))
    small = decimated(painted(whole), wanted)
    assert 0.9 * wanted - 2 <= len(small.faces) <= wanted
    assert edges_by_faces(small) == CLOSED
    assert volume(small) == pytest.approx(volume(whole), rel=0.01 if share > 0.1 else 0.05)
    assert np.linalg.norm(small.face_normals(), axis=1).min() > 0
    assert np.abs(small.colors - (small.vertices * 0.3 + 0.5)).mean() < 0.03
    again = decimated(painted(whole), wanted)
    for one, other in (
        (small.vertices, again.vertices),
        (small.faces, again.faces),
        (small.colors, again.colors),
    ):
        assert one.tobytes() == other.tobytes()


def test_decimation_far_from_the_origin_and_with_a_boundary():
    ball = level_set(sphere)
    far = decimated(Mesh(ball.vertices + 1e6, ball.faces), 400)
    near = decimated(ball, 400)
    assert np.array_equal(far.faces, near.faces) and np.abs(far.vertices - 1e6 - near.vertices).max() < 1e-6
    bowl = decimated(with_hole(ball, lambda centres: centres[:, 2] < 0.3), 300)
    assert edges_by_faces(bowl)[1:] == (0, 0) and len(boundary_loops(bowl)) == 1
    assert np.abs(bowl.vertices[:, 2].max() - 0.3) < 0.06


def test_faces_that_are_turned_over_are_unfolded(monkeypatch):
    """fast-simplification seldom turns a face over; here it is made to, by a vertex beyond its neighbours."""
    import fast_simplification

    ball = level_set(sphere)
    fine = decimated(ball, 400)
    spread = np.linalg.norm(fine.vertices - fine.vertices[0], axis=1)
    vertices = fine.vertices.copy()
    vertices[0] = (
        0.7 * np.array(vertices[np.argsort(spread)[30]]) / np.linalg.norm(vertices[np.argsort(spread)[30]])
    )
    folded = Mesh(vertices, fine.faces)
    assert flipped_faces(ball, folded).any()
    centre = ball.vertices.mean(axis=0)
    scale = np.abs(ball.vertices - centre).max()  # fast-simplification gets and returns them so
    monkeypatch.setattr(
        fast_simplification, "simplify", lambda *_, **__: ((folded.vertices - centre) / scale, folded.faces)
    )
    mended = decimated(ball, 400)
    assert not flipped_faces(ball, mended).any() and np.array_equal(mended.faces, fine.faces)
    assert np.abs(np.linalg.norm(mended.vertices, axis=1) - 0.7).max() < 0.05


def test_the_sides_of_a_thin_wall_keep_their_colours():
    def wall(X):
        return np.maximum(np.abs(X[..., :2]).max(axis=-1) - 0.8, np.abs(X[..., 2]) - 0.03)

    mesh = level_set(wall, 50, noise=0.1)
    up = mesh.vertices[:, 2] > 0
    colors = np.where(up[:, None], [1.0, 0, 0], [0, 0, 1.0]).astype(np.float32)
    small = decimated(Mesh(mesh.vertices, mesh.faces, colors), 600)
    inner = np.abs(small.vertices[:, :2]).max(axis=1) < 0.7
    assert inner.sum() > 4
    wanted = np.where(small.vertices[inner, 2:] > 0, [1.0, 0, 0], [0, 0, 1.0])
    assert np.abs(small.colors[inner] - wanted).max() < 0.2


def test_all_steps_together():
    ball = level_set(sphere)
    holed = with_hole(ball, lambda centres: np.linalg.norm(centres - [0, 0, 0.7], axis=1) > 0.06)
    scene = both(holed, box((0.05, 0.05, 0.05), (2, 2, 2)))
    done = tidied(scene, TidySettings(faces=500))
    assert edges_by_faces(done) == CLOSED and 490 <= len(done.faces) <= 500 and euler(done) == 2
    plain = tidied(scene, TidySettings(share=0, holes=False))
    assert len(plain.faces) == len(scene.faces)
    assert len(tidied(scene, TidySettings(largest=True)).faces) > len(holed.faces)
    empty = tidied(Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64)), TidySettings(faces=10))
    assert len(empty.faces) == len(empty.vertices) == 0
    assert decimated(done, 500) is done


def test_wrong_calls_are_named(monkeypatch):
    ball = level_set(sphere, 12)
    with pytest.raises(ArgumentError, match="share: is 2"):
        with_large_components(ball, 2.0)
    with pytest.raises(ArgumentError, match="faces: is 3"):
        decimated(ball, 3)
    image = Texture(np.zeros((2, 2, 3), np.uint8), np.zeros((len(ball.faces), 3, 2), np.float32))
    for step in (with_filled_holes, lambda mesh: decimated(mesh, 10)):
        with pytest.raises(ArgumentError, match="has a texture"):
            step(Mesh(ball.vertices, ball.faces, None, image))
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ArgumentError, match=r'fast-simplification.*pip install .*\[mesh\]"') as caught:
        decimated(ball, 10)
    assert "\n" not in str(caught.value)
