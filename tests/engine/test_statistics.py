"""The backend webgpu: statistics of each Gaussian, and the stop per pixel, against the native kernels in float64."""

import dataclasses

import numpy as np
import pytest
import torch

from engine.frames import packed, view_of
from float32_backends import ILL_CONDITIONED, POSE, SETTINGS, SMALLER, images_and_gradients
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.clean.evidence import gather
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.engine import frame
from gsplat_edu.engine.statistics import Asked, statistics_program
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from native_scenes import random

NAMES = ("absgrad", "weight_sum", "weight_max", "pixels", "error_sum")
PIXEL = dataclasses.replace(SETTINGS, stop="pixel", alpha_max=0.999)

pytestmark = pytest.mark.usefixtures("webgpu")


def collected(scene, backend, settings=SETTINGS, channels=0):
    """Return statistics by Gaussian, of a loss with random weights, and the gradients."""
    dtype = torch.float64 if backend == "cpu" else torch.float32
    gaussians = scene.gaussians(dtype).trainable()
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)  # noqa: E731
    generator = torch.Generator().manual_seed(5)
    features = torch.linspace(-1, 1, len(gaussians) * channels, dtype=dtype).reshape(-1, max(channels, 1))
    features = features.requires_grad_() if channels else None
    out = render(gaussians, scene.camera, settings=settings, features=features, backend=backend)
    errors = draw(*out.transmittance.shape).abs()
    statistics = out.collect(*NAMES, errors=errors)
    loss = (out.image * draw(*out.image.shape)).sum() + (out.depth * draw(*out.depth.shape)).sum()
    if channels:
        loss = loss + (out.features * draw(*out.features.shape)).sum()
    loss.backward()
    found = {}
    for name, values in statistics().items():
        assert values.dtype == dtype
        found[name] = torch.zeros(len(gaussians), *values.shape[1:], dtype=torch.float64)
        found[name][out.visible] = values.double()
    return found, {name: tensor.grad for name, tensor in gaussians.tensors().items()}


@pytest.mark.parametrize("stop", ["tile", "pixel"])
@pytest.mark.parametrize(
    "name", ["random", "needles 100:1", "opaque, tiles stop", "17 x 33", "partly behind"]
)
def test_statistics_are_those_of_the_native_kernels(name, stop):
    """Bounds: those of gradients, 3e-4 of the largest (4e-3 where conics are ill-conditioned). A pixel whose alpha is
    at 1/255, or whose transmittance is at 1e-4, may count in one and not in the other."""
    settings = dataclasses.replace(SETTINGS, stop=stop)
    found, _ = collected(SMALLER[name], "webgpu", settings)
    truth, _ = collected(SMALLER[name], "cpu", settings)
    bound = 4e-3 if name in ILL_CONDITIONED else 3e-4
    for key in NAMES:
        largest = float(truth[key].max())
        assert largest > 0, key
        if key == "pixels":
            assert (found[key] - truth[key]).abs().sum() <= 1e-4 * truth[key].sum() + 2
        else:
            assert (found[key] - truth[key]).abs().max() <= bound * largest, key


def test_features_add_their_absolute_gradients():
    """They are composited by themselves, so the sum is at least the native one, which takes all together."""
    scene = SMALLER["random"]
    plain, _ = collected(scene, "webgpu")
    found, _ = collected(scene, "webgpu", channels=6)
    truth, _ = collected(scene, "cpu", channels=6)
    assert (found["absgrad"] >= truth["absgrad"] - 3e-4 * truth["absgrad"].max()).all()
    assert (found["absgrad"] > plain["absgrad"]).any() and (found["absgrad"] < 4 * truth["absgrad"]).any()
    for key in NAMES[1:]:
        assert torch.equal(found[key], plain[key]), key


def test_collecting_changes_no_gradient_and_two_runs_have_the_same_bits():
    scene = SMALLER["opaque, tiles stop"]
    first, gradients = collected(scene, "webgpu")
    second, again = collected(scene, "webgpu")
    assert all(torch.equal(first[name], second[name]) for name in NAMES)
    assert all(torch.equal(gradients[name], again[name]) for name in gradients)
    alone = scene.gaussians(torch.float32).trainable()
    generator = torch.Generator().manual_seed(5)
    out = render(alone, scene.camera, settings=SETTINGS, backend="webgpu")
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64).float()  # noqa: E731
    draw(*out.transmittance.shape)
    ((out.image * draw(*out.image.shape)).sum() + (out.depth * draw(*out.depth.shape)).sum()).backward()
    for name, tensor in alone.tensors().items():
        assert torch.equal(tensor.grad, gradients[name]), name


def test_noise_in_the_buffers_changes_no_statistics(device, monkeypatch):
    scene, found = SMALLER["opaque, tiles stop"], []
    view, allocate = view_of(SMALLER["opaque, tiles stop"]), device.allocate
    for poison in (False, True):
        pool = frame.Pool(device)
        drawn = frame.draw_frame(pool, packed(scene), view)
        monkeypatch.setattr(
            device,
            "allocate",
            lambda program, counts, like, poison=poison: poisoned(
                allocate(program, counts, like=like), poison
            ),
        )
        grads = np.random.default_rng(0).normal(size=(*drawn.transmittance.shape, 5)).astype(np.float32)
        asked = Asked(view.packed(15), np.ones_like(drawn.transmittance))
        found.append(frame.differentiate_frame(drawn, packed(scene), grads, None, asked).statistics)
        monkeypatch.undo()
    np.testing.assert_array_equal(*found)


def poisoned(memory, poison):
    """Fill the buffers that only statistics have with noise."""
    rng = np.random.default_rng(1)
    for name in ("weighed", "statistic_slots", "collected") if poison else ():
        memory.write(name, rng.integers(0, 2**32, memory.read(name).size, dtype=np.uint32))
    return memory


def test_wrong_requests_are_named():
    scene = random(5, (9, 11))
    out = render(scene.gaussians(torch.float32).trainable(), scene.camera, backend="webgpu")
    with pytest.raises(ShapeError, match="^errors"):
        out.collect("error_sum", errors=torch.zeros(9, 12))
    statistics = out.collect("pixels")
    with pytest.raises(ArgumentError, match="call backward on a loss of this image first"):
        statistics()


@pytest.mark.parametrize("name", SMALLER)
def test_pixels_stop_one_by_one(name):
    """Bounds are those of the stop of tiles. Where rounding moves a pixel's stop, it keeps or loses up to its light."""
    values, gradients, out = images_and_gradients(SMALLER[name], "webgpu", settings=PIXEL)
    truths, expected, oracle = images_and_gradients(SMALLER[name], "cpu", settings=PIXEL)
    assert abs(out.num_pairs - oracle.num_pairs) <= 2 and len(out.visible) == len(oracle.visible)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    assert values["T"].min() > 1e-4 * (1 - 1e-6)
    bound = 4e-3 if name in ILL_CONDITIONED else 3e-4
    for key, truth in expected.items():
        parts = len(SMALLER[name].means) if key in POSE else 1
        assert np.abs(gradients[key] - truth).max() <= parts * bound * np.abs(truth).max(), key


def test_the_stop_per_pixel_differs_where_tiles_stop():
    scene = SMALLER["opaque, tiles stop"]
    by_tile, _, _ = images_and_gradients(scene, "webgpu", settings=dataclasses.replace(PIXEL, stop="tile"))
    by_pixel, _, _ = images_and_gradients(scene, "webgpu", settings=PIXEL)
    assert (by_tile["T"] < 1e-4).any() and (by_pixel["T"] > 1e-4).all()


@pytest.mark.parametrize("channels", [0, 5])
def test_median_depth_and_features_with_the_stop_per_pixel(channels):
    scene = SMALLER["opaque, tiles stop"]
    settings = dataclasses.replace(PIXEL, median_depth=True)
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        generator = torch.Generator().manual_seed(1)
        features = torch.randn(len(scene.means), channels, generator=generator, dtype=torch.float64).to(dtype)
        gaussians = scene.gaussians(dtype)
        found.append(
            render(
                gaussians,
                scene.camera,
                settings=settings,
                features=features if channels else None,
                backend=backend,
            )
        )
    ours, truth = found
    assert ((ours.median_depth - truth.median_depth).abs() > 1e-5).sum() <= 2
    if channels:
        largest = max(1.0, float(truth.features.abs().max()))
        assert (ours.features - truth.features).abs().max() < 1.1 * largest / 255


def test_a_frame_shares_its_buffers_with_its_statistics():
    whole = frame.program(8, True)
    for of_features in (False, True):
        program = statistics_program(whole, of_features)
        sizes = {one.name: one.size for one in whole.buffers}
        own = {one.name for one in program.buffers} - set(sizes)
        assert own == {"errors", "weighed", "statistic_slots", "collected"}
        assert all(sizes.get(one.name, one.size) == one.size for one in program.buffers)
        assert program is statistics_program(whole, of_features)


def test_cleaning_finds_the_same_evidence():
    """`gsplat_edu.clean` asks for two passes of each view; it judges by sums, which agree as gradients do."""
    views, points, colors = procedural_capture(40, 3, splats=80)
    gaussians = from_points(points, colors, recipe(10))
    found, truth = (
        gather(gaussians, views, RenderSettings(median_depth=True), load_backend(name))
        for name in ("webgpu", "cpu")
    )
    assert truth.weight.max() > 1 and (truth.gain != 0).any()
    for name in ("weight", "peak", "gain", "spread"):
        ours, expected = getattr(found, name), getattr(truth, name)
        assert np.abs(ours - expected).max() <= 1e-3 * np.abs(expected).max(), name
    np.testing.assert_array_equal(found.views, truth.views)
