"""The record of a camera gives back its lens and its shutter."""

import json

import numpy as np
import pytest

from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.lens_record import lens_entry, with_lens
from lens_scenes import LENSES, lens_camera


@pytest.mark.parametrize(
    "name", [name for name, (lens, _) in LENSES.items() if lens.kind != "equirectangular"]
)
def test_a_camera_is_read_as_it_was_written(name):
    camera, plain = lens_camera(name), Camera(np.eye(3), (0, 0, -3), 50, 50, 20, 16, 35, 41)
    read = with_lens(plain, json.loads(json.dumps(lens_entry(camera))))
    assert read.projection == camera.projection and (read.shutter is None) == (camera.shutter is None)
    if read.shutter is not None:
        for ours, given in (
            (read.shutter.turn, camera.shutter.turn),
            (read.shutter.shift, camera.shutter.shift),
        ):
            np.testing.assert_array_equal(ours, given)
        assert read.shutter.readout == camera.shutter.readout
        assert read.shutter.exposure == camera.shutter.exposure
