"""Paths are smooth and closed, and every frame is near a real view."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.paths.following import path_along, point_looked_at
from gsplat_edu.scene.camera import Camera, look_at

SUBJECT = np.array([3.0, -20.0, 7.0])
UP = np.array([0.0, -1.0, 0.0])
FRAMES = [np.eye(3), Rotation.random(random_state=1).as_matrix()]


def placed(eye, target, up=UP):
    return Camera(look_at(eye, target, up), eye, 80, 85, 30.5, 22.0, 48, 64)


def around(azimuths, elevations, radius=2.5, frame=FRAMES[0], jitter=0.0):
    """Return cameras at azimuths and elevations (degrees) around the subject; they miss its centre by about `jitter`
    degrees."""
    rng = np.random.default_rng(0)
    cameras = []
    for azimuth, elevation in zip(np.radians(azimuths), np.radians(elevations), strict=True):
        level = np.array([math.sin(azimuth), 0.0, -math.cos(azimuth)])
        offset = radius * (math.cos(elevation) * level + math.sin(elevation) * UP)
        aim = radius * math.radians(jitter) * rng.normal(size=3)
        cameras.append(placed(SUBJECT + frame @ offset, SUBJECT + frame @ aim, frame @ UP))
    return cameras


def seen_from(path, frame=FRAMES[0]):
    """Return azimuth and elevation (degrees) and distance of a path's cameras, as seen from the subject."""
    offsets = np.stack([camera.eye - SUBJECT for camera in path.cameras]) @ frame
    distances = np.linalg.norm(offsets, axis=1)
    return (
        np.degrees(np.arctan2(offsets[:, 0], -offsets[:, 2])),
        np.degrees(np.arcsin(offsets @ UP / distances)),
        distances,
    )


def off(path, cameras):
    """Return the largest angle between a frame's viewing direction and the nearest real one, degrees."""
    axes = np.stack([camera.R[2] for camera in cameras])
    cosines = np.stack([camera.R[2] for camera in path.cameras]) @ axes.T
    return np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0))).max()


def steps(path):
    """Return the change of position and of rotation from each frame to the next, and from the last to the first."""
    pairs = list(zip(path.cameras, path.cameras[1:] + path.cameras[:1], strict=True))
    return np.array([(np.linalg.norm(b.eye - a.eye), np.linalg.norm(b.R - a.R)) for a, b in pairs])


def check_smooth(cameras, depth=1.0):
    """Check that four times as many frames give a quarter of the step, which a jump would not."""
    few, many = (steps(path_along(cameras, frames, depth)).max(axis=0) for frames in (40, 160))
    assert (many <= 0.35 * few + 1e-9).all()


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("count", [5, 8, 24])
def test_cameras_all_round_get_a_full_circle(frame, count):
    cameras = around(np.arange(count) * 360 / count, [20] * count, frame=frame)
    path = path_along(cameras, 40)
    assert "full circle" in path.description and len(path.cameras) == 40
    azimuths, elevations, distances = seen_from(path, frame)
    np.testing.assert_allclose(
        np.sort(np.diff(np.unwrap(np.radians(azimuths)))),
        math.radians(9) * np.sign(np.unwrap(np.radians(azimuths))[-1] - np.radians(azimuths[0])),
        atol=1e-6,
    )
    np.testing.assert_allclose(elevations, 20, atol=1e-5)
    np.testing.assert_allclose(distances, 2.5, rtol=1e-6)
    np.testing.assert_allclose(path.cameras[0].eye, cameras[0].eye, atol=1e-5)
    assert off(path, cameras) <= 180 / count + 1e-3, "at most half of the angle between neighbours"
    check_smooth(cameras)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(("extent", "count"), [(20, 4), (90, 12), (200, 40), (270, 30)])
def test_the_path_stays_within_an_arc_of_cameras(frame, extent, count):
    """The cameras are in two rows, 20 degrees apart; neighbours in a row are at most 2 extent / (count - 1) apart."""
    azimuths = np.linspace(-extent / 2, extent / 2, count)
    cameras = around(azimuths, [10, 30] * (count // 2), frame=frame, jitter=1)
    path = path_along(cameras, 60)
    assert "full circle" not in path.description
    if extent > 20:
        assert (
            f"cover {extent} degrees" in path.description
            or f"cover {extent - 1} degrees" in path.description
            or (f"cover {extent + 1} degrees" in path.description)
        )
    seen, elevations, distances = seen_from(path, frame)
    # The centre follows from axes with 1 degree of jitter each, so its error is smaller.
    assert np.abs(seen).max() <= extent / 2 + 1 and np.ptp(seen) > 0.85 * extent
    # For two values, mean + 0.85 sigma exceeds the larger by at most 16 % of their difference, 3 degrees.
    assert elevations.min() > 10 - 4 and elevations.max() < 30 + 4
    np.testing.assert_allclose(distances, 2.5, rtol=0.03)
    between = 2 * extent / (count - 1)
    assert off(path, cameras) < math.hypot(between / 2, 10) + 2
    check_smooth(cameras)


def test_a_hole_in_the_circle_is_not_crossed():
    """Photos show two sides of a subject, 100 degrees apart. The path stays on the side with more photos."""
    cameras = around([*np.linspace(-50, 50, 15), *np.linspace(150, 210, 5)], [15] * 20)
    azimuths, *_ = seen_from(path_along(cameras, 50))
    assert np.abs(azimuths).max() <= 50


def test_the_path_follows_distance_and_height():
    """Cameras are near and low on one side, far and high on the other, as around a statue on a slope."""
    azimuths = np.arange(36) * 10.0
    swing = np.cos(np.radians(azimuths))
    cameras = [around([a], [15 + 10 * s], radius=3 + s)[0] for a, s in zip(azimuths, swing, strict=True)]
    found, elevations, distances = seen_from(path_along(cameras, 72))
    # Smoothing by a Gaussian of 15 degrees reduces the variation of ln r, nearly a cosine, by 1 - exp(-0.26²/2) = 3.4
    # %.
    np.testing.assert_allclose(elevations, 15 + 10 * np.cos(np.radians(found)), atol=0.5)
    np.testing.assert_allclose(distances, 3 + np.cos(np.radians(found)), atol=0.12)


def test_outliers_do_not_move_the_path():
    good = around(np.linspace(0, 80, 24), [20] * 24, jitter=1)
    far = [placed(SUBJECT + 20 * (camera.eye - SUBJECT), SUBJECT) for camera in around([200, 300], [5, 5])]
    past = [
        placed(camera.eye, camera.eye - (SUBJECT - camera.eye)) for camera in around([150, 250, 330], [0] * 3)
    ]
    cameras = [*far, *good, *past]
    assert np.linalg.norm(point_looked_at(cameras) - SUBJECT) < 0.05
    azimuths, elevations, distances = seen_from(path_along(cameras, 40))
    assert azimuths.min() > -2 and azimuths.max() < 82
    assert np.abs(elevations - 20).max() < 2 and np.abs(distances - 2.5).max() < 0.1


def grid(frame, turns=(0.0,), jitter=0.0, pitch=0.0):
    """Return parallel cameras on a grid of 6 by 4 world units, 1 apart; `turns` are the rolls of the rows."""
    rng = np.random.default_rng(0)
    cameras = []
    for row in range(5):
        for column in range(7):
            aim = np.array([*(jitter * rng.normal(size=2)), 1.0]) + np.array([0, pitch, 0])
            turn = turns[row % len(turns)]
            up = np.array([math.sin(turn), -math.cos(turn), 0.0])
            eye = frame @ np.array([column - 3.0, row - 2.0, 0.0])
            cameras.append(placed(eye, eye + frame @ aim, frame @ up))
    return cameras


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("turns", [(0.0,), (0.0, math.pi)])
@pytest.mark.parametrize("jitter", [0.0, 0.03])
def test_cameras_facing_one_way_get_a_loop_between_them(frame, turns, jitter):
    """Photos of a wall, or of fields from the air, in strips back and forth. The loop turns by 12 degrees, jitter is
    2 to 3."""
    cameras = grid(frame, turns, jitter)
    for depth in (1.0, 4.0, 100.0):
        path = path_along(cameras, 40, depth)
        assert "one viewing direction" in path.description
        eyes = np.stack([camera.eye for camera in path.cameras]) @ frame
        assert np.abs(eyes[:, :2]).max() <= 3 + 1e-9
        assert np.abs(eyes[:, 2]).max() < 0.5 and np.ptp(eyes[:, 0]) > 2
        assert off(path, cameras) < 12 + 3
        check_smooth(cameras, depth)


def test_aerial_photos_that_look_down_on_one_place():
    """Above 80 degrees of elevation, azimuth has no meaning, so the path is a loop above the place."""
    cameras = around(np.arange(20) * 130.0, np.linspace(80, 89, 20))
    path = path_along(cameras, 30)
    _, elevations, _ = seen_from(path)
    assert elevations.min() > 79 and "loop" in path.description
    assert off(path, cameras) < 5
    check_smooth(cameras)


@pytest.mark.parametrize("radius", [0.0, 0.5])
@pytest.mark.parametrize(("extent", "closed"), [(360, True), (120, False)])
def test_a_panorama_turns_on_the_spot(radius, extent, closed):
    angles = np.radians(np.arange(0, extent, 10))
    ahead = [np.array([math.sin(a), 0.0, math.cos(a)]) for a in angles]
    cameras = [placed(SUBJECT + radius * f, SUBJECT + (radius + 1) * f) for f in ahead]
    path = path_along(cameras, 36, 3.0)
    assert ("closed loop" in path.description) is closed
    assert max(np.linalg.norm(camera.eye - SUBJECT) for camera in path.cameras) <= radius + 1e-9
    assert off(path, cameras) <= 5 + 1e-6, "at most half of the angle between neighbours"
    turned = np.degrees(np.arccos(np.clip([c.R[2] @ ahead[0] for c in path.cameras], -1, 1)))
    assert turned.max() > (170 if closed else 90)
    check_smooth(cameras, 3.0)


def test_the_path_follows_a_walk():
    """Photos along a corridor and round a corner look ahead, at most half a unit and 10 degrees apart."""
    places = [(0.0, 0.0, 0.5 * i) for i in range(20)]
    places += [(0.5 * i, 0.0, 10.0) for i in range(20)]
    ways = [0.0] * 15 + list(np.radians(np.linspace(0, 90, 10))) + [math.pi / 2] * 15
    cameras = [
        placed(np.array(p), np.add(p, (math.sin(w), 0.0, math.cos(w))))
        for p, w in zip(places, ways, strict=True)
    ]
    path = path_along(cameras, 80, 2.0)
    eyes, real = (np.stack([camera.eye for camera in group]) for group in (path.cameras, cameras))
    distances = np.linalg.norm(eyes[:, None] - real, axis=2).min(axis=1)
    assert distances.max() < 0.5 and off(path, cameras) < 10
    assert np.linalg.norm(np.ptp(eyes, axis=0)) > 12, "nearly the whole walk, whose extent is 10 by 10"
    check_smooth(cameras, 2.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_cameras_get_a_small_loop(count):
    """Parallel cameras 0.2 apart, 4 units from the scene, give half axes from 0.03 * 4 to 0.1 * 1.2."""
    R = FRAMES[1]
    cameras = [Camera(R, R[0] * 0.2 * i, 50, 50, 10, 10, 21, 21) for i in range(count)]
    path = path_along(cameras, 12, 4.0)
    middle = R[0] * 0.1 * (count - 1)
    away = [np.linalg.norm(camera.eye - middle) for camera in path.cameras]
    assert 0.11 < max(away) <= 0.25
    assert off(path, cameras) < math.degrees(0.25 / 4) + 0.1
    check_smooth(cameras, 4.0)


def test_two_cameras_that_look_at_one_subject():
    cameras = around([0, 40], [10, 10])
    path = path_along(cameras, 20, 2.0)
    azimuths, *_ = seen_from(path)
    assert azimuths.min() > -5 and azimuths.max() < 45 and off(path, cameras) < 22
    check_smooth(cameras, 2.0)


@pytest.mark.parametrize("azimuths", [[0, 90], [0, 120, 240], [0, 90, 180, 270]])
def test_cameras_too_far_apart_for_a_path_get_a_loop_at_one_of_them(azimuths):
    """All frames used to be equal, or half way between two photos, far from either."""
    cameras = around(azimuths, [10] * len(azimuths))
    path = path_along(cameras, 12, 2.0)
    eyes, real = (np.stack([camera.eye for camera in each]) for each in (path.cameras, cameras))
    nearest = np.linalg.norm(eyes[:, None] - real, axis=2).min(axis=0)
    assert np.sort(nearest)[0] < 0.1 and "too far apart" in path.description
    # Half axes are 0.03 of the distance 2.5, and the view turns by 0.075 / 2.5 rad, 1.7 degrees.
    assert 0.07 < np.ptp(eyes, axis=0).max() < 0.16 and off(path, cameras) < 1.8
    check_smooth(cameras, 2.0)


def test_equal_cameras_give_a_path():
    cameras = around([0, 0, 0, 0], [10] * 4)
    assert off(path_along(cameras, 5, 2.0), cameras) < 3


def test_no_camera_or_no_frame_is_refused():
    with pytest.raises(ArgumentError, match="number of cameras: is 0"):
        path_along([], 3)
    with pytest.raises(ArgumentError, match="frames: is 0"):
        path_along(around([0], [0]), 0)
    with pytest.raises(ArgumentError, match="depth: "):
        path_along(around([0], [0]), 3, 0.0)
