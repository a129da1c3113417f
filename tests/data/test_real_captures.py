"""Real captures, if this machine has them: numbers of views, notes, and poses that agree with points and photos."""

import json

import cv2
import numpy as np
import pytest

from gsplat_edu.data.colmap import read_points
from gsplat_edu.data.dataset import DataSettings, load_dataset, scene_extent


def points_in_sight(dataset):
    """Return, for each view and point, whether the point is in front of the camera and inside its image."""
    seen = []
    for view in dataset.train:
        camera = view.camera
        u, v, z = camera.project(camera.world_to_cam(dataset.points))
        seen.append((z > 0) & (u > -0.5) & (u < camera.W - 0.5) & (v > -0.5) & (v < camera.H - 0.5))
    return np.array(seen)


def test_snowmiku97(real):
    dataset = load_dataset(real("snowmiku97"))
    assert (dataset.layout, len(dataset.train), len(dataset.test)) == ("COLMAP", 84, 13)
    assert dataset.points.shape == (25784, 3) and dataset.notes == ()
    assert {(v.camera.W, v.camera.H, v.camera.cx, v.camera.cy) for v in dataset.train} == {
        (990, 742, 494.5, 370.5)
    }
    names = sorted(v.name for v in (*dataset.train, *dataset.test))
    assert [v.name for v in dataset.test] == names[::8]
    seen = points_in_sight(dataset)
    assert seen.any(axis=0).mean() > 0.99  # COLMAP triangulated each point from photos of this capture
    assert 4 < scene_extent([v.camera for v in dataset.train]) < 8


def share_of_colour(dataset, views, shift):
    """Return the share of visible points whose photo colour, at their projection plus a shift, is within 0.05."""
    near = []
    for view in views:
        camera, edge = view.camera, 4
        u, v, z = camera.project(camera.world_to_cam(dataset.points))
        inside = (
            (z > 0)
            & (abs(u - camera.W / 2) < camera.W / 2 - edge)
            & (abs(v - camera.H / 2) < camera.H / 2 - edge)
        )
        where = np.stack([u[inside] + shift[0], v[inside] + shift[1]], axis=1).astype(np.float32)[None]
        colors = cv2.remap(view.image, where[..., 0], where[..., 1], cv2.INTER_LINEAR)[0] / 255.0
        near.append(np.abs(colors - dataset.colors[inside]).mean(axis=1) < 0.05)
    return np.concatenate(near).mean()


def test_snowmikus_points_have_the_colour_of_the_photos(real):
    """Check poses, axes and the pixel convention against the photos themselves.

    COLMAP coloured each point from the photos that show it. Many points are hidden from a view, so most colours differ.
    But the share that agrees is largest without a shift, and smaller if points are shifted by half a pixel, as by a
    wrong convention.
    """
    dataset = load_dataset(real("snowmiku97"))
    views = dataset.train[::6]
    right = share_of_colour(dataset, views, (0.0, 0.0))
    assert right > 0.25
    for shift in ((0.5, 0.5), (-0.5, -0.5), (1, 0), (-1, 0), (0, 1), (0, -1)):
        assert share_of_colour(dataset, views, shift) < right - 0.005
    assert share_of_colour(dataset, views, (30.0, 0.0)) < 0.7 * right


def test_fox(real):
    dataset = load_dataset(real("fox"))
    assert dataset.layout == "transforms.json" and len(dataset.train) == 43 and len(dataset.test) == 7
    notes = " | ".join(map(str, dataset.notes))
    assert "17 of 67 photos have no file" in notes and "50 of 50 photos have lens distortion" in notes
    assert "no points: starting from 100,000 random" in notes
    photo = dataset.train[0].read()
    assert photo.image.shape == (1920, 1080, 3)
    assert photo.mask is None or photo.mask.mean() > 0.99
    with_points = load_dataset(real("fox"), points=real("fox") / "points3D_aligned_derived.ply")
    assert len(with_points.points) == 1457
    assert points_in_sight(with_points).any(axis=0).mean() > 0.99


def test_the_foxs_colmap_model(real):
    """The model's folder is given, the photos lie beside it, and nine views share an OPENCV camera."""
    dataset = load_dataset(real("fox/colmap9_opencv"), DataSettings(test_every=0))
    assert len(dataset.train) == 9 and len(dataset.points) == 1457
    assert points_in_sight(dataset).any(axis=0).mean() > 0.99
    assert any("distortion" in note for note in map(str, dataset.notes))
    assert dataset.train[0].image.shape == (1920, 1080, 3)


def test_truck11(real):
    """Names include a folder, and a note reports the odd calibration. The poses equal those in cameras.json, which
    holds camera-to-world rotations and camera centres."""
    folder = real("truck11")
    dataset = load_dataset(folder, DataSettings(test_every=0))
    assert len(dataset.train) == 11 and len(dataset.points) == 8143
    assert any("1198 and 501.4 px: the calibration may be wrong" in note for note in map(str, dataset.notes))
    stated = {entry["img_name"]: entry for entry in json.loads((folder / "cameras.json").read_text())}
    for view in dataset.train:
        entry = stated[view.name]
        np.testing.assert_allclose(view.camera.eye, entry["position"], atol=1e-5)
        np.testing.assert_allclose(view.camera.R.T, entry["rotation"], atol=1e-6)
        np.testing.assert_allclose((view.camera.fx, view.camera.fy), (entry["fx"], entry["fy"]), rtol=1e-9)
        assert view.image.shape == (389, 649, 3)


def test_every_track_of_a_large_points_file_is_skipped(real):
    """25,784 points have tracks of many lengths. Skipping one track wrongly would garble all points after it."""
    cloud = read_points(real("snowmiku97") / "sparse" / "0")
    assert cloud.points.shape == (25784, 3) and np.isfinite(cloud.points).all()
    assert cloud.colors.min() >= 0 and cloud.colors.max() <= 1


@pytest.mark.parametrize("resolution", [4.0, 300.0])
def test_smaller_photos_of_a_real_capture(real, resolution):
    dataset = load_dataset(real("snowmiku97"), DataSettings(resolution=resolution))
    camera = dataset.train[0].camera
    assert ((248, 186) if resolution == 4 else (300, 225)) == (camera.W, camera.H)
    assert dataset.train[0].image.shape == (camera.H, camera.W, 3)
