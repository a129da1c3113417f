"""Distances, samples, mesh and photos of the solids agree with independent computations."""

import functools
import math

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chi2_contingency, chisquare
from skimage.measure import marching_cubes

from gsplat_edu import ArgumentError
from gsplat_edu.evaluate.surface import (
    Comparison,
    sample_surface,
    score_points,
    score_surface,
    visible_points,
)
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.scene.mesh import Mesh
from lab.captures.solids import Part, SolidScene, solids
from lab.captures.solids_mesh import solids_mesh
from lab.captures.solids_photos import (
    LIGHT,
    SolidsPhoto,
    photograph_solids,
    solids_capture,
    solids_orbit,
    texture_colors,
)
from lab.captures.solids_shapes import Block, Bowl, Rod, Torus, gradient

AXIS = np.array([2.0, -3.0, 6.0]) / 7
SHAPES = {
    "block": Block(np.array([0.3, -0.2, 0.1]), np.array([0.2, 0.5, 0.9]), 0.4),
    "rod": Rod(np.array([-0.4, 0.2, 0.1]), np.array([0.5, -0.1, 0.3]), 0.15),
    "torus": Torus(np.array([0.1, 0.2, -0.3]), AXIS, 0.5, 0.2),
    "bowl": Bowl(np.array([0.1, 0.2, -0.3]), 0.6, 0.1, math.radians(70)),
    "deep bowl": Bowl(np.array([0.1, 0.2, -0.3]), 0.6, 0.1, math.radians(130)),
}
each_shape = pytest.mark.parametrize("name", SHAPES)
SIZE = (96, 72)


@functools.cache
def whole(floor=True):
    return solids(floor)


@functools.cache
def photo(index, finish="textured") -> SolidsPhoto:
    return photograph_solids(whole(), solids_orbit(8, SIZE)[index], finish)


def around(shape, count, seed=0):
    """Return places in the box around a shape's bounding sphere, a quarter larger."""
    half = 1.25 * shape.radius
    return shape.center + np.random.default_rng(seed).uniform(-half, half, (count, 3))


def extracted(shape, cells):
    """Return the mesh of a shape by scikit-image."""
    low, side = shape.center - 1.1 * shape.radius, 2.2 * shape.radius
    axis = np.linspace(0, side, cells + 1)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = shape.distance((low + grid).reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(axis[1],) * 3)
    return Mesh(low + vertices.astype(np.float64), faces.astype(np.int64)[:, ::-1].copy())


# distances


@each_shape
def test_distances_are_those_to_the_nearest_sample(name):
    shape = SHAPES[name]
    samples = shape.sample(np.random.default_rng(1), 200_000)
    assert np.abs(shape.distance(samples)).max() < 1e-12
    points = around(shape, 3_000)
    distance, apart = shape.distance(points), cKDTree(samples).query(points)[0]
    gap = 4 * math.sqrt(shape.area / 200_000)  # no point of the surface is farther from a sample
    assert np.all(apart >= np.abs(distance) - 1e-12)
    assert np.all(apart <= np.abs(distance) + gap)
    assert (distance < 0).any() and (distance > 0).any()


@each_shape
def test_distances_change_no_faster_than_the_place_and_as_fast_at_the_surface(name):
    shape = SHAPES[name]
    a, b = around(shape, 4_000), around(shape, 4_000, seed=1)
    assert np.all(
        np.abs(shape.distance(a) - shape.distance(b)) <= np.linalg.norm(a - b, axis=1) * (1 + 1e-12)
    )
    on = shape.sample(np.random.default_rng(2), 2_000)
    normals = gradient(shape, on)
    for h in (1e-4, -1e-4):
        assert np.median(np.abs(shape.distance(on + h * normals) - h)) < 1e-9
        assert np.abs(shape.distance(on + h * normals) - h).max() < (1e-9 if h > 0 else 1e-3)


@pytest.mark.parametrize("floor", [True, False])
def test_the_scene_is_a_lower_bound_with_slope_one_at_its_surface(floor):
    scene = whole(floor)
    rng = np.random.default_rng(3)
    a, b = (rng.uniform([-1.7, -1, -1.7], [1.7, 0.3, 1.7], (4_000, 3)) for _ in range(2))
    assert np.all(
        np.abs(scene.distance(a) - scene.distance(b)) <= np.linalg.norm(a - b, axis=1) * (1 + 1e-12)
    )
    points, normals = scene.surface(60_000, seed=4)
    assert np.abs(scene.distance(points)).max() < 1e-9  # on the surface, and in no other part
    apart = cKDTree(points).query(a)[0]
    outside = scene.distance(a) > 0
    assert np.all(apart >= np.abs(scene.distance(a)) - 1e-9)  # inside at most the distance, outside equal
    assert np.all(apart[outside] <= scene.distance(a)[outside] + 0.08)
    moved = scene.distance(points + 1e-5 * normals)
    assert np.mean(np.abs(moved - 1e-5) < 1e-10) > 0.999  # others are at concave edges
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.mean(np.abs((scene.normals(points) * normals).sum(axis=1) - 1) < 1e-6) > 0.999


# samples


@each_shape
def test_the_area_is_that_of_a_fine_mesh(name):
    close = 0.025 if name == "block" else 0.004  # marching cubes cuts off edges
    assert topology(extracted(SHAPES[name], 90)).area == pytest.approx(SHAPES[name].area, rel=close)


def test_samples_of_a_block_follow_the_areas_of_its_faces():
    block = Block(np.zeros(3), np.array([0.2, 0.5, 0.9]))
    points = SolidScene((Part("slots", block),)).surface(12_000, seed=5)[0]
    face = np.abs(np.abs(points) - block.half).argmin(axis=1) * 2 + 0
    side = face + (points[np.arange(len(points)), face // 2] > 0)
    a, b, c = 2 * block.half
    areas = np.repeat([b * c, a * c, a * b], 2)
    assert chisquare(np.bincount(side, minlength=6), areas / areas.sum() * len(points)).pvalue > 1e-3


@pytest.mark.parametrize("name", ["rod", "torus", "bowl", "deep bowl", "scene"])
def test_samples_are_as_uniform_as_those_of_a_mesh(name):
    """Counts in cells of both, by a chi-square of two samples; the mesh is within a percent of the area."""
    scene = whole(False) if name == "scene" else SolidScene((Part("x", SHAPES[name]),))
    mesh = solids_mesh(scene, 0.012) if name == "scene" else extracted(SHAPES[name], 70)
    mine, theirs = scene.surface(6_000, seed=6)[0], sample_surface(mesh, 6_000, seed=7)[0]
    both = np.concatenate([mine, theirs])
    low, high = both.min(axis=0), both.max(axis=0)
    cell = np.floor((both - low) / (high - low + 1e-9) * 5).astype(int) @ [25, 5, 1]
    counts = np.stack([np.bincount(part, minlength=125) for part in (cell[:6_000], cell[6_000:])])
    counts = counts[:, counts.sum(axis=0) >= 20]
    assert counts.shape[1] > 15 and chi2_contingency(counts).pvalue > 1e-3


def test_samples_depend_on_the_seed_only():
    scene = whole()
    assert np.array_equal(scene.surface(500, seed=1)[0], scene.surface(500, seed=1)[0])
    assert not np.array_equal(scene.surface(500, seed=1)[0], scene.surface(500, seed=2)[0])
    with pytest.raises(ArgumentError, match="count"):
        scene.surface(0)


# mesh


def test_the_mesh_of_a_torus_has_its_hole_area_and_volume():
    shape = SHAPES["torus"]
    mesh = solids_mesh(SolidScene((Part("torus", shape),)), 0.02)
    found = topology(mesh)
    assert found.closed and (found.components, found.genus) == (1, 1)
    assert found.volume == pytest.approx(2 * math.pi**2 * 0.5 * 0.2**2, rel=0.01)
    assert found.area == pytest.approx(shape.area, rel=0.005)
    assert np.abs(shape.distance(mesh.vertices)).max() < 0.005
    assert np.mean(np.abs(shape.distance(mesh.vertices)) < 1e-9) > 0.95
    points, normals = sample_surface(mesh, 5_000)
    assert (normals * gradient(shape, points)).sum(axis=1).min() > 0.9  # outward


@pytest.mark.parametrize(("floor", "components", "handles"), [(True, 1, 2), (False, 5, 1)])
def test_the_mesh_of_the_scene_is_its_surface(floor, components, handles):
    """Without the floor: bowl, arch, leaning rod, slots, and the torus with a hole. The floor closes the arch."""
    scene = whole(floor)
    mesh = solids_mesh(scene, 0.015)
    found = topology(mesh)
    assert (found.boundary_edges, found.flipped_edges, found.components) == (0, 0, components)
    assert found.non_manifold_edges < 20 and found.euler == 2 * components - 2 * handles
    points, _ = sample_surface(mesh, 20_000)
    away = np.abs(scene.distance(points))
    assert away.mean() < 3e-4 and away.max() < 0.0075
    scores = score_surface(mesh, scene.surface(50_000), Comparison(0.05, samples=20_000))
    assert scores.distances.f1 > 0.999 and scores.distances.completeness < 1e-3
    assert scores.normal_degrees < 4


@pytest.mark.parametrize("step", [0.0, math.nan, 1e-7])
def test_a_step_out_of_range_is_refused(step):
    with pytest.raises(ArgumentError, match="step" if step != 1e-7 else "cells"):
        solids_mesh(whole(), step)


# photos


@pytest.mark.parametrize("index", [0, 3])
def test_depth_agrees_with_a_dense_march_along_each_ray(index):
    scene, camera, found = whole(), solids_orbit(8, SIZE)[index], photo(index)
    rng = np.random.default_rng(index)
    v, u = rng.integers(0, SIZE[1], 250), rng.integers(0, SIZE[0], 250)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(250)], 1) @ camera.R
    at = np.arange(1.5, 6.5, 2e-3)
    places = camera.eye + at[None, :, None] * rays[:, None]
    inside = scene.distance(places.reshape(-1, 3)).reshape(250, -1) < 0
    met = inside.any(axis=1)
    high = at[inside.argmax(axis=1)]
    low = high - 2e-3
    for _ in range(40):
        middle = (low + high) / 2
        within = scene.distance(camera.eye + middle[:, None] * rays) < 0
        low, high = np.where(within, low, middle), np.where(within, middle, high)
    depth = found.depth[v, u]
    both = met & (depth > 0)
    assert both.sum() > 100 and (depth == 0).sum() > 20
    # the march may step over a rim that the ray only grazes, and then goes on to a later surface
    grazed = both & (depth < low - 1e-8)
    assert np.abs(depth - low)[both & ~grazed].max() < 1e-8
    assert grazed.sum() <= 3 and not np.any(met & (depth == 0))
    hits = camera.eye + depth[depth > 0, None] * rays[depth > 0]
    assert np.abs(scene.distance(hits)).max() < 1e-8


def test_normals_are_the_gradient_of_the_distance():
    scene, camera, found = whole(), solids_orbit(8, SIZE)[1], photo(1)
    v, u = np.nonzero(found.depth)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1) @ camera.R
    points = camera.eye + found.depth[v, u, None] * rays
    h = 1e-5
    slopes = [(scene.distance(points + h * e) - scene.distance(points - h * e)) / (2 * h) for e in np.eye(3)]
    normals = found.normals[v, u]
    off = np.abs(np.stack(slopes, axis=1) - normals).max(axis=1)
    assert np.median(off) < 1e-8 and np.mean(off < 1e-4) > 0.998  # others are at concave edges
    assert ((normals * rays).sum(axis=1) < 0.02).all()  # they face the camera
    assert np.all(found.normals[found.depth == 0] == 0) and np.all(found.part[found.depth == 0] == -1)
    assert np.array_equal(scene.nearest(points), found.part[v, u])


def test_photos_are_deterministic_and_differ_by_view():
    again = photograph_solids(whole(), solids_orbit(8, SIZE)[0])
    for mine, theirs in zip(photo(0), again, strict=True):
        assert np.array_equal(mine, theirs)
    assert not np.array_equal(photo(0).image, photo(1).image)
    assert {whole().parts[i].name for i in np.unique(photo(0).part) if i >= 0} == {
        "floor",
        "bowl",
        "rods",
        "slots",
        "torus",
    }


def seen_twice(finish):
    """Return by how much the brightest channel changes between two photos, 0 to 255, at points of bowl and torus.

    Points that face away from either camera by more than 60 degrees are left out: their pixels mix with others.
    """
    cameras = solids_orbit(8, (288, 216))[:2]
    photos = [photograph_solids(whole(), camera, finish) for camera in cameras]
    points, normals = whole().surface(60_000)
    names = np.array([part.name for part in whole().parts])[whole().nearest(points)]
    seen = np.isin(names, ["bowl", "torus"])
    seen &= visible_points(points, cameras, [photo.depth for photo in photos], 1e-3, views=2)
    for camera in cameras:
        ray = points - camera.eye
        seen &= (ray * normals).sum(axis=1) < -0.5 * np.linalg.norm(ray, axis=1)
    values = []
    for camera, photo in zip(cameras, photos, strict=True):
        u, v, _ = camera.project(camera.world_to_cam(points[seen]))
        at = [part[None].astype(np.float32) for part in (u, v)]
        values.append(cv2.remap(photo.image, *at, cv2.INTER_LINEAR)[0].astype(float))
    assert seen.sum() > 500
    return np.abs(values[0] - values[1]).max(axis=1)


def test_gloss_changes_with_the_view_and_a_plain_surface_does_not():
    plain, glossy = seen_twice("plain"), seen_twice("glossy")
    assert np.median(plain) < 2
    assert np.percentile(glossy, 90) > 40 > 4 * np.percentile(plain, 75)


def test_the_highlight_is_where_the_light_mirrors():
    """The change from plain to glossy, beyond the weak texture, is large only near the half vector."""
    camera = solids_orbit(8, SIZE)[2]
    plain, glossy = photo(2, "plain"), photo(2, "glossy")
    more = glossy.image.astype(float).min(axis=2) - plain.image.min(axis=2)
    torus = [part.name for part in whole().parts].index("torus")
    v, u = np.nonzero(plain.part == torus)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1) @ camera.R
    half = LIGHT - rays / np.linalg.norm(rays, axis=1, keepdims=True)
    cosine = (half / np.linalg.norm(half, axis=1, keepdims=True) * plain.normals[v, u]).sum(axis=1)
    assert np.median(more[v, u][cosine > 0.97]) > 70
    assert np.median(more[v, u][cosine < 0.7]) < 10


def test_texture_gives_features_and_plain_gives_none():
    corners = {}
    for finish in ("textured", "plain"):
        objects = cv2.erode((photo(0).part > 0).astype(np.uint8), np.ones((5, 5)))
        edges = cv2.Laplacian(photo(0).depth, cv2.CV_64F) ** 2 > 1e-3  # occlusions have corners in both
        objects[cv2.dilate(edges.astype(np.uint8), np.ones((5, 5))) > 0] = 0
        grey = cv2.cvtColor(photo(0, finish).image, cv2.COLOR_RGB2GRAY)
        response = cv2.cornerMinEigenVal(grey, 3)[objects > 0]
        corners[finish] = np.mean(response > 1e-3)
    assert corners["textured"] > 0.2 and corners["plain"] < 0.05
    points = whole().surface(2_000)[0]
    spread = texture_colors("floor", points, 1.0).std(axis=0)
    assert np.all(spread > 0.1) and texture_colors("floor", points, 0.0).std() == pytest.approx(
        np.std([0.55, 0.52, 0.48]), abs=1e-6
    )


def test_a_capture_has_views_and_noisy_start_points():
    made = solids_capture("glossy", 48, 5, start=2_000, seed=3)
    assert [view.name for view in made.views] == [f"view_{i:03d}.png" for i in range(5)]
    assert all(view.image.shape == (36, 48, 3) for view in made.views)
    assert made.photos[2].image is made.views[2].image
    away = made.scene.distance(made.points)
    assert len(away) == len(made.colors) == 2_000 and 0.008 < away.std() < 0.012
    assert 0 <= made.colors.min() <= made.colors.max() <= 1
    again = solids_capture("glossy", 48, 5, start=2_000, seed=3)
    assert np.array_equal(made.points, again.points) and np.array_equal(made.colors, again.colors)
    bare = solids_capture("plain", 48, 2, floor=False, start=50)
    assert {part.name for part in bare.scene.parts} == {"bowl", "rods", "slots", "torus"}
    assert (bare.photos[0].depth == 0).mean() > 0.5
    with pytest.raises(ArgumentError, match="finish"):
        solids_capture("matte", 48, 2)
    with pytest.raises(ArgumentError, match="count"):
        solids_capture("plain", 48, 0)


def test_a_virtual_scan_sees_the_bowl_from_both_sides_but_nothing_below_the_floor():
    cameras, scene = solids_orbit(8, SIZE), whole()
    points, _ = scene.surface(20_000)
    seen = visible_points(points, cameras, [photo(i).depth for i in range(8)], 0.01)
    below = (points[:, 1] > 0.1 - 1e-9) & (np.abs(points[:, [0, 2]]).max(axis=1) < 1.45)
    assert below.sum() > 2_000 and not seen[below].any()
    bowl = next(part.shape for part in scene.parts if part.name == "bowl")
    on = np.abs(bowl.distance(points)) < 1e-9
    inner = np.linalg.norm(points - bowl.center, axis=1) < bowl.sphere
    assert seen[on & inner].mean() > 0.9 and seen[on & ~inner].mean() > 0.5
    floor = (np.abs(points[:, 1]) < 1e-9) & (np.abs(points).max(axis=1) > 1.2)
    assert seen[floor].mean() > 0.9


def test_exact_depths_score_full_marks_where_photos_see_the_surface():
    """As points in space they are on the surface; unseen surface lowers recall only if it counts."""
    cameras, depths = solids_orbit(8, SIZE), [photo(i).depth for i in range(8)]
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    points = []
    for camera, depth in zip(cameras, depths, strict=True):
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        points.append((camera.eye + (depth[..., None] * rays) @ camera.R)[depth > 0])
    truth, comparison = whole().surface(20_000), Comparison(0.08)
    seen = functools.partial(visible_points, cameras=cameras, depths=depths, tolerance=0.01)
    fair = score_points(np.concatenate(points), truth, comparison, seen)
    assert fair.precision > 0.999 and fair.recall > 0.99 and 0.3 < fair.counted < 0.7
    unfair = score_points(np.concatenate(points), truth, comparison)
    assert unfair.precision == fair.precision and unfair.recall < 0.75
