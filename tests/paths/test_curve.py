"""The motion passes through all keyframes, smoothly, at constant speed or at the given times."""

import math

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from gsplat_edu.paths.curve import PathCurve, Travel, monotone_interpolation
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.scene.camera import look_at

# Keyframes are unevenly spaced, and the camera also rotates and zooms.
EYES = [(0, 0, -4), (0.3, -0.2, -3.8), (2.5, -0.5, -2), (3, 0, 1), (0.5, 0.4, 3.5)]
FOVS = [50, 55, 40, 60, 45]


def keyframes(times=(None, None, None, None, None)):
    """Return keyframes around the origin, which look near it."""
    return tuple(
        Keyframe(np.array(eye, float), look_at(eye, (0.1 * i, 0.1, 0)), float(fov), time)
        for i, (eye, fov, time) in enumerate(zip(EYES, FOVS, times, strict=True))
    )


def turned(axis, degrees, eye=(0.0, 0.0, 0.0), fov=50.0, time=None):
    """Return a keyframe rotated about an axis."""
    R = Rotation.from_rotvec(np.radians(degrees) * np.array(axis, float)).as_matrix().T
    return Keyframe(np.array(eye, float), R, fov, time)


def angles(a, b):
    """Return the angles between rotations, radians."""
    return Rotation.from_matrix(a @ np.swapaxes(b, -1, -2)).magnitude()


def speeds(curve, times, dt):
    """Return central differences: velocity, angular velocity in the camera's frame, rate of ln tan(fov / 2)."""
    (e0, r0, f0), (e1, r1, f1) = (curve.poses(times + side * dt / 2) for side in (-1, 1))
    turn = Rotation.from_matrix(r1 @ np.swapaxes(r0, 1, 2)).as_rotvec() / dt
    zoom = np.diff(np.log(np.tan(np.radians([f0, f1]) / 2)), axis=0)[0] / dt
    return (e1 - e0) / dt, turn, zoom


def nearest(curve, keyframe, times):
    """Return the smallest distance of a curve from a keyframe at the given times, world units and radians."""
    eyes, rotations, fovs = curve.poses(times)
    moved = np.linalg.norm(eyes - keyframe.eye, axis=1)
    best = (moved + angles(rotations, keyframe.R) + np.radians(abs(fovs - keyframe.fov))).argmin()
    return moved[best], float(angles(rotations[best], keyframe.R)), abs(fovs[best] - keyframe.fov)


@pytest.mark.parametrize("loop", [False, True])
def test_the_camera_passes_through_all_keyframes_at_constant_speed(loop):
    path = KeyframePath(keyframes(), loop)
    curve = PathCurve(path)
    assert path.seconds == 2.0 * (5 if loop else 4), "two seconds per segment"
    times = np.linspace(0, path.seconds, 20001)
    for keyframe in path.keyframes:
        # Between two samples the camera moves by length / 20000, which the radius converts to an angle.
        step = curve.length / 20000
        off = nearest(curve, keyframe, times)
        assert off[0] <= step and off[1] <= step / curve.travel.radius and off[2] < 0.1
    dt = 1e-4
    moved, turn, zoom = speeds(curve, times[10:-10:7], dt)
    turning = np.hypot(np.linalg.norm(turn, axis=1), zoom)
    speed = (
        np.hypot(np.linalg.norm(moved, axis=1), curve.travel.radius * turning) * path.seconds / curve.length
    )
    # The table has 64 chords per segment. Inside a segment, slopes from chords on both sides are off by (1/64)² times
    # the speed's second relative derivative per segment, here below 8. At keyframes, where the acceleration jumps, and
    # at open ends, they are off by 1/64 times the first one, here below 2.
    assert np.quantile(abs(speed - 1), 0.95) < 8 / 64**2 and abs(speed - 1).max() < 2 / 64


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("times", [None, (0.0, 0.5, 2.0, 2.4, 6.0)])
def test_velocities_are_continuous_across_keyframes(loop, times):
    """All velocities agree just before and just after any instant, including the seam of a loop."""
    path = KeyframePath(keyframes(times or (None,) * 5), loop, 9.0 if loop else None)
    curve = PathCurve(path)
    dt = 1e-5
    if times is None:
        grid = np.linspace(0, path.seconds, 4001)
        at = np.array([grid[_closest(curve, k, grid)] for k in path.keyframes])
    else:
        at = np.array(times)
    at = at if loop else at[1:-1]
    # In 200 steps around each keyframe, a jump of the velocity would appear between two of them.
    around = at[:, None] + np.linspace(-2e-3, 2e-3, 201)
    moved, turn, zoom = (x.reshape(len(at), 201, -1) for x in speeds(curve, around.ravel(), dt))
    for rates in (moved, turn, zoom):
        scale = np.abs(rates).max()
        assert scale > 0.01, "the velocity changes at all"
        # The velocity changes by its own size in a hundredth of a second at the fastest, so by 2e-3 of it in 2e-5 s;
        # differences of positions of size 4 over 1e-5 s have rounding errors of 1e-10.
        assert np.abs(np.diff(rates, axis=1)).max() < 5e-3 * scale


def _closest(curve, keyframe, times):
    eyes, rotations, _ = curve.poses(times)
    return (np.linalg.norm(eyes - keyframe.eye, axis=1) + angles(rotations, keyframe.R)).argmin()


@pytest.mark.parametrize("loop", [False, True])
def test_keyframes_are_met_at_their_times(loop):
    times = (1.0, 1.5, 4.0, 4.2, 8.0)
    path = KeyframePath(keyframes(times), loop, 9.5 if loop else None)
    curve = PathCurve(path)
    assert curve.seconds == (9.5 if loop else 7.0)
    eyes, rotations, fovs = curve.poses(np.array(times) - 1.0)
    for i, keyframe in enumerate(path.keyframes):
        np.testing.assert_allclose(eyes[i], keyframe.eye, atol=1e-9)
        np.testing.assert_allclose(rotations[i], keyframe.R, atol=1e-9)
        assert fovs[i] == pytest.approx(keyframe.fov)
    first, again = (np.concatenate([x.ravel() for x in curve.poses([t])]) for t in (0.25, 0.25 + 9.5))
    assert np.allclose(first, again) == loop, "a loop repeats its motion, an open path does not"


def test_the_times_change_the_speed_and_not_the_curve():
    plain, timed = (
        PathCurve(KeyframePath(keyframes(t), False)) for t in ((None,) * 5, (0.0, 5.0, 5.5, 7.0, 7.5))
    )
    assert timed.length == pytest.approx(plain.length)
    fine = plain.poses(np.linspace(0, plain.seconds, 20001))[0]
    for eye in timed.poses(np.linspace(0, 7.5, 40))[0]:
        assert np.linalg.norm(fine - eye, axis=1).min() < plain.length / 20000


def test_rotations_go_the_short_way_and_at_constant_speed():
    """From 170 to -170 degrees, the camera rotates by 20 degrees, not by 340."""
    curve = PathCurve(KeyframePath((turned((0, 1, 0), 170), turned((0, 1, 0), -170)), False))
    _, rotations, _ = curve.poses(np.linspace(0, 2, 5))
    expected = Rotation.from_rotvec(np.radians([[0, a, 0] for a in (170, 175, 180, 185, 190)])).as_matrix()
    np.testing.assert_allclose(rotations, np.swapaxes(expected, 1, 2), atol=1e-12)


@pytest.mark.parametrize("count", [3, 4, 7])
def test_a_full_turn_in_a_loop_closes_although_the_quaternion_changes_its_sign(count):
    """The camera rotates without moving, so its angular speed is constant."""
    frames = tuple(turned((0, 1, 0), 360 * i / count) for i in range(count))
    curve = PathCurve(KeyframePath(frames, True, 10.0))
    _, rotations, _ = curve.poses(np.linspace(0, 10, 101))
    steps = angles(rotations[1:], rotations[:-1])
    np.testing.assert_allclose(steps, 2 * math.pi / 100, rtol=1e-9)
    np.testing.assert_allclose(rotations[-1], rotations[0], atol=1e-9)


def test_a_ring_of_keyframes_gives_nearly_a_circle():
    """Between the keyframes of a ring, the camera keeps its distance from the centre."""
    ring = [2 * math.pi * i / 12 for i in range(12)]
    eyes = [(3 * math.sin(a), -1.0, -3 * math.cos(a)) for a in ring]
    path = KeyframePath(tuple(Keyframe(np.array(e), look_at(e, (0, -1, 0)), 50.0) for e in eyes), True)
    curve = PathCurve(path)
    eyes, rotations, _ = curve.poses(np.linspace(0, path.seconds, 600))
    # A Catmull-Rom segment over the angle h comes to (9 cos(h/2) - cos(3h/2)) / 8 = 1 - 3 h⁴ / 128 of the radius.
    assert abs(np.hypot(eyes[:, 0], eyes[:, 2]) - 3).max() < 3 * 3 / 128 * (2 * math.pi / 12) ** 4
    inwards = -eyes * (1, 0, 1) / np.hypot(eyes[:, 0], eyes[:, 2])[:, None]
    assert np.sum(inwards * rotations[:, 2], axis=1).min() > np.cos(np.radians(0.5))
    # One radian counts as much as the radius of the circle, except that the polygon is shorter than the circle.
    assert curve.travel.radius == pytest.approx(3 * math.sin(math.pi / 12) / (math.pi / 12))


def test_three_keyframes_of_an_open_path_are_one_parabola():
    """At the two ends, there is no fourth keyframe that would change the curve."""
    path = KeyframePath(tuple(turned((0, 1, 0), 0, (x, x * x, 5.0)) for x in (-1.0, 0.0, 1.0)), False)
    x, y, z = PathCurve(path).poses(np.linspace(0, 4, 41))[0].T
    np.testing.assert_allclose(y, x * x, atol=1e-12)
    np.testing.assert_allclose(z, 5.0)
    assert (x[0], x[20], x[40]) == pytest.approx((-1.0, 0.0, 1.0))


def test_equal_keyframes_are_merged_or_a_rest_if_they_have_times():
    a, b, c = turned((0, 1, 0), 0), turned((0, 1, 0), 20, (1, 0, 0)), turned((1, 0, 0), 20, (1, 2, 0))
    twice, once = (PathCurve(KeyframePath(k, False, 4.0)) for k in ((a, b, b, c), (a, b, c)))
    for one, other in zip(twice.poses(np.linspace(0, 4, 50)), once.poses(np.linspace(0, 4, 50)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    timed = [turned((0, 1, 0), 20 * min(i, 1), (min(i, 1), 0, 2 * (i > 2)), time=float(i)) for i in range(4)]
    eyes, rotations, _ = PathCurve(KeyframePath(tuple(timed), False)).poses(np.linspace(0, 3, 31))
    np.testing.assert_allclose(eyes[10:21], np.repeat([[1.0, 0, 0]], 11, axis=0), atol=1e-12)
    np.testing.assert_allclose(rotations[10:21], np.repeat(rotations[10:11], 11, axis=0), atol=1e-12)
    assert eyes[9, 0] < 1 and eyes[21, 2] > 0


@pytest.mark.parametrize("loop", [False, True])
@pytest.mark.parametrize("times", [(None, None, None), (0.0, 1.0, 2.0)])
def test_a_path_whose_keyframes_are_all_equal_stands_still(loop, times):
    frames = tuple(turned((0, 1, 0), 30, (1, 2, 3), time=t) for t in times)
    eyes, rotations, fovs = PathCurve(KeyframePath(frames, loop, 3.0 if loop else None)).poses(
        [0.0, 0.7, 1.9]
    )
    np.testing.assert_allclose(eyes, [(1, 2, 3)] * 3)
    np.testing.assert_allclose(rotations, [frames[0].R] * 3, atol=1e-12)
    np.testing.assert_allclose(fovs, 50.0)


def test_a_zoom_without_motion_is_linear_in_the_logarithm():
    path = KeyframePath((turned((0, 1, 0), 0, fov=90.0), turned((0, 1, 0), 0, fov=10.0)), False)
    _, _, fovs = PathCurve(path).poses(np.linspace(0, 2, 5))
    scales = np.tan(np.radians(fovs) / 2)
    np.testing.assert_allclose(scales[1:] / scales[:-1], (scales[-1] / scales[0]) ** 0.25)


def test_a_slight_turn_on_a_straight_flight_does_not_disturb_its_speed():
    path = KeyframePath(tuple(turned((0, 1, 0), (i % 2) * 0.5, (0, 0, 3.0 * i)) for i in range(5)), False)
    z = PathCurve(path).poses(np.linspace(0, 8, 81))[0][:, 2]
    # Rotating by 0.009 over 3 units with a radius of 12 / 2 pi changes a step by (0.017 / 3)² / 2.
    np.testing.assert_allclose(np.diff(z), 12 / 80, rtol=1e-4)


def test_the_monotone_cubic_agrees_with_scipys_inside():
    """SciPy chooses other slopes, but only at the two ends."""
    rng = np.random.default_rng(0)
    x, y = np.cumsum(rng.uniform(0.1, 3, 12)), np.cumsum(rng.choice([0.0, 0.3, 2.0, 7.0], 12))
    at = np.linspace(x[1], x[-2], 300)
    np.testing.assert_allclose(
        monotone_interpolation(x, y, at, False), PchipInterpolator(x, y)(at), rtol=1e-12
    )
    everywhere = monotone_interpolation(x, y, np.linspace(x[0], x[-1], 2000), False)
    assert np.diff(everywhere).min() >= -1e-12


def test_cameras_of_a_video():
    curve = PathCurve(KeyframePath(keyframes(), False))
    cameras = curve.cameras(9, 64, 48)
    assert len(cameras) == 9 and {(c.W, c.H, c.cx, c.cy) for c in cameras} == {(64, 48, 31.5, 23.5)}
    np.testing.assert_allclose(cameras[0].eye, EYES[0])
    np.testing.assert_allclose(cameras[-1].eye, EYES[-1])
    for camera, fov in ((cameras[0], 50), (cameras[-1], 45)):
        assert Keyframe.of_camera(camera).fov == pytest.approx(fov) and camera.fx == camera.fy
    around = PathCurve(KeyframePath(keyframes(), True))
    moved = np.linalg.norm(around.cameras(1000, 8, 8)[-1].eye - np.array(EYES[0]))
    assert 0 < moved <= around.length / 1000 * 1.01, "the last frame is one interval before the first"


def test_the_measure_of_distance_follows_the_scale_of_the_scene():
    """A path ten times as large passes the keyframes at the same times."""
    small, large = (
        PathCurve(KeyframePath(keyframes(), False).placed(np.eye(3), s, (0, 0, 0))) for s in (1, 10)
    )
    assert large.length == pytest.approx(10 * small.length)
    at = np.linspace(0, 8, 30)
    np.testing.assert_allclose(large.poses(at)[0], 10 * small.poses(at)[0], atol=1e-9)
    assert Travel(2.0).between(np.zeros((1, 8))).shape == (0,)
