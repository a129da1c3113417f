"""Marching cubes in the native volume, on given distances."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

import known_surfaces as surfaces
from gsplat_edu import _native
from gsplat_edu.scene.mesh import Mesh


def volume_of(distances, weights=None, first=(0, 0, 0)):
    """Cut a dense grid, of axes z, y and x and multiples of 8 voxels, into blocks; voxel 0 has its centre at 1/2."""
    weights = np.ones_like(distances) if weights is None else weights
    counts = np.array(distances.shape) // 8

    def blocks(grid):
        cut = grid.astype(np.float32).reshape(counts[0], 8, counts[1], 8, counts[2], 8)
        return np.ascontiguousarray(cut.transpose(0, 2, 4, 1, 3, 5).reshape(-1, 8, 8, 8))

    places = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1]
    volume = _native.Volume(voxel=1.0, truncation=3.0, max_bytes=2**30)
    volume.load(
        places=np.ascontiguousarray(places + first), distances=blocks(distances), weights=blocks(weights)
    )
    return volume


def extracted(volume, threads=1, min_weight=0.0):
    vertices, faces, colors = volume.extract(min_weight=min_weight, threads=threads)
    assert colors is None
    return Mesh(vertices, faces)


def noise(seed, size=24, margin=1):
    """Random distances without any two neighbours alike, surrounded by free space."""
    inside = np.random.default_rng(seed).normal(size=(size - 2 * margin,) * 3)
    return np.pad(inside, margin, constant_values=1.0)


def masks(distances):
    """The case of every cell: bit x + 2 y + 4 z of a corner is set if it is inside."""
    inside = distances < 0
    n = len(inside) - 1
    return sum(
        inside[z : z + n, y : y + n, x : x + n].astype(int) << (x + 2 * y + 4 * z)
        for z in (0, 1)
        for y in (0, 1)
        for x in (0, 1)
    )


@pytest.mark.parametrize("seed", range(3))
def test_all_256_cases_make_closed_manifolds(seed):
    distances = noise(seed)
    assert len(np.unique(masks(distances))) == 256
    mesh = extracted(volume_of(distances))
    surfaces.assert_closed_manifold(mesh)
    assert surfaces.enclosed(mesh) > 0


def test_each_case_alone_is_closed_between_free_cells():
    for case in range(256):
        distances = np.ones((8, 8, 8))
        for corner in range(8):
            if case >> corner & 1:
                distances[3 + (corner >> 2), 3 + (corner >> 1 & 1), 3 + (corner & 1)] = -0.7
        mesh = extracted(volume_of(distances))
        if case:
            surfaces.assert_closed_manifold(mesh)
            assert surfaces.enclosed(mesh) > 0


def torus(size=32):
    z, y, x = np.meshgrid(*[np.arange(size) + 0.5 - 15.83] * 3, indexing="ij")
    return np.hypot(np.hypot(x, y) - 9.1, z) - 4.2


def oracle(distances):
    """scikit-image's vertices, as x, y and z, with the centre of voxel 0 at 1/2, and its mesh."""
    vertices, faces, *_ = marching_cubes(distances.astype(np.float32), 0.0, allow_degenerate=True)
    return vertices[:, ::-1] + 0.5, faces


def farthest(first, second):
    """The largest distance from a point of either set to the nearest one of the other; both are equally many."""
    assert len(first) == len(second)
    return max(KDTree(a).query(b)[0].max() for a, b in ((first, second), (second, first)))


def test_a_torus_is_the_oracles():
    mesh = extracted(volume_of(torus()))
    surfaces.assert_closed_manifold(mesh)
    assert surfaces.euler(mesh) == 0
    vertices, faces = oracle(torus())
    assert len(faces) == len(mesh.faces)
    assert farthest(vertices, mesh.vertices) < 1e-5
    theirs = Mesh(vertices.astype(np.float64), faces.astype(np.int64))
    assert surfaces.enclosed(mesh) == pytest.approx(abs(surfaces.enclosed(theirs)), rel=1e-3)
    assert surfaces.enclosed(mesh) == pytest.approx(2 * np.pi**2 * 9.1 * 4.2**2, rel=0.015)


def test_noise_has_the_oracles_vertices():
    """The oracle joins ambiguous cells in other ways and puts vertices inside some; those on edges are the same."""
    distances = noise(5, size=16)
    vertices, _ = oracle(distances)
    on_edges = (np.abs((vertices - 0.5) - np.round(vertices - 0.5)) < 1e-6).sum(axis=1) >= 2
    mesh = extracted(volume_of(distances))
    assert farthest(vertices[on_edges], mesh.vertices) < 1e-5


def test_threads_do_not_change_a_bit():
    volume = volume_of(noise(7, size=40))
    alone = extracted(volume)
    for threads in (2, 5):
        again = extracted(volume, threads)
        assert again.vertices.tobytes() == alone.vertices.tobytes()
        assert again.faces.tobytes() == alone.faces.tobytes()


def test_blocks_of_negative_places_are_the_same_surface():
    first = np.array([-2, -1, -3])
    here, there = extracted(volume_of(torus())), extracted(volume_of(torus(), first=first))
    assert np.array_equal(here.faces, there.faces)
    assert there.vertices == pytest.approx(here.vertices + 8 * first, abs=1e-12)


def test_an_unknown_corner_leaves_a_hole():
    distances, weights = torus(), np.ones((32, 32, 32))
    whole = extracted(volume_of(distances))
    weights[16:24, 2:6, 14:18] = 0.5
    mesh = extracted(volume_of(distances, weights), min_weight=0.5)
    edges = surfaces.open_edges(mesh)
    assert 0 < len(edges) < 60 and 0 < len(mesh.faces) < len(whole.faces)
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    known = extracted(volume_of(distances, weights), min_weight=0.25)
    assert known.vertices.tobytes() == whole.vertices.tobytes()


def test_unknown_voxels_everywhere_leave_no_unused_vertex():
    weights = (np.random.default_rng(11).uniform(size=(24, 24, 24)) < 0.8).astype(float)
    mesh = extracted(volume_of(noise(6), weights))
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    assert len(surfaces.open_edges(mesh)) > 100 and len(mesh.faces) > 100


def test_missing_blocks_leave_an_open_border():
    """The grid ends inside of the torus: no cell reaches into a block that does not exist."""
    mesh = extracted(volume_of(torus()[:16]))
    assert np.abs(mesh.vertices[surfaces.open_edges(mesh).ravel()][:, 2] - 15.5).max() < 1e-12
    assert surfaces.open_edges(mesh).size and mesh.vertices[:, 2].max() <= 15.5


def test_a_distance_of_zero_is_outside():
    distances = np.ones((8, 8, 8))
    distances[3, 3, 3], distances[3, 3, 4] = -1, 0
    mesh = extracted(volume_of(distances))
    surfaces.assert_closed_manifold(mesh)
    assert len(mesh.vertices) == 6 and [4.5, 3.5, 3.5] in mesh.vertices.tolist()


def test_what_is_loaded_is_read_again():
    distances = noise(3)
    volume = volume_of(distances, np.abs(noise(4)))
    places = np.empty((27, 3), np.int64)
    found, weights = np.empty((2, 27, 8, 8, 8), np.float32)
    volume.read(places=places, distances=found, weights=weights)
    again = _native.Volume(voxel=1.0, truncation=3.0, max_bytes=2**30)
    again.load(places=places, distances=found, weights=weights)
    assert extracted(again).vertices.tobytes() == extracted(volume).vertices.tobytes()
    assert found[13, 2, 3, 4] == np.float32(distances[10, 11, 12])
    with pytest.raises(ValueError, match="the volume is not empty"):
        again.load(places=places, distances=found, weights=weights)


@pytest.mark.parametrize(
    ("words", "places"),
    [
        ("not sorted", [[0, 0, 0], [0, 0, 0]]),
        ("not sorted", [[0, 0, 1], [1, 0, 0]]),
        ("beyond the last one", [[0, 0, 0], [2**40, 0, 0]]),
    ],
)
def test_places_that_do_not_fit_are_refused(words, places):
    volume = _native.Volume(voxel=1.0, truncation=3.0, max_bytes=2**30)
    empty = np.zeros((2, 8, 8, 8), np.float32)
    with pytest.raises(ValueError, match=words):
        volume.load(places=np.array(places), distances=empty, weights=empty)
    assert volume.blocks == 0


def test_the_native_volume_survives_what_the_python_class_refuses():
    """NaN, infinite and negative depth or weight counts as no surface; wild cameras see nothing or are refused."""
    depth = np.full((20, 30), 2, np.float32)
    wild = depth.copy()
    wild[0], wild[1], wild[2], wild[3] = np.nan, np.inf, -1, 1e-42
    places = {
        "R": np.eye(3),
        "eye": np.zeros(3),
        "fx": 30.0,
        "fy": 30.0,
        "cx": 15.0,
        "cy": 10.0,
        "threads": 1,
    }

    def bits(**given):
        volume = _native.Volume(voxel=0.1, truncation=0.3, max_bytes=2**30)
        volume.integrate(**({"depth": depth, "weights": None, "image": None} | places | given))
        return volume.extract(min_weight=0.0, threads=1)[0].tobytes()

    calm, weights = wild.copy(), np.ones_like(depth)
    calm[:4], weights[:4] = 0, np.array([[np.nan], [np.inf], [-1], [0]])
    assert bits(depth=wild) == bits(depth=calm) == bits(weights=weights) != b""
    for given in ({"cx": 1e300}, {"eye": np.full(3, 1e300)}, {"R": np.full((3, 3), np.nan)}, {"fx": 1e-300}):
        with pytest.raises(ValueError, match="reaches beyond"):
            bits(**given)
    with pytest.raises(ValueError, match="fx: has to be positive"):
        bits(fx=0.0)
    with pytest.raises(ValueError, match="weights: has to be float32 of shape"):
        bits(weights=np.ones((20, 31), np.float32))
