"""Random start points lie where at least two training photos see them, and are the same in every run."""

import math

import numpy as np
import pytest

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.points import RANDOM_POINTS
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.visible_cloud import FARTHEST, NEAREST, cloud_in_cube, cloud_in_view, seen_by
from gsplat_edu.data.writers import write_blender, write_transforms
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.rig import orbit_camera, scene_extent
from gsplat_edu.scene.views import View


def room(count=24):
    """Cameras near the middle of a room that look outwards."""
    found = []
    for i in range(count):
        turn = 2 * math.pi * i / count
        eye = np.array([math.cos(turn), 0.0, math.sin(turn)])
        found.append(Camera(look_at(eye, 3 * eye), eye, 40.0, 40.0, 31.5, 23.5, 48, 64))
    return found


def orbit(count=12):
    return [orbit_camera(2 * math.pi * i / count, 0.3, 64, 60.0) for i in range(count)]


@pytest.mark.parametrize("cameras", [room(), orbit()], ids=["room", "orbit"])
def test_two_cameras_see_every_point_and_none_is_close_to_a_camera(cameras):
    cloud = cloud_in_view(cameras)
    assert len(cloud.points) == RANDOM_POINTS and np.isfinite(cloud.points).all()
    assert seen_by(cloud.points, cameras, 2).all() and cloud.colors.min() >= 0 and cloud.colors.max() <= 1
    extent = scene_extent(cameras)
    depths = np.stack([camera.world_to_cam(cloud.points)[:, 2] for camera in cameras])
    drawn = ((depths >= 0.99 * NEAREST * extent) & (depths <= 1.01 * FARTHEST * extent)).any(axis=0)
    assert drawn.all()
    again = cloud_in_view(cameras)
    assert np.array_equal(cloud.points, again.points) and np.array_equal(cloud.colors, again.colors)


def test_a_room_gets_points_beyond_its_cameras():
    cloud = cloud_in_view(room())
    assert np.median(np.linalg.norm(cloud.points, axis=1)) > 2, "the cameras are 1 from the centre"


def test_one_photo_and_photos_that_share_nothing():
    (one,) = room(1)
    assert seen_by(cloud_in_view([one]).points, [one], 1).all()
    back = Camera(look_at([0, 0, -9.0], [0, 0, -20.0]), [0, 0, -9.0], 400.0, 400.0, 31.5, 23.5, 48, 64)
    front = Camera(look_at([0, 0, 9.0], [0, 0, 20.0]), [0, 0, 9.0], 400.0, 400.0, 31.5, 23.5, 48, 64)
    assert cloud_in_view([back, front]) is None


def test_points_of_a_cube_that_no_two_photos_see_are_dropped():
    cameras = [camera for camera in orbit() if camera.eye[0] > 0]
    cloud = cloud_in_cube(cameras, np.zeros(3), 5.0)
    assert 0 < len(cloud.points) < RANDOM_POINTS and seen_by(cloud.points, cameras, 2).all()


def test_captures_without_points_start_in_view_of_their_training_photos(tmp_path):
    views = procedural_capture(size=32, count=12)[0]
    write_transforms(tmp_path / "a", views)
    write_blender(tmp_path / "b", views[:9], views[9:])
    for path in ("a", "b"):
        dataset = load_dataset(tmp_path / path, DataSettings())
        cameras = [view.camera for view in dataset.train]
        assert not dataset.measured and seen_by(dataset.points, cameras, 2).all()
        assert any(
            "random points" in note and "two or more photos look" in note for note in map(str, dataset.notes)
        )


def test_photos_that_share_nothing_start_around_the_cameras(tmp_path):
    views = procedural_capture(size=32, count=2)[0]
    pixels = np.zeros((32, 32, 3), np.uint8)
    eyes = (np.array([4.0, 0, 0]), np.array([-4.0, 0, 0]))
    turned = [
        View(
            Camera(look_at(eye, 2 * eye), eye, 200.0, 200.0, 15.5, 15.5, 32, 32),
            pixels,
            name=view.name,
        )
        for view, eye in zip(views, eyes, strict=True)
    ]
    write_transforms(tmp_path, turned)
    dataset = load_dataset(tmp_path, DataSettings(test_every=0))
    assert any("no two photos see the same place" in note for note in map(str, dataset.notes))
    assert len(dataset.points) == RANDOM_POINTS


def test_cameras_close_together_get_points_at_their_subject():
    """The distance between the cameras is a twentieth of the distance to the subject."""
    eyes = [np.array([0.2 * i, 0.1 * (i % 2), -8.0]) for i in range(-2, 3)]
    cameras = [Camera(look_at(eye, np.zeros(3)), eye, 60.0, 60.0, 31.5, 31.5, 64, 64) for eye in eyes]
    points = cloud_in_view(cameras).points
    assert np.min(points[:, 2] + 8) > 7 and np.sum(np.abs(points[:, 2]) < 2) > 1_000
