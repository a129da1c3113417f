"""Poses of held-out photos are aligned, and colours are fitted on the same half of a photo of another exposure."""

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.alignment import SQUARES, aligned_psnr, light_squares
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from test_exposure import photographed

GREY, EXTENT = (0.55, 0.5, 0.45), 4.0
EVEN, UNEVEN = np.ones(3), np.array([0.5, 0.6, 0.55])


def shown(gaussians, camera):
    return render(gaussians, camera, settings=RenderSettings(background=GREY))


@pytest.fixture(scope="module")
def scene():
    """An opaque cloud of splats and one of its cameras."""
    views, points, colors = procedural_capture(64, 3, splats=300)
    return from_points(points, 0.2 + 0.5 * colors, recipe(1, start_opacity=0.9, start_scale=1.5)), views[
        0
    ].camera


def photo_of(scene, scales):
    """Return the scene's render as a photo with alpha, of another exposure, with a camera off by half a degree."""
    gaussians, camera = scene
    with torch.no_grad():
        seen = shown(gaussians, camera)
    opacity = 1 - seen.transmittance.double().numpy()[..., None]
    image = seen.image.double().numpy() - np.array(GREY) * (1 - opacity)
    straight = np.clip(image / np.maximum(opacity, 1e-6), 0, 1)
    twist = torch.tensor([0.005, -0.006, 0.004, 0.02, -0.02, 0.02], dtype=torch.float64)
    off = CameraTensors.of(camera).moved(twist).value()
    alpha = np.round(255 * opacity[..., 0]).astype(np.uint8)
    return View(off, photographed(straight, scales), alpha=alpha, name="a")


@pytest.mark.parametrize("transparent", [True, False])
def test_a_photo_of_another_exposure_is_scored_at_its_own(scene, transparent):
    """The photo shows the scene, so with pose and gains corrected only rounding to bytes is left, above 40 dB."""
    scores = {}
    for name, scales in (("even", EVEN), ("uneven", UNEVEN)):
        view = photo_of(scene, scales)
        if not transparent:  # the background counts as part of the object, and is darkened with it
            even = photo_of(scene, EVEN).read().over(GREY) / 255.0
            view = View(view.camera, photographed(even, scales), name="a")
        for colors in (False, True):
            scores[name, colors] = aligned_psnr(scene[0], view, shown, GREY, EXTENT, colors=colors)
    assert scores["even", False] > 38 and scores["even", True] > 38
    assert scores["uneven", False] < 25
    assert scores["uneven", True] > 38


def test_a_photo_of_a_rolling_shutter_is_scored_at_its_motion(scene):
    """The camera turns by 0.1 radians while the photo is read: 7 px, which no pose explains."""
    gaussians, camera = scene
    moving = camera.through(shutter=RollingShutter((0.06, 0.08, 0.0), (0.0, 0.0, 0.0)))
    with torch.no_grad():
        image = shown(gaussians, moving).image.double().numpy()
    view = View(camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), name="a")
    posed, found = (
        aligned_psnr(gaussians, view, shown, GREY, EXTENT, moving=moving) for moving in (False, True)
    )
    assert found > posed + 3


def test_no_pixel_in_a_half_gives_no_score(scene):
    view = photo_of(scene, EVEN)
    light = light_squares(*view.image.shape[:2])
    for mask in (light, ~light):
        masked = View(view.camera, view.image, mask=mask, name="a")
        for colors in (False, True):
            assert aligned_psnr(scene[0], masked, shown, GREY, EXTENT, colors=colors) is None


def test_the_scored_half_does_not_move_the_pose(scene):
    """Painting the scored squares of the photo grey does not change the pose, which is fitted on the others."""
    view = photo_of(scene, EVEN)
    photo, light = np.ascontiguousarray(view.read().over(GREY)), light_squares(*view.image.shape[:2])
    images = []

    def watched(gaussians, camera):
        output = shown(gaussians, camera)
        images.append(output.image.detach())
        return output

    ends = []
    for dark in (photo, np.full_like(photo, 128)):
        given = View(view.camera, np.where(light[..., None], photo, dark), name="a")
        aligned_psnr(scene[0], given, watched, GREY, EXTENT)
        ends.append(images[-1])
    assert torch.equal(*ends)


def test_light_squares_are_half_of_the_photo_in_every_corner():
    for H, W in ((64, 64), (97, 131), (24, 40)):
        light = light_squares(H, W)
        assert abs(light.mean() - 0.5) < 0.05
        for part in (light[: H // 2], light[H // 2 :], light[:, : W // 2], light[:, W // 2 :]):
            assert abs(part.mean() - 0.5) < 0.1
        assert light[0, 0] and not light[0, W // SQUARES + 1]
