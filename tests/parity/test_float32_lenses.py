"""Lenses, the seam of panoramas and rolling shutters in the backends that compute in float32: cuda and webgpu.

Images are compared with the NumPy reference, gradients with the native kernels in float64; the bounds of gradients are
those of `lens_gradients`. Bounds of images: 22 eps for exp2 and log2, 100 eps for the sum, and four times what moves a
pixel when the parameters move by 4 eps; two pixels may have an alpha within rounding of 1/255. The engine's own arc
tangent errs by 3 ULP, which moves a mean by less than such a move of its coordinates.
"""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
import torch

from float32_backends import sensitivity
from gsplat_edu import Camera
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.shutter import RollingShutter
from lens_gradients import BOUND, PANORAMAS, SETTINGS, check_against_native, images_and_gradients
from lens_scenes import (
    CENTRE,
    CLAMPED,
    LENSES,
    LIMIT,
    LOST,
    MOVING,
    STEPS,
    around,
    beyond,
    lens_camera,
    lens_truth,
    lost,
)
from parity.conftest import where

SMALL = (33, 27)
"""Width and height of images, no multiples of a tile: three columns of tiles and two rows."""

EPS = float(np.finfo(np.float32).eps)

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the interpreter computes with NumPy


@pytest.fixture
def check(backend):
    return functools.partial(check_against_native, backend=backend, device=where(backend))


def rendered(scene, camera, backend, settings=SETTINGS):
    gaussians = scene.gaussians(torch.float32).to(torch.device(where(backend)))
    return render(gaussians, camera, settings=settings, backend=backend)


IMAGES = [("webgpu", name, None) for name in LENSES]
IMAGES += [("cuda", name, None) for name in [*LENSES][1::2]]
IMAGES += [(backend, name, LIMIT) for backend in ("webgpu", "cuda") for name in CLAMPED]
"""On cuda, images of the other lenses are compared with those of the native kernels only."""


@pytest.mark.parametrize(("backend", "name", "limit"), IMAGES, indirect=["backend"])
def test_images_agree_with_the_reference(backend, name, limit):
    scene = dataclasses.replace(around(150), camera=lens_camera(name, *SMALL))
    image, T, depth = lens_truth(scene, scene.camera, limit)
    out = rendered(scene, scene.camera, backend, dataclasses.replace(SETTINGS, jacobian_limit=limit))
    assert len(out.visible) > 20
    bright = max(1.0, np.abs(image).max())
    error = np.maximum(
        np.abs(out.image.cpu().numpy() - image).max(axis=-1), np.abs(out.transmittance.cpu().numpy() - T)
    )
    over = error > 4 * sensitivity(scene) + 122 * EPS * bright
    assert over.sum() <= 2 and error.max() < 1.1 * bright / 255
    assert np.abs(out.depth.cpu().numpy() - depth).max() < 1.1 * max(1.0, depth.max()) / 255
    assert np.median(np.abs(out.depth.cpu().numpy() - depth)) <= 122 * EPS * max(1.0, depth.max())


@pytest.mark.parametrize(("name", "antialiased"), [*zip(LENSES, itertools.cycle([False, True]))])
def test_gradients_match_the_native_kernels_in_float64(check, name, antialiased):
    """Every second lens is antialiased: the compensation depends on the footprint, whatever lens it comes from."""
    check(
        around(60, seed=3), lens_camera(name, *SMALL), dataclasses.replace(SETTINGS, antialiased=antialiased)
    )


@pytest.mark.parametrize("name", CLAMPED)
def test_clamped_gradients_match_the_native_kernels(check, name, monkeypatch):
    scene, camera = around(60, seed=3), lens_camera(name, *SMALL)
    inner = tuple((0.4 * low, 0.4 * high) for low, high in camera.jacobian_bounds(LIMIT))
    monkeypatch.setattr(Camera, "jacobian_bounds", lambda camera, limit: inner)
    assert beyond(scene, camera).sum() >= 4
    check(scene, camera, dataclasses.replace(SETTINGS, jacobian_limit=LIMIT))


@pytest.mark.parametrize("name", ["thin prism", "panorama, moving"])
def test_features(check, name):
    check(around(40, seed=3), lens_camera(name, *SMALL), channels=6)


def test_two_runs_give_the_same_bits(backend):
    camera = lens_camera("panorama, moving", *SMALL)
    first, second = (
        images_and_gradients(around(80, seed=1), camera, backend, device=where(backend))[:2] for _ in "ab"
    )
    for ours, other in zip(first, second, strict=True):
        assert all(torch.equal(tensor, other[key]) for key, tensor in ours.items())


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 1e-2, 0.29, 0.31, 0.33, 1.5707, 1.6, 2.5])
def test_a_fisheye_near_its_axis_and_past_90_degrees(check, angle):
    """Also on both sides of the switch from the series to the closed form, at tan² = 0.1.

    The means are rounded to float32 for both backends: near the axis, their rounding is a part of their places on the
    plane. On the axis, the rest of a place is rounding, and so is what decentring's coefficients get.
    """
    camera, scene = lens_camera("fisheye", 30, 30), around(3, seed=7)
    turns, distance = np.array([0.3, 2.2, 4.0]), np.array([1.0, 1.5, 2.0])[:, None]
    across = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1) * np.sin(angle)
    means = CENTRE + distance * (across + np.array([0, 0, np.cos(angle)])) @ camera.R
    rounded = means.astype(np.float32).astype(np.float64)
    but = ("camera's coefficients",) if angle < 1e-4 else ()
    check(dataclasses.replace(scene, means=rounded), camera, bound=1e-4, but=but)


@pytest.mark.parametrize("latitudes", [(70.0, 79.9), (80.1, 88.9), (89.1, 89.9)])
@pytest.mark.parametrize("name", PANORAMAS)
def test_a_panorama_near_its_poles(check, name, latitudes):
    """On both sides of the bound of the ellipse, `POLE`."""
    camera = lens_camera(name, 32, 16)
    scene, turns = around(6, seed=8), np.array([0.5, 2.4, 4.4, 1.5, 3.4, 5.4])
    up = np.radians(np.repeat(latitudes, 3))
    down = np.array([1, -1, 1, -1, 1, -1]) * np.sin(up)
    direction = np.stack([np.cos(up) * np.sin(turns), down, np.cos(up) * np.cos(turns)], axis=1)
    apart = np.linspace(2.0, 2.5, 6)[:, None]  # of one distance, their order would be that of rounding
    check(dataclasses.replace(scene, means=CENTRE + apart * direction @ camera.R), camera)


@pytest.mark.parametrize("W", [45, 32])
@pytest.mark.parametrize("name", PANORAMAS)
def test_the_seam(check, name, W):
    """Gaussians behind the camera, narrow ones and one that reaches around, in images of whole tiles and of others."""
    camera, scene = lens_camera(name, W, W // 2), around(12, seed=9)
    turns = np.pi + np.linspace(-0.12, 0.12, 12)
    direction = np.stack([np.sin(turns), 0.3 * np.linspace(-1, 1, 12), np.cos(turns)], axis=1)
    moved = dataclasses.replace(scene, means=CENTRE + np.linspace(1, 2, 12)[:, None] * direction @ camera.R)
    moved.log_scales[3] = 0.6
    weight = 1 - check(moved, camera).transmittance
    assert weight[:, 0].max() > 0.1 and weight[:, -1].max() > 0.1, "the edges show them"


def test_a_panorama_turned_by_a_tile_is_its_image_moved_by_a_tile(backend):
    """Also across the seam. Nearer to the poles, splats reach half way round, where tiles see different copies."""
    scene, W = around(100, seed=4), 48
    camera = lens_camera("panorama", W, 24)
    before = rendered(scene, camera, backend).image
    for columns in (16, 32):
        angle = 2 * np.pi * columns / W
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        other = rendered(scene, Camera.posed(turn @ camera.R, camera.eye, camera.intrinsics), backend).image
        moved = torch.roll(before, columns, dims=1)
        error = (other[6:18] - moved[6:18]).abs()
        assert error.max() < 1.1 * max(1.0, float(moved.max())) / 255 and error.mean() < 1e-6


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_coefficients_of_zero_have_a_gradient(backend, kind):
    """From which a lens begins to be learned; the dense renderer's, which knows no tile stop."""
    scene = around(40, seed=3)
    scene.logits[:] -= 2.0
    camera, found = lens_camera("fisheye").through(Projection(kind)), []
    for one, device, dtype in ((backend, where(backend), torch.float32), ("torch", "cpu", torch.float64)):
        zero = torch.zeros(len(STEPS), dtype=torch.float64, requires_grad=True)
        tensors = dataclasses.replace(CameraTensors.of(camera), coefficients=STEPS * zero)
        gaussians = scene.gaussians(dtype).to(torch.device(device))
        render(gaussians, tensors, settings=SETTINGS, backend=one).image.square().sum().backward()
        found.append(zero.grad)
    assert (found[1] != 0).all()
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=BOUND * float(found[1].abs().max()))


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
def test_every_readout(check, readout):
    projection = LENSES["opencv"][0]
    camera = lens_camera("opencv", *SMALL).through(
        projection, RollingShutter(MOVING.turn, MOVING.shift, readout)
    )
    check(around(60, seed=3), camera)


def test_a_shutter_at_rest_is_none(backend):
    """A camera that does not move during its readout, and one without a rolling shutter."""
    scene, plain = around(40, seed=2), lens_camera("fisheye")
    still = plain.through(plain.projection, RollingShutter((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    one, other = (rendered(scene, camera, backend).image for camera in (plain, still))
    assert (one - other).abs().max() < 1e-5


def test_what_newton_s_method_does_not_find_is_not_drawn(backend):
    scene, camera = lost()
    native = render(scene.gaussians(), camera, backend="cpu")
    ours = rendered(scene, camera, backend)
    assert set(ours.visible.tolist()) == set(native.visible.tolist()) and LOST not in ours.visible


def test_what_moves_too_fast_for_the_shutter_is_not_drawn(backend):
    """Along the readout at more than half of its speed, where the native kernels do not draw it either."""
    camera = lens_camera("pinhole, moving")
    fast = camera.through(Projection(), RollingShutter((0.9, 0.0, 0.0), (0.0, 2.0, 0.0)))
    scene = around(200, seed=2)
    ours = rendered(scene, fast, backend)
    native = render(scene.gaussians(), fast, backend="cpu")
    slow = render(scene.gaussians(), camera, backend="cpu")
    assert set(ours.visible.tolist()) == set(native.visible.tolist())
    assert len(ours.visible) < len(slow.visible)


@pytest.mark.parametrize("lens", ["fisheye, moving", "panorama", "orthographic", "opencv"])
def test_bad_gaussians_do_not_affect_others(backend, lens):
    camera = lens_camera(lens, *SMALL)
    good = around(40, seed=3).gaussians(torch.float32).to(torch.device(where(backend)))
    bad = good.map(torch.clone)
    for i, (name, value) in enumerate([("means", np.nan), ("means", 1e30), ("log_scales", 60.0)]):
        bad.tensors()[name][7 + i] = value
    rest = lambda t: torch.cat([t[:7], t[10:]])  # noqa: E731
    without, bad = good.map(rest).trainable(), bad.trainable()
    images = [render(g, camera, settings=SETTINGS, backend=backend).image for g in (bad, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for key, tensor in bad.tensors().items():
        assert (tensor.grad[7:10] == 0).all(), key
        assert torch.equal(rest(tensor.grad), without.tensors()[key].grad), key


@pytest.mark.parametrize("lens", ["fisheye", "equidistant", "panorama", "panorama, moving"])
def test_where_a_lens_has_no_direction(backend, lens):
    """The camera's centre, and straight above it: no number becomes NaN."""
    camera, scene = lens_camera(lens, *SMALL), around(30, seed=3)
    scene.means[4] = CENTRE
    scene.means[5] = CENTRE + 2.0 * camera.R[1]
    values, gradients, _ = images_and_gradients(scene, camera, backend, device=where(backend))
    assert all(tensor.isfinite().all() for tensor in (*values.values(), *gradients.values()))


def test_a_scene_of_no_gaussians(backend):
    values, gradients, out = images_and_gradients(
        around(0), lens_camera("fisheye, moving"), backend, device=where(backend)
    )
    assert out.num_pairs == 0 and (values["T"] == 1).all()
    assert all((tensor == 0).all() for tensor in gradients.values())
