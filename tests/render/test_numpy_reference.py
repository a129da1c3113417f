"""The NumPy reference equals an independent implementation of its formulas, pixel by pixel."""

import numpy as np
import pytest

from gsplat_edu import Camera, project_cov3d, render_gaussians, sphere_shell

TIGHT = {"rtol": 0, "atol": 1e-13}  # rounding of a few hundred float64 operations on numbers of order 1


def by_the_book(cam, means, cov3ds, colors, opacities, bg=(0.0, 0.0, 0.0), tile=None):
    """Composite pixel by pixel. With `tile`, stop a tile once the transmittance of all its pixels is below 1e-4."""
    means_cam = cam.world_to_cam(means)
    order = [i for i in np.argsort(means_cam[:, 2], kind="stable") if means_cam[i, 2] > 0.05]
    u, v, _ = cam.project(means_cam)
    inverse = [np.linalg.inv(project_cov3d(cov3ds[i], means_cam[i], cam) + 0.3 * np.eye(2)) for i in order]
    image, T = np.zeros((cam.H, cam.W, 3)), np.ones((cam.H, cam.W))
    step = tile or max(cam.H, cam.W)
    for y0 in range(0, cam.H, step):
        for x0 in range(0, cam.W, step):
            pixels = [
                (y, x) for y in range(y0, min(y0 + step, cam.H)) for x in range(x0, min(x0 + step, cam.W))
            ]
            for i, conic in zip(order, inverse, strict=True):
                if tile and all(T[p] < 1e-4 for p in pixels):
                    break
                for y, x in pixels:
                    d = np.array([x - u[i], y - v[i]])
                    alpha = min(0.99, opacities[i] * np.exp(-0.5 * d @ conic @ d))
                    if alpha >= 1 / 255:
                        image[y, x] += T[y, x] * alpha * colors[i]
                        T[y, x] *= 1 - alpha
    return image + T[..., None] * np.asarray(bg), T


def test_exact_extent_without_stop_follows_the_formula(random_splats, random_camera):
    splats = random_splats(30)
    image, T = render_gaussians(random_camera, *splats, bg=(0.2, 0.4, 0.9), extent="exact", stop="none")
    expected, expected_T = by_the_book(random_camera, *splats, bg=(0.2, 0.4, 0.9))
    np.testing.assert_allclose(image, expected, **TIGHT)
    np.testing.assert_allclose(T, expected_T, **TIGHT)


def test_tile_stop_follows_the_loop_over_tiles(random_splats, random_camera):
    means, cov3ds, colors, _ = random_splats(60, seed=4, scale=3.0)
    opacities = np.linspace(0.7, 1.0, 60)
    splats = means, cov3ds, colors, opacities
    image, T = render_gaussians(random_camera, *splats, extent="exact", stop="tile")
    expected, expected_T = by_the_book(random_camera, *splats, tile=16)
    np.testing.assert_allclose(image, expected, **TIGHT)
    np.testing.assert_allclose(T, expected_T, rtol=1e-12, atol=0)
    _, unstopped = render_gaussians(random_camera, *splats, extent="exact", stop="none")
    assert (unstopped < T).any(), "a tile stops early"
    assert T[unstopped < T].max() < 1e-4, "tiles stop only below 1e-4"


@pytest.fixture
def wide_splat():
    """A splat near a pixel centre, so wide that alpha is still 0.01 at the edge of its 3-sigma box."""
    cam = Camera(np.eye(3), (0, 0, 0), fx=100, fy=100, cx=50.25, cy=44.5, H=90, W=100)
    return cam, ([[0, 0, 10]], [np.diag([0.987, 0.597, 0.01])], [[1, 1, 1]], [1.0])


def test_the_three_sigma_box_of_the_chapter(wide_splat):
    """Sigma2d = diag(99, 60), lambda_max = 99, r = ceil(3 sqrt(99)) = 30."""
    cam, splat = wide_splat
    _, T = render_gaussians(cam, *splat)
    rows, columns = np.nonzero(T < 1)
    assert (columns.min(), columns.max()) == (50 - 30, 51 + 30)
    # The box also ends 30 rows away, but alpha falls below 1/255 before that:
    reach = np.sqrt(2 * np.log(255) * 60)
    assert (rows.min(), rows.max()) == (np.ceil(44.5 - reach), np.floor(44.5 + reach))
    np.testing.assert_allclose(T[44, 20], 1 - np.exp(-0.5 * (30.25**2 / 99 + 0.25 / 60)), **TIGHT)


def test_the_floor_under_the_discriminant_widens_a_round_splat():
    """Sigma2d = 11 I: r = ceil(3 sqrt(11 + sqrt(0.1))) = 11, where ceil(3 sqrt(11)) would be 10.

    Alpha 11 px away is exp(-5.5) = 1.04 / 255, so only the box decides whether that pixel is drawn.
    """
    cam = Camera(np.eye(3), (0, 0, 0), fx=1, fy=1, cx=20, cy=20, H=41, W=41)
    _, T = render_gaussians(cam, [[0, 0, 1]], [np.diag([10.7, 10.7, 1])], [[1, 1, 1]], [1.0])
    columns = np.nonzero(T < 1)[1]
    assert (columns.min(), columns.max()) == (9, 31)


def test_exact_reaches_every_pixel_above_the_floor(wide_splat):
    cam, splat = wide_splat
    _, T = render_gaussians(cam, *splat, extent="exact")
    dy, dx = np.mgrid[: cam.H, : cam.W] - np.array([44.5, 50.25])[:, None, None]
    alpha = np.exp(-0.5 * (dx**2 / 99 + dy**2 / 60))
    np.testing.assert_array_equal(T < 1, alpha >= 1 / 255)


def test_box_stop_skips_hidden_splats():
    """Three walls of alpha 0.99 leave a transmittance of 1e-6, so the splat behind them is skipped."""
    cam = Camera(np.eye(3), (0, 0, 0), fx=100, fy=100, cx=15.5, cy=15.5, H=32, W=32)
    wall, small = np.diag([1e4, 1e4, 1e-6]), np.diag([1e-4, 1e-4, 1e-6])
    means = [[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 4]]
    splats = means, [wall, wall, wall, small], [[0, 0, 0]] * 3 + [[1, 1, 1]], [1.0, 1.0, 1.0, 1.0]
    stopped, _ = render_gaussians(cam, *splats, stop="box")
    drawn, _ = render_gaussians(cam, *splats, stop="none")
    assert stopped.max() == 0 and 0 < drawn.max() < 1e-6


def test_box_stop_draws_a_splat_that_shows_beside_the_walls():
    """The walls hide columns 2 to 6 of a splat whose box spans columns 0 to 17, so all of the splat is drawn."""
    cam = Camera(np.eye(3), (0, 0, 0), fx=100, fy=100, cx=15.5, cy=15.5, H=32, W=32)
    means = [[z * (column - 15.5) / 100, 0, z] for column, z in ((4, 1), (4, 2), (4, 3), (8, 4))]
    cov3ds = [np.diag([(0.03 * z) ** 2, 1e4, 1e-6]) for z in (1, 2, 3)] + [np.diag([0.12**2, 0.12**2, 1e-6])]
    splats = means, cov3ds, [[0, 0, 0]] * 3 + [[1, 1, 1]], [1.0] * 4
    stopped, T = render_gaussians(cam, *splats, stop="box")
    drawn, _ = render_gaussians(cam, *splats, stop="none")
    assert T[16, 4] < 1e-4 and T[16, 14] > 0.1, "behind the walls, and beside them"
    assert 0 < drawn[16, 4].max() < 1e-4
    np.testing.assert_array_equal(stopped, drawn)


def test_alpha_is_clamped_and_floored():
    cam = Camera(np.eye(3), (0, 0, 0), 10, 10, 4, 4, 9, 9)
    _, T = render_gaussians(cam, [[0, 0, 1]], [np.eye(3)], [[1, 1, 1]], [1.0])
    assert T[4, 4] == 1 - 0.99
    _, T = render_gaussians(cam, [[0, 0, 1]], [np.eye(3)], [[1, 1, 1]], [0.999 / 255])
    assert (T == 1).all()


def test_nearer_splats_come_first_and_ties_keep_their_order():
    cam = Camera(np.eye(3), (0, 0, 0), 10, 10, 0, 0, 1, 1)
    cov3ds, opacities = [np.eye(3) * 1e-4] * 2, [0.5, 0.5]
    red, blue = [1.0, 0, 0], [0, 0, 1.0]
    image, _ = render_gaussians(cam, [[0, 0, 2], [0, 0, 1]], cov3ds, [red, blue], opacities)
    np.testing.assert_allclose(image[0, 0], [0.25, 0, 0.5])
    image, _ = render_gaussians(cam, [[0, 0, 1], [0, 0, 1]], cov3ds, [red, blue], opacities)
    np.testing.assert_allclose(image[0, 0], [0.5, 0, 0.25])


def test_splats_at_or_before_the_near_plane_are_culled():
    cam = Camera(np.eye(3), (0, 0, 0), 10, 10, 2, 2, 5, 5)
    splat = [np.eye(3) * 1e-4], [[1, 1, 1]], [0.5]
    for z, drawn in ((-1.0, False), (0.0, False), (0.05, False), (0.0501, True)):
        _, T = render_gaussians(cam, [[0, 0, z]], *splat)
        assert (T < 1).any() == drawn, z
    _, T = render_gaussians(cam, [[0, 0, 0.5]], *splat, z_near=0.5)
    assert (T == 1).all()


def test_the_image_is_not_clipped():
    cam = Camera(np.eye(3), (0, 0, 0), 10, 10, 2, 2, 5, 5)
    image, _ = render_gaussians(cam, [[0, 0, 1]], [np.eye(3)], [[3, -2, 0]], [0.9])
    assert image.max() > 1 and image.min() < 0


def test_the_sphere_is_round_and_coloured_by_position():
    """The camera looks along +z from z = -3, so +x (red) is right in the image and +y (green) is down."""
    cam = Camera.looking_at((0, 0, -3), (0, 0, 0), 75, 75, 64, 64)
    image, T = render_gaussians(cam, *sphere_shell())
    rows, columns = np.nonzero(T < 0.5)
    radius = 75 / np.sqrt(3**2 - 1)  # silhouette of the unit sphere
    for low, high in ((rows.min(), rows.max()), (columns.min(), columns.max())):
        assert abs(32 - low - radius) < 2 and abs(high - 32 - radius) < 2
    assert image[32, 50, 0] > image[32, 14, 0] + 0.3
    assert image[50, 32, 1] > image[14, 32, 1] + 0.3
