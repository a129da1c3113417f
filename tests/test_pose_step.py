"""Steps of a pose reach the true pose with any exposure, and keep the given pose if a photo has no information."""

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ShapeError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.parts.poses.step import FEWEST, image_flow, pose_step
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points

EXTENT = 4.0
SPREAD = 0.01 * torch.tensor([1.0] * 3 + [EXTENT] * 3, dtype=torch.float64)
OFF = torch.tensor([0.006, -0.005, 0.004, 0.03, -0.02, 0.02], dtype=torch.float64)
NOWHERE = torch.zeros(6, dtype=torch.float64)


@pytest.fixture(scope="module")
def scene():
    """An opaque cloud of splats, one of its cameras, and the photo of that camera, as floats."""
    views, points, colors = procedural_capture(96, 3, splats=300)
    gaussians = from_points(points, 0.2 + 0.5 * colors, recipe(1, start_opacity=0.9, start_scale=1.5))
    camera = views[0].camera
    return gaussians, camera, shown(gaussians, camera).image


def shown(gaussians, camera):
    settings = RenderSettings(median_depth=True, depth=False)
    with torch.no_grad():
        return render(gaussians, camera, settings=settings, backend="cpu")


def aligned(scene, photo, steps=12, moved=None):
    """Take steps from a wrong camera; return the remaining motion in the image, px rms, and the camera."""
    gaussians, camera, _ = scene
    now = CameraTensors.of(camera).moved(OFF).value()
    for _ in range(steps):
        seen = shown(gaussians, now)
        step = pose_step(
            seen.image, seen.median_depth, now, photo, NOWHERE if moved is None else moved, SPREAD
        )
        now = CameraTensors.of(now).moved(step).value()
    return motion(gaussians, camera, now), now


def motion(gaussians, camera, other):
    """Return the distance of the scene's points between the images of two cameras, px rms."""
    points = gaussians.means.detach().double().numpy()
    places = [(points - c.eye) @ c.R.T for c in (camera, other)]
    u, v = (p[:, :2] / p[:, 2:] * (c.fx, c.fy) for p, c in zip(places, (camera, other), strict=True))
    return float(np.sqrt(np.square(u - v).sum(axis=1).mean()))


def test_a_wrong_pose_is_corrected(scene):
    before = motion(scene[0], scene[1], CameraTensors.of(scene[1]).moved(OFF).value())
    after, _ = aligned(scene, scene[2])
    assert before > 0.5 and after < 0.1 * before


def test_the_exposure_of_a_photo_does_not_change_the_steps(scene):
    """The model of gains is exact: y = g x + 0.055 (g - 1)."""
    darker = 0.7 * scene[2] + 0.055 * (0.7 - 1)
    before = motion(scene[0], scene[1], CameraTensors.of(scene[1]).moved(OFF).value())
    assert aligned(scene, darker)[0] < 0.1 * before


def test_the_true_pose_does_not_move(scene):
    gaussians, camera, photo = scene
    seen = shown(gaussians, camera)
    step = pose_step(seen.image, seen.median_depth, camera, photo, NOWHERE, SPREAD)
    assert step.abs().max() < 1e-9


def test_bytes_and_a_mask_count(scene):
    gaussians, camera, photo = scene
    now = CameraTensors.of(camera).moved(OFF).value()
    seen = shown(gaussians, now)
    mask = torch.zeros(camera.H, camera.W, dtype=torch.bool)
    mask[20:70, 20:70] = True
    spoiled = torch.where(mask[..., None], photo, 1.0 - photo)
    whole, part, bad = (
        pose_step(seen.image, seen.median_depth, now, image, NOWHERE, SPREAD, mask=counts)
        for image, counts in ((photo, mask), (spoiled, mask), (spoiled, None))
    )
    assert torch.equal(whole, part) and not torch.allclose(whole, bad)
    coarse = pose_step(
        seen.image, seen.median_depth, now, (255 * photo).round().to(torch.uint8), NOWHERE, SPREAD, mask=mask
    )
    assert torch.allclose(coarse, whole, atol=0.05 * float(whole.abs().max()))


def test_a_photo_without_information_keeps_the_given_pose(scene):
    """Photo and render are flat, so only the distance from the given pose matters, and the step returns to it."""
    _, camera, photo = scene
    flat, depth = torch.full_like(photo, 0.5), torch.ones(camera.H, camera.W)
    step = pose_step(flat, depth, camera, flat, OFF, SPREAD)
    torch.testing.assert_close(step, -OFF)


def test_too_few_pixels_do_not_move_the_pose(scene):
    gaussians, camera, photo = scene
    seen = shown(gaussians, camera)
    mask = torch.zeros(camera.H, camera.W, dtype=torch.bool)
    mask.view(-1)[: FEWEST // 2] = True
    for depth, counts in ((seen.median_depth, mask), (torch.zeros_like(seen.median_depth), None)):
        assert not pose_step(seen.image, depth, camera, photo, OFF, SPREAD, mask=counts).any()


def test_the_flow_is_that_of_finite_differences(scene):
    _, camera, _ = scene
    generator, size = torch.Generator().manual_seed(0), 1e-6
    pixels = 90.0 * torch.rand(20, 2, dtype=torch.float64, generator=generator)
    z = 2.0 + torch.rand(20, dtype=torch.float64, generator=generator)
    rays = np.concatenate(
        [(pixels.numpy() - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((20, 1))], 1
    )
    points = (z.numpy()[:, None] * rays) @ camera.R + camera.eye
    for column, direction in enumerate(np.eye(6)):
        other = CameraTensors.of(camera).moved(torch.from_numpy(size * direction)).value()
        seen = (points - other.eye) @ other.R.T
        place = seen[:, :2] / seen[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        found = (place - pixels.numpy()) / size
        np.testing.assert_allclose(
            image_flow(camera, pixels, z)[:, :, column].numpy(), found, rtol=1e-4, atol=1e-3
        )


def test_the_bits_do_not_depend_on_the_number_of_threads(scene):
    gaussians, camera, photo = scene
    now = CameraTensors.of(camera).moved(OFF).value()
    seen, before, found = shown(gaussians, now), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append(pose_step(seen.image, seen.median_depth, now, photo, NOWHERE, SPREAD))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_sizes_have_to_fit(scene, as_shipped):
    gaussians, camera, photo = scene
    seen = shown(gaussians, camera)
    with pytest.raises(ShapeError, match="photo"):
        pose_step(seen.image, seen.median_depth, camera, photo[:-1], NOWHERE, SPREAD)
