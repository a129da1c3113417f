"""The figures of chapters 10 to 12: the package's kernels in a browser, and the same in JavaScript, against NumPy."""

import json
import sys

import numpy as np
import pytest
import torch

import figure_data
from browsers import GRAPHICS, chromium
from chapters import ROOT
from figure_pages import NO_ADAPTER, canvas_box, read_data, state, tap, told, write_pages
from gestures import drag, swipe

sys.path.append(str(ROOT / "benchmarks"))
from ladder.oracle import oracle, tolerance
from ladder.splats import Splats
from ladder.tape import autograd_gradients

from ladder import gpu

CHAPTERS = {"naive": "10_the_naive_kernel", "tiles": "11_tiles", "slots": "12_the_backward_pass"}
WAYS = {"webgpu": GRAPHICS, "javascript": ("--disable-features=WebGPU",)}


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    return write_pages(tmp_path_factory.mktemp("figures"), CHAPTERS.values())


@pytest.fixture(scope="module", params=WAYS)
def browser(request):
    with chromium(WAYS[request.param]) as launched:
        yield request.param, launched


@pytest.fixture
def opened(browser, pages):
    """Open a figure on a phone and wait for its kernels; a message in the console fails the test.

    Resolves to the page and whether WebGPU computed the figure.
    """
    way, launched = browser
    messages, contexts = [], []

    def opening(name, script=None):
        context = launched.new_context(viewport={"width": 390, "height": 800}, has_touch=True)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        if script:
            page.add_init_script(script)
        page.goto((pages / f"{CHAPTERS[name]}.html").as_uri())
        settle(page, name)
        if way == "webgpu" and "no WebGPU" in told(page, name):
            pytest.skip("this Chromium has no WebGPU adapter")
        return page, way == "webgpu"

    yield opening
    for context in contexts:
        context.close()
    assert [text for text in messages if text != NO_ADAPTER] == []


def settle(page, name):
    """Wait until the kernels of a figure have answered."""
    page.evaluate(f"gsplatPlay.live.{name}.idle()")


def splats_of(page, name, H, W):
    """Return the splats of a figure as the ladder has them."""
    marks = page.evaluate(
        f"(() => {{ const marks = gsplatPlay.live.{name}.marks; return [...(marks.call ? marks() : marks)]; }})()"
    )
    columns = np.array(marks, np.float32).reshape(-1, 9)
    parts = (columns[:, :2], columns[:, 2:5], columns[:, 5:8], columns[:, 8])
    return Splats(*map(np.ascontiguousarray, parts), H, W)


def array_of(page, expression):
    return np.array(page.evaluate(f"[...{expression}]"))


def test_kernels_of_the_site_are_those_of_the_package():
    for name, value in figure_data.kernels().items():
        assert read_data(name) == json.loads(json.dumps(value)), "run course/figure_data.py --only kernels"
        for module, text in read_data(name)["program"]["modules"].items():
            assert text == gpu.source(module)


@pytest.mark.parametrize("name", CHAPTERS)
def test_a_browser_without_webgpu_says_so_in_one_line(opened, name):
    page, on_gpu = opened(name)
    last = told(page, name).splitlines()[-1]
    assert last.startswith("GPU: ") if on_gpu else last.startswith("This browser has no WebGPU")


def test_kernels_get_the_same_numbers_as_from_python(opened):
    page, _ = opened("tiles")
    splats = splats_of(page, "tiles", 64, 96)
    records = array_of(page, "gsplatPlay.screen.records(gsplatPlay.live.tiles.marks)").reshape(-1, 16)
    assert np.allclose(records, gpu.records(splats), rtol=2e-6, atol=1e-7)
    words = array_of(page, "new Uint32Array(gsplatPlay.screen.view(96, 64))").astype(np.uint32)
    expected = np.frombuffer(gpu.view_of(splats), np.uint32)
    used = [*range(28, 32), *range(34, 40)]  # background, stop, clamp, and the sizes
    assert words[used].tolist() == expected[used].tolist()
    counts = page.evaluate("gsplatPlay.screen.counts(gsplatPlay.live.tiles.marks, 96, 64, 512)")
    assert counts == gpu.counts_of(splats, 512)


def check_image(found, splats, stop, exact):
    """Check an image (pixels, 4) against NumPy: to rounding of float64, or within the kernels' tolerance."""
    image, T = oracle(splats, stop=stop)
    bound, T_bound = tolerance(splats, wgsl=True)
    if exact:  # float64; an alpha at the floor may fall on either side, which the tolerance has room for
        assert np.mean(np.abs(found[..., :3] - image) > 1e-12) < 1e-3
    assert np.abs(image).max() > 0.3
    assert (np.abs(found[..., :3] - image) <= bound).all() and (np.abs(found[..., 3] - T) <= T_bound).all()


def test_the_naive_figure_is_the_reference(opened):
    page, on_gpu = opened("naive")
    splats = splats_of(page, "naive", 48, 72)
    ours = array_of(page, "gsplatPlay.screen.dense(gsplatPlay.live.naive.marks(), 72, 48)").reshape(48, 72, 4)
    check_image(ours, splats, "none", exact=True)
    if on_gpu:
        theirs = array_of(page, "gsplatPlay.live.naive.state.gpu.image")[: 4 * 48 * 72].reshape(48, 72, 4)
        check_image(theirs, splats, "none", exact=False)
        assert (theirs != ours).any(), "float32 is not float64"
    walked = page.evaluate(
        "gsplatPlay.screen.walk(gsplatPlay.screen.all(gsplatPlay.live.naive.marks()), 30, 20)"
    )
    assert f"{len(walked['steps'])} are above the floor" in told(page, "naive")


def met_by_pixels(splats):
    """For each tile the splats that are above the floor at one of its pixels."""
    y, x = np.mgrid[: splats.H, : splats.W]
    across = -(-splats.W // 16)
    tile = y // 16 * across + x // 16
    met = [set() for _ in range(tile.max() + 1)]
    for i in range(splats.count):
        (u, v), (A, B, C) = splats.means2d[i].astype(float), splats.conics[i].astype(float)
        dx, dy = x - u, y - v
        alpha = splats.opacities[i] * np.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
        for k in np.unique(tile[alpha >= 1.0001 / 255]):
            met[k].add(i)
    return met


def check_lists(page, on_gpu):
    splats = splats_of(page, "tiles", 64, 96)
    found = state(page, "tiles")
    kinds = [found["lists"]["tiles"]] + ([found["gpu"]["tiles"]] if on_gpu else [])
    met = met_by_pixels(splats)
    for tiles in kinds:
        for entries, least in zip(tiles, met, strict=True):
            members = [entry["splat"] for entry in entries]
            assert members == sorted(set(members)) and least <= set(members)
        # a tile is entered where the ellipse meets its rows, which may pass between two pixels
        assert sum(map(len, tiles)) <= 1.15 * sum(map(len, met))
    if on_gpu:
        assert found["gpu"]["same"]
        image = array_of(page, "gsplatPlay.live.tiles.state.gpu.image")[: 6 * 64 * 96].reshape(64, 96, 6)
        check_image(image[..., :4], splats, "tile", exact=False)
    return splats


def test_lists_follow_a_splat(opened):
    page, on_gpu = opened("tiles")
    before = check_lists(page, on_gpu)
    canvas, box = canvas_box(page, "tiles")
    scale = box["width"] / 96

    def at(x, y):
        return box["x"] + (x + 0.5) * scale, box["y"] + (y + 0.5) * scale

    chosen = state(page, "tiles")
    drag(page, at(chosen["u"], chosen["v"]), at(80, 50))
    settle(page, "tiles")
    moved = check_lists(page, on_gpu)
    assert np.allclose(moved.means2d[chosen["chosen"]], [80, 50], atol=0.5)
    assert (moved.means2d != before.means2d).any(axis=1).sum() == 1
    swipe(page, at(80, 50), at(40, 20))
    settle(page, "tiles")
    assert np.allclose([state(page, "tiles")[key] for key in "uv"], [40, 20], atol=0.5)
    canvas.focus()
    words, earlier = told(page, "tiles"), state(page, "tiles")
    for key in ("ArrowLeft", "ArrowDown", "a"):
        page.keyboard.press(key)
    settle(page, "tiles")
    now = state(page, "tiles")
    assert [now["u"] - earlier["u"], now["v"] - earlier["v"]] == pytest.approx([-1, 1], abs=1e-4)
    assert now["tile"] == earlier["tile"] - 1 and told(page, "tiles") != words
    page.keyboard.press("n")
    assert state(page, "tiles")["chosen"] == earlier["chosen"] + 1
    check_lists(page, on_gpu)


def test_the_prefix_sum_says_where_slots_begin(opened):
    page, _ = opened("tiles")
    rows = {line.split()[0]: line.split()[1:] for line in told(page, "tiles").splitlines()[:3]}
    counts = np.array(rows["tiles"], int)
    assert rows["start"] == [str(value) for value in np.cumsum(counts) - counts]
    assert f"make {counts.sum()} pairs" in told(page, "tiles")


def test_slots_are_the_gradient_and_have_one_order(opened):
    page, on_gpu = opened("slots")
    splats = splats_of(page, "slots", 64, 96)
    sums, grads = (array_of(page, f"gsplatPlay.live.slots.{name}") for name in ("sums", "grads"))
    lists = page.evaluate("gsplatPlay.live.slots.lists")
    grad = torch.tensor(grads.reshape(64, 96, 5)[..., :3])
    _, (*_, by_opacity), _, _ = autograd_gradients(splats, grad)
    expected = by_opacity.numpy() * splats.opacities.astype(float)  # h = alpha dL/dalpha
    owner = np.repeat(np.arange(splats.count), lists["met"])
    found = np.bincount(owner, sums, splats.count)
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
    if on_gpu:
        h = array_of(page, "gsplatPlay.live.slots.state.gpu.h").astype(np.float32)
        added = array_of(page, "gsplatPlay.live.slots.state.gpu.splats").astype(np.float32)
        assert np.abs(h - sums).max() < 1e-5 * np.abs(sums).max()
        for i in range(splats.count):
            total = np.float32(0)
            for value in h[owner == i]:
                total += value
            assert total == added[i]
        assert "its sum has the bits of the sum in order" in told(page, "slots")


def test_other_orders_have_other_sums(opened):
    page, _ = opened("slots")
    canvas, box = canvas_box(page, "slots")
    canvas.focus()
    page.keyboard.press("r")
    assert state(page, "slots")["tries"] == 200
    assert page.evaluate("gsplatPlay.live.slots.state.results.size") > 1
    tap(page, page.get_by_role("button"))
    assert "400 random orders" in told(page, "slots")
    before = state(page, "slots")
    page.keyboard.press("Tab")
    canvas.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    after = state(page, "slots")
    assert (after["splat"], after["tile"], after["tries"]) == (before["splat"] + 1, before["tile"] - 1, 0)
    tap(page, (box["x"] + 0.51 / 16 * box["width"], box["y"] + 2.5 / 24 * box["height"]))
    assert [state(page, "slots")[key] for key in ("splat", "tile")] == [0, 2]


def test_a_pixel_is_marked_by_mouse_finger_and_keys(opened):
    page, on_gpu = opened("naive")
    canvas, box = canvas_box(page, "naive")
    scale = box["width"] / 72
    page.mouse.move(box["x"] + 10.5 * scale, box["y"] + 5.5 * scale)
    assert [state(page, "naive")[key] for key in "xy"] == [10, 5]
    tap(page, (box["x"] + 60.5 * scale, box["y"] + 40.5 * scale))
    assert [state(page, "naive")[key] for key in "xy"] == [60, 40]
    canvas.focus()
    for key in ("ArrowLeft", "ArrowUp", "+"):
        page.keyboard.press(key)
    settle(page, "naive")
    assert [state(page, "naive")[key] for key in ("x", "y", "count")] == [59, 39, 130]
    assert "3456 pixels x 130 splats" in told(page, "naive")
    slider = page.locator("[data-play=naive] input")
    slider.focus()
    page.keyboard.press("Home")
    settle(page, "naive")
    assert state(page, "naive")["count"] == 1
    assert ("54 workgroups" in told(page, "naive")) == on_gpu


def test_a_gpu_that_fails_leaves_the_picture_of_javascript(opened):
    adapter = "requestAdapter: async () => { throw new Error('gone'); }"
    broken = f"Object.defineProperty(navigator, 'gpu', {{value: {{{adapter}}}}})"
    page, _ = opened("naive", broken)
    assert "WebGPU failed (gone): JavaScript computes the picture" in told(page, "naive")
