"""What only the engine does with lenses: its stop per pixel, statistics, the term of depth, and its arc tangent."""

import dataclasses

import numpy as np
import pytest
import torch

from engine.frames import plain_view
from gsplat_edu.engine import host, passes
from gsplat_edu.engine.passes import LIMITS, MODULES, Buffer, Pass, Program, Size
from gsplat_edu.ops.depth import DepthRule, depth_error
from gsplat_edu.render.api import render
from gsplat_edu.render.output import COLLECTED
from gsplat_edu.render.settings import RenderSettings
from lens_gradients import BOUND, SETTINGS, check_against_native, images_and_gradients
from lens_scenes import around, lens_camera

pytestmark = pytest.mark.usefixtures("webgpu")


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


@pytest.mark.usefixtures("device")
def test_the_arc_tangent_errs_by_three_units(monkeypatch):
    """Around every edge between its branches, and at random."""
    rng = np.random.default_rng(0)
    turns = np.concatenate(
        [rng.uniform(-np.pi, np.pi, 60_000), np.pi / 8 * np.arange(-8, 9), [1e-8, 1e-4, 3.1415925]]
    )
    points = np.stack([np.sin(turns), np.cos(turns)], axis=1) * rng.uniform(0.01, 100, (len(turns), 1))
    points = points.astype(np.float32)
    monkeypatch.setitem(MODULES, "angles", ("job", "view", "constants", "lens"))
    device = host.Device(
        limits=LIMITS,
        source=lambda name: passes.module_source(name) + (ANGLES if name == "angles" else ""),
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
