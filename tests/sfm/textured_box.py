"""Tolerances for cameras that structure from motion estimates from photos of the textured box."""

import numpy as np

from gsplat_edu.data.dataset import DataSettings, load_dataset
from lab.captures.textured_box import align_cameras

# At a focal length of 352 px, a pixel is 1/352 rad, or 4/352 of a unit at the distance of the box. Reprojection
# errors are a quarter of a pixel. Poses also have errors of the lens, which so few and small photos hardly determine,
# so two pixels are allowed.
TURNED = np.degrees(2 / 352)
"""Largest angle between an estimated and a true rotation, degrees."""

MOVED = 2 * 4 / 352 / 3.6
"""Largest distance between an estimated and a true centre, as a fraction of the cameras' extent of 3.6."""


LIMIT = 1200
"""Features kept per photo. Some photos of the box have more."""


def cameras_of(capture):
    """Return the cameras of a capture on disk by the names of their photos."""
    dataset = load_dataset(capture, DataSettings(test_every=0))
    assert dataset.layout == "COLMAP"
    return {view.name: view.camera for view in dataset.train}


def check(found, truth):
    """Compare estimated with true cameras; return the rotation between the two worlds."""
    alignment = align_cameras(found, truth)
    assert alignment.moved.max() < MOVED
    assert alignment.turned.max() < TURNED
    return alignment.R
