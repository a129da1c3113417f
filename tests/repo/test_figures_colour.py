"""The moving figure of chapter 06: harmonics, a lobe's coefficients and colours are those of the package."""

import numpy as np

from figure_pages import drag, state, swipe, told
from gsplat_edu import C0, eval_sh, orbit_camera, sh_basis


def unit_vectors(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def sphere_nodes(n, m):
    """Directions and weights of a sum that is exact for polynomials of degree min(2 n, m) - 1."""
    z, w = np.polynomial.legendre.leggauss(n)
    turn, r = 2 * np.pi * np.arange(m) / m, np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(np.broadcast_arrays(r * np.cos(turn), r * np.sin(turn), z[:, None]), axis=-1)
    return nodes.reshape(-1, 3), np.repeat(w * 2 * np.pi / m, m)


def test_harmonics_and_colours_are_those_of_the_package(opened):
    page, rng = opened("06_spherical_harmonics"), np.random.default_rng(6)
    dirs = unit_vectors(rng, 300)
    found = page.evaluate("dirs => dirs.map(gsplatPlay.harmonics)", dirs.tolist())
    assert np.allclose(found, sh_basis(dirs), rtol=0, atol=1e-14)
    floored = 0
    for degree in range(4):
        c, body, gloss = rng.normal(size=16), rng.uniform(size=3), 0.7
        sh = np.repeat(gloss * c[None, :, None], 3, axis=2)
        sh[:, 0] += (body - 0.5) / C0
        colours = page.evaluate(
            "([dirs, c, body, gloss, k]) => dirs.map((d) => gsplatPlay.glossy(d, c, body, gloss, k))",
            [dirs.tolist(), c.tolist(), body.tolist(), gloss, degree],
        )
        expected = eval_sh(degree, np.repeat(sh, 300, axis=0), dirs)
        assert np.allclose(colours, expected, rtol=0, atol=1e-13)
        floored += (expected == 0).sum()
    assert floored > 100


def test_the_coefficients_of_a_lobe_are_its_integrals(opened):
    page, rng = opened("06_spherical_harmonics"), np.random.default_rng(66)
    nodes, weights = sphere_nodes(80, 160)
    basis = sh_basis(nodes)
    for axis, kappa in zip(unit_vectors(rng, 30), rng.uniform(0.5, 80, 30), strict=True):
        values = np.exp(kappa * (nodes @ axis - 1))
        c = basis.T @ (weights * values)
        lobe = page.evaluate("([axis, kappa]) => gsplatPlay.lobe(axis, kappa)", [axis.tolist(), kappa])
        assert np.allclose(lobe["c"], c, rtol=0, atol=1e-12)
        assert np.isclose(lobe["energy"], (weights * values**2).sum(), rtol=1e-12)
        other, degree = c + rng.normal(size=16), int(rng.integers(4))
        for numbers in (c, other):
            k = (degree + 1) ** 2
            left = np.sqrt((weights * (values - basis[:, :k] @ numbers[:k]) ** 2).sum() / lobe["energy"])
            share = page.evaluate(
                "([c, lobe, degree]) => gsplatPlay.leftOut(c, lobe, degree)", [numbers.tolist(), lobe, degree]
            )
            # the square of the share is a difference of numbers of order one
            assert abs(share**2 - left**2) < 1e-11 * (1 + left**2)


def test_the_ball_and_the_bars_follow_mouse_finger_keys_and_sliders(opened):
    page = opened("06_spherical_harmonics")
    balls = page.locator("[data-play=harmonics] canvas").first
    bars = page.locator("[data-play=harmonics] canvas").last
    balls.scroll_into_view_if_needed()
    box, words = balls.bounding_box(), told(page, "harmonics")
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    drag(page, middle, (middle[0] - 50, middle[1] - 20))
    now = state(page, "harmonics")
    assert np.allclose([now["azimuth"], now["elevation"]], [0.5, 0.2], rtol=0, atol=1e-6)
    looks = told(page, "harmonics").splitlines()[0].replace("\u2212", "-").split()[-3:]
    assert np.allclose([float(v) for v in looks], orbit_camera(0.5, 0.2, 8, 8).R[2], rtol=0, atol=6e-4)
    swipe(page, middle, (middle[0] + 50, middle[1]))
    assert abs(state(page, "harmonics")["azimuth"]) < 0.1
    balls.focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowUp")
    assert told(page, "harmonics") != words

    bars.scroll_into_view_if_needed()
    box = bars.bounding_box()
    at = box["x"] + 6.5 / 16 * box["width"]
    drag(page, (at, box["y"] + 80), (at, box["y"] + 80 - 64 / 2))
    assert state(page, "harmonics")["chosen"] == 6
    assert np.isclose(state(page, "harmonics")["c"][6], 0.5)
    bars.focus()
    for key, chosen, value in (("ArrowUp", 6, 0.55), ("ArrowDown", 6, 0.5), ("ArrowRight", 7, None)):
        page.keyboard.press(key)
        assert state(page, "harmonics")["chosen"] == chosen
        assert value is None or np.isclose(state(page, "harmonics")["c"][6], value), key
    assert "b7(d) c7" in told(page, "harmonics")
    page.get_by_label("sharpness").focus()
    page.keyboard.press("ArrowRight")
    assert state(page, "harmonics")["sharpness"] == 4.5
    assert np.isclose(
        state(page, "harmonics")["c"][6],
        page.evaluate("""gsplatPlay.lobe(
        gsplatPlay.unit([-0.35, -0.45, 0.82]), 4.5).c[6]"""),
    )
    page.get_by_label("degree").focus()
    page.keyboard.press("ArrowLeft")
    assert state(page, "harmonics")["degree"] == 2


def test_the_ball_is_painted(opened):
    page = opened("06_spherical_harmonics")
    canvas = page.locator("[data-play=harmonics] canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    shown = page.evaluate(
        """([x, y]) => [...document.querySelector("[data-play=harmonics] canvas").getContext("2d")
            .getImageData(x, y, 1, 1).data]""",
        [box["width"] / 2 - (box["height"] - 20) / 2, box["height"] / 2 + 8],
    )
    peak = np.exp(
        4.0 * (np.array([-0.35, -0.45, 0.82]) @ [0, 0, 1] / np.linalg.norm([-0.35, -0.45, 0.82]) - 1)
    )
    assert np.allclose(shown[:3], 255 * (np.array([0.2, 0.3, 0.4]) + 0.7 * peak), rtol=0, atol=4)
