"""Cameras with lenses written as COLMAP's models and as transforms.json are read back as they were."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.views import View
from lens_scenes import ARIA, CENTRE, FISHEYE, OPENCV, ROTATION, THIN_PRISM

MILD = Projection(distortion=Distortion.of(k1=-0.05, k2=0.01, p1=0.001, p2=-0.002))
LENSES = {
    "pinhole": Projection(),
    "opencv": MILD,
    "full opencv": OPENCV,
    "fisheye": FISHEYE,
    "thin prism": THIN_PRISM,
    "radial first": ARIA,
    "panorama": Projection("equirectangular"),
}


def view_of(projection, name="a.png"):
    if projection.kind == "equirectangular":
        camera = Camera.panorama(ROTATION, CENTRE, 24, 48)
    else:
        camera = Camera(ROTATION, CENTRE, 30.0, 31.0, 20.2, 15.1, 32, 40).through(projection)
    rng = np.random.default_rng(0)
    return View(camera, rng.integers(0, 255, (camera.H, camera.W, 3)).astype(np.uint8), name=name)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("name", LENSES)
def test_colmap(tmp_path, name, binary):
    view = view_of(LENSES[name])
    write_colmap(tmp_path, [view], np.zeros((1, 3)), np.zeros((1, 3)), binary=binary)
    assert_same(view, load_dataset(tmp_path, DataSettings(lens="native")).train[0])


@pytest.mark.parametrize("name", ["pinhole", "opencv", "full opencv", "fisheye"])
def test_transforms(tmp_path, name):
    view = view_of(LENSES[name])
    write_transforms(tmp_path, [view])
    assert_same(view, load_dataset(tmp_path, DataSettings(lens="native")).train[0])


def assert_same(view, read):
    assert read.camera.projection == view.camera.projection
    found, given = read.camera, view.camera
    for name in ("R", "eye", "fx", "fy", "cx", "cy"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(read.image, view.image)


def test_what_a_format_lacks_is_refused(tmp_path, as_shipped):
    with pytest.raises(ArgumentError, match=r"a\.png: transforms\.json has no model"):
        write_transforms(tmp_path, [view_of(THIN_PRISM)])
    with pytest.raises(ArgumentError, match="COLMAP has no model for its orthographic projection"):
        view = view_of(Projection("orthographic"))
        write_colmap(tmp_path, [view], np.zeros((1, 3)), np.zeros((1, 3)))
