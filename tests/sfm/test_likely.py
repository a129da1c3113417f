"""Pairs of photos are chosen by the matches of their largest features."""

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.sfm.likely import LARGEST, LENGTH, RATIO, largest_features, likely_pairs, votes
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box
from sfm.databases import random_descriptors, write_features
from sfm.textured_box import LIMIT, cameras_of, check


def test_features_of_the_largest_scales_are_read(tmp_path):
    rng = np.random.default_rng(0)
    count = LARGEST + 50
    descriptors, scales = random_descriptors(rng, count), rng.permutation(count) + 1.0
    path = tmp_path / "database.db"
    write_features(path, {"a.jpg": (descriptors, scales), "blank.jpg": (descriptors[:0], scales[:0])})
    found, blank, missing = largest_features(path, ["a.jpg", "blank.jpg", "missing.jpg"])
    np.testing.assert_array_equal(found, descriptors[np.argsort(-scales)[:LARGEST]])
    assert blank.shape == missing.shape == (0, 128)


def overlapping(rng):
    """Return the descriptors of three photos: the first two share 40 features up to noise, the third none."""
    one, other, third = (random_descriptors(rng, count).astype(np.float32) for count in (90, 80, 70))
    shared = np.maximum(one[:40] + rng.normal(scale=4.0, size=(40, 128)), 0.0)
    other[:40] = np.round(LENGTH * shared / np.linalg.norm(shared, axis=1, keepdims=True))
    other[50] = one[51] = one[50]  # of two equal features, none is a clear match
    return [one, other, third]


def test_votes_are_mutual_and_clear_matches():
    photos = overlapping(np.random.default_rng(1))
    told = []
    found = votes(photos, told.append)
    expected = np.zeros((3, 3), int)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        # half the squared distance of vectors of length LENGTH, in whole numbers
        apart = np.maximum(int(LENGTH) ** 2 - photos[i].astype(int) @ photos[j].astype(int).T, 0)
        for k, row in enumerate(apart):
            first, second = np.sort(row)[:2]
            nearest = int(np.argmin(row))
            if first < RATIO**2 * second and apart[:, nearest].min() == apart[k, nearest]:
                expected[i, j] = expected[j, i] = expected[i, j] + 1
    np.testing.assert_array_equal(found, expected)
    assert found[0, 1] == 40 and found[0, 2] == found[1, 2] == 0
    assert told == [0, 1, 3]


def test_votes_depend_neither_on_threads_nor_on_the_order_of_features():
    rng = np.random.default_rng(2)
    photos = overlapping(rng)
    shuffled = [rows[rng.permutation(len(rows))] for rows in photos]
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            np.testing.assert_array_equal(votes(shuffled), votes(photos))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_photos_without_features_have_no_votes():
    nothing = np.zeros((0, 128), np.float32)
    one = random_descriptors(np.random.default_rng(3), 5).astype(np.float32)
    assert not votes([nothing, one, nothing]).any()
    assert votes([one, one[:1]])[0, 1] == 1, "a single feature has no second nearest one"


def test_each_photo_gets_partners_and_all_that_share_enough():
    counts = np.zeros((5, 5), int)
    for i, j, count in ((0, 1, 9), (0, 2, 8), (0, 3, 7), (1, 2, 6), (2, 3, 1)):
        counts[i, j] = counts[j, i] = count
    # Photo 4 shares nothing: the first photo is its partner.
    assert likely_pairs(counts, 1, 100) == {(0, 1), (0, 2), (0, 3), (0, 4)}
    assert likely_pairs(counts, 1, 6) == {(0, 1), (0, 2), (0, 3), (0, 4), (1, 2)}
    assert len(likely_pairs(counts, 10, 100)) == 10, "all pairs of so few photos"


@pytest.mark.slow
def test_unordered_photos_get_their_poses_from_likely_pairs(colmap, tmp_path):
    truth = box_orbit(40)
    order = np.random.default_rng(4).permutation(len(truth))
    cameras = {f"{number:02}.png": truth[i] for number, i in enumerate(order)}
    (tmp_path / "photos").mkdir()
    for name, camera in cameras.items():
        Image.fromarray(photograph_box(camera)).save(tmp_path / "photos" / name)
    said, progress = [], []
    options = SfmOptions(tmp_path / "photos", tmp_path / "capture", max_features=LIMIT, matcher="likely")
    reconstruct(options, said.append, lambda *step: progress.append(step))
    found = cameras_of(options.out)
    assert set(found) == set(cameras)
    check(found, cameras)
    compared = [(done, total) for stage, done, total in progress if stage == "comparing photos"]
    assert compared[-1] == (780, 780) and compared == sorted(compared)
    (matched,) = {total for stage, _, total in progress if stage == "matches"}
    assert matched < 780 / 2
    assert any(
        sentence.startswith("matches:") and f" of {matched:,} pairs match" in sentence for sentence in said
    )
