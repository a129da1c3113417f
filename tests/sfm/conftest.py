"""Fixtures of the tests of structure from motion: photos of a box, and the capture made from them."""

import importlib.util
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box
from sfm.textured_box import LIMIT


@pytest.fixture(scope="session")
def colmap():
    """Skip if pycolmap is not installed. It is not imported here, because its libraries conflict with Pillow's."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")


@pytest.fixture(scope="session")
def phone(tmp_path_factory):
    """14 photos as a phone writes them, with the sensor's pixels and the orientation in EXIF. Half are portraits."""
    folder = tmp_path_factory.mktemp("phone") / "photos"
    truth = {}
    landscape, portrait = box_orbit(14), box_orbit(14, size=(240, 320))
    for i in range(14):
        # Names have spaces, and some suffixes are in capitals.
        name = f"walk {i % 3} IMG_{i:02d}.{'JPG' if i % 5 else 'png'}"
        truth[name] = portrait[i] if i % 2 else landscape[i]
        pixels = photograph_box(truth[name])
        exif = Image.Exif()
        if i % 2:
            pixels = np.ascontiguousarray(np.rot90(pixels))  # portrait: the sensor is on its side
            exif[0x0112] = 6  # to be rotated clockwise for display
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / name, quality=95, exif=exif)
    return SimpleNamespace(folder=folder, truth=truth)


@pytest.fixture(scope="session")
def done(colmap, phone, tmp_path_factory):
    """The capture that one thread makes from the phone's photos, with the messages (`said`) and the progress of the
    run."""
    out = tmp_path_factory.mktemp("done") / "capture"
    said, progress = [], []
    options = SfmOptions(phone.folder, out, max_features=LIMIT, threads=1)
    assert reconstruct(options, said.append, lambda *step: progress.append(step)) == out
    return SimpleNamespace(out=out, said=said, progress=progress, options=options, truth=phone.truth)
