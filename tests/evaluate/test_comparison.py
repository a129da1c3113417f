"""A photo beside its render, photo first, both with their names."""

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.evaluate.comparison import comparison_size, name_strip, read_comparison, save_comparison

RNG = np.random.default_rng(0)
PHOTO, RENDER = RNG.integers(0, 256, (2, 20, 70, 3), dtype=np.uint8)


def test_the_photo_comes_first_under_its_name(tmp_path):
    path = tmp_path / "a.png"
    save_comparison(path, PHOTO, RENDER)
    with Image.open(path) as file:
        both = np.asarray(file)
    np.testing.assert_array_equal(both[-20:, :70], PHOTO)
    np.testing.assert_array_equal(both[-20:, 74:], RENDER)
    left, right = both[:-20, :70], both[:-20, 74:]
    assert (left < 128).any() and (right < 128).any() and not np.array_equal(left, right)
    found = read_comparison(path)
    assert comparison_size(path) == (70, 20)
    np.testing.assert_array_equal(found["photo"], PHOTO)
    np.testing.assert_array_equal(found["render"], RENDER)


def test_names_grow_with_the_pictures():
    assert name_strip(["photo", "render"], 70).shape == (13, 144, 3)
    large = name_strip(["photo", "render"], 1300)
    assert large.shape == (26, 2604, 3)
    dark = np.flatnonzero((large < 128).any(axis=(0, 2)))
    assert dark.min() < 20 and (dark > 1304).any() and not ((dark > 200) & (dark < 1304)).any()


def test_other_pictures_are_refused(tmp_path):
    Image.fromarray(PHOTO).save(tmp_path / "odd.png")
    with pytest.raises(ValueError, match="is not a photo beside its render"):
        read_comparison(tmp_path / "odd.png")
