"""How large are the errors of float32 on extreme scenes, and what causes them?

    python benchmarks/precision.py [--scenes 2000] [--seed 24] [--smoke] [--out FILE.json]

Each scene is random over many decades of focal length, distance, position in the world, scales, and distance of the
means from the image. The native kernels render it in float32 and in float64 from the same float32 parameters. If the
images differ by more than rounding, the benchmark looks for a discontinuity that a rounding error can cross; the table
counts scenes by the cause found. docs/PRECISION.md explains the classes and the bound.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import hardware
import numpy as np
import torch

from gsplat_edu import Camera, SplatError, build_cov3d_batch, eval_sh, quat_to_R_batch, render_gaussians
from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION, T_STOP, TILE, Z_NEAR
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians

SETTINGS = RenderSettings(depth=False, background=(0.2, 0.5, 0.9))
EPS = 2.0**-24
"""Relative error of one float32 rounding."""

STEEPEST = np.sqrt(np.log2(np.e) / 2 / DILATION)
"""Largest factor of dx and dy in the exponent's squares, per px. It is finite because of the dilation."""


def extreme_scene(seed: int, index: int) -> tuple[Camera, Gaussians]:
    """Make one random scene: up to 40 Gaussians with float32 parameters, and a camera of up to 48 x 48 px."""
    rng = np.random.default_rng([seed, index])
    n, (W, H) = int(rng.integers(1, 41)), (int(size) for size in rng.integers(8, 49, 2))
    focal, distance = W * 10.0 ** rng.uniform(-1, 3), 10.0 ** rng.uniform(-2, 4)
    target = _direction(rng) * distance * 10.0 ** rng.uniform(-2, 5) * rng.integers(0, 2)
    eye = target + _direction(rng) * distance
    camera = Camera.looking_at(eye, target, focal, focal * rng.uniform(0.8, 1.25), H, W, _direction(rng))
    z, spread = distance * 10.0 ** rng.uniform(-2, 1, n), 10.0 ** rng.uniform(-1, 4)
    x, y = rng.normal(size=(2, n)) * spread * [[W / 2 / camera.fx], [H / 2 / camera.fy]] * z
    decades = rng.uniform(-2, 5) + rng.uniform(-3, 3, (n, 3))
    arrays = {
        "means": np.stack([x, y, z], axis=-1) @ camera.R + eye,
        "quats": rng.normal(size=(n, 4)),
        "log_scales": np.log(z / focal)[:, None] + np.log(10.0) * decades,
        "sh0": rng.normal(size=(n, 1, 3)) / 2,
        "sh_rest": rng.normal(size=(n, 3, 3)) / 2,
        "logit_opacities": 3 * rng.normal(size=n),
    }
    return camera, Gaussians(**{k: torch.tensor(v, dtype=torch.float32) for k, v in arrays.items()})


def needle(size: int) -> tuple[Camera, Gaussians]:
    """Make one Gaussian with a standard deviation of 1000 px along the diagonal, none across, and its mean outside."""
    camera = Camera(np.eye(3), (0, 0, 0), 1000.0, 1000.0, size / 2, size / 2, size, size)
    place = (-100 - size / 2) / 1000.0
    arrays = {
        "means": [[place, place, 1.0]],
        "quats": [[np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)]],
        "log_scales": np.log([[1.0, 1e-5, 1e-5]]),
        "sh0": np.ones((1, 1, 3)),
        "sh_rest": np.zeros((1, 3, 3)),
        "logit_opacities": [2.0],
    }
    return camera, Gaussians(
        **{k: torch.tensor(np.asarray(v), dtype=torch.float32) for k, v in arrays.items()}
    )


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True)
class Layers:
    """The composited layers of a scene in float64, near to far, computed in NumPy independently of the kernels."""

    order: np.ndarray  # M, index of the Gaussian
    depths: np.ndarray  # M
    alphas: np.ndarray  # M H W, before the floor and the clamp
    colors: np.ndarray  # M 3
    noise: np.ndarray  # M, estimated float64 error of the exponent if covariances are multiplied out

    def drawn(self) -> np.ndarray:
        """Return the alpha used for compositing, (M, H, W)."""
        return np.where(self.alphas < ALPHA_MIN, 0.0, np.minimum(self.alphas, ALPHA_MAX))


def layers(camera: Camera, gaussians: Gaussians) -> Layers:
    """Project and evaluate every Gaussian at every pixel, using the factors of its covariance."""
    arrays = {name: tensor.double().numpy() for name, tensor in gaussians.tensors().items()}
    seen = camera.world_to_cam(arrays["means"])
    order = np.flatnonzero(seen[:, 2] > Z_NEAR)
    order = order[np.argsort(seen[order, 2], kind="stable")]
    x, y, z = seen[order].T
    zero = np.zeros_like(z)
    rows = [[camera.fx / z, zero, -camera.fx * x / z**2], [zero, camera.fy / z, -camera.fy * y / z**2]]
    JW = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) @ camera.R
    R, scales = quat_to_R_batch(arrays["quats"][order]), np.exp(arrays["log_scales"][order])
    r0, r1 = np.moveaxis(JW @ (R * scales[:, None, :]), 1, 0)
    normal = (
        (np.cross(JW[:, 0], JW[:, 1])[:, None, :] @ R)[:, 0] * np.roll(scales, 1, 1) * np.roll(scales, 2, 1)
    )
    a0, b, c0, det0 = ((p * q).sum(axis=1) for p, q in ((r0, r0), (r0, r1), (r1, r1), (normal, normal)))
    a, c, det = a0 + DILATION, c0 + DILATION, det0 + DILATION * (a0 + c0) + DILATION**2
    dx = np.arange(camera.W) - (camera.fx * x / z + camera.cx)[:, None, None]
    dy = np.arange(camera.H)[:, None] - (camera.fy * y / z + camera.cy)[:, None, None]
    shape = [v[:, None, None] for v in (a, b, c, det)]
    power = -0.5 * (shape[2] / shape[3] * (dx - shape[1] / shape[2] * dy) ** 2 + dy**2 / shape[2])
    opacities = 1 / (1 + np.exp(-arrays["logit_opacities"][order]))
    toward = arrays["means"][order] - camera.eye
    sh = np.concatenate([arrays["sh0"], arrays["sh_rest"]], axis=1)[order]
    colors = eval_sh(1, sh, toward / np.linalg.norm(toward, axis=1, keepdims=True))
    # The inverse of a computed covariance has a relative error of its condition number times eps, for terms of this
    # size.
    terms = (shape[2] * dx**2 + shape[0] * dy**2).max(axis=(1, 2)) / det
    noise = 64 * np.finfo(np.float64).eps * (a + c) ** 2 / det * (11 + terms)
    return Layers(order, z, opacities[:, None, None] * np.exp(power), colors, noise)


def relative_bound(camera: Camera) -> float:
    """Bound the relative error of an alpha in float32.

    alpha = 2^(log2 o - s² - t²), with |s| and |t| at most sqrt(8) if alpha >= 1/255. s is a sum of three terms of at
    most STEEPEST times the image's diagonal D, each rounded with its factors four times: |ds| <= 12 EPS STEEPEST D, and
    the exponent's error is 2 sqrt(8) (|ds| + |dt|). Polynomial, opacity and the last rounding add 16 EPS.
    """
    diagonal = float(np.hypot(camera.W, camera.H))
    return float(np.log(2) * 2 * np.sqrt(8) * 2 * 12 * EPS * STEEPEST * diagonal + 16 * EPS)


@dataclass(frozen=True)
class Verdict:
    """Error of one scene's float32 image and its causes."""

    error: float  # largest difference from float64, any pixel and channel
    bound: float  # largest error that rounding explains
    causes: tuple[str, ...]  # discontinuities that a rounding error can cross, whether or not one did
    allowed: float  # bound including these


def judge(camera: Camera, gaussians: Gaussians) -> Verdict:
    """Compare float32 with float64 and find ties."""
    with torch.no_grad():
        single, double = (
            render(
                gaussians.map(lambda t, d=dtype: t.to(d)), camera, settings=SETTINGS, backend="cpu"
            ).image.double()
            for dtype in (torch.float32, torch.float64)
        )
    error = float((single - double).abs().max())
    drawn = layers(camera, gaussians)
    bright = float(max(1.0, np.abs(drawn.colors).max(initial=0.0)))
    relative = relative_bound(camera)
    alphas = drawn.drawn()
    # An error of alpha changes the image by that error times T times the colour difference to the layers behind. The
    # weights T alpha of a pixel add up to at most 1, and sums round once per layer.
    bound = 2 * bright * (relative + (len(alphas) + 16) * EPS)
    floor_ties = (np.abs(drawn.alphas / ALPHA_MIN - 1) < relative).sum(axis=0).max(initial=0)
    causes, allowed = [], bound
    if floor_ties:
        causes.append("alpha at the floor 1/255")
        allowed += 2 * bright * float(floor_ties) * ALPHA_MIN
    if _stop_is_tied(alphas, relative * (len(alphas) + 1)):
        causes.append("tile at the stop 1e-4")
        allowed += 2 * bright * T_STOP
    # The float32 depth is the rounded float64 depth, so neighbours tie if their rounded depths are equal.
    near = np.diff(drawn.depths.astype(np.float32)) <= 0
    if np.any(near & (np.diff(drawn.depths) > 0)):
        causes.append("equal depths in float32")
        allowed += 2 * bright
    return Verdict(error, bound, tuple(causes), allowed)


def _stop_is_tied(alphas: np.ndarray, relative: float) -> bool:
    """Return whether a tile's largest transmittance is within `relative` of the stop."""
    T = np.cumprod(1 - alphas, axis=0)
    padded = np.pad(T, ((0, 0), (0, -T.shape[1] % TILE), (0, -T.shape[2] % TILE)))
    count, H, W = padded.shape
    tiles = padded.reshape(count, H // TILE, TILE, W // TILE, TILE).max(axis=(2, 4))
    # At the clamp, 1 - alpha is 0.01, so its relative error is a hundred times that of alpha.
    return bool((np.abs(tiles / T_STOP - 1) < 100 * relative).any())


def is_stopped(camera: Camera, gaussians: Gaussians) -> bool:
    """Return whether a tile stops before its last layer; the dense renderer does not stop there."""
    T = np.prod(1 - layers(camera, gaussians).drawn(), axis=0)
    padded = np.pad(T, ((0, -T.shape[0] % TILE), (0, -T.shape[1] % TILE)))
    tiles = padded.reshape(padded.shape[0] // TILE, TILE, padded.shape[1] // TILE, TILE).max(axis=(1, 3))
    return bool((tiles < 2 * T_STOP).any())


def oracle_error(camera: Camera, gaussians: Gaussians) -> tuple[float, float] | str:
    """Return the difference of float64 kernels and NumPy reference, and a bound; or why the reference refuses."""
    arrays = {name: tensor.double().numpy() for name, tensor in gaussians.tensors().items()}
    covs = build_cov3d_batch(np.exp(arrays["log_scales"]), quat_to_R_batch(arrays["quats"]))
    toward = arrays["means"] - camera.eye
    sh = np.concatenate([arrays["sh0"], arrays["sh_rest"]], axis=1)
    colors = eval_sh(1, sh, toward / np.linalg.norm(toward, axis=1, keepdims=True))
    opacities = 1 / (1 + np.exp(-arrays["logit_opacities"]))
    try:
        truth, _ = render_gaussians(
            camera, arrays["means"], covs, colors, opacities, SETTINGS.background, extent="exact", stop="tile"
        )
    except SplatError as error:
        return str(error)
    with torch.no_grad():
        image = render(
            gaussians.map(torch.Tensor.double), camera, settings=SETTINGS, backend="cpu"
        ).image.numpy()
    drawn = layers(camera, gaussians)
    bright = max(1.0, np.abs(colors).max())
    return float(np.abs(image - truth).max()), float(2 * bright * (1e-12 + drawn.noise.sum()))


def gradient_error(camera: Camera, gaussians: Gaussians) -> tuple[float, str]:
    """Return the largest relative difference of float64 gradients, kernels vs. autograd, and its parameter."""
    found = []
    for backend in ("cpu", "torch"):
        moved = gaussians.map(torch.Tensor.double).trainable()
        image = render(moved, camera, settings=SETTINGS, backend=backend).image
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        (image * weights).sum().backward()
        found.append({name: tensor.grad for name, tensor in moved.tensors().items()})
    ours, theirs = found
    errors = {
        name: float((ours[name] - grad).abs().max() / grad.abs().max().clamp(min=1e-300))
        for name, grad in theirs.items()
    }
    return max((error, name) for name, error in errors.items())


def images_table(seed: int, count: int) -> list[Verdict]:
    """Print the number of scenes by class; return all verdicts."""
    verdicts = [judge(*extreme_scene(seed, k)) for k in range(count)]
    print(f"float32 against float64, {count} scenes (seed {seed})")
    limits = (1e-5, 1e-4, 1e-3, 0.02)
    print("  over " + ", ".join(f"{limit:g}: {sum(v.error > limit for v in verdicts)}" for limit in limits))
    print("| class | scenes | largest difference |\n|---|---|---|")
    groups: dict[str, list[float]] = {}
    for verdict in verdicts:
        within = verdict.error <= verdict.bound
        explained = verdict.error <= verdict.allowed
        name = "within rounding" if within else " + ".join(verdict.causes) if explained else "unexplained"
        groups.setdefault(name, []).append(verdict.error)
    for name, errors in sorted(groups.items(), key=lambda item: -len(item[1])):
        print(f"| {name} | {len(errors)} | {max(errors):.2g} |")
    print(f"  largest bound on rounding: {max(v.bound for v in verdicts):.2g}")
    return verdicts


def oracle_table(seed: int, count: int) -> dict[str, int]:
    """Print how the float64 kernels agree with the NumPy oracle; return the number of scenes by class."""
    classes: Counter[str] = Counter()
    for k in range(count):
        result = oracle_error(*extreme_scene(seed, k))
        if isinstance(result, str):
            classes["the oracle refuses, naming the Gaussian"] += 1
        else:
            classes[
                "to 1e-9"
                if result[0] < 1e-9
                else "as covariances allow"
                if result[0] < result[1]
                else "unexplained"
            ] += 1
    print(f"float64 kernels against the NumPy oracle: {dict(classes)}")
    return dict(classes)


def gradients_table(seed: int, count: int) -> list[float]:
    """Print how float64 gradients agree with autograd through the dense renderer; return the differences."""
    errors = [
        gradient_error(*scene)[0] for k in range(count) if not is_stopped(*(scene := extreme_scene(seed, k)))
    ]
    print(
        f"float64 gradients against autograd, {len(errors)} of {count} scenes in which no tile stops: "
        f"over 1e-6 of the largest: {sum(error > 1e-6 for error in errors)}, worst {max(errors, default=0.0):.2g}"
    )
    return errors


def main() -> None:
    """Print the tables and write the JSON."""
    parser = hardware.parser("What float32 costs on extreme scenes.")
    parser.add_argument("--scenes", type=int, default=2000, help="number of scenes (--smoke: 20)")
    parser.add_argument("--seed", type=int, default=24, help="seed of the scenes")
    args = parser.parse_args()
    count = 20 if args.smoke else args.scenes
    torch.set_num_threads(1)
    found: dict[str, Any] = {
        "seed": args.seed,
        "images": [asdict(verdict) for verdict in images_table(args.seed, count)],
        "oracle": oracle_table(args.seed, count),
        "gradients": gradients_table(args.seed, min(count, 400)),
    }
    hardware.report(found, args.out)


if __name__ == "__main__":
    main()
