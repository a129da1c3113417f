"""Photos of a page have the pinhole in which the page shows their cameras."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.rig import stand_in
from gsplat_edu.scene.views import View
from gsplat_edu.viewer.page_proof import PHOTO_SIDE, shown_photo

SETTINGS = RenderSettings(depth=False)

EYE = (0.1, -0.3, -1.9)

R = look_at(EYE, (0.0, 0.0, 0.0))

PINHOLE = Camera(R, EYE, 700.0, 710.0, 400.7, 292.2, 600, 800)

LENSES = {
    "pinhole": PINHOLE,
    "small": Camera(R, EYE, 190.0, 185.0, 101.3, 76.1, 150, 200),
    "distorted": PINHOLE.through(Projection("perspective", Distortion.of(k1=-0.15, k2=0.03, p1=0.002))),
    "fisheye": Camera(R, EYE, 380.0, 385.0, 402.0, 305.0, 600, 800).through(Projection("fisheye")),
    "panorama": Camera.panorama(R, EYE, 600, 1200),
}


def photographed(gaussians, camera):
    with torch.no_grad():
        image = render(gaussians, camera, settings=SETTINGS, backend="cpu").image
    return np.rint(255 * image.clamp(0, 1).numpy()).astype(np.uint8)


def psnr(a, b):
    return 20 * np.log10(255) - 10 * np.log10(np.mean((a.astype(float) - b) ** 2))


@pytest.mark.parametrize("lens", LENSES)
def test_a_photo_shows_what_the_pinhole_sees(random_gaussians, lens):
    gaussians, camera = random_gaussians(150, rest=0), LENSES[lens]
    jpeg = shown_photo(0, View(camera, photographed(gaussians, camera)), (0.0, 0.0, 0.0)).jpeg
    found = np.asarray(Image.open(io.BytesIO(jpeg)))
    pinhole = stand_in(camera)
    small = pinhole if max(pinhole.W, pinhole.H) <= PHOTO_SIDE else resized(pinhole, PHOTO_SIDE)
    assert found.shape == (small.H, small.W, 3)
    expected = photographed(gaussians, small)
    # splats are approximated to first order by each lens in its own way, and the JPEG loses some more
    assert psnr(found, expected) > 27
    shifted = np.roll(expected, 4, axis=1)
    assert psnr(found, shifted) < psnr(found, expected) - 3, "the measure notices 4 px"


def test_what_the_lens_did_not_see_is_black():
    narrow = Camera(R, EYE, 380.0, 380.0, 400.0, 300.0, 600, 800)
    lens = narrow.through(Projection("perspective", Distortion.of(k1=0.4)))
    shown = shown_photo(0, View(lens, np.full((600, 800, 3), 255, np.uint8)), (0.0, 0.0, 0.0))
    found = np.asarray(Image.open(io.BytesIO(shown.jpeg)))
    assert max(shown.border) < 0.5, "most of the border saw nothing"
    assert found[0, 0].max() < 16 and found[180, 240].min() > 240


def test_masked_parts_stay_and_transparent_parts_show_the_background():
    camera = LENSES["small"]
    image = np.full((150, 200, 3), 90, np.uint8)
    alpha = np.zeros((150, 200), np.uint8)
    alpha[:, :100] = 255
    mask = np.zeros((150, 200), bool)
    shown = shown_photo(0, View(camera, image, alpha=alpha, mask=mask), (1.0, 0.0, 0.0))
    found = np.asarray(Image.open(io.BytesIO(shown.jpeg)))
    np.testing.assert_allclose(shown.border, ((90 + 255) / 510, 90 / 510, 90 / 510), atol=0.02)
    np.testing.assert_allclose(found[75, 40].astype(int), (90, 90, 90), atol=6)
    np.testing.assert_allclose(found[75, 160].astype(int), (255, 0, 0), atol=6)
