"""The kernels do not crash, hang or leak, and a bad Gaussian does not affect the others."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.utils.checkpoint

from gsplat_edu import ArgumentError, Camera, _native, orbit_camera
from gsplat_edu.base.headroom import available_memory
from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from native_scenes import camera, random

POISONS = (float("nan"), float("inf"), -float("inf"), 1e-42, 3e38, -3e38, 1e20, -1e20, 0.0)


def run_python(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run code in a new Python process, with additions to the environment."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)


def poisoned(gaussians: Gaussians, victims: torch.Tensor, rng: np.random.Generator) -> Gaussians:
    """Replace a random number of every victim by a bad value."""
    changed = gaussians.map(torch.clone)
    names = list(changed.tensors())
    for victim in victims.tolist():
        numbers = changed.tensors()[names[rng.integers(len(names))]][victim].view(-1)
        numbers[rng.integers(len(numbers))] = POISONS[rng.integers(len(POISONS))]
    return changed


@pytest.mark.parametrize("block", range(8))
def test_bad_parameters_do_not_affect_other_gaussians(block):
    """25 seeds per block, 200 in all. If no victim is drawn, image and gradients equal those without the victims.

    A victim whose numbers remain valid (a scale of 0, an opacity of 1) is still drawn. Then the image and the others'
    gradients must stay finite.
    """
    for seed in range(25 * block, 25 * block + 25):
        rng = np.random.default_rng(seed)
        scene = random(40, seed=seed)
        victims = torch.tensor(rng.choice(40, 5, replace=False))
        changed = poisoned(scene.gaussians(torch.float32), victims, rng).trainable()
        out = render(changed, scene.camera, backend="cpu")
        assert torch.isfinite(out.transmittance).all(), seed
        weights = torch.tensor(rng.normal(size=out.image.shape), dtype=torch.float32)
        ((out.image * weights).sum() + out.depth.sum()).backward()
        others = torch.ones(40, dtype=torch.bool)
        others[victims] = False
        assert torch.isfinite(out.image).all() and torch.isfinite(out.depth).all(), seed
        for name, tensor in changed.tensors().items():
            assert torch.isfinite(tensor.grad[others]).all(), (seed, name)
        if not set(out.visible.tolist()) & set(victims.tolist()):
            clean = scene.gaussians(torch.float32).map(lambda t, others=others: t[others].clone()).trainable()
            expected = render(clean, scene.camera, backend="cpu")
            assert torch.equal(out.image, expected.image), seed
            ((expected.image * weights).sum() + expected.depth.sum()).backward()
            for name, tensor in changed.tensors().items():
                assert torch.equal(tensor.grad[others], clean.tensors()[name].grad), (seed, name)


def test_non_finite_gaussians_are_not_drawn_and_get_zero_gradients():
    scene = random(10)
    gaussians = scene.gaussians()
    gaussians.quats[3] = 0.0
    gaussians.means[5, 1] = float("nan")
    gaussians.sh_rest[7, 2, 1] = float("inf")
    gaussians = gaussians.trainable()
    out = render(gaussians, scene.camera, backend="cpu")
    assert not {3, 5, 7} & set(out.visible.tolist())
    out.image.sum().backward()
    for name, tensor in gaussians.tensors().items():
        assert (tensor.grad[[3, 5, 7]] == 0).all(), name


def test_a_mean_near_the_float_maximum_does_not_reach_the_depth():
    scene = random(10)
    gaussians = scene.gaussians(torch.float32)
    R = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
    gaussians.means[4] = 3e38
    out = render(gaussians, Camera(R, (-2.0, -2.0, -2.0), 30, 30, 15, 15, 30, 30), backend="cpu")
    assert torch.isfinite(out.depth).all() and 4 not in out.visible.tolist()


def test_transmittance_of_thin_distant_splats_stays_in_range(isa):
    """Cancellation may make the exponent positive, but alpha does not exceed the opacity."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        direction = rng.normal(size=3)
        means = torch.tensor(
            500.0 * direction / np.linalg.norm(direction) + (0, 0, 5.0), dtype=torch.float32
        )[None]
        means[:, 2] = means[:, 2].abs() + 1
        one = Gaussians(
            means=means,
            quats=torch.tensor(rng.normal(size=(1, 4)), dtype=torch.float32),
            log_scales=torch.tensor([[np.log(1000.0), -6.0, -6.0]], dtype=torch.float32),
            sh0=torch.ones(1, 1, 3),
            sh_rest=torch.zeros(1, 0, 3),
            logit_opacities=torch.tensor([1.0]),
        ).trainable()
        out = render(one, Camera(np.eye(3), (0, 0, 0), 100, 100, 50, 50, 100, 100), backend="cpu")
        lowest = 1 - torch.sigmoid(torch.tensor(1.0))
        assert out.transmittance.min() >= lowest - 1e-6 and out.transmittance.max() <= 1
        out.image.sum().backward()
        assert all(torch.isfinite(t.grad).all() for t in one.tensors().values())


def test_backward_reads_tensors_recreated_by_checkpointing():
    """Checkpointing frees the tensors of the forward pass and recreates them elsewhere."""
    scene = random(60)
    found = []
    for wrap in (False, True):
        gaussians = scene.gaussians(torch.float32).trainable()

        def image(means, gaussians=gaussians):
            moved = dataclasses.replace(gaussians, means=means * 1.0)
            return render(moved, scene.camera, backend="cpu").image

        if wrap:
            result = torch.utils.checkpoint.checkpoint(image, gaussians.means, use_reentrant=False)
        else:
            result = image(gaussians.means)
        torch.rand(200_000)  # reuses freed memory
        result.square().sum().backward()
        found.append({name: t.grad for name, t in gaussians.tensors().items()})
    for name, gradient in found[0].items():
        assert torch.equal(gradient, found[1][name]), name


def test_a_second_backward_accumulates_gradient_norms():
    scene = random(20)
    out = render(scene.gaussians().trainable(), scene.camera, backend="cpu")
    out.image.sum().backward(retain_graph=True)
    once = out.means2d_grad_norms().clone()
    out.image.sum().backward()
    torch.testing.assert_close(out.means2d_grad_norms(), 2 * once)


@pytest.mark.parametrize("case", ["none", "all culled"])
def test_an_empty_view_shows_the_background(case):
    scene = random(0 if case == "none" else 20)
    gaussians = scene.gaussians(torch.float32)
    gaussians.means[:, 2] -= 100.0
    gaussians = gaussians.trainable()
    settings = RenderSettings(background=(0.1, 0.2, 0.3))
    out = render(gaussians, scene.camera, settings=settings, backend="cpu")
    torch.testing.assert_close(out.image, torch.tensor([0.1, 0.2, 0.3]).expand_as(out.image))
    assert (out.transmittance == 1).all() and (out.depth == 0).all()
    assert out.num_pairs == 0 and len(out.visible) == 0
    out.image.sum().backward()
    assert all((tensor.grad == 0).all() for tensor in gaussians.tensors().values())
    assert out.means2d_grad_norms().shape == (0,)


def test_backward_from_a_single_output():
    scene = random(20)
    full, part = (scene.gaussians().trainable() for _ in range(2))
    render(full, scene.camera, backend="cpu").depth.sum().backward()
    out = render(part, scene.camera, backend="cpu")
    out.transmittance.sum().backward()
    assert (part.sh0.grad == 0).all() and part.logit_opacities.grad.abs().max() > 0
    assert full.means.grad.abs().max() > 0 and (full.sh_rest.grad == 0).all()


def test_parameters_need_not_be_contiguous():
    scene = random(20)
    plain = scene.gaussians()
    strided = plain.map(lambda t: torch.stack([t, t], dim=-1)[..., 0])
    assert not strided.means.is_contiguous()
    assert torch.equal(*(render(g, scene.camera, backend="cpu").image for g in (plain, strided)))


def test_other_dtypes_are_refused():
    with pytest.raises(ArgumentError, match=r"^means: is float16, .*; use means.float\(\)$"):
        render(random(3).gaussians(torch.float16), camera(9, 9), backend="cpu")
    zeros, ball, view = torch.zeros(1, 3), torch.eye(3)[None], camera(9, 9)
    with pytest.raises(ArgumentError, match="all float32 or all float64"):
        render_covariances(zeros, ball, zeros.double(), torch.zeros(1), view)
    with pytest.raises(ArgumentError, match="^cov3ds: are torch.float32"):
        render_covariances(zeros.double(), ball, zeros.double(), torch.zeros(1).double(), view)


def test_float64_covariances_keep_the_digits_of_needles():
    """A needle of 1,000 x 0.2 px lies at 45 degrees, so a determinant in float32 would keep at most one digit."""
    half = math.sqrt(0.5)
    axes = torch.tensor([[half, -half, 0.0], [half, half, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    axes = axes * torch.tensor([1000.0, 0.2, 0.0], dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        given = (torch.tensor([[4.125, 4.0, 1.0]]), torch.ones(1, 3), torch.full((1,), 0.9))
        means, colors, opacities = (t.to(dtype) for t in given)
        view = Camera(np.eye(3), np.zeros(3), 1.0, 1.0, 0.0, 0.0, 9, 9)
        settings = RenderSettings(dilation=0.0)
        covs = (axes @ axes.mT)[None].requires_grad_()
        out = render_covariances(means, covs, colors, opacities, view, settings)
        out.image.sum().backward()
        found.append((out.image.detach().double(), covs.grad))
    # alpha <= 1 and |d log alpha| is below 20 roundings of eps = 6e-8
    assert float((found[0][0] - found[1][0]).abs().max()) < 20 * 6e-8
    assert float(found[1][0][0, 0].max()) > 0.01 and float(found[1][0][0, 8].max()) == 0.0
    assert float((found[0][1] - found[1][1]).abs().max()) < 1e-4 * float(found[1][1].abs().max())


def test_several_cameras_give_stacked_views():
    scene = random(30)
    cameras = [camera(41, 35), Camera.looking_at((2, 0, -2), (0, 0, 0), 40, 40, 35, 41)]
    gaussians = scene.gaussians().trainable()
    stack = render(gaussians, cameras, backend="cpu")
    assert stack.image.shape == (2, 35, 41, 3) and stack.depth.shape == stack.transmittance.shape == (
        2,
        35,
        41,
    )
    for i, one in enumerate(cameras):
        assert torch.equal(stack.image[i], render(gaussians, one, backend="cpu").image)
    stack.image.sum().backward()
    assert [view.means2d_grad_norms().shape == view.visible.shape for view in stack.views] == [True, True]
    with pytest.raises(ArgumentError, match="sizes"):
        render(gaussians, [camera(8, 8), camera(9, 8)], backend="cpu")


@pytest.mark.slow
@pytest.mark.own_process
def test_memory_does_not_grow():
    """Render scenes of changing size in a new process: after 100 warm-up renders, 300 more may not add 16 MiB.

    The warm-up begins with the largest scene, which needs about 30 MiB. Leaking a buffer per render would take
    gigabytes.
    """
    code = """
import resource, numpy as np, torch
from native_scenes import random, camera
from gsplat_edu.render.api import render
rng = np.random.default_rng(0)
scenes = [random(n).gaussians(torch.float32) for n in (50, 500, 5000, 20000)]
def rss():
    return int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize() / 2**20
def turn(scene=None, size=None):
    g = scenes[rng.integers(4) if scene is None else scene].trainable()
    size = rng.integers(1, 400, 2) if size is None else size
    render(g, camera(int(size[0]), int(size[1])), backend='cpu').image.sum().backward()
for _ in range(5):
    turn(3, (399, 399))
for _ in range(95):
    turn()
before = rss()
for _ in range(300):
    turn()
print(rss() - before)
"""
    done = run_python(code, PYTHONPATH=str(Path(__file__).parents[1]))
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 16.0


@pytest.mark.own_process
@pytest.mark.parametrize("name", _native.isas())
def test_the_environment_forces_an_instruction_set(name):
    done = run_python("from gsplat_edu import _native; print(_native.isa())", GSPLAT_EDU_ISA=name)
    assert done.stdout.strip() == name


@pytest.mark.own_process
def test_an_unavailable_instruction_set_is_reported_and_the_dense_backend_trains(tmp_path):
    """In one process, because an import takes seconds; photos of 16 px are those of other tests."""
    both = """
import sys
import photos
from gsplat_edu.cli.main import main
photos.keep()
refused = main(["demo", "--backend", "cpu"])
sys.exit(10 * refused + main(["demo", "--backend", "torch", *sys.argv[1:]]))
"""
    budget = ["--iters", "2", "--size", "16", "--k0", "5", "--out", str(tmp_path / "x.png")]
    done = run_python(both, *budget, GSPLAT_EDU_ISA="v9", PYTHONPATH=str(Path(__file__).parents[1]))
    assert done.returncode == 20, done.stderr
    assert done.stderr.count("\n") == 1 and "GSPLAT_EDU_ISA=v9" in done.stderr and "v2" in done.stderr


def test_an_exception_from_the_memory_check_ends_the_render():
    """9,000 splats in 64 x 64 tiles need 295 MB for pairs, and the kernels call Python before any block of 256 MiB.
    Ctrl-C raises KeyboardInterrupt in the Python code that is running, so it has to end the render. After a
    MemoryError or an ImportError, the available memory is unknown, and rendering continues.
    """
    count = 9_000
    screens = Gaussians(
        means=torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * 0.1,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), 3.0),
        sh0=torch.zeros(count, 1, 3),
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.zeros(count),
    )
    view, asked = orbit_camera(0.0, 0.0, 1024, 1000.0), []

    def failing(error):
        def ask():
            asked.append(error)
            raise error

        return ask

    try:
        for error in (KeyboardInterrupt("stop"), ZeroDivisionError("a bug in the check")):
            _native.ask_before_large_blocks(failing(error))
            with pytest.raises(type(error), match=str(error)):
                render(screens, view, backend="cpu")
        for error in (MemoryError(), ImportError("the interpreter ends")):
            _native.ask_before_large_blocks(failing(error))
            assert torch.isfinite(render(screens, view, backend="cpu").image).all()
    finally:
        _native.ask_before_large_blocks(available_memory)
    assert [type(error) for error in asked[:3]] == [KeyboardInterrupt, ZeroDivisionError, MemoryError]


@pytest.mark.parametrize("threads", [1, 2])
def test_denormal_numbers_are_zero_in_the_kernels_and_nowhere_else(threads):
    """The square of 1e-20 is denormal in float32. The Gaussians are so many that both threads work."""
    count = 1 << 17
    parameter, first, second = torch.zeros(3, count)
    numbers = {
        "rate": 0.1,
        "beta1": 0.9,
        "beta2": 0.999,
        "eps": 1e-15,
        "correction1": 0.1,
        "correction2": 0.001,
    }
    tiny = torch.full((count,), 1e-20)
    _native.adam_f32(
        parameter=parameter, first=first, second=second, gradient=tiny, **numbers, threads=threads
    )
    assert bool((first > 0).all()) and not second.any()
    assert np.float32(1e-30) * np.float32(1e-12) > 0 and bool((torch.full((1,), 1e-30) * 1e-12 > 0).all())


def test_the_processor_time_of_stages_contains_that_of_their_tasks(set_threads):
    """One thread and two threads make equally many calls of `parallel`."""
    scene, calls = random(3000), []
    for threads in (1, 2):
        set_threads(threads)
        seconds, before = _native.parallel_time()
        out = render(scene.gaussians(torch.float32).trainable(), scene.camera, backend="cpu")
        frame = out.image.grad_fn.frame
        out.image.sum().backward()
        after, count = _native.parallel_time()
        calls.append(count - before)
        for whole, tasks in zip(frame.processor_seconds, frame.parallel_seconds, strict=True):
            assert 0 < tasks <= whole
        assert sum(frame.parallel_seconds) <= after - seconds + 1e-9
    assert calls[0] == calls[1] > 10
