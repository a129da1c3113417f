"""Measures of a mesh agree with values computed by hand."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chisquare
from skimage.measure import marching_cubes

from gsplat_edu import ArgumentError, Camera
from gsplat_edu.base.errors import ShapeError
from gsplat_edu.evaluate.surface import (
    Comparison,
    sample_surface,
    score_points,
    score_surface,
    triangle_distances,
    visible_points,
)
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.scene.mesh import Mesh
from known_surfaces import joined, torus

EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
TRIANGLE = Mesh(np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
BOX_FACES = np.array(
    [
        *([0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]),
        *([2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]),
    ]
)


def box(*sides):
    """Return a box with one corner at the origin; outward faces, two triangles a side."""
    corners = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)], float)
    return Mesh(corners * sides, BOX_FACES)


def sheet(columns, rows, width=1.0, height=1.0, left=0.0, z=0.0):
    """Return a flat rectangle in the plane z, with normal +z."""
    x, y = np.meshgrid(np.linspace(left, left + width, columns + 1), np.linspace(0, height, rows + 1))
    vertices = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3)
    n = columns + 1
    first = (np.arange(rows)[:, None] * n + np.arange(columns)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + n + 1], 1), np.stack([first, first + n + 1, first + n], 1)]
    )
    return Mesh(vertices, faces)


# sampling


def test_samples_are_uniform_over_area():
    """Independent of the sampling by strata: random cells of the box, a chi-square of all counts."""
    mesh = box(1.0, 2.0, 5.0)
    points, normals = sample_surface(mesh, 20_000, seed=3)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    observed, expected = [], []
    for axis, side in enumerate((1.0, 2.0, 5.0)):
        others = [a for a in range(3) if a != axis]
        size = np.array([1.0, 2.0, 5.0])[others]
        for end in (0.0, side):
            on = np.abs(normals[:, axis]) > 0.5
            on &= np.abs(points[:, axis] - end) < 1e-12
            assert np.all(normals[on, axis] == (1 if end else -1))
            cells = np.floor(points[on][:, others] / size * 4).astype(int).clip(0, 3)
            observed += list(np.bincount(cells[:, 0] * 4 + cells[:, 1], minlength=16))
            expected += [size.prod() / 16 / 34 * 20_000] * 16
    assert sum(observed) == 20_000
    assert chisquare(observed, expected).pvalue > 1e-3


def test_samples_follow_the_area_not_the_faces():
    fine = joined(sheet(40, 40, left=-1.0), sheet(1, 1))
    points, _ = sample_surface(fine, 1_000)
    assert abs((points[:, 0] < 0).sum() - 500) <= 1
    assert np.array_equal(points, sample_surface(fine, 1_000)[0])
    assert not np.array_equal(points, sample_surface(fine, 1_000, seed=1)[0])


def test_faces_without_area_get_no_samples():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9], [10, 10, 10], [11, 11, 11]])
    mesh = Mesh(vertices, np.array([[3, 4, 5], [3, 3, 4], [0, 1, 2], [5, 5, 5]]))
    points, normals = sample_surface(mesh, 500)
    assert points.max() <= 1 and np.array_equal(normals, np.tile([0.0, 0, 1], (500, 1)))
    for flat in (EMPTY, Mesh(vertices, np.array([[3, 4, 5]]))):
        assert [part.shape for part in sample_surface(flat, 10)] == [(0, 3), (0, 3)]
    with pytest.raises(ArgumentError, match="area is too large"):
        sample_surface(Mesh(1e200 * vertices, mesh.faces), 10)
    with pytest.raises(ArgumentError, match="count"):
        sample_surface(mesh, 0)


def test_distances_to_triangles_agree_with_a_dense_search():
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(60, 3, 3))
    triangles[:3, 2] = triangles[:3, 1]  # without area: a segment
    triangles[3, :] = triangles[3, 0]  # a point
    points = 1.5 * rng.normal(size=(60, 3))
    a, b = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201))
    inside = a + b <= 1 + 1e-12
    weights = np.stack([1 - a - b, a, b], -1)[inside]
    found = triangle_distances(points, triangles)
    for point, triangle, distance in zip(points, triangles, found, strict=True):
        dense = np.linalg.norm(weights @ triangle - point, axis=1).min()
        assert distance - 1e-12 <= dense <= math.hypot(distance, 0.02) + 1e-3


# scores


@pytest.mark.parametrize("as_points", [False, True])
def test_the_truth_scores_full_marks_against_itself(as_points):
    mesh = torus()
    truth = sample_surface(mesh, 40_000, seed=7) if as_points else mesh
    scores = score_surface(mesh, truth, Comparison(tau=0.05, samples=20_000))
    far = scores.distances
    assert (far.precision, far.recall, far.f1, far.counted) == (1, 1, 1, 1)
    spacing = 0.5 * math.sqrt(scores.shape.area / (40_000 if as_points else 20_000))
    assert far.spacing == pytest.approx(spacing, rel=0.1)
    if as_points:  # inflated by the spacing, as documented
        assert far.accuracy == pytest.approx(far.spacing, rel=0.2)
    else:
        assert max(far.accuracy, far.completeness) < 0.005 * far.spacing
        assert scores.normal_cosine == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("tau", "f1"), [(0.11, 1.0), (0.09, 0.0)])
def test_a_sheet_moved_along_its_normal(tau, f1):
    far = score_surface(sheet(3, 3, z=0.1), sheet(2, 5), Comparison(tau, samples=4_000)).distances
    assert (far.precision, far.recall, far.f1) == (f1, f1, f1)
    assert far.accuracy == pytest.approx(0.1) and far.completeness == pytest.approx(0.1)
    assert far.chamfer == pytest.approx(0.1)


def test_a_sheet_moved_within_its_plane():
    """0 <= x <= 1 against 0.4 <= x <= 1.4: what sticks out by x is x away, 0.4 wide, mean 0.08."""
    scores = score_surface(sheet(6, 6, left=0.4), sheet(4, 4), Comparison(tau=0.1, samples=20_000))
    far = scores.distances
    assert far.accuracy == pytest.approx(0.4**2 / 2, abs=2e-3)
    assert far.completeness == pytest.approx(0.4**2 / 2, abs=2e-3)
    assert far.precision == pytest.approx(0.7, abs=8e-3) and far.recall == pytest.approx(0.7, abs=8e-3)
    assert far.f1 == pytest.approx(0.7, abs=8e-3)


def test_accuracy_sees_extra_parts_and_completeness_missing_ones():
    half, whole = sheet(4, 4), sheet(8, 4, width=2.0)
    less = score_surface(half, whole, Comparison(tau=0.01, samples=20_000)).distances
    more = score_surface(whole, half, Comparison(tau=0.01, samples=20_000)).distances
    assert less.accuracy < 1e-5 and less.precision == 1 and less.completeness == pytest.approx(0.25, abs=2e-3)
    assert less.recall == pytest.approx(0.505, abs=2e-3)
    assert less.f1 == pytest.approx(2 * 0.505 / 1.505, abs=2e-3)
    assert (more.accuracy, more.precision) == pytest.approx((less.completeness, less.recall), abs=3e-3)


def test_decimating_the_wrong_half_lowers_the_vertex_error_only():
    """The right half is 0.1 too high. With a tenth of its vertices the mesh is as wrong as before."""
    truth = sheet(20, 10, width=2.0)
    right, coarse = sheet(100, 100, z=0.1, left=1.0), sheet(32, 31, z=0.1, left=1.0)
    before, after = (joined(sheet(100, 100), wrong) for wrong in (right, coarse))
    by_vertex = [float(np.abs(mesh.vertices[:, 2]).mean()) for mesh in (before, after)]
    by_area = [score_surface(mesh, truth, Comparison(0.05, samples=20_000)) for mesh in (before, after)]
    assert by_vertex[0] == pytest.approx(0.05) and by_vertex[1] < 0.01
    for scores in by_area:
        assert scores.distances.accuracy == pytest.approx(0.05, abs=1e-3)
        assert scores.distances.precision == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 60.0])
def test_normals_of_a_tilted_sheet(degrees):
    """Narrow strips, whose middles coincide, so that closest points exist although the planes differ."""
    turn = math.radians(degrees)
    strip = sheet(1, 50, width=1e-3)
    tilted = strip.vertices @ np.array(
        [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    )
    for faces in (strip.faces, strip.faces[:, ::-1].copy()):  # flipped normals count as right
        scores = score_surface(Mesh(tilted, faces), strip, Comparison(0.1, samples=2_000))
        assert scores.normal_degrees == pytest.approx(degrees, abs=1e-5)
        assert scores.normal_cosine == pytest.approx(math.cos(turn))


def test_the_distance_is_to_the_triangles_even_where_samples_are_sparse():
    points, normals = sample_surface(sheet(1, 1, z=0.02), 3_000)
    scores = score_surface(sheet(1, 1), (points, normals), Comparison(0.05, samples=200))
    assert scores.distances.completeness == pytest.approx(0.02)


def test_an_empty_mesh_and_a_single_triangle():
    nothing = score_surface(EMPTY, TRIANGLE, Comparison(0.1, samples=100))
    far = nothing.distances
    assert (far.accuracy, far.completeness, far.chamfer, nothing.normal_degrees) == (None,) * 4
    assert (far.precision, far.recall, far.f1) == (0, 0, 0)
    scores = score_surface(TRIANGLE, TRIANGLE, Comparison(0.1, samples=100))
    assert scores.distances.f1 == 1 and scores.distances.accuracy < 1e-12
    assert scores.normal_degrees == 0 and dataclasses.asdict(scores)["shape"]["area"] == 6
    with pytest.raises(ArgumentError, match="no point that counts"):
        score_surface(TRIANGLE, EMPTY, Comparison(0.1))


def test_bounds_apply_to_both_sides():
    bounds = np.array([[0.0, 0, -1], [1, 1, 1]])
    far = score_surface(
        sheet(4, 2, width=2.0), sheet(6, 2, width=3.0), Comparison(0.01, samples=9_000, bounds=bounds)
    ).distances
    assert far.f1 == 1
    assert (
        score_surface(sheet(4, 2, width=2.0), sheet(6, 2, width=3.0), Comparison(0.01)).distances.recall < 0.7
    )


def test_points_of_the_truth_that_do_not_count():
    far = score_surface(
        sheet(2, 2), sheet(4, 2, width=2.0), Comparison(0.01, samples=8_000), lambda points: points[:, 0] < 1
    ).distances
    assert far.recall == 1 and far.counted == pytest.approx(0.5, abs=1e-3)
    mine = sample_surface(sheet(1, 1, z=0.05), 3_000)[0]
    given = score_points(mine, sheet(1, 1), Comparison(0.06, samples=8_000))
    assert given.precision == 1 and given.accuracy == pytest.approx(0.05)
    assert given.completeness > 0.05  # points have gaps, a mesh has none


ORIGIN = [[0.0, 0, 0]]


def against(points, normals):
    """Score one point against a truth of the given points."""
    return score_points(ORIGIN, (points, normals), Comparison(1.0))


@pytest.mark.parametrize(
    ("words", "error", "call"),
    [
        ("points", ArgumentError, lambda: score_points([[0, 0, np.nan]], TRIANGLE, Comparison(1.0))),
        ("truth normals", ArgumentError, lambda: against(ORIGIN, [[0, 0, np.nan]])),
        ("truth normals", ShapeError, lambda: against(ORIGIN, [[0, 0]])),
        ("truth", ArgumentError, lambda: against(np.zeros((0, 3)), np.zeros((0, 3)))),
        ("tau", ArgumentError, lambda: Comparison(np.nan)),
        ("tau", ArgumentError, lambda: Comparison(0.0)),
        ("bounds", ArgumentError, lambda: Comparison(1.0, bounds=np.zeros((2, 3)))),
        ("samples", ArgumentError, lambda: Comparison(1.0, samples=0)),
        ("vertices", ArgumentError, lambda: Mesh(np.full((3, 3), np.nan), TRIANGLE.faces)),
    ],
)
def test_wrong_arguments_are_named(words, error, call):
    with pytest.raises(error, match=words):
        call()


# topology


def test_a_box_and_a_torus():
    shape = topology(box(1.0, 2.0, 3.0))
    assert (shape.vertices, shape.edges, shape.faces, shape.euler) == (8, 18, 12, 2)
    assert shape.closed and (shape.genus, shape.components, shape.boundary_loops) == (0, 1, 0)
    assert (shape.area, shape.volume) == pytest.approx((22.0, 6.0))
    inside_out = topology(Mesh(box(1.0, 2.0, 3.0).vertices, BOX_FACES[:, ::-1].copy()))
    assert inside_out.volume == pytest.approx(-6.0) and inside_out.closed
    ring = topology(torus())
    assert (ring.euler, ring.genus, ring.components) == (0, 1, 1) and ring.closed
    far = Mesh(torus().vertices + 1e6, torus().faces)
    assert topology(far).volume == pytest.approx(ring.volume, rel=1e-8)
    several = topology(joined(torus(), box(1.0, 1.0, 1.0), Mesh(torus().vertices + 9, torus().faces)))
    assert (several.components, several.genus, several.euler) == (3, 2, 2)


def test_holes_and_handles_of_an_open_mesh():
    kept = np.ones(len(torus().faces), bool)
    kept[[5, 300]] = False  # two separate triangles
    shape = topology(Mesh(torus().vertices, torus().faces[kept]))
    assert (shape.boundary_edges, shape.boundary_loops, shape.genus, shape.volume) == (6, 2, 1, None)
    assert not shape.closed and shape.manifold
    flat = topology(sheet(3, 2))
    assert (flat.boundary_edges, flat.boundary_loops, flat.genus, flat.euler) == (10, 1, 0, 1)


def test_edges_and_vertices_that_are_not_manifold():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    fin = topology(Mesh(np.eye(5, 3), faces))
    assert (fin.non_manifold_edges, fin.genus, fin.components) == (1, None, 1)
    tip = box(1.0, 1.0, 1.0)
    again = np.where(BOX_FACES == 0, 0, BOX_FACES + 7)  # a second box, which shares vertex 0
    shape = topology(
        Mesh(np.concatenate([tip.vertices, -tip.vertices[1:]]), np.concatenate([BOX_FACES, again]))
    )
    assert (shape.non_manifold_vertices, shape.non_manifold_edges, shape.boundary_edges) == (1, 0, 0)
    assert shape.genus is None and shape.volume is None and shape.components == 1
    turned = BOX_FACES.copy()
    turned[4] = turned[4, ::-1]
    flipped = topology(Mesh(tip.vertices, turned))
    assert flipped.flipped_edges == 3 and flipped.genus is None and flipped.volume is None
    corner = topology(Mesh(np.eye(5, 3), np.array([[0, 1, 2], [0, 3, 4]])))
    assert corner.boundary_loops is None and corner.non_manifold_vertices == 1


def test_a_moebius_strip_is_not_oriented():
    n = 12
    a, b = 2 * np.arange(n), 2 * np.arange(n) + 1
    after, beside = np.roll(a, -1), np.roll(b, -1)
    after[-1], beside[-1] = 1, 0
    faces = np.concatenate([np.stack([a, after, b], 1), np.stack([b, after, beside], 1)])
    shape = topology(Mesh(np.random.default_rng(0).normal(size=(2 * n, 3)), faces))
    assert (shape.boundary_loops, shape.boundary_edges, shape.euler, shape.genus) == (1, 2 * n, 0, None)
    assert shape.flipped_edges > 0


def test_degenerate_faces_and_unused_vertices_are_left_out():
    shape = topology(Mesh(np.eye(9, 3), np.array([[0, 1, 2], [0, 0, 1], [4, 4, 4]])))
    assert (shape.vertices, shape.edges, shape.faces, shape.components) == (3, 3, 1, 1)
    nothing = topology(EMPTY)
    assert (nothing.faces, nothing.components, nothing.area, nothing.volume) == (0, 0, 0.0, None)
    assert not nothing.closed


def test_a_surface_by_an_independent_extractor():
    """Two balls and a ring by scikit-image: closed, of known genus and nearly known volume."""
    axis = np.linspace(-2, 2, 61)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    ring = np.hypot(np.hypot(x, y) - 1.3, z) - 0.3
    ball = np.minimum(
        np.sqrt(x**2 + y**2 + z**2) - 0.5, np.sqrt((x - 1.6) ** 2 + (y - 1.6) ** 2 + z**2) - 0.3
    )
    step = axis[1] - axis[0]
    vertices, faces, _, _ = marching_cubes(np.minimum(ring, ball), 0.0, spacing=(step,) * 3)
    shape = topology(Mesh(vertices.astype(np.float64), faces.astype(np.int64)[:, ::-1].copy()))
    assert shape.closed and (shape.components, shape.genus) == (3, 1)
    true = 2 * math.pi**2 * 1.3 * 0.3**2 + 4 / 3 * math.pi * (0.5**3 + 0.3**3)
    assert abs(shape.volume) == pytest.approx(true, rel=0.02)


# virtual scan


def camera():
    return Camera(np.eye(3), (0.0, 0.0, -2.0), fx=20.0, fy=20.0, cx=15.5, cy=11.5, H=24, W=32)


def test_a_virtual_scan_of_a_slanted_plane():
    """z = 0.5 x in front of the camera; points on it are seen exactly, points behind it are not."""
    view = camera()
    u, _ = np.meshgrid(np.arange(32), np.arange(24))
    slope = (u - view.cx) / view.fx
    depth = 2.0 / (1 - 0.5 * slope)  # z + 2 = depth, x = slope depth
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.9, 0.9, 9)))
    points = np.stack([x, y, 0.5 * x], axis=1)
    assert visible_points(points, [view], [depth], 1e-9).all()
    toward = np.array([0, 0, 0.01])
    behind = points + toward
    assert not visible_points(behind, [view], [depth], 0.005).any()
    assert visible_points(behind, [view], [depth], 0.02).all()
    inner = np.abs(x) < 0.95  # others leave the photo as they come nearer
    assert visible_points(points[inner] - toward, [view], [depth], 0.0).all()


def test_points_outside_the_photo_and_in_the_open():
    view, nothing = camera(), np.zeros((24, 32))
    points = np.array([[0.0, 0, 0], [0, 0, -3], [5, 0, 0], [1.59, 0, 0], [1.61, 0, 0]])
    seen = visible_points(points, [view], [nothing], 0.0)
    assert list(seen) == [
        True,
        False,
        False,
        True,
        False,
    ]  # half a pixel beyond the last centre: 16 px / 20 * 2
    assert np.array_equal(seen, visible_points(points, [view], [np.full((24, 32), np.inf)], 0.0))
    assert not visible_points(points, [view], [nothing], 0.0, views=2).any()
    assert visible_points(points[:1], [view, view], [nothing, nothing], 0.0, views=2).all()
    assert not visible_points(points, [], [], 0.0).any()


@pytest.mark.parametrize(
    ("words", "depths", "tolerance"),
    [
        ("but there are 1", [], 0.0),
        ("depths.0.: is", [np.zeros((3, 3))], 0.0),
        ("NaN", [np.full((24, 32), np.nan)], 0.0),
        ("tolerance", [np.zeros((24, 32))], -1.0),
    ],
)
def test_wrong_scans_are_named(words, depths, tolerance):
    with pytest.raises(ArgumentError, match=words):
        visible_points(np.zeros((1, 3)), [camera()], depths, tolerance)
