"""Photos that keep their lens: which ones, their cameras, their pixels, and a training through a fisheye."""

from functools import partial

import numpy as np
import pytest

from gsplat_edu import Camera, load_backend, recipe, training
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.lens import FISHEYE as FISHEYE_MODEL, Lens
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.native_lens import (
    cropped_fraction,
    is_native,
    native_intrinsics,
    pixels_with_rays,
    projection_of,
)
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.render.api import render
from gsplat_edu.scene.projection import Projection
from lens_captures import FISHEYE, room_photo, write_room

COEFFICIENTS = {
    "perspective": (-0.2, 0.05, 0.003, -0.004, 0.01, 0.02, 0.01, 0.005),
    "fisheye": (-0.02, 0.004, -0.001, 0.0002),
    "thin prism fisheye": (0.02, -0.004, 0.003, -0.002, 0.001, -2e-4, 0.004, -0.003),
    "radial tangential prism fisheye": (
        -0.02,
        4e-3,
        -3e-3,
        8e-4,
        -9e-5,
        3e-6,
        2e-3,
        -1e-3,
        2e-3,
        -1e-3,
        1e-3,
        5e-4,
    ),
}


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_the_renderer_projects_as_the_formulas_that_undistort_do(model):
    lens = Lens(200, 160, 110.0, 112.0, 99.0, 81.0, COEFFICIENTS[model], model)
    camera = Camera.posed(np.eye(3), np.zeros(3), native_intrinsics(lens))
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.6, 0.6, (2, 50))
    a, b = FORMULAS[model].image(x, y, np.array(lens.coefficients))
    u, v, _ = camera.project(np.stack([x, y, np.ones_like(x)], axis=1))
    np.testing.assert_allclose(u, lens.fx * a + lens.cx, rtol=0, atol=1e-9)
    np.testing.assert_allclose(v, lens.fy * b + lens.cy, rtol=0, atol=1e-9)


def test_a_panorama_is_equirectangular_and_other_models_are_undistorted():
    assert projection_of(FaceLens.of(400, 200, 3)) == Projection("equirectangular")
    for model in set(FORMULAS) - set(COEFFICIENTS):
        lens = Lens(200, 160, 110.0, 112.0, 99.0, 81.0, (0.1,), model)
        assert projection_of(lens) is None and not is_native(lens, "native")


def test_auto_keeps_wide_lenses_and_what_would_lose_a_tenth():
    def perspective(k1):
        return Lens(200, 160, 110.0, 110.0, 99.5, 79.5, (k1,))

    mild, strong = perspective(-0.02), perspective(0.25)
    assert cropped_fraction(mild) < 0.1 < cropped_fraction(strong)
    fisheye = Lens(200, 160, 110.0, 110.0, 99.5, 79.5, (0.0, 0.0, 0.0, 0.0), FISHEYE_MODEL)
    pinhole = Lens(200, 160, 110.0, 110.0, 99.5, 79.5)
    chosen = [is_native(lens, "auto") for lens in (mild, strong, fisheye, pinhole, FaceLens.of(400, 200, 0))]
    assert chosen == [False, True, True, False, True]
    assert [is_native(lens, "native") for lens in (mild, strong, fisheye, pinhole)] == [
        True,
        True,
        True,
        False,
    ]
    assert not any(is_native(lens, "undistort") for lens in (mild, strong, fisheye))


def test_pixels_beyond_the_circle_of_a_fisheye_have_no_ray():
    """170 degrees end at 2.967 rad: with 20 px per radian, at 59.3 px from the middle."""
    lens = Lens(160, 160, 20.0, 20.0, 79.5, 79.5, (), FISHEYE_MODEL)
    rays = pixels_with_rays(native_intrinsics(lens))
    radius = np.hypot(*np.meshgrid(np.arange(160) - 79.5, np.arange(160) - 79.5))
    np.testing.assert_array_equal(rays, radius <= 20.0 * np.radians(170.0) + 1e-6)
    assert (
        pixels_with_rays(native_intrinsics(Lens(60, 60, 20.0, 20.0, 29.5, 29.5, (), FISHEYE_MODEL))) is None
    )


def test_panoramas_are_loaded_whole(tmp_path):
    truth = write_room(tmp_path, Projection("equirectangular"), 4, 64)
    faces = load_dataset(tmp_path, DataSettings(test_every=0))
    whole = load_dataset(tmp_path, DataSettings(test_every=0, lens="auto"))
    assert len(faces.train) == 32 and [view.name for view in whole.train] == [
        f"r{i:02}.png" for i in range(4)
    ]
    for view, camera in zip(whole.train, truth, strict=True):
        np.testing.assert_allclose(view.camera.R, camera.R, atol=1e-9)
        np.testing.assert_allclose(view.camera.rays(), camera.rays(), atol=1e-9)
        np.testing.assert_array_equal(view.image, room_photo(camera))
    assert "4 of 4 photos are trained through their own lens, without resampling" in map(str, whole.notes)


def test_a_fisheye_keeps_its_pixels_at_any_size(tmp_path):
    truth = write_room(tmp_path, FISHEYE, 4, 64)
    for resolution in (None, 2):
        dataset = load_dataset(tmp_path, DataSettings(lens="native", test_every=0, resolution=resolution))
        view, photo = dataset.train[1], dataset.train[1].read()
        side = 64 // (resolution or 1)
        expected = truth[1].scaled(side, side)
        assert view.camera.projection == FISHEYE
        np.testing.assert_allclose(view.camera.rays(), expected.rays(), atol=1e-9)
        counts = np.isfinite(expected.rays()).all(axis=-1)
        assert counts.all() == (photo.mask is None)
        if photo.mask is not None:
            np.testing.assert_array_equal(photo.mask, counts)


def test_random_points_lie_where_the_lens_looks(tmp_path):
    write_room(tmp_path, FISHEYE, 6, 48)
    (tmp_path / "sparse/0/points3D.txt").unlink()
    dataset = load_dataset(tmp_path, DataSettings(lens="native"))
    seen = [view.camera.sight(dataset.points).valid for view in dataset.train]
    assert len(dataset.points) > 1000 and (np.sum(seen, axis=0) >= 2).all()


@pytest.mark.parametrize("projection", [FISHEYE, Projection("equirectangular")], ids=["fisheye", "panorama"])
def test_a_training_learns_through_the_lens(tmp_path, projection):
    """Held-out photos of the same lens become like the room's."""
    write_room(tmp_path, projection, 12, 48)
    dataset = load_dataset(tmp_path, DataSettings(lens="native"))
    trainer = training(recipe(250, seed=1), dataset, load_backend("cpu"))

    def score():
        scores = score_views(trainer.gaussians, dataset.test, partial(render, backend="cpu"), (0, 0, 0))
        return summarize(scores)["psnr"]

    before = score()
    trainer.run()
    after = score()
    assert after > before + 5.0 and after > 16.0
