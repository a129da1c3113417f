"""How close the cameras that structure from motion finds have to come to those of the textured box."""

import numpy as np

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.textured_box import align_cameras

# A lens of 352 px sees a pixel as 1/352 rad, and moves by 4/352 of a unit at the distance of the box. Reprojection
# errors are a quarter of a pixel, but the lens's own parameters, which so few and so small photos fix badly, take
# up some of the poses: two pixels' worth is allowed.
TURNED = np.degrees(2 / 352)
"""Largest angle between a rotation and its truth, degrees."""

MOVED = 2 * 4 / 352 / 3.6
"""Largest distance of a centre from its truth, as a share of the cameras' extent of 3.6."""


LIMIT = 1200
"""Features of a photo: some photos of the box have more."""


def cameras_of(capture):
    """The cameras of a capture on disk, by the names of their photos."""
    dataset = load_dataset(capture, DataSettings(test_every=0))
    assert dataset.layout == "COLMAP"
    return {view.name: view.camera for view in dataset.train}


def check(found, truth):
    """Compare cameras with their truth; return the rotation between the two worlds."""
    alignment = align_cameras(found, truth)
    assert alignment.moved.max() < MOVED
    assert alignment.turned.max() < TURNED
    return alignment.R
