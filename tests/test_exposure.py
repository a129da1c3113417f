"""A gain per channel is exact for a scale of linear light, and is measured from an image and a photo."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.ops.exposure import color_matrix, falloff, measured_gains, measured_vignetting, stops
from gsplat_edu.ops.recolor import recolored


def decoded(encoded):
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encoded(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055)


def photographed(image, scales):
    """Scale an image's linear light and round to bytes, like a camera."""
    return np.round(255 * np.clip(encoded(decoded(image) * scales), 0, 1)).astype(np.uint8)


def texture(size=(90, 120), seed=3):
    return np.random.default_rng(seed).uniform(0.0, 1.0, (*size, 3))


def test_a_scale_of_linear_light_is_the_line_of_its_gain():
    """This is exact above the linear part of the sRGB curve, 0.04045 before and after the scale."""
    image, scales = np.linspace(0.07, 0.8, 99).reshape(11, 3, 3), np.array([0.6, 1.0, 1.5])
    logs = torch.from_numpy(np.log(scales) / 2.4)
    found = recolored(torch.from_numpy(image), color_matrix(logs)).numpy()
    np.testing.assert_allclose(found, encoded(decoded(image) * scales), rtol=1e-12)
    np.testing.assert_allclose(stops(logs).numpy(), np.log2(scales), rtol=1e-12)


@pytest.mark.parametrize("scales", [(1.0, 1.0, 1.0), (0.5, 0.6, 0.55), (1.6, 1.4, 1.5)])
def test_gains_are_measured_to_a_hundredth_of_a_stop(scales):
    """The photo is rounded to bytes and clipped; the render has noise, and a fifth of it may be black."""
    image, rng = texture(), np.random.default_rng(0)
    render = np.clip(image + 0.02 * rng.normal(size=image.shape), 0, 1)
    render[:, :24] = 0.0
    logs = measured_gains(torch.from_numpy(render), torch.from_numpy(photographed(image, np.array(scales))))
    # A black fifth shifts the median to the 37.5th percentile of the other ratios, which scatter by a few per cent.
    np.testing.assert_allclose(stops(logs).numpy(), np.log2(scales), atol=0.1)
    render[:, :24] = image[:, :24]
    logs = measured_gains(torch.from_numpy(render), torch.from_numpy(photographed(image, np.array(scales))))
    np.testing.assert_allclose(stops(logs).numpy(), np.log2(scales), atol=0.01)


def test_masked_and_clipped_pixels_do_not_count():
    image = texture()
    photo = torch.from_numpy(photographed(image, np.ones(3)))
    mask = torch.ones(photo.shape[:2], dtype=torch.bool)
    photo[:, 30:80] //= 2
    mask[:, 30:80] = False
    photo[:, 80:] = 255
    render = torch.from_numpy(image)
    assert stops(measured_gains(render, photo, mask)).abs().max() < 0.01
    assert stops(measured_gains(render, photo)).abs().max() > 0.1, "the mask has an effect"


@pytest.mark.parametrize("value", [0, 255])
def test_without_usable_pixels_the_gain_is_1(value):
    render, photo = torch.rand(40, 40, 3), torch.full((40, 40, 3), value, dtype=torch.uint8)
    assert torch.equal(measured_gains(render, photo), torch.zeros(3))
    assert torch.equal(measured_gains(torch.full((40, 40, 3), math.nan), photo // 2 + 60), torch.zeros(3))


def test_the_bits_do_not_depend_on_the_threads():
    render, photo = (
        torch.from_numpy(texture((300, 200))).float(),
        torch.from_numpy(photographed(texture((300, 200)), 1.2)),
    )
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(measured_gains(render, photo))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[0], other) for other in found[1:]) and found[0].dtype == torch.float32


@pytest.mark.parametrize("size", [(90, 120), (121, 80), (1, 1), (1, 50)])
def test_vignetting_has_no_mean_and_is_radial(size):
    """The logarithm is k times the squared distance from the centre, minus the mean over the pixels."""
    H, W = size
    logs = torch.log(falloff(torch.tensor(-0.4, dtype=torch.float64), H, W)).numpy()
    y, x = np.mgrid[:H, :W]
    q = ((y - (H - 1) / 2) ** 2 + (x - (W - 1) / 2) ** 2) / ((H * H + W * W) / 4)
    np.testing.assert_allclose(logs, -0.4 * (q - q.mean()), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("k", "scales"), [(0.0, (1.0, 1.0, 1.0)), (-0.4, (1.2, 1.0, 0.9)), (0.2, (0.7, 0.8, 0.8))]
)
def test_vignetting_and_gains_are_measured_together(k, scales):
    """The photo is rounded to bytes and clipped; the render has noise, and a masked part of it is black."""
    image, rng = 0.7 * texture() + 0.05, np.random.default_rng(0)
    q = 2.4 * np.log(falloff(torch.tensor(k, dtype=torch.float64), 90, 120).numpy())[..., None]
    photo = torch.from_numpy(photographed(image, np.array(scales) * np.exp(q)))
    render = np.clip(image + 0.02 * rng.normal(size=image.shape), 0, 1)
    found = measured_vignetting(torch.from_numpy(render), photo).numpy()
    # Ratios of 2,700 pixels scatter by a tenth, so medians of a third of them are accurate to 0.005, over 0.6 in q.
    np.testing.assert_allclose(stops(torch.from_numpy(found[:3])).numpy(), np.log2(scales), atol=0.02)
    assert abs(found[3] - k) < 0.02
    render[:, 48:72] = 0.0
    mask = torch.ones(90, 120, dtype=torch.bool)
    mask[:, 48:72] = False
    assert abs(measured_vignetting(torch.from_numpy(render), photo, mask).numpy()[3] - k) < 0.02


def test_too_few_pixels_measure_no_vignetting():
    image = torch.from_numpy(texture())
    assert measured_vignetting(image, image, torch.zeros(90, 120, dtype=torch.bool)).tolist() == [0.0] * 4
    ring = torch.zeros(90, 120, dtype=torch.bool)
    ring[:, 0] = ring[:, -1] = True
    assert torch.isfinite(measured_vignetting(image, image, ring)).all()
