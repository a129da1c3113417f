"""Density control as Markov chain Monte Carlo: Gaussians are samples and are relocated, never removed.

A dead Gaussian, too faint to be visible, moves onto a living one drawn in proportion to opacity. Both get new
opacities and scales that leave the image (nearly) unchanged. The number grows by a few percent at a time up to a cap.
Noise moves Gaussians that are still faint. Regularisers keep opacity and scale small, so that superfluous Gaussians
die and are relocated.

Source: Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo".

Chapter: 16_birth_and_death.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.noise import NoiseKernel, NoiseNumbers, add_noise_natively
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import State
from gsplat_edu.train.density.surgery import replace
from gsplat_edu.train.events import Change, RelocateEvent
from gsplat_edu.train.far import Shell
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.saved import check_entries, check_torch_generator
from gsplat_edu.train.schedule import milestone

MOST_SHARERS = 51
"""Largest number of Gaussians that share one place; beyond it the sum below loses precision. (2024's code)"""

NOISE_SHARPNESS = 100.0
"""k of the noise gate sigmoid(k (t - opacity)). (2024, eq. 9)"""

NOISE_THRESHOLD = 0.005
"""t of the gate: only Gaussians about as faint as dead ones get the full noise. (2024: 1 - 0.995)"""


class MCMC:
    """Relocate dead Gaussians, grow up to the cap, add noise; its regularisers are in `gsplat_edu.train.objective`.

    Args:
        config: Window, growth and noise; `max_gaussians` has to be set.
        generator: Source of the draws and of the noise.
        shell: Where far splats lie, which get no noise; None if there are none.
        add_noise: Moves the means; see `Backend.add_noise`.

    Raises:
        ArgumentError: there is no cap.
    """

    observes_renders_only = is_over = True

    def __init__(
        self,
        config: TrainConfig,
        generator: torch.Generator,
        shell: Shell | None = None,
        add_noise: NoiseKernel = add_noise_natively,
    ) -> None:
        if config.max_gaussians is None:
            raise ArgumentError("max_gaussians: mcmc grows up to a cap and needs one, for example 200000")
        self.config, self.generator, self.cap = config, generator, config.max_gaussians
        self.shell, self._noise = shell, add_noise

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Do nothing: neither relocation nor growth depends on the renders."""

    @torch.no_grad()
    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Relocate and grow when the schedule says so; add noise after every step."""
        events = list[Change]()
        if self.is_due(iteration) and len(gaussians):
            dead = (gaussians.opacities <= self.config.min_opacity) | ~gaussians.finite_rows()
            num_relocated = self._relocate(gaussians, optimizer, torch.nonzero(dead)[:, 0])
            newborn = self._newborn(gaussians, optimizer)
            keep = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
            gaussians = replace(gaussians, optimizer, keep, newborn)  # sorts them, also if none is added
            num_added = len(gaussians) - len(keep)
            events.append(RelocateEvent(iteration, num_relocated, num_added, len(gaussians)))
        self._add_noise(gaussians, self.passed(iteration, optimizer.learning_rates["means"]))
        return gaussians, events

    def is_due(self, iteration: int) -> bool:
        """Return whether the schedule says to relocate and grow; see `FollowsDevice.is_due`."""
        config = self.config
        due = milestone(iteration, config.densify_every, config.batch)
        return due is not None and config.densify_start < due < config.mcmc.stop

    def passed(self, iteration: int, rate: float) -> NoiseNumbers:
        """Draw the noise that every step adds; see `FollowsDevice.passed`."""
        seed = int(torch.randint(2**62, (1,), generator=self.generator))  # checkpoints store the generator
        return NoiseNumbers(seed, rate * self.config.mcmc.noise, NOISE_SHARPNESS, NOISE_THRESHOLD)

    def observed(self) -> dict[str, Tensor]:
        """Return nothing: relocation needs no statistics."""
        return {}

    def absorb(self, statistics: Mapping[str, Tensor]) -> None:
        """Do nothing."""

    def _relocate(self, gaussians: Gaussians, optimizer: Adam, dead: Int64[Tensor, " D"]) -> int:
        """Move dead Gaussians onto living ones, in place. Do nothing if all are dead."""
        weights = gaussians.opacities.double()
        weights[dead] = 0.0
        if not len(dead) or not bool((weights > 0).any()):
            return 0
        places = self._draw(weights, len(dead))
        self._share(gaussians, optimizer, places)
        for tensor in gaussians.tensors().values():
            tensor[dead] = tensor[places]
        optimizer.forget_rows(dead)
        return len(dead)

    def _newborn(self, gaussians: Gaussians, optimizer: Adam) -> list[Gaussians]:
        """Return copies of drawn Gaussians, up to the cap, and let both share their places; [] if there are none."""
        count = len(gaussians)
        num_added = max(min(self.cap, int(self.config.mcmc.growth * count)) - count, 0)
        if not num_added:
            return []
        weights = torch.where(gaussians.finite_rows(), gaussians.opacities.double(), 0.0)
        if not bool((weights > 0).any()):
            return []
        places = self._draw(weights, num_added)
        self._share(gaussians, optimizer, places)
        return [gaussians.map(lambda tensor: tensor[places])]

    def _draw(self, weights: Float[Tensor, " N"], count: int) -> Int64[Tensor, " count"]:
        """Draw indices with replacement, with probabilities proportional to the weights."""
        cumulated = torch.cumsum(weights.cpu(), dim=0)  # a GPU's sum differs from run to run
        uniform = torch.rand(count, generator=self.generator, dtype=torch.float64)
        places = torch.searchsorted(cumulated, uniform * cumulated[-1], right=True)
        return places.clamp(max=len(weights) - 1).to(weights.device)

    def _share(self, gaussians: Gaussians, optimizer: Adam, places: Int64[Tensor, " D"]) -> None:
        """Adjust opacity and scale of the Gaussians at these places, in place, before others join them."""
        arrivals = torch.bincount(places, minlength=len(gaussians))
        hosts = torch.nonzero(arrivals)[:, 0]
        sharers = (arrivals[hosts] + 1).clamp(max=MOST_SHARERS)
        opacities, factor = shared_shape(gaussians.opacities[hosts].double(), sharers)
        opacities = opacities.clamp(min=self.config.min_opacity, max=1 - 1e-6)
        gaussians.logit_opacities[hosts] = torch.logit(opacities).to(gaussians.logit_opacities)
        gaussians.log_scales[hosts] += factor.log()[:, None].to(gaussians.log_scales)
        optimizer.forget_rows(hosts)

    def _add_noise(self, gaussians: Gaussians, numbers: NoiseNumbers) -> None:
        """Means += rate noise sigmoid(k (t - opacity)) Sigma n,  n ~ N(0, I).

        The rate of a batch is larger by the root of its size, and so the sum of the noise of its images is kept.
        Splats of a shell stay: their covariance, hundreds of world units squared, would throw them out of the scene.
        """
        far = None if self.shell is None else self.shell.holds(gaussians.means)
        places = None if far is None else gaussians.means[far]
        self._noise(gaussians, numbers)
        if far is not None and places is not None:
            gaussians.means[far] = places

    def state(self) -> State:
        """Return the generator."""
        return {"generator": self.generator.get_state()}, {}

    def load_state(self, tensors: dict[str, Tensor], numbers: dict[str, Any], gaussians: Gaussians) -> None:
        """Restore what `state` returned; see `DensityStrategy.load_state`."""
        state = check_entries("density", tensors, ("generator",))["generator"]
        check_entries("density", numbers, ())
        check_torch_generator("density.generator", state, self.generator)
        self.generator.set_state(state)


def shared_shape(
    opacities: Float[Tensor, " N"], sharers: Int64[Tensor, " N"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Compute opacity and scale factor so that n Gaussians in one place look like the single one before.

    o' = 1 - (1 - o)^(1/n),   scale' = scale o / (sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1))

    Args:
        opacities: (N,) opacity o of the single Gaussian, in (0, 1), float64.
        sharers: (N,) n, 1 to 51.

    Returns:
        (N,) opacity of each of the n Gaussians, and (N,) factor on its scales.

    Source: Kheradmand et al. 2024, eq. 8 and 9.
    """
    each = 1 - (1 - opacities) ** (1 / sharers.double())
    total = torch.zeros_like(opacities)
    for k in range(MOST_SHARERS):
        # sum_{i=k+1..n} C(i-1, k) = C(n, k+1), by the hockey-stick identity.
        log_binomial = _log_choose(sharers, k + 1)
        term = torch.exp(log_binomial + (k + 1) * torch.log(each)) / math.sqrt(k + 1)
        total += torch.where(sharers > k, term * (-1) ** k, 0.0)
    return each, opacities / total


def _log_choose(n: Int64[Tensor, " N"], k: int) -> Float[Tensor, " N"]:
    """Return log C(n, k); the value for n < k is not used."""
    real = n.double().clamp(min=k)
    return torch.lgamma(real + 1) - math.lgamma(k + 1) - torch.lgamma(real - k + 1)
