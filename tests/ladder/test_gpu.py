"""The WGSL rungs match the oracle and the other rungs; without an adapter they say so."""

import numpy as np
import pytest
from ladder.oracle import oracle, tolerance
from ladder.splats import scene

from gsplat_edu.engine.passes import LIMITS, MODULES, module_source
from ladder import backward, forward, gpu


@pytest.fixture
def _adapter():
    if not gpu.available():
        pytest.skip(gpu.where())


RUNS = pytest.mark.usefixtures("_adapter")


def odd(count, seed, stretch):
    """Return a scene of an image whose sides are not multiples of a tile, with splats on and beyond its edges."""
    return scene(count, 45, seed, stretch)._replace(H=37)


@RUNS
@pytest.mark.parametrize(("count", "stretch"), [(0, 1.0), (1, 1.0), (150, 8.0), (900, 3.0)])
def test_naive_and_tiled_match_the_oracle(count, stretch):
    splats = odd(count, seed=count, stretch=stretch)
    tiled = gpu.Tiled(splats)
    for stop, (image, T) in {
        "none": gpu.naive(splats),
        "tile": (tiled.image, tiled.transmittance),
    }.items():
        expected, expected_T = oracle(splats, stop=stop)
        bound, T_bound = tolerance(splats, wgsl=True)
        assert bound.max() < 1e-2 and np.median(bound) < 1e-4
        assert (np.abs(image - expected) <= bound).all()
        assert (np.abs(T - expected_T) <= T_bound).all()


@RUNS
def test_a_tile_that_is_dark_stops():
    deep = scene(12_000, 64, seed=1)
    expected, _ = oracle(deep, stop="tile")
    assert np.abs(gpu.Tiled(deep).image - expected).max() < 1e-4


@RUNS
def test_the_lists_have_every_splat_that_a_tile_shows_near_to_far():
    splats = odd(300, seed=3, stretch=4.0)
    lists = gpu.Tiled(splats).lists
    assert lists.begin[0] == 0 and lists.begin[-1] == len(lists.splat)
    y, x = np.mgrid[: splats.H, : splats.W]
    for tile in range(9):
        entries = lists.splat[lists.begin[tile] : lists.begin[tile + 1]]
        assert (np.diff(entries) > 0).all()
        inside = (y // 16 == tile // 3) & (x // 16 == tile % 3)
        for i in range(splats.count):
            (u, v), (A, B, C) = splats.means2d[i].astype(float), splats.conics[i].astype(float)
            dx, dy = x[inside] - u, y[inside] - v
            alpha = splats.opacities[i] * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
            assert i in entries or (alpha < 1.0001 / 255).all()
    order = np.argsort(lists.slot)  # by slot: those of a splat are neighbours
    assert (np.diff(lists.splat[order]) >= 0).all()


@RUNS
def test_gradients_are_those_of_the_other_rungs_with_the_same_bits_each_time():
    splats = odd(400, seed=5, stretch=2.0)
    grad = np.random.default_rng(0).normal(size=(splats.H, splats.W, 3)).astype(np.float32)
    slots, sums = gpu.Tiled(splats).backward(grad)
    again = gpu.Tiled(splats).backward(grad)
    assert slots.tobytes() == again[0].tobytes() and sums.tobytes() == again[1].tobytes()
    expected = backward.slots(splats, forward.tight(splats).image, grad)
    A, B, C = splats.conics.T
    m = sums[:, 4:].T
    found = {
        "colors": sums[:, :3],
        "opacities": m[0] / splats.opacities,
        "means2d": np.stack([A * m[1] + B * m[2], B * m[1] + C * m[2]], axis=1),
        "conics": np.stack([-m[3] / 2, -m[4], -m[5] / 2], axis=1),
    }
    for name, truth in expected._asdict().items():
        assert np.abs(found[name] - truth).max() <= 1e-5 * np.abs(truth).max() > 0, name


@RUNS
def test_slots_are_added_in_their_order():
    splats = odd(400, seed=6, stretch=2.0)
    tiled = gpu.Tiled(splats)
    slots, sums = tiled.backward(np.ones((splats.H, splats.W, 3)))
    owner = tiled.lists.splat[np.argsort(tiled.lists.slot)]
    for i in range(splats.count):
        added = np.zeros(10, np.float32)
        for row in slots[owner == i]:
            added += row
        assert added.tobytes() == sums[i].tobytes()


def test_modules_are_files_and_programs_keep_to_what_browsers_grant():
    assert not set(gpu.OWN) & set(MODULES)
    assert gpu.source("scan") == module_source("scan")
    for program in (gpu.naive_program(), gpu.tiles_program(9)):
        for one in program.passes():
            assert f"fn {one.entry}(" in gpu.source(one.module)
            most = LIMITS["max-storage-buffers-per-shader-stage"]
            assert len(one.reads) + len(one.writes) <= most
