"""How many steps would second-order steps save, with one photo a step and a fixed number of Gaussians?

    python benchmarks/second_order.py [CAPTURE] [--resolution R] [--splats N] [--steps N] [--out FILE.json] [--smoke]

A laboratory in NumPy, for a question to the recipe: nothing of it is fast. Adam, with three factors on the rates of
the strategy fast, is compared with steps that divide by the diagonal of Gauss and Newton, J'J, where J holds the
derivatives of all pixels of a photo. Both minimise the squared error, see the same photos in the same order, and learn
means, scales, quaternions, opacities and colours of degree 0.

With s the five numbers of a Gaussian in the image (mean, covariance) and e a parameter's derivative of them, a diagonal
entry is e' (sum over pixels of ds ds') e: 15 sums more than the gradient's, so a kernel could have it. A step is

    G = b G + (1 - b) J'r,   H = c H + (1 - c) diag J'J,   p -= rate clip(G / ((1 + lambda) H + floor))

where floor is a hundredth of the mean of H over the Gaussians. The rate falls with 1 - b: otherwise each residual would
be corrected more than once while G remembers it, and the steps diverge.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from captures import capture
from torch import Tensor

from gsplat_edu import C0, Camera, load_dataset
from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points

Parameters = dict[str, Tensor]
"""Parameters of all Gaussians by name, float64; or a number for each of them."""

ADAM = (1.0, 2.0, 4.0)
"""Factors on Adam's rates."""

GAUSS_NEWTON = ((0.06, 0.9, 0.9), (0.1, 0.8, 0.98), (0.3, 0.5, 0.5))
"""Rate, b and c."""

LAMBDA, FLOOR, MOST = 1.0, 0.01, 0.3
"""Damping of the diagonal; its floor; the largest step, of a mean in units of the start's scale, of a logit doubled."""


def in_image(mean: Tensor, scale: Tensor, quat: Tensor, R: Tensor, eye: Tensor, f: Tensor) -> Tensor:
    """Return mean and covariance of one Gaussian in the image: u, v, and the covariance's xx, xy, yy."""
    x, y, z = R @ (mean - eye)
    w, a, b, c = quat / quat.norm()
    turn = torch.stack(
        [
            torch.stack([1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)]),
            torch.stack([2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)]),
            torch.stack([2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)]),
        ]
    )
    zero = torch.zeros_like(z)
    J = torch.stack(
        [torch.stack([f[0] / z, zero, -f[0] * x / z**2]), torch.stack([zero, f[1] / z, -f[1] * y / z**2])]
    )
    M = J @ R @ (turn * scale.exp())
    S = M @ M.T
    centre = [f[0] * x / z + f[2], f[1] * y / z + f[3]]
    return torch.stack([*centre, S[0, 0] + DILATION, S[0, 1], S[1, 1] + DILATION])


EACH = (0, 0, 0, None, None, None)
project = torch.func.vmap(in_image, in_dims=EACH)
slopes = torch.func.vmap(torch.func.jacrev(in_image, argnums=(0, 1, 2)), in_dims=EACH)


def matrices(camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotation, centre and (fx, fy, cx, cy) of a camera."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    return torch.tensor(camera.R), torch.tensor(np.asarray(camera.eye)), torch.tensor(numbers).double()


class Drawn:
    """The image of Gaussians, and what their derivatives need.

    Args:
        p: The parameters.
        camera: A camera with a pinhole.
    """

    def __init__(self, p: Parameters, camera: Camera) -> None:
        self.p, self.at = p, matrices(camera)
        R, eye, _ = self.at
        s = project(p["means"], p["scales"], p["quats"], *self.at).numpy()
        depth = ((p["means"] - eye) @ R.T)[:, 2].numpy()
        self.opacities, self.raw = torch.sigmoid(p["opacities"]).numpy(), (0.5 + C0 * p["sh0"]).numpy()
        self.colors = np.clip(self.raw, 0.0, None)
        reach = np.sqrt(2 * np.log(np.maximum(self.opacities / ALPHA_MIN, 1.0)))
        low, high = (
            [s[:, k] + sign * reach * np.sqrt(s[:, k + k + 2]) for k in (0, 1)] for sign in (-1.0, 1.0)
        )
        first, last = np.ceil(np.clip(low, 0, None)).astype(int), np.floor(high)
        ends = np.minimum(last, [[camera.W - 1], [camera.H - 1]]).astype(int) + 1
        seen = (depth > 0.2) & (ends > first).all(axis=0)
        self.order = np.flatnonzero(seen)[np.argsort(depth[seen], kind="stable")]
        self.image, self.parts = np.zeros((3, camera.H, camera.W)), []
        T = np.ones((camera.H, camera.W))
        for i in self.order:
            window = slice(first[1, i], ends[1, i]), slice(first[0, i], ends[0, i])
            dx = s[i, 0] - np.arange(first[0, i], ends[0, i])[None]
            dy = s[i, 1] - np.arange(first[1, i], ends[1, i])[:, None]
            xx, xy, yy = s[i, 2:]
            conic = np.array([yy, -xy, xx]) / (xx * yy - xy * xy)
            lx, ly = conic[0] * dx + conic[1] * dy, conic[1] * dx + conic[2] * dy
            alpha = np.minimum(self.opacities[i] * np.exp(-0.5 * (lx * dx + ly * dy)), ALPHA_MAX)
            alpha[alpha < ALPHA_MIN] = 0.0
            light = T[window].copy()
            self.image[:, *window] += self.colors[i][:, None, None] * (light * alpha)
            T[window] *= 1.0 - alpha
            self.parts.append((window, alpha, light, lx, ly))

    def derivatives(self, photo: np.ndarray) -> tuple[Parameters, Parameters]:
        """Return J'r and the diagonal of J'J, with r = image - photo."""
        residual, behind = self.image - np.moveaxis(photo, -1, 0), self.image.copy()
        count = len(self.order)
        first, second = np.zeros((count, 9)), np.zeros((count, 7, 7))
        for n, (i, (window, alpha, light, lx, ly)) in enumerate(zip(self.order, self.parts, strict=True)):
            weight, color = light * alpha, self.colors[i][:, None, None]
            rest = behind[:, *window]
            rest -= weight * color
            slope = alpha * (light * color - rest / (1.0 - alpha)) * (alpha < ALPHA_MAX)
            power = [-lx, -ly, lx * lx / 2, lx * ly, ly * ly / 2, np.full_like(alpha, 1 - self.opacities[i])]
            d = np.stack([np.broadcast_to(one, alpha.shape) for one in power]).reshape(6, -1)
            own = residual[:, *window]
            first[n, :6], first[n, 6:] = (
                d @ (slope * own).sum(axis=0).ravel(),
                (weight * own).sum(axis=(1, 2)),
            )
            second[n, :6, :6], second[n, 6, 6] = (d * (slope**2).sum(axis=0).ravel()) @ d.T, (weight**2).sum()
        some = [self.p[name][self.order] for name in ("means", "scales", "quats")]
        lit = C0 * (self.raw[self.order] > 0)
        G, H = {}, {}
        for name, jacobian in zip(("means", "scales", "quats"), slopes(*some, *self.at), strict=True):
            e = jacobian.numpy()
            G[name] = np.einsum("nki,nk->ni", e, first[:, :5])
            H[name] = np.einsum("nki,nkl,nli->ni", e, second[:, :5, :5], e)
        G["opacities"], H["opacities"] = first[:, 5], second[:, 5, 5]
        G["sh0"], H["sh0"] = lit * first[:, 6:], lit * lit * second[:, 6, 6, None]
        return self._spread(G), self._spread(H)

    def _spread(self, seen: dict[str, np.ndarray]) -> Parameters:
        every = {name: np.zeros(tensor.shape) for name, tensor in self.p.items()}
        for name, values in seen.items():
            every[name][self.order] = values
        return {name: torch.from_numpy(values) for name, values in every.items()}


Step = Callable[[Parameters, Parameters, Parameters, int, float], Parameters]
"""Returns new parameters, given parameters, J'r, diag J'J, the step from 1, and the share of all steps taken."""


def adam(factor: float, extent: float) -> Step:
    """Return steps of Adam at the rates of the strategy fast, times a factor."""
    c = recipe(3_000, strategy="fast")
    rates = {"means": c.means_rate * extent, "scales": c.scales_rate, "quats": c.quats_rate}
    rates |= {"opacities": c.opacities_rate, "sh0": c.sh0_rate}
    first: Parameters = {}
    second: Parameters = {}

    def step(p: Parameters, G: Parameters, _: Parameters, t: int, share: float) -> Parameters:
        for name, g in G.items():
            first[name] = 0.9 * first.get(name, torch.zeros_like(g)) + 0.1 * g
            second[name] = 0.999 * second.get(name, torch.zeros_like(g)) + 0.001 * g**2
        fall = {name: 0.1**share if name == "means" else 0.1 ** (share / 2) for name in p}
        return {
            name: value
            - factor * rates[name] * fall[name] * first[name] / (1 - 0.9**t)
            / ((second[name] / (1 - 0.999**t)).sqrt() + 1e-15)
            for name, value in p.items()
        }  # fmt: skip

    return step


def gauss_newton(rate: float, b: float, c: float, start: Parameters) -> Step:
    """Return steps that divide by the diagonal of J'J; see the module."""
    first: Parameters = {}
    second: Parameters = {}
    most = dict.fromkeys(start, torch.tensor(MOST)) | {"opacities": torch.tensor(2 * MOST)}
    most["means"] = MOST * start["scales"].exp()

    def step(p: Parameters, G: Parameters, H: Parameters, t: int, share: float) -> Parameters:
        moved = {}
        for name, value in p.items():
            first[name] = b * first.get(name, torch.zeros_like(value)) + (1 - b) * G[name]
            second[name] = c * second.get(name, torch.zeros_like(value)) + (1 - c) * H[name]
            h = second[name] / (1 - c**t)
            floor = FLOOR * h[h > 0].mean() if bool((h > 0).any()) else 1.0
            full = first[name] / (1 - b**t) / ((1 + LAMBDA) * h + floor)
            moved[name] = value - rate * 0.1 ** (share / 2) * full.clamp(-most[name], most[name])
        return moved

    return step


def pixels(view: View) -> np.ndarray:
    """Return a photo, 0 to 1."""
    found = view.read().image
    return found / 255.0 if found.dtype == np.uint8 else found.astype(np.float64)


def curve(
    start: Parameters, step: Step, train: list[View], test: list[View], steps: int
) -> list[list[float]]:
    """Take the steps; return step and mean PSNR of the test views, at a quarter, half, three quarters and the end."""
    p, order, found = start, shuffled(len(train)), []
    photos = [pixels(view) for view in train]
    for t in range(1, steps + 1):
        i = next(order)
        p = step(p, *Drawn(p, train[i].camera).derivatives(photos[i]), t, (t - 1) / max(1, steps - 1))
        if t in {steps * k // 4 for k in (1, 2, 3, 4)}:
            images = [np.moveaxis(Drawn(p, view.camera).image, 0, -1).clip(0, 1) for view in test]
            scores = [psnr(image, pixels(view)) for image, view in zip(images, test, strict=True)]
            found.append([float(t), float(np.mean(scores))])
    return found


def shuffled(count: int) -> Iterator[int]:
    """Yield each view once, in a random order, again and again."""
    rng = np.random.default_rng(1)
    while True:
        yield from rng.permutation(count).tolist()


def main() -> None:
    """Read the command line, take all steps, and print a row for each way."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("capture", nargs="?", type=Path)
    parser.add_argument(
        "--resolution", type=float, default=8.0, help="divisor of the photos' size (default: 8)"
    )
    parser.add_argument("--splats", type=int, default=3_000)
    parser.add_argument("--steps", type=int, default=300)
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.resolution, arguments.splats, arguments.steps = 1.0, 20, 8
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    with capture(arguments.capture, arguments.smoke) as folder:
        dataset = load_dataset(folder, DataSettings(resolution=arguments.resolution))
        train, test = list(dataset.train), list(dataset.test)[::2]
        config = recipe(3_000, strategy="none", max_gaussians=arguments.splats, sh_degree=0)
        placed = from_points(dataset.points, dataset.colors, config)
        start = {
            "means": placed.means, "scales": placed.log_scales, "quats": placed.quats,
            "opacities": placed.logit_opacities, "sh0": placed.sh0[:, 0],
        }  # fmt: skip
        start = {name: tensor.detach().double() for name, tensor in start.items()}
        ways = {
            f"Adam, rates x {factor:g}": adam(factor, scene_extent([view.camera for view in train]))
            for factor in ADAM
        }
        ways |= {f"Gauss-Newton {one}": gauss_newton(*one, start) for one in GAUSS_NEWTON}
        for name, step in ways.items():
            began = time.process_time()
            rows.append({"way": name, "psnr": curve(start, step, train, test, arguments.steps)})
            rows[-1]["processor_seconds"] = time.process_time() - began
            print(
                f"{name:32}",
                ", ".join(f"{t:.0f}: {score:.2f} dB" for t, score in rows[-1]["psnr"]),
                flush=True,
            )
    hardware.report({"capture": folder.name, "steps": arguments.steps, "ways": rows}, arguments.out)


if __name__ == "__main__":
    sys.exit(main())
