"""The fit of GPS positions: geodesy, robustness, and cases in which it is not used."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.sfm.gps import LARGEST_MISFIT, TILT, east_north_up, fit_positions, similarity
from gsplat_edu.sfm.photos import taken_at


def orbit(count, size=40.0):
    """Return positions on a bumpy circle, m."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([size * np.cos(angle), size * np.sin(angle), 0.2 * size * np.sin(3 * angle)], axis=1)


def moved(places):
    """Return the positions in the coordinates of an arbitrary world, and its scale in m per unit."""
    R = Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix()
    return (places - [3.0, 5.0, 7.0]) @ R / 8.0 + [1.0, 2.0, 3.0], 8.0


@pytest.mark.parametrize("latitude", [0.0, 47.3, -80.0])
def test_distances_are_those_of_the_ellipsoid(latitude):
    """One degree of latitude is 110.574 km at the equator and 111.694 at a pole, one of longitude 111.320 cos phi km.

    The test computes them from the meridional radius a (1 - e²) / (1 - e² sin² phi)^1.5 and from the transverse
    radius.
    """
    a, e2 = 6378137.0, 0.0066943799901413165
    phi, step = np.radians(latitude), 1e-4
    places = east_north_up(
        [
            (latitude, 10.0, 100.0),
            (latitude + step, 10.0, 100.0),
            (latitude, 10.0 + step, 100.0),
            (latitude, 10.0, 105.0),
        ]
    )
    north, east, up = places[1:] - places[0]
    w = 1 - e2 * np.sin(phi) ** 2
    meridian, across = a * (1 - e2) / w**1.5 + 100, a / np.sqrt(w) + 100
    np.testing.assert_allclose(north, [0, np.radians(step) * meridian, 0], atol=1e-4)
    np.testing.assert_allclose(east, [np.radians(step) * across * np.cos(phi), 0, 0], atol=1e-4)
    np.testing.assert_allclose(up, [0, 0, 5], atol=1e-6)


def test_a_similarity_is_recovered():
    places = orbit(12)
    eyes, scale = moved(places)
    found = similarity(eyes, places)
    assert found.s == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(found.s * eyes @ found.R.T + found.t, places, atol=1e-9)
    assert similarity(np.zeros((4, 3)), places[:4]) is None


@pytest.mark.parametrize("count", [10, 45])
def test_a_third_of_wrong_positions_does_not_matter(count):
    """Positions spread over 40 m have noise of 1 m, and every third is wrong by 30 to 300 m."""
    rng = np.random.default_rng(count)
    places = orbit(count)
    eyes, scale = moved(places)
    noisy = places + rng.normal(size=places.shape)
    wrong = np.arange(count) % 3 == 0
    noisy[wrong] += rng.choice([-1, 1], size=(wrong.sum(), 3)) * rng.uniform(30, 300, (wrong.sum(), 1))
    fit = fit_positions(eyes, noisy)
    again = fit_positions(eyes, noisy)
    assert fit.move.s == again.move.s and fit.good
    assert not fit.inside[wrong].any() and fit.inside[~wrong].mean() > 0.8
    error = abs(fit.move.s / scale - 1)
    assert error < 0.04 and error < 4 * fit.error
    assert fit.tilt < TILT


def test_exact_positions_give_the_exact_scale():
    places = orbit(8)
    eyes, scale = moved(places)
    fit = fit_positions(eyes, places)
    assert fit.move.s == pytest.approx(scale, rel=1e-9) and fit.inside.all() and fit.residual < 1e-8


def test_positions_without_information_are_not_used():
    """The cases are a phone's error of 5 m on an orbit of 3 m, too few photos, and photos from one place."""
    rng = np.random.default_rng(3)
    places = orbit(30, size=3.0)
    eyes, _ = moved(places)
    fit = fit_positions(eyes, places + 5 * rng.normal(size=places.shape))
    assert not fit.good and fit.residual > LARGEST_MISFIT * fit.spread
    assert fit_positions(eyes[:5], places[:5]) is None
    assert fit_positions(eyes, np.zeros_like(places)) is None


def test_a_straight_flight_determines_scale_but_not_up():
    rng = np.random.default_rng(4)
    places = np.outer(np.linspace(-100, 100, 25), [0.8, 0.6, 0.0])
    eyes, scale = moved(places)
    fit = fit_positions(eyes, places + 0.5 * rng.normal(size=places.shape))
    assert fit.good and fit.tilt > TILT and fit.move.s == pytest.approx(scale, rel=0.01)


def test_a_drones_positions_are_read_and_fit():
    """The positions of a drone's 167 photos, in another world and with noise of 1.5 m, give the scale to 1 %."""
    shared = Path(__file__).parents[3] / "shared" / "data"
    folder = Path(os.environ.get("GSPLAT_EDU_DATA", shared)) / "seneca167" / "images"
    if not folder.is_dir():
        pytest.skip("seneca167 is not on this machine; see GSPLAT_EDU_DATA")
    places = [taken_at(path) for path in sorted(folder.iterdir())]
    assert len(places) == 167 and all(places)
    known = east_north_up(places)
    eyes, scale = moved(known)
    fit = fit_positions(eyes, known + 1.5 * np.random.default_rng(0).normal(size=known.shape))
    assert fit.good and fit.move.s == pytest.approx(scale, rel=0.01)
