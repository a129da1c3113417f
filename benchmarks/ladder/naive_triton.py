"""The naive kernel in Triton: a program takes a block of pixels and reads every splat, near to far.

Compiled for a GPU if there is one. Otherwise Triton's interpreter runs the same source step by step in NumPy, which
checks the kernel but says nothing about its speed.
"""

# ruff: noqa: ANN001, ANN201
from __future__ import annotations

import os
import time

import numpy as np
import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
if DEVICE == "cpu":
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")  # otherwise triton 3.9 warns at the first compilation

import triton  # noqa: E402
import triton.language as tl  # noqa: E402

from gsplat_edu.base import constants  # noqa: E402
from ladder.splats import Splats  # noqa: E402

ALPHA_MIN, ALPHA_MAX = tl.constexpr(constants.ALPHA_MIN), tl.constexpr(constants.ALPHA_MAX)
BLOCK = 256 if DEVICE == "cuda" else 1024
"""Pixels per program. A step of the interpreter costs the same for any number of pixels."""


@triton.jit
def naive_kernel(
    means2d, conics, colors, opacities, image, transmittance, count, W, pixels, BLOCK: tl.constexpr
):
    """Composite every splat into a block of pixels."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    x, y = (pixel % W).to(tl.float32), (pixel // W).to(tl.float32)
    T = tl.full([BLOCK], 1.0, tl.float32)
    r, g, b = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for i in range(count):
        dx, dy = x - tl.load(means2d + 2 * i), y - tl.load(means2d + 2 * i + 1)
        A, B, C = tl.load(conics + 3 * i), tl.load(conics + 3 * i + 1), tl.load(conics + 3 * i + 2)
        power = -0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy
        alpha = tl.minimum(ALPHA_MAX, tl.load(opacities + i) * tl.exp(power))
        w = tl.where(alpha < ALPHA_MIN, 0.0, T * alpha)
        r += w * tl.load(colors + 3 * i)
        g += w * tl.load(colors + 3 * i + 1)
        b += w * tl.load(colors + 3 * i + 2)
        T -= w
    inside = pixel < pixels
    tl.store(image + 3 * pixel, r, mask=inside)
    tl.store(image + 3 * pixel + 1, g, mask=inside)
    tl.store(image + 3 * pixel + 2, b, mask=inside)
    tl.store(transmittance + pixel, T, mask=inside)


def where() -> str:
    """Return what the kernel runs on here."""
    if DEVICE == "cpu":
        return "Triton's interpreter, on the CPU: no GPU here"
    return f"compiled by Triton {triton.__version__} for {torch.cuda.get_device_name()}"


def naive_triton(splats: Splats) -> tuple[np.ndarray, np.ndarray, float]:
    """Draw splats; return image (H, W, 3), transmittance (H, W), seconds.

    If the kernel is compiled, the first launch does so and is not timed.
    """
    arrays = [torch.from_numpy(array).to(DEVICE) for array in splats[:4]]
    image = torch.empty(splats.H, splats.W, 3, device=DEVICE)
    transmittance = torch.empty(splats.H, splats.W, device=DEVICE)
    grid = (triton.cdiv(splats.pixels, BLOCK),)
    times: list[float] = []
    for _ in range(4 if DEVICE == "cuda" else 1):
        start = time.perf_counter()
        naive_kernel[grid](*arrays, image, transmittance, splats.count, splats.W, splats.pixels, BLOCK)
        if DEVICE == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return image.cpu().numpy(), transmittance.cpu().numpy(), min(times[1:] or times)
