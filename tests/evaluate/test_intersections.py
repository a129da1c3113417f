"""Self-intersections: planted ones are all found, touching is none."""

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.intersections import intersecting_faces, self_intersections
from gsplat_edu.scene.mesh import Mesh
from known_surfaces import joined, torus


def triangle(*corners):
    return Mesh(np.array(corners, dtype=np.float64), np.array([[0, 1, 2]]))


FLAT = triangle([0, 0, 0], [4, 0, 0], [0, 4, 0])


@pytest.mark.parametrize(
    ("other", "found"),
    [
        (triangle([1, 1, -1], [1.5, 1, 1], [1, 1.5, 1]), 2),  # its edges pass through
        (triangle([1, 1, -1], [1.2, 1.2, 1], [9, 8, 1]), 2),  # one edge of each passes through
        (triangle([1, 1, 0], [1.5, 1, 1], [1, 1.5, 1]), 0),  # a corner touches
        (triangle([0, 0, 0], [4, 0, 0], [0, 0, 4]), 0),  # an edge in common, by place
        (triangle([0, 0, 0], [4, 0, 0], [0, 3, 0]), 0),  # in the same plane
        (triangle([1, 1, 1e-9], [1.5, 1, 1], [1, 1.5, 1]), 0),  # just above
        (triangle([1, 1, -1e-9], [1.5, 1, 1], [1, 1.5, 1]), 2),  # just below
        (triangle([3, 3, -1], [3, 3, 1], [4, 4, 1]), 0),  # beside it, though the boxes overlap
    ],
)
@pytest.mark.parametrize("moved", [0.0, 1e3])
def test_two_triangles(other, found, moved):
    both = joined(FLAT, other)
    # 1e-9 beside 1,000 is still 10,000 roundings of its coordinates
    assert intersecting_faces(Mesh(both.vertices + moved, both.faces)).sum() == found


def test_faces_that_share_a_corner_can_intersect_beyond_it():
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [2, 1, -1.0], [2, 1, 1]])
    assert intersecting_faces(Mesh(vertices, np.array([[0, 1, 2], [0, 3, 4]]))).all()
    apart = vertices + np.array([[0, 0, 0]] * 3 + [[0, 0, 2]] * 2)
    assert not intersecting_faces(Mesh(apart, np.array([[0, 1, 2], [0, 3, 4]]))).any()


def brute_force(mesh):
    """Solve for the crossing of every edge with every face."""
    hit = np.zeros(len(mesh.faces), bool)
    corners = mesh.corners
    for one in range(len(corners)):
        for two in range(len(corners)):
            if one == two or len(set(mesh.faces[one]) & set(mesh.faces[two])) > 1:
                continue
            a, b, c = corners[two]
            for k in range(3):
                p, q = corners[one, k], corners[one, (k + 1) % 3]
                system = np.stack([q - p, a - b, a - c], axis=1)
                if abs(np.linalg.det(system)) < 1e-14:
                    continue
                t, u, v = np.linalg.solve(system, a - p)
                if min(t, 1 - t, u, v, 1 - u - v) > 1e-9:
                    hit[one] = hit[two] = True
    return hit


def test_random_triangles_agree_with_brute_force():
    rng = np.random.default_rng(3)
    middles = rng.uniform(-1, 1, (60, 1, 3))
    corners = middles + rng.normal(size=(60, 3, 3)) * rng.choice([0.1, 0.3, 0.8], (60, 1, 1))
    soup = Mesh(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3))
    expected = brute_force(soup)
    assert 10 < expected.sum() < 58
    assert np.array_equal(intersecting_faces(soup), expected)
    wanted = np.arange(60) % 3 == 0
    assert np.array_equal(intersecting_faces(soup, wanted), expected & wanted)


def test_closed_surfaces_have_none_until_they_meet():
    ring = torus(48, 24, r=0.3)
    assert self_intersections(ring).found == 0
    upright = ring.vertices[:, [2, 0, 1]]
    linked = joined(ring, Mesh(upright + np.array([0.0, 1.0, 0.0]), ring.faces))
    assert self_intersections(linked).found == 0, "two links of a chain do not touch"
    crossed = joined(ring, Mesh(upright + np.array([1.0, 0.013, 0.02]), ring.faces))
    whole = self_intersections(crossed)
    assert 0 < whole.found < len(crossed.faces) / 2 and whole.tested == len(crossed.faces)
    part = self_intersections(crossed, most=len(crossed.faces) // 3)
    assert part.tested == -(-len(crossed.faces) // 3) and part.faces == len(crossed.faces)
    assert part.share == pytest.approx(whole.share, rel=0.4)


def test_nothing_and_refusals():
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert self_intersections(empty) == (0, 0, 0) and self_intersections(empty).share == 0.0
    with pytest.raises(ArgumentError, match="most"):
        self_intersections(FLAT, most=0)
