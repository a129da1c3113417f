"""The clamp of the Jacobian behind perspective lenses and rolling shutters: its bounds, and the ellipse it gives."""

import numpy as np
import pytest

from gsplat_edu import Camera, project_cov3d, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from lens_scenes import LIMIT, LOST, around, beyond, lens_camera, lost


def rows(seen):
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in seen.jacobian], axis=-2)


def test_bounds_of_a_distorted_lens_are_the_rays_of_its_edges():
    camera = lens_camera("prism")
    W, H = camera.W, camera.H
    columns, lines = np.meshgrid(np.linspace(-0.5, W - 0.5, 50), np.linspace(-0.5, H - 0.5, 40))
    x, y = (columns - camera.cx) / camera.fx, (lines - camera.cy) / camera.fy
    rays = camera.projection.directions(x, y, camera.widest)[..., :2].reshape(-1, 2)
    low, high = np.transpose(camera.jacobian_bounds(1.0))
    np.testing.assert_allclose(low, rays.min(axis=0), atol=1e-3)
    np.testing.assert_allclose(high, rays.max(axis=0), atol=1e-3)
    wide_low, wide_high = np.transpose(camera.jacobian_bounds(1.3))
    np.testing.assert_allclose(wide_high - wide_low, 1.3 * (high - low), rtol=1e-12)
    np.testing.assert_allclose(wide_high + wide_low, high + low, rtol=1e-12)


def test_bounds_of_coefficients_of_zero_and_of_a_shutter_are_a_pinhole_s():
    camera = lens_camera("pinhole, moving")
    pinhole = camera.through(Projection()).jacobian_bounds(1.3)
    assert camera.jacobian_bounds(1.3) == pinhole
    zero = camera.through(Projection(distortion=Distortion())).jacobian_bounds(1.3)
    np.testing.assert_allclose(zero, pinhole, rtol=1e-12)


def test_a_lens_that_turns_back_within_its_image_is_bounded_by_its_widest_angle():
    camera = lens_camera("opencv")
    assert np.isnan(camera.rays()).any()
    most = np.tan(camera.widest)
    np.testing.assert_allclose(camera.jacobian_bounds(1.0), [(-most, most)] * 2)


@pytest.mark.parametrize("kind", ["fisheye", "orthographic", "panorama"])
def test_other_projections_have_no_bounds(kind):
    camera, scene = lens_camera(kind), around(100)
    assert camera.jacobian_bounds(1.3) == ((-np.inf, np.inf), (-np.inf, np.inf))
    assert (rows(camera.sight(scene.means, jacobian_limit=1.0)) == rows(camera.sight(scene.means))).all()


@pytest.mark.parametrize(
    "name", ["prism", "pinhole, moving", "pincushion, moving", "pinhole, blurred", "pincushion, blurred"]
)
def test_place_and_depth_stay_and_the_ellipse_is_that_of_the_clamped_point(name):
    camera, scene = lens_camera(name), around(300)
    free, seen = camera.sight(scene.means, 0.05), camera.sight(scene.means, 0.05, LIMIT)
    moved = beyond(scene, camera)
    assert moved.sum() > 10 and (~moved & seen.valid).sum() > 10
    for field in ("u", "v", "depth"):
        assert (getattr(free, field)[seen.valid] == getattr(seen, field)[seen.valid]).all()
    assert (rows(free)[seen.valid & ~moved] == rows(seen)[seen.valid & ~moved]).all()
    # Three steps of Newton's method find the row of those that the lens also sees at half time.
    found = [
        i
        for i in np.flatnonzero(moved)
        if camera.through(camera.projection).sight(scene.means[i : i + 1]).valid[0]
    ]
    for i in found[:12]:
        expected = derivative(camera, scene.means[i], (free.u[i], free.v[i]), camera.jacobian_bounds(LIMIT))
        np.testing.assert_allclose(rows(seen)[i], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def derivative(camera, mean, place, bounds):
    """Return by finite differences how the image of the clamped point moves with it, if its row is read when the
    mean's is."""
    shutter = camera.shutter or RollingShutter((0, 0, 0), (0, 0, 0))
    axis, size = shutter.axis, (camera.W, camera.H)[shutter.axis]
    sign = {"up": -1, "left": -1, AT_ONCE: 0}.get(shutter.readout, 1)
    start = sign * ((place[axis] + 0.5) / size - 0.5)

    def turn(time):
        half = 0.5 * time * shutter.turn
        cross = np.array([[0, -half[2], half[1]], [half[2], 0, -half[0]], [-half[1], half[0], 0]])
        return np.linalg.solve(np.eye(3) - cross, np.eye(3) + cross) @ camera.R

    still = Camera.posed(np.eye(3), np.zeros(3), camera.intrinsics)

    def image(point, time):
        p = turn(time) @ (point - camera.eye - time * shutter.shift)
        seen = still.sight(p[None])
        return np.array([seen.u[0], seen.v[0]])

    p = turn(start) @ (mean - camera.eye - start * shutter.shift)
    p[:2] = [np.clip(c / p[2], *bound) * p[2] for c, bound in zip(p[:2], bounds, strict=True)]
    clamped = turn(start).T @ p + camera.eye + start * shutter.shift
    first = image(clamped, start)

    def seen_at(point):
        time = start
        for _ in range(60):
            time = start + sign * (image(point, time) - first)[axis] / size
        return image(point, time)

    step = 1e-5 * np.linalg.norm(p)
    return np.stack(
        [(seen_at(clamped + d) - seen_at(clamped - d)) / (2 * step) for d in step * np.eye(3)], -1
    )


def test_a_splat_at_twice_the_field_does_not_reach_the_image_of_a_shutter():
    """A needle along the optical axis, at x/z = 1.04 where the image ends at 0.5; unclamped, it points inwards."""
    base = Camera(np.eye(3), np.zeros(3), 40.0, 40.0, 19.5, 19.5, 40, 40)
    moving = base.through(Projection(), RollingShutter((0.1, 0.05, 0.0), (0.0, 0.0, 0.0)))
    zero = base.through(Projection(distortion=Distortion()))
    needle = np.diag([1e-4, 1e-4, 0.22**2])[None]
    for camera in (moving, zero, base):
        given = (camera, np.array([[1.04, 0.0, 1.0]]), needle, np.ones((1, 3)), np.array([0.9]))
        bounded, _ = render_gaussians(*given, extent="exact", jacobian_limit=1.3)
        free, _ = render_gaussians(*given, extent="exact")
        assert free.max() > 0.02 and bounded.max() == 0


def test_project_cov3d_clamps_behind_a_lens():
    camera = Camera.posed(np.eye(3), np.zeros(3), lens_camera("prism").intrinsics)
    mean, cov = np.array([1.25, 0.0, 1.0]), 0.01 * np.eye(3)
    (_, edge), _ = camera.jacobian_bounds(1.1)
    assert edge < 1.25
    found = project_cov3d(cov, mean, camera, jacobian_limit=1.1)
    np.testing.assert_allclose(found, project_cov3d(cov, [edge, 0.0, 1.0], camera), rtol=1e-12)
    assert (found != project_cov3d(cov, mean, camera)).any()


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_what_newton_s_method_does_not_find_is_not_drawn(backend):
    scene, camera = lost()
    x, y, z = (scene.means[LOST] - camera.eye) @ camera.R.T
    assert x / z > 1.9 and y / z > 5
    assert not camera.sight(scene.means[[LOST]], 0.05).valid[0]
    assert LOST not in render(scene.gaussians(), camera, backend=backend).visible.tolist()
