"""Photos that are not placed yet: what they share with those before and after them, and which are brighter."""

import cv2
import numpy as np
import pytest

from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.doctor.unplaced import APART, LOOK, Look, examine_unplaced, in_order, measured

STEP = 40


def walls(count, seed=0):
    """Photos of one wall from places side by side."""
    wall = np.random.default_rng(seed).integers(30, 200, (75, 40 + 4 * count, 3), dtype=np.uint8)
    wall = cv2.resize(wall, None, fx=10, fy=10, interpolation=cv2.INTER_NEAREST)
    return [wall[:480, STEP * i : STEP * i + LOOK] for i in range(count)]


def found_in(folder, photos):
    paths = [folder / f"{i:02d}.png" for i in range(len(photos))]
    for path, photo in zip(paths, photos, strict=True):
        cv2.imwrite(str(path), photo)
    looks = [Look(path) for path in paths]
    shared = {
        (i, j): looks[i].shared_with(looks[j])
        for i in range(len(looks))
        for j in range(i + 1, min(i + 1 + APART, len(looks)))
    }
    found = examine_unplaced([measured(path.name, path) for path in paths], len(paths), shared)
    return {one.name: one for one in found}, in_order(shared)


def test_photos_that_share_enough_are_fine(tmp_path):
    assert found_in(tmp_path, walls(14)) == ({}, True)


def test_a_gap_names_both_of_its_sides(tmp_path):
    found, ordered = found_in(tmp_path, walls(8) + walls(8, seed=1))
    assert ordered
    assert found["overlap"].images == ("07.png",)
    assert "first 07.png with 08.png" in found["overlap"].sentence


def test_a_photo_that_the_next_but_one_makes_up_for_is_no_gap(tmp_path):
    photos = walls(14)
    photos[6] = walls(1, seed=1)[0]
    found, _ = found_in(tmp_path, photos)
    assert "overlap" not in found


@pytest.mark.parametrize("stops", [-1.0, 1.0])
def test_a_photo_of_another_exposure_is_named_with_its_stops(tmp_path, stops):
    photos = walls(14)
    light = (photos[6] / 255.0) ** 2.2 * 2.0**stops
    photos[6] = np.clip(255.0 * light ** (1 / 2.2), 0, 255).astype(np.uint8)
    found, _ = found_in(tmp_path, photos)
    assert found["brightness"].images == ("06.png",)
    assert float(found["brightness"].values[0]) == pytest.approx(stops, abs=0.15)


def test_photos_in_another_order_are_not_judged(tmp_path):
    mixed = [photo for pair in zip(walls(6), walls(6, seed=1), strict=True) for photo in pair]
    found, ordered = found_in(tmp_path, [mixed[i] for i in (0, 7, 4, 11, 2, 9, 6, 1, 10, 3, 8, 5)])
    assert not ordered
    assert "overlap" not in found


def test_panoramas_are_compared_by_their_own_lens(tmp_path):
    """A turn of the camera moves a panorama's columns around."""
    scene = cv2.resize(
        np.random.default_rng(2).integers(30, 200, (40, 80, 3), dtype=np.uint8), (LOOK, LOOK // 2)
    )
    paths = [tmp_path / f"{i}.png" for i in range(2)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), np.roll(scene, 60 * i, axis=1))
    one, other = map(Look, paths)
    assert isinstance(one.lens, FaceLens)
    assert one.shared_with(other).overlap
