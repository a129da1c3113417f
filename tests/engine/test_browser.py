"""A browser plays the same description: Tint compiles every shader, image and gradients are those of the native host.

Chromium computes WebGPU on the CPU with SwiftShader. It has its own compiler and its own exp2, so bits differ; the
bounds are those of two float32 kernels, twice those of one against float64.
"""

import base64
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from engine.frames import packed, view_of
from float32_backends import SMALLER
from gsplat_edu.engine import frame
from gsplat_edu.engine.frame import PAIRS, VISIBLE
from gsplat_edu.engine.passes import Program, manifest, sort_bits
from gsplat_edu.engine.statistics import Asked, statistics_program
from gsplat_edu.engine.step import GROUPS, HALT, L1, LIVE, PackedPhoto, StepNumbers, step_program
from gsplat_edu.render.output import STATISTICS
from lens_scenes import around, lens_camera

SCRIPT = (Path(__file__).parent / "host.js").read_text()
THROUGH_LENSES = {
    name: dataclasses.replace(around(60), camera=lens_camera(name))
    for name in ("radial first", "opencv, moving up", "panorama, moving", "orthographic, moving")
}
PARTS = ("render", "composite_backward", "project_backward")
READS = ("live", "image", "core_grads", "rest_grads", "camera_sums")


@pytest.fixture(scope="module")
def page(browser):
    one = browser.new_page()
    one.route(
        "http://localhost/**",
        lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"),
    )
    one.goto("http://localhost/")  # WebGPU needs a secure context
    one.add_script_tag(content=SCRIPT)
    return one


def text_of(array):
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def played(page, program, counts, writes, block, parts, reads, most=0):
    """Play parts of a program in the browser, and return buffers as uint32; see `play` in host.js."""
    given = {name: text_of(array) for name, array in writes.items()}
    block = text_of(np.frombuffer(block, dtype=np.uint8))
    result = page.evaluate(
        "given => play(...given)", [manifest(program), counts, given, block, list(parts), list(reads), most]
    )
    if not result["adapter"]:
        pytest.skip("this Chromium has no WebGPU adapter")
    assert result["notes"] == []
    return {
        name: np.frombuffer(base64.b64decode(text), dtype=np.uint32) for name, text in result["found"].items()
    }


def counts_of(scene, view, room, live):
    return {
        "gaussians": len(scene.core),
        "rest": scene.rest.size,
        "pixels": view.camera.H * view.camera.W,
        "edges": view.tiles + 2,
        "live": live,
        "pairs": room,
    }


def test_a_browser_splits_passes_with_the_same_bits(page, pool):
    """Two workgroups in each submission, against a part in one."""
    scene, view = packed(SMALLER["random"]), view_of(SMALLER["random"])
    grads = np.random.default_rng(1).normal(size=(view.camera.H, view.camera.W, frame.GRADS))
    program = frame.program(sort_bits(view.tiles.bit_length()), False)
    writes = {"core": scene.core, "rest": scene.rest, "grads": grads.astype(np.float32)}
    given = (
        counts_of(scene, view, 1 << 12, frame.LIVE),
        writes,
        view.packed(scene.rest.shape[1]),
        PARTS,
        READS,
    )
    whole, split = (played(page, program, *given, most) for most in (0, 2))
    assert whole["image"].any() and whole["core_grads"].any()
    for name in READS:
        np.testing.assert_array_equal(whole[name], split[name])


@pytest.mark.parametrize("name", ["random", "opaque, tiles stop", "needles 100:1", *THROUGH_LENSES])
def test_image_and_gradients_in_a_browser(page, pool, name):
    scene, view = (make((SMALLER | THROUGH_LENSES)[name]) for make in (packed, view_of))
    ours = frame.draw_frame(pool, scene, view)
    grads = np.random.default_rng(1).normal(size=(*ours.transmittance.shape, frame.GRADS)).astype(np.float32)
    expected = frame.differentiate_frame(ours, scene, grads, None)
    counts = counts_of(scene, view, ours.memory.counts["pairs"], frame.LIVE)
    program = frame.program(sort_bits(view.tiles.bit_length()), False, view.optics)
    writes = {"core": scene.core, "rest": scene.rest, "grads": grads}
    found = played(page, program, counts, writes, view.packed(scene.rest.shape[1]), PARTS, READS)
    assert found["live"][: frame.SPARE].tolist() == [len(ours.visible), ours.num_pairs]
    image = found["image"].view(np.float32).reshape(*ours.transmittance.shape, frame.PIXEL)
    assert np.abs(image[..., :3] - ours.image).max() < 1.1 / 255
    assert np.abs(image[..., :3] - ours.image).mean() < 1e-6
    assert np.abs(image[..., 3] - ours.transmittance).mean() < 1e-6
    core = found["core_grads"].view(np.float32).reshape(-1, frame.OUT)[:, : frame.CORE]
    for part in np.split(np.arange(frame.CORE), [3, 7, 10, 13]):
        truth = expected.core[:, part]
        assert np.abs(core[:, part] - truth).max() <= 6e-4 * np.abs(truth).max()
    rest = found["rest_grads"].view(np.float32).reshape(expected.rest.shape)
    assert np.abs(rest - expected.rest).max() <= 6e-4 * np.abs(expected.rest).max()
    camera = (
        found["camera_sums"].view(np.float32).reshape(-1, len(expected.camera)).sum(axis=0, dtype=np.float64)
    )
    places = np.split(
        np.arange(len(camera)), [9, 12, 16, *range(17, 32)]
    )  # each coefficient has its own size
    for part in (place for place in places if len(place)):
        bound = 6e-4 * len(scene.core) * np.abs(expected.camera[part]).max()
        assert np.abs(camera[part] - expected.camera[part]).max() <= bound


def test_statistics_and_the_stop_per_pixel_in_a_browser(page, pool):
    scene, view = (
        packed(SMALLER["opaque, tiles stop"]),
        view_of(SMALLER["opaque, tiles stop"], pixel_stop=True),
    )
    ours = frame.draw_frame(pool, scene, view)
    size, generator = ours.transmittance.shape, np.random.default_rng(1)
    grads = generator.normal(size=(*size, frame.GRADS)).astype(np.float32)
    errors = generator.random(size).astype(np.float32)
    block = view.packed(scene.rest.shape[1])
    expected = frame.differentiate_frame(ours, scene, grads, None, Asked(block, errors)).statistics
    drawing = frame.program(sort_bits(view.tiles.bit_length()), False)
    counting = statistics_program(drawing, False)
    buffers = tuple(dict.fromkeys((*drawing.buffers, *counting.buffers)))
    program = Program(buffers, {**drawing.parts, **counting.parts})
    counts = counts_of(scene, view, ours.memory.counts["pairs"], frame.LIVE)
    writes = {"core": scene.core, "rest": scene.rest, "grads": grads, "errors": errors}
    found = played(page, program, counts, writes, block, ("render", "statistics"), ("image", "collected"))
    image = found["image"].view(np.float32).reshape(*size, frame.PIXEL)
    assert np.abs(image[..., :3] - ours.image).max() < 1.1 / 255 and image[..., 3].min() > 1e-4 * (1 - 1e-6)
    collected = found["collected"].view(np.float32).reshape(expected.shape)
    for column in range(expected.shape[1]):
        bound = 2 if column == STATISTICS.index("pixels") else 6e-4 * expected[:, column].max()
        assert np.abs(collected[:, column] - expected[:, column]).max() <= bound, STATISTICS[column]


def test_a_step_of_training_in_a_browser(page, device):
    """The gradients of the photo's loss arrive in Adam's first moments; loss, visible Gaussians and pairs in `live`."""
    scene, view = packed(SMALLER["random"]), view_of(SMALLER["random"])
    H, W = view.camera.H, view.camera.W
    photo = PackedPhoto.packed((255 * np.random.default_rng(2).random((H, W, 3))).astype(np.uint8), None)
    rates = dict.fromkeys(GROUPS, (1e-3, 0.9, 0.999, 1e-15, 0.1, 0.001))
    numbers = StepNumbers(rates, opacity_weight=0.01, scale_weight=0.01, collects=True)
    block = view.packed(scene.rest.shape[1]) + numbers.packed(H * W, len(scene.core), photo.floats)
    program = step_program(sort_bits(view.tiles.bit_length()))
    counts = counts_of(scene, view, 1 << 16, LIVE)
    writes = {"core": scene.core, "rest": scene.rest, "photo": photo.words}
    reads = ("live", "core_first", "rest_first", "statistics")
    found = played(page, program, counts, writes, block, ("step",), reads)
    memory = device.allocate(program, counts)
    for name, array in writes.items():
        memory.write(name, array)
    expected = memory.play("step", block, read=reads)
    assert found["live"][[VISIBLE, PAIRS, HALT]].tolist() == expected["live"][[VISIBLE, PAIRS, HALT]].tolist()
    assert found["live"].view(np.float32)[L1:] == pytest.approx(
        expected["live"].view(np.float32)[L1:], rel=1e-4
    )
    core, truth = (each["core_first"].view(np.float32).reshape(-1, frame.CORE) for each in (found, expected))
    for part in np.split(np.arange(frame.CORE), [3, 7, 10, 13]):
        assert np.abs(core[:, part] - truth[:, part]).max() <= 6e-4 * np.abs(truth[:, part]).max() > 0
    for name in ("rest_first", "statistics"):
        one, other = (each[name].view(np.float32) for each in (found, expected))
        assert np.abs(one - other).max() <= 6e-4 * np.abs(other).max() > 0
