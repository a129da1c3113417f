"""Wrong poses and intrinsics are corrected, the gauge is fixed, gradients are checked, resumed runs have equal bits."""

import json

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.alignment import aligned_psnr
from gsplat_edu.parts.poses.refinement import LENSES, TWISTS, Refinement, gauge
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points

EXTENT = 4.0
"""Distance of the procedural cameras from the centre, about, world units."""

HELD_OUT = 12


def turned(camera, twist):
    """Rotate a camera by twist[:3] radians and shift it by twist[3:] world units."""
    return CameraTensors.of(camera).moved(torch.from_numpy(np.asarray(twist, float))).value()


def with_camera(view, camera):
    return View(camera, view.read().image, name=view.name)


@pytest.fixture(scope="module")
def capture():
    """Views of 64 px, their points, and the training views with poses off by 0.5 degrees and 1 % of the extent."""
    views, points, colors = procedural_capture(64, HELD_OUT + 2, splats=120)
    rng = np.random.default_rng(1)

    def off(view):
        directions = rng.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sizes = np.repeat([np.radians(0.5), 0.01 * EXTENT], 3)
        return with_camera(view, turned(view.camera, directions.ravel() * sizes))

    return views, [off(view) for view in views[:HELD_OUT]], points, colors


def trainer(capture, views, refine, iterations=600, **changes):
    config = recipe(iterations, strategy="fast", max_gaussians=800, sh_degree=1, refine=refine, **changes)
    start = from_points(*capture[2:], config)
    return training(config, Views(views), load_backend("cpu"), Start(start, extent=EXTENT))


def aligned(run, views):
    return np.mean([aligned_psnr(run.gaussians, view, render, (0.0, 0.0, 0.0), EXTENT) for view in views])


def pose_errors(cameras, views):
    """Return the mean error of rotations, degrees, and of positions, per cent of the extent."""
    angles, shifts = [], []
    for camera, view in zip(cameras, views, strict=True):
        cosine = (np.trace(camera.R @ view.camera.R.T) - 1) / 2
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        shifts.append(100 * np.linalg.norm(camera.eye - view.camera.eye) / EXTENT)
    return np.mean(angles), np.mean(shifts)


@pytest.mark.slow
def test_wrong_poses_are_corrected_and_held_out_quality_with_them(capture):
    views, wrong, *_ = capture
    best, lost, regained = (
        trainer(capture, given, refine)
        for given, refine in ((views[:HELD_OUT], "none"), (wrong, "none"), (wrong, "poses"))
    )
    for run in (best, lost, regained):
        run.run()
    before = pose_errors([view.camera for view in wrong], views[:HELD_OUT])
    cameras = [regained.view_model.refined(i, view.camera) for i, view in enumerate(wrong)]
    after = pose_errors(cameras, views[:HELD_OUT])
    assert before == pytest.approx((0.5, 1.0), rel=1e-3)
    # Half a degree is half a pixel at 64 px, so the photos hardly determine rotations better than that.
    assert after[0] < before[0] and after[1] < 0.7 * before[1]
    good, bad, ours = (aligned(run, views[HELD_OUT:]) for run in (best, lost, regained))
    assert good - bad > 1.0, "wrong poses reduce the quality"
    assert ours - bad > 0.8 * (good - bad)


@pytest.mark.slow
def test_a_wrong_focal_length_is_recovered(capture):
    views = capture[0][:HELD_OUT]
    off = []
    for view in views:
        c = view.camera
        off.append(with_camera(view, Camera(c.R, c.eye, 1.02 * c.fx, c.fy, c.cx, c.cy, c.H, c.W)))
    run = trainer(capture, off, "intrinsics", lens_rate=1e-3)
    run.run()
    ratio = [
        camera.fx / camera.fy
        for camera in (run.view_model.refined(i, view.camera) for i, view in enumerate(off))
    ]
    true = views[0].camera.fx / views[0].camera.fy
    # Only fx is wrong. Photos determine the ratio fx / fy, while the scale of both depends on the scene's depth.
    assert np.ptp(ratio) == 0.0, "all views share one lens"
    assert abs(ratio[0] / true - 1) < 0.01


def test_common_moves_of_all_cameras_are_not_learned(capture):
    """Shifting, rotating and scaling the whole capture is in the gauge, up to second order in the move."""
    cameras = [view.camera for view in capture[0]]
    basis = gauge(cameras, EXTENT)
    flat = basis.reshape(-1, basis.shape[2])
    np.testing.assert_allclose(flat.T @ flat, np.eye(7), atol=1e-12)
    small, middle = 1e-5, np.mean([camera.eye for camera in cameras], axis=0)
    K = np.array([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]) * small
    rotation = np.eye(3) + K + K @ K / 2
    twists = []
    for camera in cameras:
        eye = middle + (1 + small) * rotation @ (camera.eye - middle) + small * np.array([0.3, -0.2, 0.5])
        turn = camera.R @ rotation.T @ camera.R.T
        w = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        twists.append(np.concatenate([w, (eye - camera.eye) / EXTENT]))
    move = np.array(twists).ravel()
    left = move - flat @ (flat.T @ move)
    assert np.linalg.norm(move) > small and np.linalg.norm(left) < 20 * small**2 * len(cameras)


def test_gradients_of_the_corrected_camera_are_proven_by_finite_differences(capture):
    """In float64, at corrections other than 0; exponentials and products are smooth."""
    cameras, config = [view.camera for view in capture[0]], recipe(10, refine="both")
    model, generator = Refinement(cameras, config, EXTENT), torch.Generator().manual_seed(1)
    model._twists = 0.1 * torch.randn(len(cameras), 6, dtype=torch.float64, generator=generator)
    lenses = 0.1 * torch.randn(1, 4, dtype=torch.float64, generator=generator)

    def numbers(lenses):
        model._lenses = lenses
        return model.camera(3, cameras[3]).intrinsics

    assert torch.autograd.gradcheck(numbers, (lenses.requires_grad_(),))


def test_a_single_view_has_fewer_moves_and_is_not_refined(capture):
    camera = capture[0][0].camera
    assert gauge([camera], EXTENT).shape == (1, 6, 6)
    model = Refinement([camera], recipe(10, refine="poses"), EXTENT)
    with torch.no_grad():
        model.parameters()[TWISTS].fill_(0.1)
    moved = model.refined(0, camera)
    np.testing.assert_allclose(moved.R, camera.R, atol=1e-12)
    np.testing.assert_allclose(moved.eye, camera.eye, atol=1e-12)


@pytest.mark.parametrize("at", [3, 21])
def test_a_resumed_run_with_everything_on_has_the_same_bits_for_any_number_of_threads(capture, tmp_path, at):
    def make():
        return trainer(capture, capture[1], "both", 40, appearance="exposure")

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole, first, second = make(), make(), make()
        whole.run()
        torch.set_num_threads(5)
        first.run(lambda: first.iteration >= at)
        load_checkpoint(save_checkpoint(tmp_path, first, 1.0), second)
        torch.set_num_threads(2)
        second.run()
    finally:
        torch.set_num_threads(before)
    (tensors, numbers), (resumed, others) = whole.state(), second.state()
    assert {f"view_model.{name}" for name in (TWISTS, LENSES, "exposures")} <= tensors.keys()
    assert tensors[f"view_model.{TWISTS}"].abs().max() > 0
    assert json.dumps(numbers) == json.dumps(others)
    for name, tensor in tensors.items():
        assert torch.equal(tensor, resumed[name]), name
