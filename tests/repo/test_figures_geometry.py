"""Moving figures of chapters 01, 03 and 04: points, ellipsoids and splats agree with the package and the chapters."""

import numpy as np

from figure_pages import canvas_box, chapter_functions, state, tap, told
from gestures import drag, swipe
from gsplat_edu import Z_NEAR, Camera, build_cov3d, orbit_camera, quat_to_R
from gsplat_edu.scene.gaussian_math import project_cov3d


def keys_change(page, name, steps):
    """Press keys on a figure's canvas; each has to change one number of its state by so much."""
    for key, (entry, change) in steps.items():
        earlier = state(page, name)[entry]
        page.keyboard.press(key)
        assert np.isclose(state(page, name)[entry] - earlier, change), key


def test_normal_numbers_are_normal_and_independent(formulas):
    drawn = np.array(formulas("01_points").evaluate("gsplatPlay.normals(20000, 1)"))
    # means, covariances and third powers of 20,000 draws, each within five of its standard deviations
    assert np.abs(drawn.mean(axis=0)).max() < 5 / np.sqrt(20_000)
    assert np.abs(np.cov(drawn.T) - np.eye(3)).max() < 5 * np.sqrt(2 / 20_000)
    assert np.abs((drawn**3).mean(axis=0)).max() < 5 * np.sqrt(15 / 20_000)
    neighbours = (drawn[1:, :, None] * drawn[:-1, None, :]).mean(axis=0)
    assert np.abs(neighbours).max() < 5 / np.sqrt(20_000)


def test_an_ellipsoid_is_computed_like_the_chapter(formulas):
    page = formulas("03_gaussians_in_3d")
    rng = np.random.default_rng(3)
    to_pixels = np.diag([200.0, 200.0, 1.0])
    for _ in range(60):
        quat, scales, distance = rng.normal(size=4), rng.uniform(0.02, 0.6, 3), rng.uniform(1.5, 12)
        k = rng.choice([1, 2])
        values = {"quat": quat.tolist(), "scales": scales.tolist(), "distance": distance}
        direction = np.array([*rng.uniform(-0.4, 0.4, 2), 1.0])
        values["direction"] = direction.tolist()
        found = page.evaluate("([values, k]) => gsplatPlay.solid(values, k)", [values, int(k)])
        cov3d, mean = build_cov3d(scales, quat_to_R(quat)), distance * direction
        A = 200 / distance * np.eye(2, 3)
        D = to_pixels @ (np.outer(mean, mean) - k**2 * cov3d) @ to_pixels
        centre = D[:2, 2] / D[2, 2]
        shape = np.outer(centre, centre) - D[:2, :2] / D[2, 2]
        assert np.allclose(found["cov"], cov3d, rtol=0, atol=1e-14)
        assert np.allclose(found["affine"], A @ cov3d @ A.T, rtol=1e-12, atol=1e-10)
        assert np.allclose(found["centre"], centre, rtol=1e-12, atol=0)
        # c c' is up to 1e4 px² here, and the shape is what is left after it is taken away from a like number
        assert np.allclose(found["shape"], shape, rtol=1e-9, atol=1e-9)
        # the outline holds all points of the shell, and touches them
        ball = rng.normal(size=(20_000, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        points = mean + k * ball @ np.transpose(found["RS"])
        reach = (200 * points[:, 0] / points[:, 2]).max()
        assert 0.98 < (reach - centre[0]) / np.sqrt(shape[0, 0]) < 1 + 1e-9


def test_the_ellipsoid_follows_mouse_finger_keys_and_sliders(opened):
    page = opened("03_gaussians_in_3d")
    canvas, box = canvas_box(page, "ellipsoid")
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before, words = state(page, "ellipsoid")["quat"], told(page, "ellipsoid")
    drag(page, middle, (middle[0] + 70, middle[1]))
    # the front follows the mouse: a turn by -0.7 about the axis that points down
    expected = quat_to_R([np.cos(0.35), 0, -np.sin(0.35), 0]) @ quat_to_R(before)
    assert np.allclose(quat_to_R(state(page, "ellipsoid")["quat"]), expected, rtol=0, atol=1e-6)
    assert told(page, "ellipsoid") != words
    swipe(page, middle, (middle[0], middle[1] + 50))
    expected = quat_to_R([np.cos(0.25), np.sin(0.25), 0, 0]) @ expected
    assert np.allclose(quat_to_R(state(page, "ellipsoid")["quat"]), expected, rtol=0, atol=1e-6)
    canvas.focus()
    for key in ("ArrowLeft", "ArrowUp", ".", ","):
        earlier = state(page, "ellipsoid")["quat"]
        page.keyboard.press(key)
        assert abs(2 * np.arccos(np.dot(earlier, state(page, "ellipsoid")["quat"])) - 0.1) < 1e-6, key
    keys_change(page, "ellipsoid", {"-": ("distance", 0.5), "+": ("distance", -0.5)})
    slider = page.get_by_label("s₁", exact=True)
    slider.focus()
    page.keyboard.press("ArrowLeft")
    assert np.allclose(state(page, "ellipsoid")["scales"], [0.49, 0.1, 0.15])
    assert slider.get_attribute("aria-valuetext") == "0.49 world units"


def test_an_ellipse_of_the_tangent_is_that_of_the_package(formulas):
    page, rng = formulas("04_splatting"), np.random.default_rng(4)
    camera = Camera.looking_at(eye=[0, 0, 0], target=[0, 0, 1], fx=150, fy=150, H=128, W=128)
    clamped = 0
    for limit in [None, 1.3] * 30:
        mean = np.array([*rng.uniform(-1, 1, 2), 1.0]) * rng.uniform(0.3, 6)
        cov = build_cov3d(rng.uniform(0.01, 0.4, 3), quat_to_R(rng.normal(size=4)))
        found = page.evaluate(
            "([cov, mean, limit]) => gsplatPlay.tangent(cov, mean, {}, limit)",
            [cov.tolist(), mean.tolist(), limit],
        )
        expected = project_cov3d(cov, mean, camera, jacobian_limit=limit)
        assert np.allclose(found["cov2d"], expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        assert np.allclose(found["centre"], camera.project(mean)[:2], rtol=0, atol=1e-10)
        clamped += limit is not None and not np.allclose(expected, project_cov3d(cov, mean, camera))
    assert clamped > 5


def test_the_error_of_the_ellipse_is_that_of_the_chapter(formulas):
    page, draws = formulas("04_splatting"), np.random.default_rng(44).normal(size=(2, 4000))
    relative_error, predicted_factor = chapter_functions(
        "04_splatting", ["relative_error", "predicted_factor"], np=np, draws=draws, PAIRS_DRAWN=4000
    )
    rng = np.random.default_rng(45)
    for e, t in rng.uniform([0.005, 0], [0.15, 3], (40, 2)):
        both = page.evaluate(
            "([e, t, draws]) => [gsplatPlay.excess(e, t, draws), gsplatPlay.predictedExcess(e, t)]",
            [e, t, draws.T.tolist()],
        )
        # a sum of differences: 1e-16 of t² against e² (1 + t²), with e >= 0.005
        assert np.isclose(both[0], relative_error(e, t)[0], rtol=0, atol=1e-11)
        assert np.isclose(both[1], predicted_factor(t) * e**2, rtol=1e-12)


def test_the_gaussian_follows_mouse_finger_keys_and_sliders(opened):
    page = opened("04_splatting")
    canvas, box = canvas_box(page, "tangent")
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    zoom, before, words = (
        box["height"] / 174,
        state(page, "tangent")["t"],
        told(page, "tangent"),
    )
    drag(page, middle, (middle[0] + 40, middle[1] + 20))
    moved = state(page, "tangent")["t"]
    assert np.allclose(np.subtract(moved, before), np.array([40, 20]) / zoom / 150, rtol=2e-3)
    assert told(page, "tangent") != words
    swipe(page, middle, (middle[0] - 40, middle[1] - 20))
    assert np.allclose(state(page, "tangent")["t"], before, rtol=0, atol=1e-6)
    canvas.focus()
    for key, k, change in (
        ("ArrowRight", 0, 0.05),
        ("ArrowLeft", 0, -0.05),
        ("ArrowDown", 1, 0.05),
        ("ArrowUp", 1, -0.05),
    ):
        earlier = state(page, "tangent")["t"][k]
        page.keyboard.press(key)
        assert np.isclose(state(page, "tangent")["t"][k] - earlier, change), key
    keys_change(page, "tangent", {"+": ("z", 0.1), "-": ("z", -0.1)})
    page.keyboard.press("c")
    assert state(page, "tangent")["clamped"]
    tap(page, page.get_by_label("clamp x/z"))
    assert not state(page, "tangent")["clamped"]
    page.get_by_label("size across").focus()
    page.keyboard.press("ArrowRight")
    assert np.isclose(state(page, "tangent")["across"], 0.07)


def test_points_reach_the_pixels_of_the_chapter(formulas):
    page, rng = formulas("01_points"), np.random.default_rng(1)
    (draw_points,) = chapter_functions("01_points", ["draw_points"], np=np, Z_NEAR=Z_NEAR)
    size, points = 48, rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for radius in (0, 0.75, 1.5, 3.0):
        for depth_test in (True, False):
            azimuth, elevation = rng.uniform(-3, 3), rng.uniform(-1.2, 1.2)
            distance = rng.choice(
                [0.9, 2.0, 8.0]
            )  # the first is inside the ball: some points are behind the camera
            owners, pixels = page.evaluate(
                """([points, azimuth, elevation, size, distance, radius, test]) => {
                    const camera = gsplatPlay.orbit(azimuth, elevation, size, 1.25 * size, distance);
                    const seen = points.map((point) => gsplatPlay.pinhole(point, camera));
                    const owners = Array.from(gsplatPlay.owners(points, camera, radius, test));
                    return [owners, seen.map(({ u, v, z }) => [u, v, z])];
                }""",
                [points.tolist(), azimuth, elevation, size, float(distance), radius, depth_test],
            )
            camera = orbit_camera(azimuth, elevation, size, 1.25 * size, distance)
            u, v, z = camera.project(camera.world_to_cam(points))
            ahead = z > Z_NEAR
            assert np.allclose(
                np.array(pixels)[ahead], np.stack([u, v, z], axis=-1)[ahead], rtol=1e-9, atol=1e-9
            )
            expected = draw_points(camera, points, radius or None, depth_test)
            assert np.array_equal(np.reshape(owners, (size, size)), expected), (radius, depth_test)


def test_expected_points_are_those_of_the_chapter(formulas):
    page, rng = formulas("01_points"), np.random.default_rng(11)
    given = {"np": np, "SIZE": 48, "COUNT": 3000}
    names = ["pixel_rays", "ball_depths", "expected_points"]
    *_, expected_points = chapter_functions("01_points", names, **given)
    for azimuth, elevation, distance in rng.uniform([-3, -1.2, 1.5], [3, 1.2, 10], (12, 3)):
        found = page.evaluate(
            """([azimuth, elevation, distance]) => {
                const camera = gsplatPlay.orbit(azimuth, elevation, 48, 60, distance);
                return Array.from(gsplatPlay.expected(3000, camera));
            }""",
            [azimuth, elevation, distance],
        )
        (front, _), cosine = expected_points(orbit_camera(azimuth, elevation, 48, 60, distance))
        assert np.allclose(
            np.reshape(found, (48, 48)),
            np.where(cosine > 0.4, front, np.nan),
            rtol=1e-9,
            atol=0,
            equal_nan=True,
        )


def test_the_points_follow_mouse_finger_keys_and_sliders(opened):
    page = opened("01_points")
    canvas, box = canvas_box(page, "points")
    middle, words = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), told(page, "points")
    drag(page, middle, (middle[0] - 75, middle[1] - 30))
    now = state(page, "points")
    assert np.allclose([now["azimuth"], now["elevation"]], [0.5, 0.0], rtol=0, atol=1e-6)
    swipe(page, middle, (middle[0] + 75, middle[1]))
    assert abs(state(page, "points")["azimuth"]) < 0.1 and told(page, "points") != words
    canvas.focus()
    keys_change(
        page, "points", {"ArrowLeft": ("azimuth", 0.1), "ArrowUp": ("elevation", 0.1), "-": ("distance", 0.5)}
    )
    page.keyboard.press("n")
    assert not state(page, "points")["nearest"]
    tap(page, page.get_by_label("the nearest point wins"))
    assert state(page, "points")["nearest"]

    def holes():
        lines = told(page, "points").splitlines()[-2:]
        return [float(line.split()[-2]) for line in lines]

    counted, expected = holes()
    assert (
        counted > 20 and abs(counted - expected) < 3
    )  # four deviations of some 1,500 coins are fewer than 5 %
    page.get_by_label("radius").focus()
    for _ in range(6):
        page.keyboard.press("ArrowRight")
    assert state(page, "points")["radius"] == 1.5 and holes()[0] < counted / 4
