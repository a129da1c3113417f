"""Random steps of Gaussians along their covariances, natively or in torch.

The numbers come from a generator without a state: Philox maps a seed and the index of a Gaussian to four 32-bit words.
Every Gaussian's draw is independent of the others', so any thread or device may compute it.

Source: Salmon et al. 2011, "Parallel Random Numbers: As Easy as 1, 2, 3"; Box and Muller 1958.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.threads import native_threads
from gsplat_edu.ops import kernels
from gsplat_edu.scene.gaussians import Gaussians, unchecked_rotations

SHUT = 60.0
"""A gate below exp(-SHUT) counts as 0: such a step changes no mean, and denormal numbers are slow."""

WORD = 0xFFFFFFFF

Words = tuple[Tensor, Tensor, Tensor, Tensor]
"""Four 32-bit words for each Gaussian, as int64."""


class NoiseNumbers(NamedTuple):
    """The numbers of one step.

    Args:
        seed: The generator's key, 0 to 2^63 - 1; another for each step.
        amount: Size of the step if the gate is fully open, per world unit squared of covariance.
        sharpness: k of the gate sigmoid(k (t - opacity)).
        threshold: t.
    """

    seed: int
    amount: float
    sharpness: float
    threshold: float


@torch.no_grad()
def add_noise_natively(gaussians: Gaussians, numbers: NoiseNumbers) -> None:
    """Move the means, in place: means += amount sigmoid(k (t - opacity)) Sigma n,  n ~ N(0, I).

    One native pass, the same to the bit on any number of threads.

    Args:
        gaussians: The Gaussians, contiguous, float32 or float64 on the CPU; only their means change. A parameter that
            is not finite makes its mean NaN or infinite.
        numbers: Seed, amount and gate.

    Raises:
        BackendUnavailableError: the native module is missing.
    """
    means = gaussians.means
    kernels.kernel("noise_f", means.dtype)(
        means=kernels.native_array(means.detach()),
        quats=kernels.native_array(gaussians.quats.detach()),
        log_scales=kernels.native_array(gaussians.log_scales.detach()),
        logit_opacities=kernels.native_array(gaussians.logit_opacities.detach()),
        **numbers._asdict(),
        threads=native_threads(),
    )
    torch.autograd.graph.increment_version(means)  # so that autograd knows of the change


@torch.no_grad()
def add_noise_in_torch(gaussians: Gaussians, numbers: NoiseNumbers) -> None:
    """Move the means as `add_noise_natively` does, by torch's operations, on any device.

    Both draw the same words; the steps differ by rounding, in float32 by up to 1e-5 of the largest step that Sigma
    allows.
    """
    means = gaussians.means
    draw = standard_normals(numbers.seed, len(means), means.detach())
    R, scales = unchecked_rotations(gaussians.quats.detach()), gaussians.scales
    wander = (R @ (scales.square() * (R.mT @ draw[..., None])[..., 0])[..., None])[..., 0]
    x = numbers.sharpness * (gaussians.opacities - numbers.threshold)
    gate = torch.where(x > SHUT, 0.0, torch.sigmoid(-x))
    means += numbers.amount * gate[:, None] * wander


NoiseKernel = Callable[[Gaussians, NoiseNumbers], None]
"""Moves the means of Gaussians, in place."""


def standard_normals(seed: int, count: int, like: Tensor) -> Float[Tensor, "count 3"]:
    """Draw three standard normal numbers per Gaussian, of this tensor's dtype and device.

    n = (r cos 2 pi v, r sin 2 pi v, r' cos 2 pi v'),  r = sqrt(-2 log u),  r' = sqrt(-2 log u')

    The upper 24 bits of the words w0 to w3 make u = (w0 + 1) / 2^24, v = w1 / 2^24, u' = (w2 + 1) / 2^24 and
    v' = w3 / 2^24. They are exact in float32; no number is beyond 5.8.
    """
    index = torch.arange(count, device=like.device)
    zero = torch.zeros_like(index)
    words = philox((index & WORD, index >> 32, zero, zero), (seed & WORD, seed >> 32))
    u, v, other_u, other_v = ((word >> 8).to(like.dtype) for word in words)
    radius, other_radius = (torch.sqrt(-2 * torch.log((w + 1) / 2**24)) for w in (u, other_u))
    angle, other_angle = (2 * math.pi / 2**24 * w for w in (v, other_v))
    columns = (radius * torch.cos(angle), radius * torch.sin(angle), other_radius * torch.cos(other_angle))
    return torch.stack(columns, dim=-1)


def philox(counter: Words, key: tuple[int, int]) -> Words:
    """Compute Philox 4x32-10: ten rounds of two products and four exclusive ors.

    Args:
        counter: Four words for each draw, as int64 from 0 to 2^32 - 1.
        key: Two words.

    Returns:
        Four words for each draw.

    Source: Salmon et al. 2011, section 3.3.
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(10):
        # A product of 64 bits overflows int64; its bits are the same.
        a, b = c0 * 0xD2511F53, c2 * 0xCD9E8D57
        c0, c1 = ((b >> 32) & WORD) ^ c1 ^ k0, b & WORD
        c2, c3 = ((a >> 32) & WORD) ^ c3 ^ k1, a & WORD
        k0, k1 = (k0 + 0x9E3779B9) & WORD, (k1 + 0xBB67AE85) & WORD
    return c0, c1, c2, c3
