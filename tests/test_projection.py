"""Projections and shutters: images of points, Jacobians, inverses, and what is refused."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera, build_cov3d, project_cov3d, quat_to_R
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import COEFFICIENTS, Distortion, Projection
from gsplat_edu.scene.projection_formulas import distort
from gsplat_edu.scene.shutter import RollingShutter
from lens_scenes import CENTRE, LENSES, MOVING, ROTATION, lens_camera


def seen_points(camera, seed=0):
    """Return points on the rays of every third pixel, at random depths, and their pixels."""
    rays, origins = camera.rays()[::3, ::3], camera.origins()[::3, ::3]
    v, u = np.mgrid[: camera.H : 3, : camera.W : 3]
    depth = np.random.default_rng(seed).uniform(2, 5, u.shape)
    has = np.isfinite(rays).all(axis=-1)
    points = origins + depth[..., None] * rays
    return points[has], u[has], v[has], depth[has]


@pytest.mark.parametrize("name", LENSES)
def test_a_point_on_the_ray_of_a_pixel_is_seen_at_the_pixel(name):
    camera = lens_camera(name)
    points, u, v, depth = seen_points(camera)
    seen = camera.sight(points)
    good = seen.valid
    assert good.mean() > 0.95 and len(points) > 100
    # Newton's method stops after three steps: with a shutter, 1e-4 px are left at the widest angles.
    atol = 1e-9 if camera.shutter is None else 1e-3
    np.testing.assert_allclose(np.asarray(seen.u)[good], u[good], rtol=0, atol=atol)
    np.testing.assert_allclose(np.asarray(seen.v)[good], v[good], rtol=0, atol=atol)
    np.testing.assert_allclose(np.asarray(seen.depth)[good], depth[good], rtol=0, atol=atol)


@pytest.mark.parametrize("name", LENSES)
def test_the_jacobian_is_the_derivative_of_the_image_point(name):
    camera = lens_camera(name)
    points = seen_points(camera)[0]
    if camera.projection.kind == "equirectangular":  # nearer to the poles, it is bounded
        offset = (points - CENTRE) @ ROTATION.T
        points = points[np.abs(offset[:, 1]) < 0.95 * np.linalg.norm(offset, axis=1)]
    points = points[camera.sight(points).valid]
    rows = np.stack(
        [np.stack(np.broadcast_arrays(*row), axis=-1) for row in camera.sight(points).jacobian], axis=-2
    )
    step = 1e-6
    for k in range(3):
        aside = np.eye(3)[k] * step
        after, before = camera.sight(points + aside), camera.sight(points - aside)
        for axis, (high, low) in enumerate(((after.u, before.u), (after.v, before.v))):
            slope = (high - low) / (2 * step)
            wrapped = np.abs(high - low) > camera.W / 2
            # The position is exact to 1e-4 px where the shutter's three steps are; its slope is, relative to the depth.
            tolerance = 1e-6 if camera.shutter is None else 3e-3
            np.testing.assert_allclose(
                rows[~wrapped, axis, k], slope[~wrapped], rtol=tolerance, atol=tolerance
            )


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_lenses_without_distortion_are_the_textbook_ones(kind):
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 11.0, 20.0, 15.0, 37, 45).through(Projection(kind))
    angle = 0.7
    u, v, depth = camera.project(2.0 * np.array([np.sin(angle), 0.0, np.cos(angle)]))
    expected = {"perspective": np.tan(angle), "fisheye": angle}[kind]
    assert u == pytest.approx(camera.fx * expected + camera.cx, abs=1e-12)
    assert v == pytest.approx(camera.cy, abs=1e-12)
    assert depth == pytest.approx({"perspective": 2.0 * np.cos(angle), "fisheye": 2.0}[kind])


def test_a_fisheye_sees_behind_and_a_pinhole_does_not():
    behind = np.array([[np.sin(2.0), 0.0, np.cos(2.0)]])
    camera = lens_camera("equidistant", 200, 200)
    wide = Camera(np.eye(3), np.zeros(3), 40.0, 40.0, 100.0, 100.0, 200, 200).through(camera.projection)
    seen = wide.sight(behind)
    assert seen.valid.all() and seen.u[0] == pytest.approx(180.0)
    assert np.isnan(
        Camera(np.eye(3), np.zeros(3), 40.0, 40.0, 100.0, 100.0, 200, 200).project(behind)[0]
    ).all()


def test_a_lens_ends_where_its_image_turns_back():
    """r (1 - 0.3 r²) grows up to r = 1.054; a point beyond would be drawn in the middle of the image."""
    lens = Projection(distortion=Distortion.of(k1=-0.3))
    camera = Camera(np.eye(3), np.zeros(3), 50.0, 50.0, 49.5, 49.5, 100, 100).through(lens)
    assert np.tan(camera.widest) == pytest.approx(np.sqrt(1 / 0.9), rel=2e-3)
    assert camera.sight(np.array([[1.0, 0.0, 1.0], [1.1, 0.0, 1.0]])).valid.tolist() == [True, False]
    corner = camera.rays()[0, 0]
    assert np.isnan(corner).all(), "the corner is at 0.99, the lens's image ends at 0.70"


def test_the_margin_ends_the_polynomials():
    """Beyond 1.5 times the corner's radius nothing is projected, however far the polynomial would go on growing."""
    lens = Projection("fisheye", Distortion.of(k1=0.01))
    camera = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 49.5, 49.5, 100, 100).through(lens)
    corner = np.hypot(50.0, 50.0) / 100.0
    radius = camera.widest * (1 + 0.01 * camera.widest**2)
    assert radius == pytest.approx(1.5 * corner, rel=5e-3)


def test_a_photo_turned_by_a_quarter_shows_the_same_rays():
    for name in ("opencv", "prism", "thin prism", "radial first", "orthographic"):
        before = lens_camera(name).intrinsics
        after = before.turned(1)
        x, y, z = 0.2, -0.3, 1.5
        u, v, _ = Camera.posed(np.eye(3), np.zeros(3), before).project(np.array([x, y, z]))
        U, V, _ = Camera.posed(np.eye(3), np.zeros(3), after).project(np.array([-y, x, z]))
        assert (float(U), float(V)) == pytest.approx((before.H - 1 - float(v), float(u)), abs=1e-12), name
        again = before.turned(4)
        assert (
            again.projection == before.projection
            or again.projection.distortion.coefficients
            == pytest.approx(before.projection.distortion.coefficients)
        )


def test_a_photo_at_another_size_shows_the_same_rays():
    for name in LENSES:
        camera = lens_camera(name, 40, 32)
        small = camera.scaled(20, 16)
        assert small.shutter is camera.shutter and small.projection == camera.projection
        inside = camera.rays()[10, 14] + camera.rays()[11, 15] + camera.rays()[10, 15] + camera.rays()[11, 14]
        if camera.shutter is None and camera.projection.kind != "equirectangular":
            np.testing.assert_allclose(small.rays()[5, 7], inside / 4, rtol=0, atol=3e-3)


def test_covariances_are_projected_by_the_lens():
    camera = lens_camera("fisheye")
    cov = build_cov3d((0.1, 0.2, 0.05), quat_to_R((1, 0.2, 0.1, 0.3)))
    mean = np.array([0.4, 0.3, 0.8])
    found = project_cov3d(cov, mean, camera)
    seen = camera.sight((mean @ camera.R + camera.eye)[None])
    JW = np.array([[np.ravel(entry)[0] for entry in row] for row in seen.jacobian])
    np.testing.assert_allclose(found, JW @ cov @ JW.T, rtol=0, atol=1e-9)
    with pytest.raises(ArgumentError, match="not seen by the lens"):
        project_cov3d(cov, np.array([0.0, 0.01, -1.0]), camera)
    with pytest.raises(ArgumentError, match="rolling shutter"):
        project_cov3d(cov, mean, lens_camera("fisheye, moving"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Projection("cylinder"), "kind"),
        (lambda: Projection("orthographic", Distortion.of(k1=0.1)), "distortion"),
        (lambda: Distortion((0.0,) * 16), "at most 15"),
        (lambda: Distortion((np.nan,)), "finite"),
        (lambda: Distortion.of(k7=1.0), "k7"),
        (lambda: RollingShutter((0, 0, 0), (0, 0, 0), "sideways"), "readout"),
        (lambda: RollingShutter((2, 0, 0), (0, 0, 0)), "radian"),
        (lambda: RollingShutter((0, 0, np.nan), (0, 0, 0)), "turn"),
        (
            lambda: Camera(np.eye(3), np.zeros(3), 9, 9, 4, 4, 9, 18).through(Projection("equirectangular")),
            "W / 2 pi",
        ),
        (
            lambda: Camera.panorama(np.eye(3), np.zeros(3), 8, 16).through(
                Projection("equirectangular"), RollingShutter(MOVING.turn, MOVING.shift, "left")
            ),
            "by rows",
        ),
        (lambda: Camera.panorama(np.eye(3), np.zeros(3), 8, 16).intrinsics.turned(1), "cannot be turned"),
    ],
)
def test_bad_lenses_are_refused(as_shipped, make, message):
    with pytest.raises(ArgumentError, match=message):
        make()


def test_intrinsics_are_those_of_a_pinhole_unless_they_say_otherwise():
    assert Intrinsics(4, 3, 5.0, 5.0, 2.0, 1.5).projection.plain
    assert lens_camera("pinhole, moving").projection.plain and not lens_camera("pinhole, moving").pinhole
    assert len(COEFFICIENTS) == len(Distortion().coefficients) == 15


@pytest.mark.parametrize(
    ("kind", "coefficients", "reach"),
    [
        ("fisheye", {"k1": -0.01, "k2": 0.004, "k3": -0.002, "k4": 0.0003}, 2.4),
        ("fisheye", {"k1": 0.05, "k2": -0.02}, 1.8),
        ("perspective", {"k1": -0.3}, 1.2),  # whose image stops growing at a radius of 0.7
        ("perspective", {"k1": 0.3, "k2": 0.1, "d1": 0.6, "d2": 0.2}, 2.0),
    ],
)
def test_rays_of_a_radial_distortion_are_found_from_the_radius_alone(kind, coefficients, reach):
    """A decentring too small to change a digit takes the way of all coefficients; both find the same rays.

    Newton's method ends at rounding, which the slope of the inverse enlarges, by less than 100 on these radii.
    """
    alone, tiny = (Projection(kind, Distortion.of(**coefficients, **more)) for more in ({}, {"p1": 1e-300}))
    radius = np.linspace(0, reach, 700)
    a, b = np.cos(7 * radius) * radius, np.sin(7 * radius) * radius
    angle = alone.widest(reach)
    found, expected = alone.directions(a, b, angle), tiny.directions(a, b, angle)
    held = np.isfinite(found).all(axis=1)
    assert (held == np.isfinite(expected).all(axis=1)).all() and held.sum() > 100
    near = held & (radius < 0.95 * radius[held].max())
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=100 * 2.3e-16)
    plane, _ = distort(*found_on_plane(kind, found[held]), alone.distortion.coefficients, False)
    np.testing.assert_allclose(np.stack(plane), [a[held], b[held]], rtol=0, atol=1e-9)


def found_on_plane(kind, rays):
    """Return where an undistorted lens shows rays, (n,) each."""
    if kind == "perspective":
        return rays[:, 0], rays[:, 1]
    across = np.hypot(rays[:, 0], rays[:, 1])
    scale = np.arctan2(across, rays[:, 2]) / np.where(across > 0, across, 1)
    return scale * rays[:, 0], scale * rays[:, 1]
