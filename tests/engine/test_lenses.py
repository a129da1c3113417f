"""Lenses, the seam of panoramas and rolling shutters in the backend webgpu; bounds are those of `lens_gradients`."""

import dataclasses

import numpy as np
import pytest
import torch

from engine.frames import plain_view
from gsplat_edu import Camera
from gsplat_edu.engine import host, passes
from gsplat_edu.engine.passes import MODULES, Buffer, Pass, Program, Size
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import COLLECTED
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.shutter import RollingShutter
from lens_gradients import BOUND, PANORAMAS, SETTINGS, check_against_native, images_and_gradients
from lens_scenes import CENTRE, CLAMPED, LENSES, LIMIT, LOST, MOVING, STEPS, around, beyond, lens_camera, lost

pytestmark = pytest.mark.usefixtures("webgpu")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", LENSES)
def test_gradients_match_the_native_kernels_in_float64(name, antialiased):
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased)
    check_against_native(around(60, seed=3), lens_camera(name), settings)


@pytest.mark.parametrize("name", CLAMPED)
def test_clamped_gradients_match_the_native_kernels(name, monkeypatch):
    scene, camera = around(60, seed=3), lens_camera(name)
    inner = tuple((0.4 * low, 0.4 * high) for low, high in camera.jacobian_bounds(LIMIT))
    monkeypatch.setattr(Camera, "jacobian_bounds", lambda camera, limit: inner)
    assert beyond(scene, camera).sum() >= 4
    check_against_native(scene, camera, dataclasses.replace(SETTINGS, jacobian_limit=LIMIT))


@pytest.mark.parametrize("name", ["thin prism", "orthographic, moving", "panorama, moving"])
@pytest.mark.parametrize("channels", [1, 6])
def test_features(name, channels):
    check_against_native(around(60, seed=3), lens_camera(name), channels=channels)


@pytest.mark.parametrize("name", ["opencv, moving up", "panorama"])
def test_the_stop_per_pixel(name):
    scene = around(150, seed=3)
    scene.logits[:] += 4.0  # opaque ones, so that pixels stop
    settings = dataclasses.replace(SETTINGS, stop="pixel")
    _, _, out = images_and_gradients(scene, lens_camera(name), "webgpu", settings)
    assert out.transmittance.min() < 1e-2
    check_against_native(scene, lens_camera(name), settings)


@pytest.mark.parametrize("name", ["fisheye, moving", "panorama"])
def test_statistics(name):
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        gaussians = around(80, seed=5).gaussians(dtype).trainable()
        out = render(gaussians, lens_camera(name), settings=SETTINGS, backend=backend)
        errors = torch.rand(out.transmittance.shape, generator=torch.Generator().manual_seed(1))
        statistics = out.collect(*COLLECTED, errors=errors.to(dtype))
        out.image.square().sum().backward()
        found.append({key: (out.visible, values.double()) for key, values in statistics().items()})
    for key, (visible, truth) in found[1].items():
        order = found[0][key][0].argsort()
        error = found[0][key][1][order] - truth[visible.argsort()]
        assert truth.max() > 0
        assert error.abs().max() <= (2 if key == "pixels" else BOUND * truth.max()), key


@pytest.mark.parametrize("name", ["radial first", "panorama, moving"])
def test_two_runs_give_the_same_bits(name):
    first, second = (images_and_gradients(around(300, seed=1), lens_camera(name), "webgpu")[:2] for _ in "ab")
    for ours, other in zip(first, second, strict=True):
        assert all(torch.equal(tensor, other[key]) for key, tensor in ours.items())


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-4, 1e-2, 0.29, 0.31, 0.33, 1.5707, 1.6, 2.5])
def test_a_fisheye_near_its_axis_and_past_90_degrees(angle):
    """Also on both sides of the switch from the series to the closed form, at tan² = 0.1.

    On the axis, the place on the plane is rounding, and so is what decentring's coefficients get.
    """
    camera, scene = lens_camera("fisheye", 120, 120), around(3, seed=7)
    turns, distance = np.array([0.3, 2.2, 4.0]), np.array([1.0, 1.5, 2.0])[:, None]
    across = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1) * np.sin(angle)
    means = CENTRE + distance * (across + np.array([0, 0, np.cos(angle)])) @ camera.R
    but = ("camera's coefficients",) if angle < 1e-4 else ()
    check_against_native(dataclasses.replace(scene, means=means), camera, bound=5e-5, but=but)


@pytest.mark.parametrize("latitude", [70.0, 85.0, 88.9, 89.1, 89.9])
@pytest.mark.parametrize("name", PANORAMAS)
def test_a_panorama_near_its_poles(name, latitude):
    """On both sides of the bound of the ellipse, at 89 degrees."""
    camera = lens_camera(name, 90, 45)
    scene, turns, up = around(3, seed=8), np.array([0.5, 2.4, 4.4]), np.radians(latitude)
    down = [np.sin(up), -np.sin(up), np.sin(up)]
    direction = np.stack([np.cos(up) * np.sin(turns), down, np.cos(up) * np.cos(turns)], axis=1)
    apart = np.array([[2.0], [2.1], [2.2]])  # of one distance, their order would be that of rounding
    check_against_native(dataclasses.replace(scene, means=CENTRE + apart * direction @ camera.R), camera)


@pytest.mark.parametrize("W", [45, 64, 90])
@pytest.mark.parametrize("name", PANORAMAS)
def test_the_seam(name, W):
    """Gaussians behind the camera, narrow ones and one that reaches around, in images of whole tiles and of others."""
    camera, scene = lens_camera(name, W, W // 2), around(12, seed=9)
    turns = np.pi + np.linspace(-0.12, 0.12, 12)
    direction = np.stack([np.sin(turns), 0.3 * np.linspace(-1, 1, 12), np.cos(turns)], axis=1)
    moved = dataclasses.replace(scene, means=CENTRE + np.linspace(1, 2, 12)[:, None] * direction @ camera.R)
    moved.log_scales[3] = 0.6
    out = render(moved.gaussians(torch.float32), camera, settings=SETTINGS, backend="webgpu")
    weight = 1 - out.transmittance
    assert weight[:, 0].max() > 0.1 and weight[:, -1].max() > 0.1, "the edges show them"
    check_against_native(moved, camera)


def test_a_panorama_turned_by_a_tile_is_its_image_moved_by_a_tile():
    """Also across the seam. Nearer to the poles, splats reach half way round, where tiles see different copies."""
    scene, W = around(400, seed=4).gaussians(torch.float32), 96
    camera = lens_camera("panorama", W, 48)
    before = render(scene, camera, backend="webgpu").image
    for columns in (16, 48, 80):
        angle = 2 * np.pi * columns / W
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        other = render(
            scene, Camera.posed(turn @ camera.R, camera.eye, camera.intrinsics), backend="webgpu"
        ).image
        moved = torch.roll(before, columns, dims=1)
        error = (other[12:36] - moved[12:36]).abs()
        assert error.max() < 1.1 * max(1.0, float(moved.max())) / 255 and error.mean() < 1e-6


@pytest.mark.parametrize("kind", ["perspective", "fisheye"])
def test_coefficients_of_zero_have_a_gradient(kind):
    """From which a lens begins to be learned; the dense renderer's, which knows no tile stop."""
    scene = around(40, seed=3)
    scene.logits[:] -= 2.0
    camera, found = lens_camera("fisheye").through(Projection(kind)), []
    for backend, dtype in (("webgpu", torch.float32), ("torch", torch.float64)):
        zero = torch.zeros(len(STEPS), dtype=torch.float64, requires_grad=True)
        tensors = dataclasses.replace(CameraTensors.of(camera), coefficients=STEPS * zero)
        render(
            scene.gaussians(dtype), tensors, settings=SETTINGS, backend=backend
        ).image.square().sum().backward()
        found.append(zero.grad)
    assert (found[1] != 0).all()
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=BOUND * float(found[1].abs().max()))


@pytest.mark.parametrize("readout", ["down", "up", "left", "right"])
def test_every_readout(readout):
    projection = LENSES["opencv"][0]
    camera = lens_camera("opencv").through(projection, RollingShutter(MOVING.turn, MOVING.shift, readout))
    check_against_native(around(60, seed=3), camera)


def test_a_shutter_at_rest_is_none():
    """A camera that does not move during its readout, and one without a rolling shutter."""
    scene, plain = around(80, seed=2).gaussians(torch.float32), lens_camera("fisheye")
    still = plain.through(plain.projection, RollingShutter((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    one, other = (render(scene, camera, backend="webgpu").image for camera in (plain, still))
    assert (one - other).abs().max() < 1e-5


def test_what_newton_s_method_does_not_find_is_not_drawn():
    scene, camera = lost()
    ours = render(scene.gaussians(torch.float32), camera, settings=SETTINGS, backend="webgpu")
    native = render(scene.gaussians(), camera, backend="cpu")
    assert set(ours.visible.tolist()) == set(native.visible.tolist()) and LOST not in ours.visible


def test_what_moves_too_fast_for_the_shutter_is_not_drawn():
    """Along the readout at more than half of its speed, where the native kernels do not draw it either."""
    camera = lens_camera("pinhole, moving")
    fast = camera.through(Projection(), RollingShutter((0.9, 0.0, 0.0), (0.0, 2.0, 0.0)))
    scene = around(200, seed=2)
    ours = render(scene.gaussians(torch.float32), fast, backend="webgpu")
    native = render(scene.gaussians(), fast, backend="cpu")
    slow = render(scene.gaussians(), camera, backend="cpu")
    assert set(ours.visible.tolist()) == set(native.visible.tolist())
    assert len(ours.visible) < len(slow.visible)


@pytest.mark.parametrize("name", ["fisheye", "panorama", "fisheye, moving"])
def test_the_term_of_depth_has_the_native_gradients(name):
    """Value and gradients of the comparison with given depth, in all directions around the camera."""
    camera, scene, found = lens_camera(name), around(60, seed=3), []
    rng = np.random.default_rng(0)
    places, off = rng.uniform(0, (camera.W - 1, camera.H - 1), (500, 2)), rng.uniform(1.0, 4.0, 500)
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        gaussians = scene.gaussians(dtype).trainable()
        out = render(gaussians, camera, settings=RenderSettings(depth=True), backend=backend)
        given = (torch.tensor(each, dtype=dtype) for each in (places, off, np.ones(500)))
        value = depth_error(out.depth, out.alpha, *given, DepthRule(bend=3.0))
        value.backward()
        found.append(
            (
                float(value.detach()),
                {k: t.grad.double() for k, t in gaussians.tensors().items() if "sh" not in k},
            )
        )
    (ours, gradients), (native, expected) = found
    assert ours == pytest.approx(native, rel=1e-4) and native > 1e-3
    for key, truth in expected.items():
        assert truth.abs().max() > 0 and (gradients[key] - truth).abs().max() <= 3e-3 * truth.abs().max(), key


@pytest.mark.parametrize(("name", "value"), [("means", np.nan), ("means", 1e30), ("log_scales", 60.0)])
@pytest.mark.parametrize("lens", ["fisheye, moving", "panorama", "orthographic", "opencv"])
def test_one_bad_gaussian_does_not_affect_others(lens, name, value):
    good, camera = around(40, seed=3).gaussians(torch.float32), lens_camera(lens)
    bad = good.map(torch.clone)
    bad.tensors()[name][7] = value
    without = good.map(lambda t: torch.cat([t[:7], t[8:]])).trainable()
    bad = bad.trainable()
    images = [render(g, camera, settings=SETTINGS, backend="webgpu").image for g in (bad, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for key, tensor in bad.tensors().items():
        assert (tensor.grad[7] == 0).all(), key
        assert torch.equal(torch.cat([tensor.grad[:7], tensor.grad[8:]]), without.tensors()[key].grad), key


@pytest.mark.parametrize("place", ["at the centre", "at the pole"])
@pytest.mark.parametrize("lens", ["fisheye", "equidistant", "panorama", "panorama, moving"])
def test_where_a_lens_has_no_direction(lens, place):
    """The camera's centre, and straight above it: no number becomes NaN."""
    camera, scene = lens_camera(lens), around(30, seed=3)
    scene.means[4] = np.asarray(CENTRE) + (0 if place == "at the centre" else 2.0) * camera.R[1]
    values, gradients, _ = images_and_gradients(scene, camera, "webgpu")
    assert all(tensor.isfinite().all() for tensor in (*values.values(), *gradients.values()))


ANGLES = """
@group(1) @binding(0) var<storage, read> points: array<vec2<f32>>;
@group(1) @binding(1) var<storage, read_write> angles: array<f32>;

@compute @workgroup_size(64)
fn measure(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 64u + thread;
    if (i < job.count) {
        angles[i] = signed_angle(points[i].x, points[i].y);
    }
}
"""


def test_the_arc_tangent_errs_by_three_units(device, monkeypatch):
    """Around every edge between its branches, and at random."""
    rng = np.random.default_rng(0)
    turns = np.concatenate(
        [rng.uniform(-np.pi, np.pi, 60_000), np.pi / 8 * np.arange(-8, 9), [1e-8, 1e-4, 3.1415925]]
    )
    points = np.stack([np.sin(turns), np.cos(turns)], axis=1) * rng.uniform(0.01, 100, (len(turns), 1))
    points = points.astype(np.float32)
    monkeypatch.setitem(MODULES, "angles", ("job", "view", "constants", "lens"))
    source = passes.module_source
    monkeypatch.setattr(
        host, "module_source", lambda name: source(name) + (ANGLES if name == "angles" else "")
    )
    items = Size("n")
    program = Program(
        (Buffer("points", Size("n", 2)), Buffer("angles", items)),
        {"measure": (Pass("angles", "measure", ("points",), ("angles",), items, 64),)},
    )
    memory = device.allocate(program, {"n": len(points)})
    memory.write("points", points)
    found = memory.play("measure", plain_view(8, 8).packed(0), read=("angles",))["angles"].view(np.float32)
    truth = np.arctan2(*points.astype(np.float64).T)
    assert (np.abs(found[: len(points)] - truth) <= 3 * np.spacing(np.abs(truth).astype(np.float32))).all()
