"""The moving figure of lenses in chapter 04: places, ellipses and outlines agree with the package and the chapter."""

import numpy as np
import pytest

from figure_pages import canvas_box, chapter_functions, state, told
from gestures import drag, swipe
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter

WIDEST = {"perspective": 1.2, "fisheye": 2.5, "equirectangular": 3.0}
BALL = "values => gsplatPlay.ball(values)"


def camera_of(kind, k1, turn):
    """Return the camera of the figure: it stands in the origin, with the world's axes."""
    W, f = (256, 128 / np.pi) if kind == "equirectangular" else (128, 40.0)
    camera = Camera(np.eye(3), np.zeros(3), f, f, (W - 1) / 2, 63.5, 128, W)
    distortion = None if kind == "equirectangular" else Distortion.of(k1=k1)
    return camera.through(Projection(kind, distortion), RollingShutter([0, turn, 0], [0, 0, 0]))


def direction(rng, kind):
    """Return a random direction that a lens sees well within its bounds, also near its axis."""
    angle, around = rng.uniform(1e-4, WIDEST[kind]) * rng.uniform() ** 2, rng.uniform(-np.pi, np.pi)
    mean = np.array([np.cos(around) * np.sin(angle), np.sin(around) * np.sin(angle), np.cos(angle)])
    return mean if kind != "equirectangular" or abs(mean[1]) < 0.98 else direction(rng, kind)


@pytest.mark.parametrize("kind", WIDEST)
def test_the_ellipse_of_a_ball_is_that_of_the_package(formulas, kind):
    page, rng = formulas("04_splatting"), np.random.default_rng(45)
    compared = 0
    for turn in [0.0, 0.3, -0.5] * 12:
        k1 = 0.0 if kind == "equirectangular" else rng.uniform(-0.02, 0.02)
        mean, size = direction(rng, kind), rng.uniform(0.01, 0.1)
        values = {"kind": kind, "k1": k1, "turn": turn, "mean": mean.tolist(), "size": size}
        found = page.evaluate(BALL, values)
        seen = camera_of(kind, k1, turn).sight(mean[None])
        if not seen.valid[0]:
            continue  # beyond the rim of a distorted lens, or too fast for the shutter
        compared += 1
        J = np.stack([[value[0] for value in row] for row in seen.jacobian])
        # six steps of Newton's method leave rounding, as the package's three do for these turns: 1e-7 px at worst
        assert np.allclose(found["centre"], [seen.u[0], seen.v[0]], rtol=0, atol=1e-6)
        expected = size**2 * J @ J.T
        assert np.allclose(found["cov2d"], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        # the true outline: each of its points is the image of a ray that touches the shell of two deviations
        rim = np.array(found["rim"])
        assert rim.shape == (120, 2)
        if turn == 0 and np.isfinite(found["miss"]):
            rays = camera_of(kind, k1, 0.0).through(
                Projection(kind, None if kind == "equirectangular" else Distortion.of(k1=k1))
            )
            W = 256 if kind == "equirectangular" else 128
            places = (rim - [(W - 1) / 2, 63.5]) / rays.fx
            if kind == "equirectangular":
                places[:, 0] = (places[:, 0] + np.pi) % (2 * np.pi) - np.pi
            looks = rays.projection.directions(*places.T, np.pi if kind == "fisheye" else 1.5)
            looks /= np.linalg.norm(looks, axis=1, keepdims=True)
            looks = looks[np.isfinite(looks).all(axis=1)]
            assert np.allclose(np.linalg.norm(np.cross(looks, mean), axis=1), 2 * size, rtol=0, atol=1e-7)
        # the tangent is the limit of small balls, with a shutter too
        assert page.evaluate(BALL, values | {"size": 1e-4})["miss"] < 0.02
    assert compared > 25


def test_the_outline_leaves_the_ellipse_as_in_the_chapter(formulas):
    page = formulas("04_splatting")
    by_fisheye, by_pinhole = chapter_functions("04_splatting", ["by_fisheye", "by_pinhole"], np=np)
    for kind, lens, degrees in (
        ("perspective", by_pinhole, (20, 40, 60)),
        ("fisheye", by_fisheye, (20, 60, 100)),
    ):
        for angle in np.radians(degrees):
            mean = np.array([np.sin(angle), 0.0, np.cos(angle)])
            values = {"kind": kind, "k1": 0, "turn": 0, "mean": mean.tolist(), "size": 0.12}
            found = page.evaluate(BALL, values)
            J = np.stack([(lens(mean + 1e-5 * e) - lens(mean - 1e-5 * e)) / 2e-5 for e in np.eye(3)], axis=-1)
            # central differences: 1e-10 of a third derivative, and rounding of 1e-14 over the step
            assert np.allclose(found["cov2d"], 0.12**2 * J @ J.T, rtol=0, atol=1e-6)
            offset = np.array(found["rim"]) - found["centre"]
            distances = np.sqrt(
                np.einsum("ni,ij,nj->n", offset, np.linalg.inv(np.array(found["cov2d"])), offset)
            )
            assert np.isclose(found["miss"], np.abs(distances / 2 - 1).max(), rtol=1e-9, atol=0)


def test_the_ball_follows_mouse_finger_keys_and_sliders(opened):
    page = opened("04_splatting")
    canvas, box = canvas_box(page, "lens")
    middle, zoom = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), box["width"] / 264

    def centre():
        line = next(line for line in told(page, "lens").splitlines() if line.startswith("centre"))
        return np.array([float(word.replace("\u2212", "-")) for word in line.split()[2:]])

    before = centre()
    drag(page, middle, (middle[0] - 40, middle[1] + 12))
    # each of the four movements is right to first order
    assert np.allclose(centre() - before, np.array([-40, 12]) / zoom, rtol=0, atol=1.5)
    before = centre()
    swipe(page, middle, (middle[0] + 20, middle[1] - 16))
    assert np.allclose(centre() - before, np.array([20, -16]) / zoom, rtol=0, atol=1.5)
    canvas.focus()
    for key, change in (
        ("ArrowLeft", (-3, 0)),
        ("ArrowRight", (3, 0)),
        ("ArrowUp", (0, -3)),
        ("ArrowDown", (0, 3)),
    ):
        before = centre()
        page.keyboard.press(key)
        assert np.allclose(centre() - before, change, rtol=0, atol=0.3), key
    page.keyboard.press("+")
    assert np.isclose(state(page, "lens")["size"], 0.13)
    page.keyboard.press("l")
    assert state(page, "lens")["kind"] == "equirectangular"
    assert page.get_by_label("distortion k1").is_disabled()
    page.get_by_label("lens", exact=True).select_option("pinhole")
    assert state(page, "lens")["kind"] == "perspective"
    page.get_by_label("turn while rows are read").focus()
    words = told(page, "lens")
    page.keyboard.press("ArrowRight")
    assert np.isclose(state(page, "lens")["turn"], 0.1) and told(page, "lens") != words


def test_a_ball_whose_part_is_behind_a_pinhole_says_so(opened):
    page = opened("04_splatting")
    page.evaluate(
        "gsplatPlay.live.lens.change({ kind: 'perspective', mean: [Math.sin(1.3), 0, Math.cos(1.3)], size: 0.3 })"
    )
    assert "behind the camera" in told(page, "lens")
