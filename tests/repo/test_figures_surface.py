"""The moving figure of chapter 15: a ray through a wall of splats agrees with the chapter's NumPy."""

import numpy as np

from figure_pages import canvas_box, chapter_functions, state, told
from gestures import drag, swipe
from gsplat_edu import ALPHA_MAX

CHAPTER = "15_cloud_to_surface"


def test_depths_of_a_wall_are_those_of_the_chapter(formulas):
    page, rng = formulas(CHAPTER), np.random.default_rng(15)
    wall, depths = chapter_functions(
        CHAPTER, ["pixel_depths", "slanted_wall"], np=np, ALPHA_MAX=ALPHA_MAX, DISTANCE=4.0
    )[::-1]
    without_median = 0
    for slant, x, sigma, opacity in rng.uniform([-1.2, -0.1, 0.02, 0.05], [1.2, 0.1, 0.2, 0.999], (60, 4)):
        count = rng.integers(5, 200)
        s, off, turned = rng.uniform(-0.9, 0.9, count), *rng.normal(0, [[0.03], [0.3]], (2, count))
        found = page.evaluate(
            """([slant, s, off, turned, x, sigma, opacity]) => {
                const splats = gsplatPlay.slantedWall(slant, s, off, turned);
                const { mean, median, planar, alpha } = gsplatPlay.pixelDepths(x, splats, sigma, opacity);
                return [mean, median, planar, alpha];
            }""",
            [slant, s.tolist(), off.tolist(), turned.tolist(), x, sigma, opacity],
        )
        expected = depths(x, *wall(slant, s, off, turned), sigma, opacity)
        without_median += np.isnan(found[1])
        # sums of some hundred products; planar divides by a sum that may nearly cancel
        assert np.allclose(found, expected, rtol=1e-7, atol=1e-12, equal_nan=True), (slant, x)
    assert 0 < without_median < 40


def test_the_planar_depth_of_the_figure_is_exact_until_splats_leave_the_wall(opened):
    page = opened(CHAPTER)

    def measured(**values):
        page.evaluate("values => gsplatPlay.live.wall.change(values)", values)
        return page.evaluate("gsplatPlay.live.wall.measured()")

    for slant in (-60, -20, 30, 70):
        for x in (-0.05, 0.0, 0.04):
            found = measured(slant=slant, x=x, noise=0, turn=0, count=200)
            assert abs(found["planar"] - found["truth"]) < 1e-9
            assert found["mean"] < found["truth"] and found["median"] < found["truth"]
    assert abs(measured(slant=55, x=0, noise=0.05)["planar"] - 4) > 1e-3
    fewer, more = (measured(slant=60, x=0, noise=0, count=count)["mean"] for count in (40, 300))
    assert more < fewer, "more splats, more bias"


def test_the_wall_follows_mouse_finger_keys_and_sliders(opened):
    page = opened(CHAPTER)
    canvas, box = canvas_box(page, "wall")
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    zoom, words = box["width"] / 0.9, told(page, "wall")
    drag(page, middle, (middle[0] - 30, middle[1] + 20))
    assert np.allclose([state(page, "wall")[k] for k in ("slant", "x")], [45, 5 / zoom], rtol=0, atol=1e-3)
    assert told(page, "wall") != words
    swipe(page, middle, (middle[0] + 30, middle[1] - 20))
    assert np.allclose([state(page, "wall")[k] for k in ("slant", "x")], [55, 0], rtol=0, atol=1e-3)
    canvas.focus()
    steps = {
        "ArrowLeft": ("slant", -5),
        "ArrowRight": ("slant", 5),
        "ArrowUp": ("x", -0.005),
        "ArrowDown": ("x", 0.005),
    }
    for key, (entry, change) in steps.items():
        earlier = state(page, "wall")[entry]
        page.keyboard.press(key)
        assert np.isclose(state(page, "wall")[entry] - earlier, change), key
    for label, entry, change in (
        ("splats", "count", 10),
        ("off the wall", "noise", 0.005),
        ("turned", "turn", 2),
    ):
        slider, earlier = page.get_by_label(label, exact=True), state(page, "wall")[entry]
        slider.focus()
        page.keyboard.press("ArrowRight")
        assert np.isclose(state(page, "wall")[entry] - earlier, change), label
    assert "planar" in told(page, "wall") and "off by" in told(page, "wall")
