"""A browser plays the same description: Tint compiles every shader, image and gradients are those of the native host.

Chromium computes WebGPU on the CPU with SwiftShader. It has its own compiler and its own exp2, so bits differ; the
bounds are those of two float32 kernels, twice those of one against float64.
"""

import base64
from pathlib import Path

import numpy as np
import pytest

from browsers import chromium
from engine.frames import packed, view_of
from float32_backends import SMALLER
from gsplat_edu.engine import frame
from gsplat_edu.engine.passes import manifest, sort_bits

SCRIPT = (Path(__file__).parent / "host.js").read_text()
FLAGS = ("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan")
PARTS = ("render", "composite_backward", "project_backward")
READS = ("live", "image", "core_grads", "rest_grads", "camera_sums")


@pytest.fixture(scope="module")
def page():
    with chromium(FLAGS) as browser:
        one = browser.new_page()
        one.route(
            "http://localhost/**",
            lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"),
        )
        one.goto("http://localhost/")  # WebGPU needs a secure context
        one.add_script_tag(content=SCRIPT)
        yield one


def text_of(array):
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def played(page, scene, view, grads, room):
    n, H, W = len(scene.core), view.camera.H, view.camera.W
    counts = {
        "gaussians": n,
        "rest": scene.rest.size,
        "pixels": H * W,
        "edges": view.tiles + 2,
        "live": frame.LIVE,
    }
    writes = {"core": text_of(scene.core), "rest": text_of(scene.rest), "grads": text_of(grads)}
    result = page.evaluate(
        "given => play(...given)",
        [
            manifest(frame.program(sort_bits(view.tiles.bit_length()), False)),
            counts | {"pairs": room},
            writes,
            text_of(np.frombuffer(view.packed(scene.rest.shape[1]), dtype=np.uint8)),
            list(PARTS),
            list(READS),
        ],
    )
    if not result["adapter"]:
        pytest.skip("this Chromium has no WebGPU adapter")
    assert result["notes"] == []
    return {
        name: np.frombuffer(base64.b64decode(text), dtype=np.uint32) for name, text in result["found"].items()
    }


@pytest.mark.sliced(1)
@pytest.mark.parametrize("name", ["random", "opaque, tiles stop", "needles 100:1"])
def test_image_and_gradients_in_a_browser(page, pool, name):
    scene, view = packed(SMALLER[name]), view_of(SMALLER[name])
    ours = frame.draw_frame(pool, scene, view)
    grads = np.random.default_rng(1).normal(size=(*ours.transmittance.shape, frame.GRADS)).astype(np.float32)
    expected = frame.differentiate_frame(ours, scene, grads, None)
    found = played(page, scene, view, grads, ours.memory.counts["pairs"])
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
        found["camera_sums"].view(np.float32).reshape(-1, frame.CAMERA_NUMBERS).sum(axis=0, dtype=np.float64)
    )
    for part in (slice(0, 9), slice(9, 12), slice(12, 16)):
        bound = 6e-4 * len(scene.core) * np.abs(expected.camera[part]).max()
        assert np.abs(camera[part] - expected.camera[part]).max() <= bound
