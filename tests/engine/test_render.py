"""The backend webgpu: gradients of everything that a render is differentiable in, against native ones in float64.

Bounds are those of the other float32 kernels (tests/native, tests/gpu): 3e-4 of the largest entry of a gradient, or
4e-3 for ill-conditioned conics. They allow for the cancellation in sums of moments; PRECISION.md has what is
measured.
"""

import dataclasses
import mmap
from pathlib import Path

import numpy as np
import pytest
import torch

import run
from float32_backends import ILL_CONDITIONED, POISON, POSE, SETTINGS, SMALLER, images_and_gradients
from gsplat_edu import Camera
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.engine import adapters
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import gpu_of, load_backend, resolve_backend
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, random
from ours import Renderer

CASES = {case.name: case for case in run.load_cases() if not case.needs}
"""The cases of pinholes: the kernels know no other lens."""

pytestmark = pytest.mark.usefixtures("webgpu")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", SMALLER)
def test_gradients_match_the_native_kernels_in_float64(name, antialiased):
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased, jacobian_limit=1.3)
    values, gradients, out = images_and_gradients(SMALLER[name], "webgpu", settings=settings)
    truths, expected, oracle = images_and_gradients(SMALLER[name], "cpu", settings=settings)
    assert abs(out.num_pairs - oracle.num_pairs) <= 2 and len(out.visible) == len(oracle.visible)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    bound = 4e-3 if name in ILL_CONDITIONED else 3e-4
    for key, truth in expected.items():
        parts = len(SMALLER[name].means) if key in POSE else 1  # the camera's is a sum over all Gaussians
        assert np.abs(gradients[key] - truth).max() <= parts * bound * np.abs(truth).max(), key


@pytest.mark.parametrize("name", CASES)
def test_the_conformance_kit_passes(name):
    renderer = Renderer("webgpu", torch.float32)
    report = run.check(renderer.render, renderer.gradients, precision="float32", cases=[CASES[name]])
    assert report.passed, str(report)
    assert not report.left_out


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_sh_degrees(degree):
    settings = dataclasses.replace(SETTINGS, sh_degree=degree)
    _, gradients, _ = images_and_gradients(SMALLER["random"], "webgpu", settings=settings)
    _, expected, _ = images_and_gradients(SMALLER["random"], "cpu", settings=settings)
    for key, truth in expected.items():
        assert np.abs(gradients[key] - truth).max() <= 3e-4 * np.abs(truth).max(), key


@pytest.mark.parametrize("rest", [0, 3, 8])
def test_gaussians_that_store_fewer_harmonics(rest):
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        whole = random(20, (17, 33), seed=4).gaussians(dtype)
        gaussians = dataclasses.replace(whole, sh_rest=whole.sh_rest[:, :rest]).trainable()
        image = render(gaussians, random(20, (17, 33)).camera, settings=SETTINGS, backend=backend).image
        image.square().sum().backward()
        found.append([image.detach().double(), *(t.grad.double() for t in gaussians.tensors().values())])
    for ours, truth in zip(*found, strict=True):
        assert ours.shape == truth.shape
        assert not truth.numel() or (ours - truth).abs().max() <= 3e-4 * truth.abs().max()


@pytest.mark.parametrize("dilation", [0.0, 0.1, 1.0])
def test_dilations(dilation):
    """Gaussians of a few pixels, which float32 resolves, and a line, which is not drawn without dilation."""
    scene = random(20, (17, 33), seed=3)
    scene.log_scales[7] = (-1.0, -60.0, -60.0)
    settings = dataclasses.replace(SETTINGS, dilation=dilation)
    values, gradients, out = images_and_gradients(scene, "webgpu", settings=settings)
    truths, expected, oracle = images_and_gradients(scene, "cpu", settings=settings)
    assert set(out.visible.tolist()) == set(oracle.visible.tolist())
    assert (7 in out.visible) == (dilation > 0)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    for key, truth in expected.items():
        parts = 20 if key in POSE else 1
        assert np.abs(gradients[key] - truth).max() <= parts * 4e-3 * np.abs(truth).max(), key


@pytest.mark.parametrize("channels", [1, 4, 7])
def test_features_and_median_depth(channels):
    """The median depth may differ where the transmittance is within float32 rounding of one half."""
    scene = random(24, (20, 17), seed=channels)
    settings = RenderSettings(median_depth=True, alpha_max=0.97, z_near=0.2)
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        gaussians = scene.gaussians(dtype).trainable()
        generator = torch.Generator().manual_seed(channels)
        features = (
            torch.randn(24, channels, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
        )
        out = render(gaussians, scene.camera, settings=settings, features=features, backend=backend)
        draw = torch.randn(out.features.shape, generator=generator, dtype=torch.float64).to(dtype)
        ((out.features * draw).sum() + out.image.sum() + out.mean_depth.sum()).backward()
        values = {"features": out.features, "image": out.image, "median": out.median_depth}
        gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()} | {
            "of features": features.grad
        }
        found.append([{k: t.detach().double() for k, t in d.items()} for d in (values, gradients)])
    (values, gradients), (truths, expected) = found
    for key in ("features", "image"):
        assert (values[key] - truths[key]).abs().max() < 1.1 * max(1.0, truths[key].abs().max()) / 255
        assert (values[key] - truths[key]).abs().median() < 1e-5
    assert ((values["median"] - truths["median"]).abs() > 1e-5).sum() <= 2 and truths["median"].max() > 2
    for key, truth in expected.items():
        assert (gradients[key] - truth).abs().max() <= 3e-4 * truth.abs().max(), key


def test_two_runs_give_the_same_bits():
    scene = SMALLER["opaque, tiles stop"]
    first, second = (images_and_gradients(scene, "webgpu")[:2] for _ in range(2))
    for ours, other in zip(first, second, strict=True):
        for key, array in ours.items():
            np.testing.assert_array_equal(array, other[key], err_msg=key)


@pytest.mark.parametrize(("name", "value"), POISON)
def test_one_bad_gaussian_does_not_affect_others(name, value):
    scene = random(20, (17, 33), seed=3)
    good = scene.gaussians(torch.float32)
    bad = good.map(torch.clone)
    bad.tensors()[name][7] = value
    without = good.map(lambda t: torch.cat([t[:7], t[8:]])).trainable()
    bad = bad.trainable()
    images = [render(g, scene.camera, settings=SETTINGS, backend="webgpu").image for g in (bad, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for key, tensor in bad.tensors().items():
        assert (tensor.grad[7] == 0).all(), key
        assert torch.equal(torch.cat([tensor.grad[:7], tensor.grad[8:]]), without.tensors()[key].grad), key


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


@pytest.mark.parametrize("kind", ["empty", "behind", "faint", "one"])
def test_almost_empty_scenes(kind):
    scene = random(0 if kind == "empty" else 1 if kind == "one" else 9, (17, 33), seed=2)
    gaussians = scene.gaussians(torch.float32)
    if kind == "behind":
        gaussians.means[:, 2] -= 100.0
    if kind == "faint":
        gaussians.logit_opacities[:] = -9.0
    gaussians = gaussians.trainable()
    out = render(gaussians, scene.camera, settings=SETTINGS, backend="webgpu")
    out.image.sum().backward()
    assert (out.num_pairs > 0) == (kind == "one") == bool(len(out.visible))
    if kind != "one":
        torch.testing.assert_close(out.image.detach(), torch.tensor(BACKGROUND).expand(33, 17, 3))
        assert all((t.grad == 0).all() for t in gaussians.tensors().values())


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_quaternion_of_a_round_gaussian_has_no_gradient(antialiased):
    """Exactly, since Adam turns rounding errors into whole steps; points become round Gaussians."""
    scene = random(30, (41, 35), seed=12, log_scales=np.repeat(np.linspace(-3, -1, 30), 3).reshape(30, 3))
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased)
    _, gradients, _ = images_and_gradients(scene, "webgpu", settings=settings)
    assert np.all(gradients["quats"] == 0) and np.all(gradients["log_scales"] != 0)


def test_a_mean_far_outside_the_image():
    """A wide Gaussian with its mean 400 px outside the image: moments are shifted far without losing digits."""
    far = random(4, (41, 35), seed=6).gaussians(torch.float64)
    far.means[0, 0] += 25.0
    far.log_scales[0] = 2.2
    found = []
    for backend, dtype in (("webgpu", torch.float32), ("cpu", torch.float64)):
        moved = far.map(lambda t, dtype=dtype: t.to(dtype)).trainable()
        render(
            moved, random(4, (41, 35)).camera, settings=SETTINGS, backend=backend
        ).image.square().sum().backward()
        found.append({key: tensor.grad.double() for key, tensor in moved.tensors().items()})
    assert float(found[1]["means"][0].abs().max()) > 0
    for key, truth in found[1].items():
        assert float((found[0][key] - truth).abs().max()) <= 3e-4 * float(truth.abs().max()), key


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
