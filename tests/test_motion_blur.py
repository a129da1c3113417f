"""Motion blur: the ellipse b b' / 12 and the opacity's factor against the average of sub-exposures.

A sub-exposure at the time d from the middle of the exposure is a photo by the camera that is turned by C(w d) and
shifted by V d, with the same readout. The reference renders 64 of them and adds them up.
"""

import dataclasses
import json

import numpy as np
import pytest

from gsplat_edu import Camera, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussian_math import opacity_compensation
from gsplat_edu.scene.lens_record import lens_entry, with_lens
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from lens_scenes import around, lens_camera, lens_truth, moved, smooth_around
from native_scenes import BACKGROUND
from proofs import proves_gradients

COUNT = 64
EXACT = {"extent": "exact", "stop": "none"}
SHIFT, TURN = np.array([0.2, 0.12, 0.0]), np.array([0.03, -0.06, 0.02])


def camera_of(readout, exposure, *, shift=SHIFT, turn=(0.0, 0.0, 0.0)):
    """Return a camera without rotation, so that the shift is across its optical axis, that sees a splat of 6 px."""
    rest = Camera(np.eye(3), (0.0, 0.0, 0.0), 60.0, 55.0, 13.0, 9.0, 20, 26)
    return moved(rest, RollingShutter(turn, shift, readout, exposure))


def sub_exposures(camera):
    """Return the cameras of the sub-exposures, each of one moment."""
    shutter = camera.shutter
    still = RollingShutter(shutter.turn, shutter.shift, shutter.readout)
    for k in range(COUNT):
        time = ((k + 0.5) / COUNT - 0.5) * shutter.exposure
        R, eye = shutter.rotation(time) @ camera.R, camera.eye + time * shutter.shift
        yield Camera.posed(R, eye, camera.intrinsics, still)


def averaged(camera, *splats):
    """Return the average of the sub-exposures."""
    images = [render_gaussians(each, *splats, bg=BACKGROUND, **EXACT)[0] for each in sub_exposures(camera)]
    return np.mean(images, axis=0)


def one_splat(*, flat=False):
    """Return a splat that is above the floor of alpha in the whole image; `flat`: a disc across the optical axis."""
    quat, depth = ((1.0, 0.0, 0.0, 0.3), 1e-4) if flat else ((1.0, 0.2, -0.1, 0.3), 0.15)
    cov = build_cov3d_batch([(0.32, 0.28, depth)], quat_to_R_batch([quat]))
    return [[0.05, -0.02, 2.0]], cov, [[0.9, 0.4, 0.1]], [0.8]


def errors(readout, fraction, splats, **motion):
    """Return the largest error of the blurred image, and the largest effect of the blur."""
    camera = camera_of(readout, fraction, **motion)
    sharp = camera_of(readout, 0.0, **motion)
    truth = averaged(camera, *splats)
    blurred, rest = (render_gaussians(each, *splats, bg=BACKGROUND, **EXACT)[0] for each in (camera, sharp))
    return abs(blurred - truth).max(), abs(rest - truth).max()


@pytest.mark.parametrize("readout", [AT_ONCE, "down", "up", "right", "left"])
def test_a_splat_agrees_with_its_sub_exposures_to_second_order(readout):
    """A disc that moves across the axis keeps its shape: half the exposure leaves a sixteenth of the error."""
    splats = one_splat(flat=True)
    (whole, effect), (half, _) = (errors(readout, fraction, splats) for fraction in (1.0, 0.5))
    assert effect > 0.01 and whole < 0.02 * effect
    assert whole / half == pytest.approx(16, rel=0.1)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), TURN])
@pytest.mark.parametrize("readout", [AT_ONCE, "down", "left"])
def test_a_thick_splat_and_a_turn_agree_nearly_so(readout, turn):
    """Perspective changes the ellipse on its way, and a turn bends the way: a small part of second order is left."""
    error, effect = errors(readout, 1.0, one_splat(), turn=turn)
    assert effect > 0.01 and error < 0.1 * effect


@pytest.mark.parametrize("readout", [AT_ONCE, "up", "right"])
def test_the_light_of_a_splat_is_kept(readout):
    """The sum of alpha over a wide image, of a splat wholly inside it, is that without blur."""
    rest = Camera(np.eye(3), (0.0, 0.0, 0.0), 60.0, 55.0, 60.0, 55.0, 110, 120)
    means, cov, colors, opacities = one_splat()
    sums = []
    for exposure in (0.0, 0.5, 1.5):
        camera = moved(rest, RollingShutter(TURN, SHIFT, readout, exposure))
        _, T = render_gaussians(camera, means, cov, colors, opacities, **EXACT)
        sums.append((1 - T).sum())
    np.testing.assert_allclose(sums[1:], sums[0], rtol=0.01)  # the rim below 1/255 is cut off


def test_overlapping_splats_differ_from_their_sub_exposures():
    """Splats that move together stay in front of one another; blurred ones are composited as if independent.

    Here the error is about half of the effect of the blur, of opacities of 0.9, and less of smaller ones.
    """
    rng = np.random.default_rng(1)
    means = np.stack(
        [rng.uniform(-1.2, 1.2, 100), rng.uniform(-1, 1, 100), rng.uniform(2.0, 2.5, 100)], axis=1
    )
    scales, quats = 0.12 * np.exp(0.3 * rng.normal(size=(100, 3))), rng.normal(size=(100, 4))
    shapes, colors = build_cov3d_batch(scales, quat_to_R_batch(quats)), rng.uniform(0, 1, (100, 3))
    shares = []
    for opacity in (0.1, 0.9):
        splats = means, shapes, colors, np.full(100, opacity)
        truth = averaged(camera_of(AT_ONCE, 1.0), *splats)
        blurred, sharp = (
            render_gaussians(camera_of(AT_ONCE, each), *splats, bg=BACKGROUND, **EXACT)[0]
            for each in (1.0, 0.0)
        )
        error, effect = (np.sqrt(np.mean((each - truth) ** 2)) for each in (blurred, sharp))
        shares.append(error / effect)
    assert shares[0] < 0.25 and 0.25 < shares[1] < 0.7


@pytest.mark.parametrize("name", ["fisheye, moving", "opencv, moving up", "pinhole, moving"])
def test_without_an_exposure_nothing_changes(name):
    scene, camera = around(60), lens_camera(name)
    zero = RollingShutter(camera.shutter.turn, camera.shutter.shift, camera.shutter.readout, 0.0)
    assert (lens_truth(scene, moved(camera, zero))[0] == lens_truth(scene, camera)[0]).all()
    assert camera.sight(scene.means).blur is None


@pytest.mark.parametrize("dilation", [0.3, 0.0])
def test_antialiasing_and_blur_share_one_factor(dilation):
    """The product is the root of det before everything by det after everything."""
    scene, camera = around(40, seed=2), lens_camera("pinhole, moving")
    camera = moved(camera, RollingShutter(camera.shutter.turn, camera.shutter.shift, "down", 1.5))
    covs = build_cov3d_batch(np.exp(scene.log_scales), quat_to_R_batch(scene.quats))
    seen = camera.sight(scene.means, 0.05)
    JW = np.stack([np.stack(row, axis=-1) for row in seen.jacobian], axis=-2)
    flat, g = JW @ covs @ np.swapaxes(JW, -1, -2), np.stack(seen.blur, axis=-1)
    dilated = flat + dilation * np.eye(2)
    after = np.linalg.det(dilated + g[:, :, None] * g[:, None, :])
    factor = opacity_compensation(flat, dilation) * np.sqrt(np.linalg.det(dilated) / after)
    np.testing.assert_allclose(factor**2, np.linalg.det(flat) / after, rtol=1e-9)
    opacities = factor / (1 + np.exp(-scene.logits))
    settings = RenderSettings(antialiased=True, dilation=dilation, background=BACKGROUND)
    out = render(scene.gaussians(), camera, settings=settings, backend="torch")
    level = 2 * np.log(np.maximum(opacities * 255, 1.0))
    extents = np.sqrt(level[:, None] * np.stack([dilated[:, k, k] + g[:, k] ** 2 for k in (0, 1)], axis=-1))
    np.testing.assert_allclose(out.radii.numpy(), extents[out.visible.numpy()], rtol=1e-9)


@pytest.mark.parametrize(
    ("turn", "readout", "exposure", "message"),
    [
        ((0, 0, 0), "down", -0.1, "exposure"),
        ((0, 0, 0), "down", np.nan, "exposure"),
        ((0, 0, 0), "down", np.inf, "exposure"),
        ((0.5, 0, 0), "down", 2.1, "in one exposure"),
        ((0, 0, 0), "sideways", 0.1, "readout"),
    ],
)
def test_what_is_no_exposure_is_refused(turn, readout, exposure, message):
    with pytest.raises(ArgumentError, match=message):
        RollingShutter(turn, (0, 0, 0), readout, exposure)


def test_a_global_shutter_sees_all_rows_at_once():
    camera = camera_of(AT_ONCE, 0.7, turn=TURN)
    assert (camera.shutter.times(camera.H, camera.W) == 0).all() and camera.shutter.axis == 1
    assert (camera.rays() == camera.through(camera.projection).rays()).all()
    points = np.array([[0.1, 0.2, 2.0], [-0.3, 0.0, 1.0], [0.0, 0.0, -1.0]])
    seen, still = camera.sight(points), camera.through(camera.projection).sight(points)
    for a, b in zip((seen.u, seen.v, *seen.jacobian), (still.u, still.v, *still.jacobian), strict=True):
        np.testing.assert_allclose(np.array(a)[..., :2], np.array(b)[..., :2], rtol=1e-15)
    assert seen.valid.tolist() == still.valid.tolist() == [True, True, False]


@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_the_derivative_by_the_motion_is_that_of_the_blur(backend):
    """A global shutter's motion acts through the blur only."""
    scene = smooth_around(3)
    tensors = CameraTensors.of(lens_camera("pinhole, moving", 11, 9))

    def forward(motion):
        given = dataclasses.replace(tensors, motion=motion, readout=AT_ONCE, exposure=1.5)
        return render(scene.gaussians(), given, backend=backend).image

    assert proves_gradients(forward, [tensors.motion], atol=2e-6, rtol=2e-5)


@pytest.mark.parametrize(("readout", "exposure"), [(AT_ONCE, 1.0), ("left", 0.25), ("down", 0.0)])
def test_records_keep_the_exposure_and_older_ones_are_read(readout, exposure):
    camera = camera_of(readout, exposure, turn=TURN)
    entry = json.loads(json.dumps(lens_entry(camera)))
    assert ("exposure" in entry["shutter"]) == (exposure > 0)
    found = with_lens(camera.through(), entry).shutter
    assert (found.readout, found.exposure) == (readout, exposure)
    assert found.turn.tolist() == camera.shutter.turn.tolist()
    with pytest.raises(ArgumentError, match="exposure"):
        with_lens(camera.through(), {"shutter": {**entry["shutter"], "exposure": -1}})


def test_a_transformed_camera_keeps_its_exposure():
    camera = camera_of("down", 0.4)
    moved_there = Similarity(np.eye(3), 2.0, np.ones(3)).camera(camera)
    assert moved_there.shutter.exposure == 0.4
