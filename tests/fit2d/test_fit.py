"""The 2D fit improves by a known amount, reproducibly."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, ShapeError
from gsplat_edu.evaluate import metrics
from gsplat_edu.fit2d.adam import RATES_2D, AdamSettings, AdamState, adam_step_2d
from gsplat_edu.fit2d.fit import SQUARED_ERROR_FLOOR, Fit2DSettings, fit_2d, psnr_2d, shrunk_photo
from gsplat_edu.fit2d.splats import Splats2D, random_splats_2d


def picture(height=28, width=36):
    """Draw a disk and a bar on a gradient: shapes that ellipses can fit."""
    v, u = np.mgrid[:height, :width] / (height - 1)
    image = np.stack([0.2 + 0.3 * u, 0.1 + 0.2 * v, 0.6 - 0.2 * u], axis=-1)
    image[np.hypot(u - 0.5, v - 0.4) < 0.25] = (0.9, 0.7, 0.2)
    image[np.abs(u + 0.3 * v - 1.2) < 0.06] = (0.1, 0.8, 0.4)
    return image


def fitted(iterations=60, seed=5, callbacks=()):
    start = random_splats_2d(40, 28, 36, np.random.default_rng(seed))
    return fit_2d(picture(), start, Fit2DSettings(iterations), callbacks)


def test_sixty_steps_gain_eight_decibels_and_are_reported():
    steps = []
    fit = fitted(callbacks=[steps.append])
    assert fit.psnrs[-1] > fit.psnrs[0] + 8 and fit.losses[-1] < 0.2 * fit.losses[0]
    assert [step.iteration for step in steps] == list(range(61))
    assert [step.loss for step in steps] == fit.losses and [step.psnr for step in steps] == fit.psnrs
    assert np.array_equal(steps[-1].rendered.image, fit.image)
    assert fit.psnrs[-1] == psnr_2d(fit.image, picture())


def test_the_seed_determines_the_fit():
    one, two, other = fitted(12), fitted(12), fitted(12, seed=6)
    assert one.losses == two.losses and np.array_equal(one.image, two.image)
    for name, array in one.splats.arrays().items():
        assert np.array_equal(array, two.splats.arrays()[name]), name
    assert one.losses != other.losses


def test_psnr_equals_that_of_the_metrics():
    rng = np.random.default_rng(7)
    image, target = rng.normal(0.5, 0.5, (9, 8, 3)), rng.uniform(size=(9, 8, 3))
    assert np.isclose(psnr_2d(image, target), metrics.psnr(image, target), rtol=1e-14)
    assert psnr_2d(target, target) == metrics.psnr(target, target) == 100
    assert SQUARED_ERROR_FLOOR == metrics.MSE_FLOOR


def test_adam_follows_its_equations():
    """The test writes out three steps, with a different rate for each parameter."""
    rng = np.random.default_rng(8)
    splats = random_splats_2d(4, 9, 9, rng)
    settings = AdamSettings(betas=(0.8, 0.95), eps=1e-3)
    state, expected = AdamState.fresh(splats), {n: a.copy() for n, a in splats.arrays().items()}
    m, v = ({n: np.zeros_like(a) for n, a in expected.items()} for _ in range(2))
    for t in (1, 2, 3):
        gradients = splats.map(lambda array: rng.normal(size=array.shape))
        for name, g in gradients.arrays().items():
            m[name] = 0.8 * m[name] + 0.2 * g
            v[name] = 0.95 * v[name] + 0.05 * g**2
            root = np.sqrt(v[name] / (1 - 0.95**t)) + 1e-3
            expected[name] -= 0.5 * RATES_2D[name] * m[name] / (1 - 0.8**t) / root
        splats, state = adam_step_2d(splats, gradients, state, settings, factor=0.5)
    assert state.steps == 3
    for name, array in splats.arrays().items():
        assert np.allclose(array, expected[name], rtol=1e-12), name


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"rates": {"means": 1.0}}, "'angles' is missing"),
        ({"rates": dict(RATES_2D) | {"depths": 1.0}}, "'depths' is not a parameter"),
        ({"rates": dict(RATES_2D) | {"means": -1.0}}, r"rates\['means'\]: is -1"),
        ({"betas": (0.9, 1.0)}, "betas: is 1"),
        ({"eps": 0.0}, "eps: is 0"),
    ],
)
def test_settings_of_adam_are_checked(options, match):
    with pytest.raises(ArgumentError, match=match):
        AdamSettings(**options)


def test_settings_and_targets_are_checked(as_shipped):
    start = random_splats_2d(3, 4, 4, np.random.default_rng(0))
    with pytest.raises(ArgumentError, match="iterations: is 0"):
        Fit2DSettings(0)
    with pytest.raises(ArgumentError, match="final_factor: is 2"):
        Fit2DSettings(final_factor=2.0)
    with pytest.raises(ShapeError, match="target: expected shape"):
        fit_2d(np.zeros((4, 4)), start)
    with pytest.raises(ShapeError, match="target: has no pixels"):
        fit_2d(np.zeros((0, 4, 3)), start)


def test_gradients_of_another_count_are_refused(as_shipped):
    few, many = (random_splats_2d(n, 4, 4, np.random.default_rng(0)) for n in (2, 3))
    with pytest.raises(ShapeError, match="gradients: has 3 splats, but there are 2"):
        adam_step_2d(few, many, AdamState.fresh(few), AdamSettings())


def test_photos_are_shrunk_by_area_averaging():
    pixels = np.random.default_rng(9).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    small = shrunk_photo(pixels, 30)
    assert small.shape == (20, 30, 3)
    means = pixels.reshape(20, 2, 30, 2, 3).mean(axis=(1, 3)) / 255
    assert np.abs(small - means).max() < 0.51 / 255, "area means, rounded to bytes"
    assert np.array_equal(shrunk_photo(pixels, 100), pixels / 255), "photos are never enlarged"
    assert shrunk_photo(pixels[:1], 7).shape == (1, 7, 3)


def test_fitting_survives_splats_outside_the_image():
    away = random_splats_2d(3, 4, 4, np.random.default_rng(0)).arrays() | {"means": np.full((3, 2), 1e6)}
    fit = fit_2d(np.full((4, 4, 3), 0.5), Splats2D(**away), Fit2DSettings(2))
    assert np.array_equal(fit.image, np.zeros((4, 4, 3)))
