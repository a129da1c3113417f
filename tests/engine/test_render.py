"""The backend webgpu: conformance, sizes and values at their bounds, memory, and commands.

parity/test_float32.py has its gradients.
"""

import dataclasses
import mmap
from pathlib import Path

import numpy as np
import pytest
import torch

import run
from float32_backends import POSE, SETTINGS, images_and_gradients
from gsplat_edu import Camera
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.engine import adapters
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import gpu_of, load_backend, resolve_backend
from native_scenes import random
from ours import Renderer

CASES = {case.name: case for case in run.load_cases() if not case.needs}
"""The cases of pinholes: the kernels know no other lens."""

pytestmark = pytest.mark.usefixtures("webgpu")


@pytest.mark.parametrize("name", CASES)
def test_the_conformance_kit_passes(name):
    renderer = Renderer("webgpu", torch.float32)
    report = run.check(renderer.render, renderer.gradients, precision="float32", cases=[CASES[name]])
    assert report.passed, str(report)
    assert not report.left_out


EXTREMES = {
    "mean": ("means", 1e30),
    "scale that overflows": ("log_scales", 88.0),
    "scale of zero": ("log_scales", -torch.inf),
    "colour": ("sh0", 1e30),
    "quaternion": ("quats", 1e30),
    "opaque": ("logit_opacities", torch.inf),
    "invisible": ("logit_opacities", -torch.inf),
    "finite but far beyond a sigmoid": ("logit_opacities", 1e30),
}


@pytest.mark.parametrize("kind", EXTREMES)
def test_huge_values_are_drawn_or_not_as_by_the_native_kernels(kind):
    name, value = EXTREMES[kind]
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        gaussians = random(20, (17, 33), seed=3).gaussians(dtype)
        gaussians.tensors()[name][7] = value
        gaussians = gaussians.trainable()
        out = render(gaussians, random(20, (17, 33)).camera, settings=SETTINGS, backend=backend)
        out.image.square().sum().backward()
        found.append((out, {key: t.grad.double() for key, t in gaussians.tensors().items()}))
    (ours, gradients), (oracle, expected) = found
    assert set(ours.visible.tolist()) == set(oracle.visible.tolist())
    truth = oracle.image.detach()
    assert (ours.image.detach().double() - truth).abs().max() < 1.1 / 255 * max(1.0, float(truth.abs().max()))
    for key, truth in expected.items():
        assert (gradients[key] - truth).abs().max() <= 3e-4 * truth.abs().max(), key


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1023, 1024, 1025, 100_000])
def test_any_number_of_gaussians(count):
    """Around the sizes of workgroups and blocks. Depths are far enough apart for float32, so the order is the same."""
    rng = np.random.default_rng(count)
    scales = rng.normal(-2.0 - 0.15 * np.log(count), 0.3, (count, 3))
    scene = random(count, (75, 50), seed=count, log_scales=scales)
    seen = (scene.means - scene.camera.eye) @ scene.camera.R.T
    seen[:, 2] = 3.0 + 2.0 * rng.permutation(count) / count
    scene = dataclasses.replace(scene, means=seen @ scene.camera.R + scene.camera.eye)
    values, gradients, out = images_and_gradients(scene, "webgpu")
    truths, expected, oracle = images_and_gradients(scene, "cpu")
    assert len(out.visible) == len(oracle.visible) > 0
    assert abs(out.num_pairs - oracle.num_pairs) <= 2 + count // 10_000
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    for key, truth in expected.items():
        parts = count if key in POSE else 1
        assert np.abs(gradients[key] - truth).max() <= parts * 3e-4 * np.abs(truth).max(), key


def test_a_camera_far_from_the_origin():
    """The eye is given as two floats: at 4096 units, float32 alone would move the image by half a pixel."""
    scene = random(30, (41, 35), seed=8)
    shift = np.array([4096.0, -2048.0, 1024.0])
    moved = dataclasses.replace(
        scene,
        means=(scene.means + shift).astype(np.float32).astype(np.float64),
        camera=Camera(
            scene.camera.R, scene.camera.eye + shift + 1e-4, fx=45.0, fy=49.0, cx=21.0, cy=16.5, H=35, W=41
        ),
    )
    values, _, _ = images_and_gradients(moved, "webgpu")
    truths, _, _ = images_and_gradients(moved, "cpu")
    assert (
        np.abs(values["image"] - truths["image"]).max() < 1.1 * max(1.0, np.abs(truths["image"]).max()) / 255
    )
    assert np.abs(values["image"] - truths["image"]).mean() < 1e-6


def test_two_backward_passes_add_up():
    gaussians = random(20, (17, 33), seed=5).gaussians(torch.float32).trainable()
    out = render(gaussians, random(20, (17, 33)).camera, backend="webgpu")
    loss = out.image.square().sum()
    loss.backward(retain_graph=True)
    once, norms = gaussians.means.grad.clone(), out.means2d_grad_norms()
    loss.backward()
    assert torch.equal(gaussians.means.grad, 2 * once) and torch.equal(out.means2d_grad_norms(), 2 * norms)


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="this system does not report resident memory"
)
def test_memory_does_not_grow():
    """Mesa's lavapipe kept 1.2 MB of each render when uniforms alone bounded the shaders' loops."""
    gaussians, camera = (
        random(500, (64, 48), seed=1).gaussians(torch.float32).trainable(),
        random(1, (64, 48)).camera,
    )

    def resident_after(renders):
        for _ in range(renders):
            render(gaussians, camera, backend="webgpu").image.sum().backward()
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    before = resident_after(20)
    assert resident_after(80) - before < 16 << 20


def test_what_it_lacks_is_refused():
    camera = random(3, (8, 8)).camera
    with pytest.raises(
        ArgumentError, match=r"^means: are torch.float64 on cpu, but the backend webgpu needs float32"
    ):
        render(random(3, (8, 8)).gaussians(), camera, backend="webgpu")
    assert load_backend("webgpu").lacks == {"processes"}


def test_auto_never_renders_with_it():
    assert resolve_backend("auto") in ("cpu", "cuda")


def test_the_command_line_renders_with_it(tmp_path):
    save_ply(tmp_path / "a.ply", random(5, (8, 8)).gaussians(torch.float32))
    command = ["render", str(tmp_path / "a.ply"), "--frames", "1", "--size", "20", "--backend", "webgpu"]
    assert main([*command, "--out", str(tmp_path / "frames")]) == 0
    assert len(list((tmp_path / "frames").iterdir())) == 1


def test_what_needs_a_forecast_is_refused(tmp_path, capsys):
    backend = "torch"
    write_colmap(tmp_path / "egg", *procedural_capture(24, 6))
    capture = str(tmp_path / "egg")
    assert main(["doctor", capture, "--backend", backend]) == 2
    line = f"gsplat-edu doctor: --backend {backend}: has no forecast; choose cpu, cuda or webgpu, or add --no-forecast"
    assert capsys.readouterr().err.splitlines()[-1] == line
    run = ["--out", str(tmp_path / "run"), "--backend", backend, "--iterations", "5"]
    assert main(["train", capture, *run, "--max-memory", "4GiB"]) == 2
    line = f"--max-memory 4 GiB: cannot be planned for --backend {backend}; choose cpu, cuda or webgpu"
    assert line in capsys.readouterr().err.splitlines()[-1]


def test_doctor_and_demo_name_the_gpu(tmp_path, capsys):
    write_colmap(tmp_path / "egg", *procedural_capture(24, 6))
    assert main(["doctor", str(tmp_path / "egg"), "--backend", "webgpu", "--no-forecast"]) == 0
    assert f"GPU        {gpu_of('webgpu')} (backend webgpu)" in capsys.readouterr().out.splitlines()
    demo = ["demo", "--backend", "webgpu", "--iters", "2", "--size", "16", "--out", str(tmp_path / "a.png")]
    assert main(demo) == 0
    assert f"rendered by webgpu on {gpu_of('webgpu')}" in capsys.readouterr().out.splitlines()


def test_without_an_adapter_the_command_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(adapters, "listed_adapters", lambda: ())
    save_ply(tmp_path / "a.ply", random(5, (8, 8)).gaussians(torch.float32))
    command = [
        "render",
        str(tmp_path / "a.ply"),
        "--frames",
        "1",
        "--backend",
        "webgpu",
        "--out",
        str(tmp_path / "b"),
    ]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gsplat-edu render: backend 'webgpu': wgpu finds no adapter")
    with pytest.raises(BackendUnavailableError):
        resolve_backend("webgpu")
