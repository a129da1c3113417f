"""Moving figures of chapters 01, 03 and 04: points, ellipsoids and splats agree with the package and the chapters."""

import numpy as np

from figure_pages import canvas_box, drag, state, swipe, told
from gsplat_edu import build_cov3d, quat_to_R


def keys_change(page, name, steps):
    """Press keys on a figure's canvas; each has to change one number of its state by so much."""
    for key, (entry, change) in steps.items():
        earlier = state(page, name)[entry]
        page.keyboard.press(key)
        assert np.isclose(state(page, name)[entry] - earlier, change), key


def test_an_ellipsoid_is_computed_like_the_chapter(opened):
    page = opened("03_gaussians_in_3d")
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
