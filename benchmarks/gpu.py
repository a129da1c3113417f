"""How long does each stage of a training iteration take on a GPU, and how close is it to the hardware's limits?

    python benchmarks/gpu.py [CAPTURE] [--minutes M] [--smoke] [--out FILE.json]

Backend cuda: random scenes of 0.1, 1 and 3 million Gaussians at 1297x840 and 1920x1080: render, 0.8 L1 + 0.2 (1 -
SSIM), backward, Adam. Milliseconds per stage are kernel times from torch's profiler over 20 iterations; host
synchronisations are counted too. Ceilings (copying 1 GiB, a float32 matrix product) are measured in the same run. The
benchmark then measures the time and the gradient error, relative to the native kernels in float64, for each precision
of matrix products. If gsplat can be imported, it renders the same scene and compares times, images and gradients.

Backend webgpu: the same scenes, and a training step as it stays on the device: its stages by the device's own clock,
the host's time to record and submit it, passes, and bytes between host and device; beside them what the model
(gsplat_edu.engine.model) computes from the scene's counters. The gradient error in the same way.

First, each backend trains a capture with adc for 7,000 iterations. What does not begin within --minutes is left out.

Each backend is measured where it has a GPU. Without one the command says so and exits with 2; --smoke takes an adapter
that computes on the processor.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import hardware
import numpy as np
import torch
from captures import capture

import gsplat_edu.cli.main as command_line
from gsplat_edu import Camera
from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine.adapters import chosen_adapter
from gsplat_edu.engine.frame import Scene as EngineScene
from gsplat_edu.engine.host import Device
from gsplat_edu.engine.measure import as_table, measure_step
from gsplat_edu.engine.view import DeviceView
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import gpu_of, load_backend, unavailable
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.schedule import gaussian_groups


class Scale(NamedTuple):
    """Sizes of the measurements."""

    counts: tuple[int, ...]  # Gaussians
    sizes: tuple[tuple[int, int], ...]  # px
    rounds: int
    copied: int  # floats
    product: int  # rows and columns of the matrices
    few: int  # Gaussians whose gradients are compared with float64
    many: int  # Gaussians for the timings by precision and against gsplat


FULL = Scale((100_000, 1_000_000, 3_000_000), ((1297, 840), (1920, 1080)), 20, 2**28, 8192, 50_000, 1_000_000)
SMOKE = Scale((500,), ((64, 48),), 2, 2**16, 64, 200, 500)
FLOATS = 59
"""Floats per Gaussian of SH degree 3."""

SETTINGS = RenderSettings(depth=False, jacobian_limit=1.3)
STAGES = {
    "project_backward": "reduce and project_backward",
    "project_kernel": "project",
    "composite_backward": "composite_backward",
    "composite_kernel": "composite",
    "count_kernel": "intersect",
    "emit_kernel": "intersect",
    "sort": "sort",
    "Sort": "sort",
    "moments": "loss",
    "add_kernel": "loss",
    "similarity": "loss",
    "maps": "loss",
    "gradient_kernel": "loss",
    "adam": "Adam",
}
"""Stage by substring of the kernel's name; the first match wins."""


def scene(count: int, device: str, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Fill a box in front of the camera with Gaussians of about two pixels."""
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.0, 2.6, 2.0]) - torch.tensor(
        [2.0, 1.3, 1.0]
    )
    parts = {
        "means": means,
        "quats": draw(count, 4),
        "log_scales": 0.3 * draw(count, 3) - 5.5,
        "sh0": draw(count, 1, 3),
        "sh_rest": 0.1 * draw(count, 15, 3),
        "logit_opacities": 1.5 * draw(count),
    }
    return Gaussians(**{name: tensor.to(device, dtype) for name, tensor in parts.items()}).trainable()


def camera(width: int, height: int) -> Camera:
    """Return a camera that looks at the box."""
    return Camera.looking_at((0, 0, -3.0), (0, 0, 0), 0.9 * width, 0.9 * width, height, width)


def milliseconds(work: Callable[[], object], rounds: int) -> float:
    """Return milliseconds per round of work on the GPU, after three warm-up rounds."""
    for _ in range(3):
        work()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(rounds):
        work()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start) / rounds


def iteration(gaussians: Gaussians, cam: Camera, photo: torch.Tensor, optimizer: Adam) -> None:
    """Run one training step."""
    backend = load_backend("cuda")
    output = render(gaussians, cam, settings=SETTINGS, backend=backend)
    photo_loss(output.image, photo, kernel=backend.loss).backward()
    optimizer.step(gaussians.tensors())


def stages(count: int, width: int, height: int, rounds: int) -> dict[str, float]:
    """Return milliseconds per iteration (total and by stage), synchronisations per iteration and peak memory."""
    gaussians, cam = scene(count, "cuda"), camera(width, height)
    photo = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8, device="cuda")
    config = TrainConfig()
    optimizer = Adam(gaussians.tensors(), gaussian_groups(config, 1.0), load_backend("cuda").adam)
    torch.cuda.reset_peak_memory_stats()
    found = {"iteration": milliseconds(lambda: iteration(gaussians, cam, photo, optimizer), rounds)}
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(rounds):
            iteration(gaussians, cam, photo, optimizer)
        torch.cuda.synchronize()
    for event in profile.key_averages():  # count kernels only; operators repeat the time of their kernels
        spent = event.self_device_time_total if event.device_type == torch.autograd.DeviceType.CUDA else 0.0
        if spent:
            stage = next((s for part, s in STAGES.items() if part in event.key), "torch around them")
            found[stage] = found.get(stage, 0.0) + spent / 1e3 / rounds
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as waits:
        warnings.simplefilter("always")
        for _ in range(rounds):
            iteration(gaussians, cam, photo, optimizer)
    torch.cuda.set_sync_debug_mode("default")
    found["waits"] = len(waits) / rounds
    found["peak GiB"] = torch.cuda.max_memory_allocated() / 2**30
    with torch.no_grad():
        pairs = render(gaussians, cam, settings=SETTINGS, backend="cuda").num_pairs or 0
    return found | achieved(found, count, pairs)


def achieved(found: dict[str, float], count: int, pairs: int) -> dict[str, float]:
    """Return bandwidths and FLOP rates of stages, for comparison with the ceilings.

    Bytes are the least traffic possible; Adam reads four numbers and writes three per parameter. Operations are
    counted in the kernels' source, about 25 per pixel and pair forward and 45 backward; an exponential counts as one.
    """
    pixels = 256 * pairs
    return {
        "Adam GB/s": 7 * 4 * FLOATS * count / found["Adam"] / 1e6,
        "project GB/s": (4 * FLOATS + 64) * count / found["project"] / 1e6,
        "composite TFLOP/s": 25 * pixels / found["composite"] / 1e9,
        "composite_backward TFLOP/s": 45 * pixels / found["composite_backward"] / 1e9,
    }


def ceilings(scale: Scale) -> dict[str, float]:
    """Measure the hardware's limits: copy bandwidth and float32 matrix products."""
    block = torch.empty(scale.copied, device="cuda")
    square = torch.randn(scale.product, scale.product, device="cuda")
    torch.backends.cuda.matmul.allow_tf32 = False
    copy, product = milliseconds(block.clone, scale.rounds), milliseconds(lambda: square @ square, 5)
    operations = 2 * scale.product**3
    return {"copy GB/s": 2 * block.nbytes / copy / 1e6, "float32 TFLOP/s": operations / product / 1e9}


def gradient_error(backend: str, count: int) -> float:
    """Return the largest gradient error relative to the largest gradient of the native kernels in float64."""
    cam = camera(640, 420)

    def gradients(name: str, dtype: torch.dtype) -> dict[str, torch.Tensor]:
        gaussians = scene(count, "cuda" if name == "cuda" else "cpu", dtype)
        render(gaussians, cam, settings=SETTINGS, backend=name).image.square().sum().backward()
        return {key: tensor.grad.double().cpu() for key, tensor in gaussians.tensors().items()}

    truth, ours = gradients("cpu", torch.float64), gradients(backend, torch.float32)
    return max(float((ours[key] - t).abs().max() / t.abs().max()) for key, t in truth.items())


def precisions(scale: Scale) -> dict[str, dict[str, float]]:
    """Return, by precision, the time and the largest gradient error relative to the largest gradient."""
    from gsplat_edu.render.cuda import render as rasterize

    found, before = {}, rasterize.PRECISION
    for name in ("ieee", "tf32x3", "tf32"):
        rasterize.PRECISION = name
        error = gradient_error("cuda", scale.few)
        large, wide = scene(scale.many, "cuda"), camera(*scale.sizes[0])
        work = lambda: render(large, wide, settings=SETTINGS, backend="cuda").image.sum().backward()  # noqa: E731, B023
        found[name] = {"error": error, "ms": milliseconds(work, scale.rounds)}
    rasterize.PRECISION = before
    return found


def beside_gsplat(scale: Scale) -> dict[str, float] | None:
    """Render a million Gaussians with gsplat and with our renderer; None if gsplat is not installed."""
    try:
        from gsplat import rasterization
    except ImportError:
        return None
    gaussians, cam = scene(scale.many, "cuda"), camera(*scale.sizes[0])
    view = torch.eye(4, device="cuda")
    view[:3, :3] = torch.tensor(cam.R)
    view[:3, 3] = torch.tensor(-cam.R @ cam.eye)
    # gsplat evaluates pixels at half-integers, our renderer at integers.
    K = torch.tensor([[cam.fx, 0, cam.cx + 0.5], [0, cam.fy, cam.cy + 0.5], [0, 0, 1.0]], device="cuda")

    def theirs() -> torch.Tensor:
        quats, scales, opacities = gaussians.quats, gaussians.scales, gaussians.opacities
        given = (gaussians.means, quats, scales, opacities, gaussians.sh, view[None], K[None], cam.W, cam.H)
        image: torch.Tensor = rasterization(*given, sh_degree=3, near_plane=0.05, packed=False)[0][0]
        return image

    def ours() -> torch.Tensor:
        return render(gaussians, cam, settings=SETTINGS, backend="cuda").image

    gradients = []
    for work in (ours, theirs):
        work().square().sum().backward()
        gradients.append({name: tensor.grad for name, tensor in gaussians.tensors().items()})
        for tensor in gaussians.tensors().values():
            tensor.grad = None
    with torch.no_grad():
        found = {"largest difference of the images": float((ours() - theirs()).abs().max())}
        found |= {
            "ours, forward ms": milliseconds(ours, scale.rounds),
            "gsplat, forward ms": milliseconds(theirs, scale.rounds),
        }
    for name, gradient in gradients[0].items():
        error = (gradient - gradients[1][name]).abs().max() / gradient.abs().max()
        found[f"largest difference of the gradients, {name}"] = float(error)
    found["ours, forward and backward ms"] = milliseconds(lambda: ours().sum().backward(), scale.rounds)
    found["gsplat, forward and backward ms"] = milliseconds(lambda: theirs().sum().backward(), scale.rounds)
    return found


def packed(gaussians: Gaussians) -> EngineScene:
    """Return Gaussians as the engine takes them."""
    parts = {
        name: tensor.detach().reshape(len(gaussians), -1) for name, tensor in gaussians.tensors().items()
    }
    core = torch.cat([parts[n] for n in ("means", "quats", "log_scales", "sh0", "logit_opacities")], dim=1)
    return EngineScene(core.numpy(), np.ascontiguousarray(gaussians.sh_rest.detach().numpy()))


def resident_step(count: int, width: int, height: int, rounds: int) -> dict[str, Any]:
    """Return what a training step on the device of webgpu takes, by stage, beside what the model computes."""
    gaussians, cam = scene(count, "cpu"), camera(width, height)
    view = DeviceView(
        cam, (0.0, 0.0, 0.0), 3, False, SETTINGS.dilation, 1.3, SETTINGS.alpha_max, SETTINGS.z_near
    )
    found = measure_step(Device.default(), packed(gaussians), view, rounds)
    return {"two runs have the same bits": found.same_bits, **found.report()}


def trained(folder: Path, backend: str, iterations: int) -> dict[str, float]:
    """Train a capture with adc; return seconds, iterations per second and the held-out PSNR."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        words = ["train", str(folder), "--out", str(out), "--strategy", "adc", "--backend", backend]
        start = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            code = command_line.main(
                [*words, "--iterations", str(iterations), "--eval-every", str(iterations)]
            )
        if code != 0:
            raise SystemExit(f"gpu.py: the training on {backend} failed")
        seconds = time.perf_counter() - start
        psnr = json.loads((out / "metrics.json").read_text())["test"]["psnr"]
    return {"iterations": iterations, "s": seconds, "iterations per s": iterations / seconds, "PSNR": psnr}


LEFT_OUT = "left out: the time was over"


def cuda_results(scale: Scale, over: Callable[[], bool]) -> dict[str, Any]:
    """Measure the backend cuda."""
    found: dict[str, Any] = {"gpu": torch.cuda.get_device_name(), "ceilings": ceilings(scale), "stages": {}}
    for count in scale.counts:
        for width, height in scale.sizes:
            measured = LEFT_OUT if over() else stages(count, width, height, scale.rounds)
            found["stages"][f"{count} at {width}x{height}"] = measured
    if over():
        return found | {"precisions": LEFT_OUT, "gsplat": LEFT_OUT}
    return found | {"precisions": precisions(scale), "gsplat": beside_gsplat(scale)}


def webgpu_results(scale: Scale, over: Callable[[], bool]) -> dict[str, Any]:
    """Measure the backend webgpu; a scene that is too large for the adapter has its reason instead of times."""
    found: dict[str, Any] = {
        "webgpu": gpu_of("webgpu"),
        "webgpu gradient error": gradient_error("webgpu", scale.few),
    }
    for count in scale.counts:
        for width, height in scale.sizes:
            name = f"webgpu, {count} at {width}x{height}"
            try:
                found[name] = LEFT_OUT if over() else resident_step(count, width, height, scale.rounds)
            except BackendUnavailableError as error:
                found[name] = str(error)
    return found


def show(result: dict[str, Any]) -> None:
    """Print the figures, stages as tables."""
    for name, table in result.items():
        print(f"{name}: {table}" if not isinstance(table, dict) else name)
        for key, value in table.items() if isinstance(table, dict) else ():
            if key == "stages":
                print(as_table(value))
            else:
                print(f"  {key}: {value}")


def main() -> int:
    """Measure, print the tables and write the JSON."""
    parser = hardware.parser("A training iteration on a GPU, stage by stage.")
    default = "snowmiku97 in $GSPLAT_EDU_DATA, else a procedural one"
    parser.add_argument("capture", nargs="?", type=Path, help=f"capture to train (default: {default})")
    parser.add_argument("--minutes", type=float, default=8.0, help="begin nothing after so long (default: 8)")
    arguments = parser.parse_args()
    scale = SMOKE if arguments.smoke else FULL
    end = time.monotonic() + 60 * arguments.minutes
    reason = unavailable("webgpu")
    has_adapter = reason is None and (arguments.smoke or not chosen_adapter().software)
    backends = ["cuda"] * torch.cuda.is_available() + ["webgpu"] * has_adapter
    if not backends:
        why = reason or "its adapter computes on the processor"
        print(f"gpu.py: no GPU: torch sees none, and webgpu has none: {why}", file=sys.stderr)
        return 2
    result: dict[str, Any] = {}
    with capture(arguments.capture, arguments.smoke) as folder:
        for name in backends:
            result[f"training, {name}"] = trained(folder, name, 5 if arguments.smoke else 7000)
    for name, results in {"cuda": cuda_results, "webgpu": webgpu_results}.items():
        if name in backends:
            result |= results(scale, lambda: time.monotonic() > end)
    hardware.report(result, arguments.out)
    show(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
