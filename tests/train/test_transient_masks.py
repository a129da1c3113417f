"""Masks of objects in single photos, tested on scenes whose photos are their own renders, so the truth is known."""

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.parts.transients.masks import RULES, Compared, find_masks, outstanding
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.sphere_shell import sphere_shell
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from passers_by import pasted

HOW = Compared(render, RenderSettings(), lambda index, camera: camera)


@pytest.fixture(scope="module")
def scene():
    """Opaque splats on a ball, and the views of 20 cameras around it."""
    means, _, colors, _ = sphere_shell(1_500)
    start = from_points(means, colors, recipe(100, sh_degree=0, start_opacity=0.9, start_scale=1.5))
    views = []
    for view in procedural_capture(64, 20, splats=3)[0]:
        with torch.no_grad():
            image = render(start, view.camera).image.clamp(0, 1)
        views.append(View(view.camera, np.round(255 * image.numpy()).astype(np.uint8), name=view.name))
    return start, views


def overlap(found, truth):
    """Return precision and recall over all views."""
    masks = [one.mask for one in found]
    hits = sum((mask & true).sum() for mask, true in zip(masks, truth, strict=True))
    return hits / max(sum(mask.sum() for mask in masks), 1), hits / sum(true.sum() for true in truth)


def changed(view, image, mask=None):
    return View(view.camera, image, mask=mask, name=view.name)


def test_only_pasted_objects_are_masked(scene):
    gaussians, views = scene
    assert not any(one.mask.any() or one.too_large for one in find_masks(gaussians, views, HOW))
    struck, truth = pasted(views)
    found = find_masks(gaussians, struck, HOW)
    precision, recall = overlap(found, truth)
    assert recall > 0.9 and precision > 0.5, "masks include the rim"
    assert all(one.mask.any() == true.any() for one, true in zip(found, truth, strict=True))


def test_errors_of_the_scene_in_every_view_are_not_masked(scene):
    gaussians, views = scene
    wrong = gaussians.map(lambda tensor: tensor.clone())
    wrong.sh0[gaussians.means[:, 1] > 0.3] = -1.5
    assert any(np.abs(render(wrong, v.camera).image.numpy() - v.image / 255.0).max() > 0.5 for v in views)
    assert sum(one.mask.mean() for one in find_masks(wrong, views, HOW)) / len(views) < 0.005


def test_a_darker_photo_is_compared_and_nothing_is_masked(scene):
    gaussians, views = scene
    dark = changed(views[4], np.round(0.5 * views[4].image).astype(np.uint8))
    assert not any(
        one.mask.any() or one.too_large for one in find_masks(gaussians, [*views[:4], dark, *views[5:]], HOW)
    )


def test_pixels_that_a_given_mask_excludes_are_no_evidence(scene):
    gaussians, views = scene
    struck, truth = pasted(views)
    given = [changed(view, view.image, ~true) for view, true in zip(struck, truth, strict=True)]
    assert not any(one.mask.any() for one in find_masks(gaussians, given, HOW))


def test_a_photo_that_differs_everywhere_is_not_masked_but_named(scene):
    gaussians, views = scene
    noise = np.random.default_rng(0).integers(0, 2, (3, 4, 3)) * 255
    image = np.kron(noise, np.ones((16, 16, 1))).astype(np.uint8)
    found = find_masks(gaussians, [*views[:7], changed(views[7], image), *views[8:]], HOW)
    assert found[7].too_large and not found[7].mask.any()
    assert not any(one.too_large for one in found[:7] + found[8:])


def test_places_that_too_few_views_see_are_not_masked(scene):
    gaussians, views = scene
    few, truth = pasted(views[:3], share=1.0)
    assert any(true.any() for true in truth)
    assert not any(one.mask.any() for one in find_masks(gaussians, few, HOW))


@pytest.mark.parametrize("threads", [2, 5])
def test_masks_have_the_same_bits_for_any_number_of_threads(scene, threads):
    gaussians, views = scene
    struck, _ = pasted(views)
    before = torch.get_num_threads()
    found = []
    try:
        for count in (1, threads):
            torch.set_num_threads(count)
            found.append([one.mask.tobytes() for one in find_masks(gaussians, struck, HOW)])
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] and any(any(mask) for mask in found[0])


def test_spots_have_to_be_large_and_connected_to_clear_pixels():
    error = np.full((60, 80), 0.02, np.float32)
    error[10:12, 10:12] = 0.9  # 4 of 4,800 pixels
    error[30:40, 30:40] = 0.9
    error[30:40, 40:44] = 0.22  # connected to a clear pixel, above GROW of the limit
    error[50:58, 60:70] = 0.22  # equally high, but not connected
    expected, based = np.full((60, 80, len(RULES)), 0.02, np.float32), np.ones((60, 80), np.float32)
    limit = min(k * 0.02 + floor for _, k, floor in RULES)
    error[error == np.float32(0.22)] = 0.85 * limit
    mask = outstanding(error, expected, based).mask
    assert mask[30:40, 30:44].all() and not mask[:20].any() and not mask[50:, 55:].any()
    assert not outstanding(error, expected, np.zeros_like(based)).mask.any(), "no splat has a base error"


def test_a_camera_of_the_caller_is_used(scene):
    """With the refined camera, a photo taken from elsewhere fits and is not masked."""
    gaussians, views = scene
    shifted = [
        View(Camera.posed(v.camera.R, v.camera.eye + 0.4, v.camera.intrinsics), v.image, name=v.name)
        for v in views
    ]
    right = Compared(render, RenderSettings(), lambda index, camera: views[index].camera)
    struck, truth = pasted(shifted)
    assert overlap(find_masks(gaussians, struck, right), truth)[1] > 0.9
