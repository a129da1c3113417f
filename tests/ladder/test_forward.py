"""Every rung of the ladder matches the float64 oracle within float32 rounding."""

import importlib.util

import numpy as np
import pytest
from ladder.oracle import oracle, tolerance
from ladder.splats import Splats, from_cov2d, projected, scene

from gsplat_edu import Camera, render_gaussians, sphere_shell
from gsplat_edu.base.constants import ALPHA_MIN, T_STOP
from gsplat_edu.base.errors import BackendUnavailableError
from ladder import build, forward

ORACLES = {
    "naive": {"extent": "exact", "stop": "none"},
    "tiled": {"extent": "box3sigma", "stop": "tile"},
    "tight": {"extent": "exact", "stop": "tile"},
    "simd": {"extent": "exact", "stop": "tile"},
    "package": {"extent": "exact", "stop": "tile"},
}
TILED = [rung for rung in ORACLES if rung != "naive"]


def odd(count: int, seed: int, stretch: float) -> Splats:
    """Return a scene of an image whose sides are not multiples of a tile, with splats on and beyond its edges."""
    return scene(count, 45, seed, stretch)._replace(H=37)


def check(rung: str, splats: Splats) -> None:
    rendered = forward.RUNGS[rung](splats)
    image, T = oracle(splats, **ORACLES[rung])
    image_bound, T_bound = tolerance(splats, conics_again=rung == "package")
    assert image_bound.max() < 1e-2 and np.median(image_bound) < 1e-4, (
        "a wrong formula would exceed the bound"
    )
    assert (np.abs(rendered.image - image) <= image_bound).all()
    assert (np.abs(rendered.transmittance - T) <= T_bound).all()


def test_every_rung_has_an_oracle():
    assert set(ORACLES) == set(forward.RUNGS)


@pytest.mark.parametrize("rung", ORACLES)
@pytest.mark.parametrize(("count", "stretch"), [(1, 1.0), (150, 1.0), (150, 8.0), (900, 3.0)])
def test_a_rung_matches_the_oracle(rung, count, stretch):
    check(rung, odd(count, seed=count, stretch=stretch))


@pytest.mark.parametrize("rung", ORACLES)
def test_no_splats_give_an_empty_image(rung):
    rendered = forward.RUNGS[rung](odd(0, seed=0, stretch=1.0))
    assert not rendered.image.any() and (rendered.transmittance == 1).all()


@pytest.mark.parametrize("rung", ORACLES)
def test_splats_off_the_screen_and_below_the_floor_draw_nothing(rung):
    means = [[-500.0, 3.0], [1e4, 1e4], [20.0, -80.0], [20.0, 20.0]]
    faint = from_cov2d(
        means, np.tile(4.0 * np.eye(2), (4, 1, 1)), np.ones((4, 3)), [0.9, 0.9, 0.9, 0.0039], (37, 45)
    )
    rendered = forward.RUNGS[rung](faint)
    assert not rendered.image.any() and (rendered.transmittance == 1).all()


@pytest.mark.parametrize("rung", TILED)
def test_a_dark_tile_stops(rung):
    """Eight opaque splats darken every pixel. A splat behind them is in the tiles' lists but not drawn."""
    wide = np.tile(1e4 * np.eye(2), (9, 1, 1))
    colors = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], [8, 1], axis=0)
    splats = from_cov2d(np.full((9, 2), 20.0), wide, colors, np.full(9, 0.95), (37, 45))
    rendered = forward.RUNGS[rung](splats)
    assert (rendered.transmittance < T_STOP).all()
    assert not rendered.image[..., 1].any()
    assert rendered.counts.pairs == 9 * 9
    if rung != "package":
        assert rendered.counts.mattered < 9 * splats.pixels


def test_the_counts_of_the_naive_rung_are_exact():
    splats = odd(200, seed=3, stretch=2.0)
    y, x = np.mgrid[: splats.H, : splats.W]
    dx, dy = (p[..., None] - splats.means2d[:, k].astype(float) for k, p in enumerate((x, y)))
    A, B, C = splats.conics.astype(float).T
    alpha = splats.opacities * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    assert np.abs(alpha / ALPHA_MIN - 1).min() > 1e-5, "no alpha is so near the floor that rounding decides"
    counts = forward.naive(splats).counts
    assert counts.pairs == 0
    assert counts.evaluated == 200 * 37 * 45
    assert counts.mattered == (alpha >= ALPHA_MIN).sum()
    assert counts.bytes == 24 * counts.evaluated + 12 * counts.mattered + 16 * 37 * 45


def test_each_rung_evaluates_fewer_splats():
    splats = odd(150, seed=5, stretch=6.0)
    counts = {rung: forward.RUNGS[rung](splats).counts for rung in forward.RUNGS}
    assert counts["tiled"].evaluated < counts["naive"].evaluated / 2
    assert counts["tight"].evaluated < counts["tiled"].evaluated / 2
    assert counts["tight"].mattered <= counts["tight"].evaluated <= 1.01 * counts["tight"].mattered
    assert counts["tight"].pairs < counts["tiled"].pairs
    assert (
        counts["simd"].pairs == counts["tight"].pairs and counts["simd"].mattered == counts["tight"].mattered
    )
    assert counts["tight"].pairs <= counts["package"].pairs <= 1.1 * counts["tight"].pairs


def test_projected_splats_match_the_reference_renderer():
    camera = Camera.looking_at(eye=[0, -1, -3], target=[0, 0, 0], fx=60, fy=60, H=37, W=45)
    means, cov3ds, colors, opacities = sphere_shell()
    splats = projected(camera, means, cov3ds, colors, opacities)
    expected, _ = render_gaussians(camera, means, cov3ds, colors, opacities, extent="exact", stop="none")
    # Rounding a mean at 45 px to float32 moves it by 2e-6 px, and alpha by less, or by 1/255 at the floor.
    difference = np.abs(oracle(splats)[0] - expected)
    assert np.median(difference) < 1e-5 and difference.max() < 2 * ALPHA_MIN


def test_the_naive_kernel_in_triton():
    if importlib.util.find_spec("triton") is None:
        pytest.skip("triton is not installed")
    from ladder.naive_triton import naive_triton, where

    splats = scene(40, 21, seed=1, stretch=3.0)._replace(H=17)
    image, T, seconds = naive_triton(splats)
    image_bound, T_bound = tolerance(splats)
    expected, expected_T = oracle(splats)
    assert (np.abs(image - expected) <= image_bound).all() and (np.abs(T - expected_T) <= T_bound).all()
    assert seconds > 0 and ("interpreter" in where() or "compiled" in where())


def test_timing_returns_the_drawn_image():
    splats = odd(20, seed=0, stretch=1.0)
    seconds, rendered = forward.seconds("tight", splats, enough=0.0)
    assert seconds > 0
    assert np.array_equal(rendered.image, forward.tight(splats).image)


def test_a_missing_compiler_is_reported_in_one_line(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    build.library.cache_clear()
    with pytest.raises(BackendUnavailableError, match="install g") as caught:
        build.library("naive")
    assert "\n" not in str(caught.value)


def test_a_library_is_built_once(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "CACHE", tmp_path / "ladder")
    build.library.cache_clear()
    build.library("naive")
    (built,) = (tmp_path / "ladder").iterdir()
    stamp = built.stat().st_mtime_ns
    build.library.cache_clear()
    build.library("naive")
    assert [(p.name, p.stat().st_mtime_ns) for p in (tmp_path / "ladder").iterdir()] == [(built.name, stamp)]
    build.library.cache_clear()
