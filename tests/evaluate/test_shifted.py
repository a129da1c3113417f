"""PSNR that lets details be out of place."""

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.evaluate.shifted import SHIFT, WINDOW, psnr_shifted


def blurred(image, width):
    for axis in (0, 1):
        padded = np.pad(
            image, [(width // 2, width // 2) if i == axis else (0, 0) for i in range(3)], mode="edge"
        )
        image = np.lib.stride_tricks.sliding_window_view(padded, width, axis).mean(axis=-1)
    return image


@pytest.fixture
def rng():
    return np.random.default_rng(41)


@pytest.fixture
def photo(rng):
    return blurred(rng.uniform(size=(70, 120, 3)), 3)


def test_a_sharp_picture_two_pixels_off_scores_above_a_blurred_one(photo):
    off = np.roll(photo, (2, -2), axis=(0, 1))
    blur = blurred(photo, 9)
    assert psnr(off, photo) < psnr(blur, photo) - 1
    assert psnr_shifted(off, photo) > psnr_shifted(blur, photo) + 3


def test_noise_and_larger_shifts_still_count(photo, rng):
    noisy = np.clip(photo + rng.normal(scale=0.1, size=photo.shape), 0, 1)
    far = np.roll(photo, round(SHIFT * 120) + 4, axis=1)
    assert psnr_shifted(photo, photo) == 100.0
    assert psnr_shifted(noisy, photo) < 21.5  # a shift cannot remove noise of 20 dB
    assert psnr_shifted(far, photo) < psnr_shifted(np.roll(photo, 2, axis=1), photo) - 5


def test_the_error_is_the_least_of_the_windows(rng):
    """A direct evaluation: every window of every shift of a small picture."""
    render, photo = rng.uniform(size=(2, 9, 11, 3))
    mask = rng.uniform(size=(9, 11)) < 0.7
    half, rows = WINDOW // 2, []
    for y, x in np.argwhere(mask):
        least = np.inf
        for down in (-1, 0, 1):
            for across in (-1, 0, 1):
                errors = [
                    np.mean((render[np.clip(v + down, 0, 8), np.clip(u + across, 0, 10)] - photo[v, u]) ** 2)
                    for v in range(max(y - half, 0), min(y + half + 1, 9))
                    for u in range(max(x - half, 0), min(x + half + 1, 11))
                    if mask[v, u]
                ]
                least = min(least, np.mean(errors))
        rows.append(least)
    assert psnr_shifted(render, photo, mask) == pytest.approx(-10 * np.log10(np.mean(rows)), abs=1e-9)


def test_bytes_count_as_their_255th_and_masked_pixels_not_at_all(photo, rng):
    truth = np.round(255 * photo).astype(np.uint8)
    mask = np.zeros(truth.shape[:2], dtype=bool)
    mask[20:50, 30:90] = True
    spoiled = np.where(mask[..., None], truth, rng.integers(0, 255, truth.shape)).astype(np.uint8)
    assert psnr_shifted(truth, spoiled, mask) == 100.0 > psnr_shifted(truth, spoiled)


def test_wrong_input_is_refused(photo):
    with pytest.raises(ShapeError, match="truth"):
        psnr_shifted(photo, photo[1:])
    with pytest.raises(ShapeError, match="mask"):
        psnr_shifted(photo, photo, np.ones((3, 3), dtype=bool))
    with pytest.raises(ArgumentError, match="no pixel counts"):
        psnr_shifted(photo, photo, np.zeros(photo.shape[:2], dtype=bool))
