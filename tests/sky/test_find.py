"""The sky is found if it is at infinity, with any orientation of the cameras; the same colours nearby are no sky."""

import math

import cv2
import numpy as np
import pytest

from doctor.rooms import room
from gsplat_edu.parts.sky.find import fibonacci, find_sky, scene_size
from gsplat_edu.scene.camera import Camera
from lab.captures.outdoors import outdoor_capture, photograph, sky_colors

NO_POINTS = np.zeros((0, 3))


@pytest.fixture(scope="module")
def outdoors():
    return outdoor_capture(96, 72, 20, points=1_000)


def searched(capture, points=None, images=None, cameras=None):
    return find_sky(
        cameras or [view.camera for view in capture.views],
        images or [view.image for view in capture.views],
        capture.points if points is None else points,
    )


def test_the_sky_is_found_above_the_horizon(outdoors):
    sky = searched(outdoors)
    assert sky.is_certain and sky.lies_at_infinity and sky.photos == 20
    assert np.abs(sky.up - (0, -1, 0)).max() < 0.05
    true = sum(int(part.sum()) for part in outdoors.sky)
    assert 0.6 * true < len(sky.directions) <= true
    assert sky.directions[:, 1].max() < math.sin(math.radians(2.5)), "no direction is below the horizon"
    # the found pixels have the colours of their directions, and few are wrong
    error = np.abs(sky.colors - sky_colors(sky.directions)).max(axis=1)
    assert np.mean(error > 0.06) < 0.02
    assert sky.spread < 0.6 * sky.spread_near


def test_the_same_colours_on_a_dome_are_no_sky():
    for dome in (8.0, 14.0):
        near = outdoor_capture(96, 72, 20, points=1_000, dome=dome)
        sky = searched(near)
        assert sky.share > 0.1, "single photos of sky and dome look alike"
        assert not sky.is_certain and not sky.lies_at_infinity


def test_walls_of_a_room_are_no_sky():
    for layout in ("orbit", "forward"):
        views, points = room(layout, 96)
        cameras, images = [v.camera for v in views], [np.asarray(v.image) for v in views]
        assert not find_sky(cameras, images, points).is_certain
        assert not find_sky(cameras, images, NO_POINTS).is_certain


def test_a_sky_of_one_colour_counts_only_if_it_is_white(outdoors):
    grey = outdoor_capture(96, 72, 20, points=1_000, clouds=0.0)
    assert searched(grey).is_certain and not searched(grey).lies_at_infinity
    images = [
        np.where(part[..., None], np.uint8(170), view.image)
        for part, view in zip(grey.sky, grey.views, strict=True)
    ]
    assert not searched(grey, images=images).is_certain, "a plain grey wall would look the same"


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_the_sky_is_found_by_cameras_in_portrait_or_upside_down(outdoors, quarters):
    cameras, images = [], []
    for view in outdoors.views:
        c = view.camera
        turn = np.round(
            [
                [math.cos(q := math.pi / 2 * quarters), -math.sin(q), 0],
                [math.sin(q), math.cos(q), 0],
                [0, 0, 1],
            ]
        )
        H, W = (c.H, c.W) if quarters == 2 else (c.W, c.H)
        cameras.append(Camera(turn @ c.R, c.eye, c.fx, c.fy, (W - 1) / 2, (H - 1) / 2, H, W))
        images.append(np.ascontiguousarray(np.rot90(view.image, -quarters)))
    sky, upright = searched(outdoors, images=images, cameras=cameras), searched(outdoors)
    assert sky.is_certain and sky.up @ upright.up > 0.99
    assert sky.share == pytest.approx(upright.share, rel=0.05)


def test_noise_and_varying_exposures_do_not_hide_the_sky(outdoors):
    rng = np.random.default_rng(0)
    images = []
    for view in outdoors.views:
        light = view.image * rng.uniform(0.75, 1.0, 3) + rng.normal(scale=1.5, size=view.image.shape)
        images.append(np.clip(np.round(light), 0, 255).astype(np.uint8))
    assert searched(outdoors, images=images).lies_at_infinity


def test_photos_may_differ_in_size(outdoors):
    cameras, images = [v.camera for v in outdoors.views], [v.image for v in outdoors.views]
    small = outdoors.views[3].scaled(2.0)
    cameras[3], images[3] = small.camera, small.read().image
    assert searched(outdoors, images=images, cameras=cameras).photos == 20


def test_without_points_the_photos_decide_alone(outdoors):
    assert searched(outdoors, NO_POINTS).is_certain


def test_masked_pixels_and_points_are_no_sky(outdoors):
    cameras, images = [v.camera for v in outdoors.views], [v.image for v in outdoors.views]
    masks = [~part for part in outdoors.sky]
    assert find_sky(cameras, images, outdoors.points, masks).share < 0.005
    far = 100.0 * fibonacci(60_000)
    assert searched(outdoors, points=far).share < 0.005


def test_directions_are_spread_evenly():
    points = fibonacci(1_000)
    assert np.allclose(np.linalg.norm(points, axis=1), 1)
    assert np.abs(points.mean(axis=0)).max() < 1e-3
    near = np.sort(points @ points.T, axis=1)[:, -2]
    assert np.arccos(near).min() > 0.75 * math.sqrt(4 * math.pi / 1_000)


def test_the_size_of_a_scene():
    cameras = [view.camera for view in outdoor_capture(8, 6, 4, points=4).views]
    reach = max(np.linalg.norm(c.eye - np.mean([k.eye for k in cameras], axis=0)) for c in cameras)
    assert scene_size(cameras, NO_POINTS) == pytest.approx(reach)
    assert scene_size(cameras, np.full((50, 3), 100.0)) > 150
    assert scene_size(cameras[:1], NO_POINTS) == 1.0


def test_photos_without_common_directions_show_no_sky():
    """White photos share no direction, so the white may be near."""
    turns = np.arange(4) * math.pi / 2
    cameras = [
        Camera.looking_at((0.0, 0.0, 0.0), (math.cos(t), -0.5, math.sin(t)), 60, 60, 20, 20) for t in turns
    ]
    images = [np.full((20, 20, 3), 250, np.uint8)] * 4
    sky = find_sky(cameras, images, NO_POINTS)
    assert sky.share > 0.5 and sky.spread == math.inf and not sky.is_certain
    assert not find_sky(cameras[:1], images[:1], NO_POINTS).is_certain
    tiny = [Camera.looking_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1, 1, 1, 1)]
    assert find_sky(tiny, [np.full((1, 1, 3), 250, np.uint8)], NO_POINTS).share == 0.0


def test_ground_seen_from_above_is_no_sky():
    """A drone looks down on smooth ground, which is below every horizon, also if photos are upside down."""
    cameras, images = [], []
    for i in range(16):
        eye = np.array([3.0 * (i % 4), -9.0, 3.0 * (i // 4)])
        up = (0.0, 0.0, 1.0) if i % 2 else (0.0, 0.0, -1.0)
        cameras.append(Camera.looking_at(eye, eye + np.array([0.3, 9.0, 0.2]), 70, 70, 60, 80, up))
        images.append(photograph(cameras[-1])[0])
    smooth = [np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0)) for image in images]
    for given in (images, smooth):
        assert not find_sky(cameras, given, NO_POINTS).is_certain
