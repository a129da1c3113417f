"""Files of maps have their values, with the axes of a normal in the order x, y, z."""

import numpy as np
import pytest
import tifffile
from PIL import Image

from gsplat_edu.evaluate.map_files import write_maps


def test_the_channels_of_normals_are_x_y_and_z(tmp_path):
    normals = np.array([[[1.0, 0.0, 0.0], [0.6, -0.8, 0.0]], [[0.0, 0.6, -0.8], [0.0, 0.0, 0.0]]])
    scales = write_maps(tmp_path, "view", {"normal": normals})
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "view.normal.tiff"), normals.astype(np.float32))
    assert scales == {"view.normal.png": {"scale": pytest.approx(2 / 65535), "offset": -1.0}}
    coarse = np.asarray(Image.open(tmp_path / "view.normal.png"))  # Pillow keeps eight of sixteen bits
    np.testing.assert_allclose(coarse / 255.0 * 2.0 - 1.0, normals, atol=2 / 255)
