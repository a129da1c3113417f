"""The capture that the studio brings along."""

import io
import zipfile

import numpy as np
from PIL import Image

from build_example import EXAMPLE, PHOTOS, SIZE, example_camera
from gsplat_edu.data.reader import CaptureReader
from lab.captures.garden import photograph_garden


def test_it_is_small_and_its_photos_are_traced():
    assert EXAMPLE.stat().st_size <= 1.5e6
    with zipfile.ZipFile(EXAMPLE) as packed:
        photo = np.asarray(Image.open(io.BytesIO(packed.read("images/garden_08.jpg"))))
    traced = photograph_garden(example_camera(7)).image
    error = np.mean((photo.astype(float) - traced) ** 2)
    assert photo.shape == (SIZE[1], SIZE[0], 3) and 10 * np.log10(255**2 / error) > 28


def test_it_becomes_a_capture_of_the_library_each_time(page, studio):
    first, second = (page.post("/api/example", json={}).json() for _ in range(2))
    assert first["entry"] == "captures/garden" and second["entry"] == "captures/garden (2)"
    facts = page.get("/api/captures/garden").json()
    assert facts["photos"] == PHOTOS and not facts.get("problem")
    capture = CaptureReader(studio.library.root / "captures" / "garden").capture
    for frame, index in ((capture.frames[0], 0), (capture.frames[-1], PHOTOS - 1)):
        camera = example_camera(index)
        np.testing.assert_allclose(frame.eye, camera.eye, atol=1e-5)
        np.testing.assert_allclose(frame.R, camera.R, atol=1e-6)
