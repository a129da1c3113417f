"""COLMAP finds the poses of all photos of a walk around a subject, whose order is found and used."""

import math
import re

import pytest
from PIL import Image

from gsplat_edu.sfm.candidates import SEQUENCE
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import align_cameras, box_orbit, photograph_box
from sfm.textured_box import MOVED, TURNED, cameras_of

COARSER = 2
"""Factor by which the photos are smaller than those for which the tolerances hold."""


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
def test_photos_in_order_are_matched_in_sequence_and_all_get_a_pose(tmp_path):
    """Photos IMG_0 to IMG_59 are a lap, listed as IMG_0, IMG_1, IMG_10, so the order has to be found."""
    photos, truth = tmp_path / "photos", {}
    photos.mkdir()
    for i, camera in enumerate(box_orbit(SEQUENCE, size=(320 // COARSER, 240 // COARSER))):
        truth[f"IMG_{i}.jpg"] = camera
        Image.fromarray(photograph_box(camera)).save(photos / f"IMG_{i}.jpg", quality=95)
    said, progress = [], []
    options = SfmOptions(photos, tmp_path / "capture", max_features=250, threads=1)
    reconstruct(options, said.append, lambda *step: progress.append(step))

    (sentence,) = (
        line for line in said if line.startswith("the photos were taken in sequence: sorted by name")
    )
    every = math.comb(SEQUENCE, 2)
    pairs = int(re.search(rf"(\d+) pairs are matched instead of all {every:,}", sentence)[1])
    assert SEQUENCE - 1 <= pairs < every / 2
    assert max(total for stage, _, total in progress if stage == "matches") == pairs, (
        "no other pairs were matched"
    )
    assert any(line.startswith(f"mapping: {SEQUENCE} of {SEQUENCE} photos have a pose") for line in said)

    found = cameras_of(options.out)
    assert set(found) == set(truth)
    alignment = align_cameras(found, truth)
    assert alignment.moved.max() < COARSER * MOVED and alignment.turned.max() < COARSER * TURNED
