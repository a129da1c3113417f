"""Moving figures of chapters 08 and 13: their gradients are those of the package, and their steps too."""

import base64

import numpy as np
import torch

import figure_data
from figure_pages import canvas_box, read_data, state, tap, told
from gestures import drag, swipe
from gsplat_edu import Camera
from gsplat_edu.fit2d.fit import Fit2DSettings, fit_2d
from gsplat_edu.fit2d.gradients import backward_2d, squared_error
from gsplat_edu.fit2d.splats import Splats2D, render_2d
from gsplat_edu.render.api import render
from gsplat_edu.scene.gaussians import Gaussians
from viewer.handles import until

WIDTHS = {"means": 2, "log_scales": 2, "angles": 1, "colors": 3, "logit_opacities": 1}


def splats_of(rows):
    parts = np.split(np.asarray(rows, dtype=float), np.cumsum([*WIDTHS.values()])[:-1], axis=1)
    squeezed = {
        name: part[:, 0] if part.shape[1] == 1 else part for name, part in zip(WIDTHS, parts, strict=True)
    }
    return Splats2D(**squeezed)


def rows_of(splats):
    return np.concatenate([array.reshape(len(splats), -1) for array in splats.arrays().values()], axis=1)


def fit_photo():
    recorded = read_data("fit")
    pixels = np.frombuffer(base64.b64decode(recorded["pixels"]), dtype=np.uint8)
    return pixels.reshape(recorded["tall"], recorded["wide"], 3) / 255, recorded["start"]


def test_the_fits_data_are_those_of_their_recipe():
    stored, made = read_data("fit"), figure_data.fit_data()
    pixels, expected = (
        np.frombuffer(base64.b64decode(one.pop("pixels")), dtype=np.uint8).astype(int)
        for one in (stored, made)
    )
    assert np.abs(pixels - expected).max() <= 1  # decoders of JPEG may round differently
    assert stored == made


def test_slopes_of_a_fit_are_those_of_the_package(formulas):
    page, rng = formulas("08_fit_an_image"), np.random.default_rng(8)
    tall, wide = 19, 23
    for _ in range(12):
        count = int(rng.integers(1, 12))
        low, high = [0, 0, -0.5, -0.5, -3, -0.2, -0.2, -0.2, -2], [wide, tall, 2, 2, 3, 1.2, 1.2, 1.2, 6]
        rows, photo = rng.uniform(low, high, (count, 9)), rng.uniform(size=(tall, wide, 3))
        found = page.evaluate(
            """([rows, photo, wide, tall]) => {
                const rendered = gsplatPlay.render2d(rows, wide, tall), { slopes2d } = gsplatPlay;
                return { ...slopes2d(rows, rendered, photo, wide), image: Array.from(rendered.image) };
            }""",
            [rows.tolist(), photo.ravel().tolist(), wide, tall],
        )
        rendered = render_2d(splats_of(rows), tall, wide)
        error, g = squared_error(rendered.image, photo)
        slopes = rows_of(backward_2d(rendered, g))
        assert np.allclose(found["image"], rendered.image.ravel(), rtol=0, atol=1e-13)
        assert np.isclose(found["error"], error, rtol=1e-13)
        # 1 - alpha >= 0.01 divides a remainder with roundings of 1e-16, over some hundred pixels
        assert np.allclose(found["slopes"], slopes, rtol=0, atol=1e-12 * np.abs(slopes).max())


def test_steps_of_a_fit_are_those_of_the_package(opened):
    page, (photo, start) = opened("08_fit_an_image"), fit_photo()
    fit = fit_2d(photo, splats_of(start), Fit2DSettings(15, final_factor=1.0))
    page.evaluate("() => { for (let i = 0; i < 15; i++) gsplatPlay.live.fit.step(); }")
    # Rounding of 1e-16 grows where a slope is close to zero, because Adam divides by the slope's usual size.
    assert np.allclose(state(page, "fit")["losses"], fit.losses, rtol=1e-7)
    assert np.allclose(page.evaluate("gsplatPlay.live.fit.splats()"), rows_of(fit.splats), rtol=0, atol=1e-5)
    assert fit.losses[-1] < 0.5 * fit.losses[0]


def test_the_fit_follows_buttons_keys_and_touch(opened):
    page = opened("08_fit_an_image")
    canvas, _ = canvas_box(page, "fit")
    words = told(page, "fit")
    tap(page, page.get_by_role("button", name="step"))
    assert state(page, "fit")["steps"] == 1 and told(page, "fit") != words
    canvas.focus()
    page.keyboard.press("ArrowRight")
    assert state(page, "fit")["steps"] == 2
    page.keyboard.press(" ")
    until(page, "gsplatPlay.live.fit.state.steps > 5")
    page.get_by_role("button", name="pause").click()
    losses = state(page, "fit")["losses"]
    assert losses[-1] < losses[0] and not state(page, "fit")["running"]
    page.keyboard.press("r")
    tap(page, page.get_by_label("one rate for all numbers"))
    assert state(page, "fit")["plain"] and state(page, "fit")["steps"] == 0
    start = np.array(read_data("fit")["start"])
    page.evaluate("() => { for (let i = 0; i < 10; i++) gsplatPlay.live.fit.step(); }")
    plain = np.array(page.evaluate("gsplatPlay.live.fit.splats()"))
    assert np.abs(plain[:, :2] - start[:, :2]).mean() < 0.2  # Adam's ten steps move a centre by pixels
    assert state(page, "fit")["losses"][-1] < state(page, "fit")["losses"][0]


def test_the_chain_is_that_of_autograd(formulas):
    page, rng = formulas("13_back_to_the_parameters"), np.random.default_rng(13)
    floored = 0
    for _ in range(25):
        x = rng.choice([-0.5, 0.5])
        one = {
            "means": rng.uniform([-1, -0.7, -1], [1, 0.7, 1.5]),
            "log_scales": rng.uniform(-2.5, 0, 3),
            "quats": rng.normal(size=4),
            "logit": rng.uniform(-2, 5, 1),
            "sh": rng.uniform(-2.5, 2, 3),
        }
        photo = rng.uniform(size=(48, 64, 3))
        found = page.evaluate(
            "([one, x, photo]) => gsplatPlay.chain(one, gsplatPlay.beside(x), photo)",
            [{name: array.tolist() for name, array in one.items()}, float(x), photo.ravel().tolist()],
        )
        leaves = {name: torch.tensor(array[None], dtype=torch.float64) for name, array in one.items()}
        gaussians = Gaussians(
            means=leaves["means"],
            quats=leaves["quats"],
            log_scales=leaves["log_scales"],
            logit_opacities=leaves["logit"][:, 0],
            sh0=leaves["sh"][:, None],
            sh_rest=torch.zeros(1, 0, 3, dtype=torch.float64),
        ).trainable()
        camera = Camera.looking_at([x, 0, -3], [x, 0, 0], 60, 60, H=48, W=64)
        error = ((render(gaussians, camera, backend="torch").image - torch.tensor(photo)) ** 2).mean()
        error.backward()
        slopes = {name: tensor.grad.numpy().ravel() for name, tensor in gaussians.tensors().items()}
        assert np.isclose(found["error"], error.item(), rtol=1e-12)
        names = {
            "means": "means",
            "log_scales": "log_scales",
            "quats": "quats",
            "logit": "logit_opacities",
            "sh": "sh0",
        }
        for mine, theirs in names.items():
            # the chapter's bound for the same arithmetic in another order
            largest = np.abs(slopes[theirs]).max()
            assert np.allclose(found["slopes"][mine], slopes[theirs], rtol=0, atol=1e-11 * largest + 1e-16), (
                mine
            )
        floored += sum(value == 0 for value in found["slopes"]["sh"])
    assert floored > 3  # colours at the floor do not move


def test_the_number_follows_mouse_finger_keys_and_buttons(opened):
    page = opened("13_back_to_the_parameters")
    canvas, box = canvas_box(page, "chain")
    y, words = box["y"] + box["height"] - 40, told(page, "chain")
    drag(page, (box["x"] + 100, y), (box["x"] + 0.75 * box["width"], y))
    assert np.isclose(state(page, "chain")["one"]["means"][0], 0.75, atol=0.01)
    assert told(page, "chain") != words
    swipe(page, (box["x"] + 100, y), (box["x"] + 0.6 * box["width"], y))
    assert np.isclose(state(page, "chain")["one"]["means"][0], 0.3, atol=0.01)
    canvas.focus()
    page.keyboard.press("ArrowRight")
    assert np.isclose(state(page, "chain")["one"]["means"][0], 0.33, atol=0.01)
    page.keyboard.press("ArrowDown")
    assert state(page, "chain")["chosen"] == 1
    page.locator("[data-play=chain] select").select_option("quaternion x")
    assert state(page, "chain")["chosen"] == 7 and told(page, "chain").startswith("quaternion x = 0.400")
    for chosen in range(14):
        page.evaluate("chosen => gsplatPlay.live.chain.change({ chosen })", chosen)
        lines = told(page, "chain").replace("\u2212", "-").splitlines()
        chain, differences = (float(line.split()[-1]) for line in lines[1:])
        # ten decimals are shown; the chapter's bound on a difference is 1e-10 of the largest slope
        assert abs(chain - differences) < 3e-10, lines[0]
    before = float(lines[0].split()[-1])
    tap(page, page.get_by_role("button", name="20 steps downhill"))
    lines = told(page, "chain").splitlines()
    assert float(lines[0].split()[-1]) < before
