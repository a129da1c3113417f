"""Every number of a training, named, with its source.

The defaults are the recipe of Kerbl et al. 2023 ("2023" below) as its code runs it, and of Kheradmand et al. 2024
for the strategy mcmc. Iterations count from 0: what happens "at iteration i" happens with or after step i + 1.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from gsplat_edu.constants import SH_MAX_DEGREE
from gsplat_edu.validation import float64_array, in_range, one_of, whole_number

RECIPE_ITERATIONS = 30_000
"""Length of the run that the recipe's milestones are made for."""

SHORT_RUN = 3_000
"""Runs shorter than this do not reset opacities: there would be no time to recover."""

STRATEGIES = ("adc", "mcmc", "none")
OVER_CAP = ("strongest", "cut")
VIEW_ORDERS = ("shuffled", "random")

FROM_SCENE = {"means_rate": 1.6e-5, "sh_every": 0}
"""Defaults of a run that starts from a trained scene. Its Gaussians are about where they belong, so the means' rate
starts at the geometric mean of the recipe's first and last; its harmonics are trained, so all of them are in use."""


@dataclass(frozen=True)
class TrainConfig:
    """One training run; see `recipe` for runs of other lengths than 30,000 iterations.

    Args:
        iterations: Number of training steps; each renders one view.
        seed: Seed of the initial Gaussians, the view order, splits, relocations and noise.
        means_rate: Initial learning rate of the means, times the scene's extent. (2023)
        means_rate_final: Learning rate of the means from `means_rate_iterations` on, times the extent; log-linear
            before. (2023)
        means_rate_iterations: Iteration at which the learning rate of the means reaches its final value.
        quats_rate: Learning rate of the quaternions. (2023)
        scales_rate: Learning rate of the log scales. (2023)
        sh0_rate: Learning rate of the degree-0 harmonic. (2023)
        sh_rest_rate: Learning rate of the higher harmonics. (2023: a twentieth of `sh0_rate`)
        opacities_rate: Learning rate of the logit opacities. (2023; newer forks use 2.5e-2)
        adam_eps: Adam's epsilon. (2023)
        ssim_weight: Weight k in the loss (1 - k) L1 + k (1 - SSIM). (2023, eq. 7)
        sh_degree: Highest degree of spherical harmonics.
        sh_every: Iterations between increases of the degree in use; 0 uses all degrees from the start. (2023)
        view_order: "shuffled": each view once before any is repeated (2023); "random": drawn with replacement.
        background: Background colour, RGB, 0 to 1.
        random_background: Draw a new background colour for every iteration.
        antialiased: Train for antialiased rendering, see `gsplat_edu.render.settings.RenderSettings`.
        jacobian_limit: Clamp of the projection's Jacobian, in half fields of view (2023); None for no clamp.
        start_opacity: Opacity of the initial Gaussians. (2023)
        start_scale: Factor on the initial scales, which are the root mean squared distance to 3 neighbours.
        strategy: "adc": clone, split, prune, reset; "mcmc": relocate, grow, add noise; "none": fixed number.
        max_gaussians: Cap on the number of Gaussians; None for no cap. mcmc requires one.
        over_cap: adc: which Gaussians are cloned or split if the cap leaves too little room. "strongest": those with
            the largest gradients; "cut": all, and what exceeds the cap is dropped from the end of the order survivors,
            clones, children; the parent of dropped children is removed too (the course).
        densify_start: Densification begins after this iteration. (2023; both strategies)
        densify_stop: Densification ends before this iteration. (2023)
        densify_every: Densify at iterations that are a multiple of this. (2023; 2024)
        grad_threshold: adc: Gaussians whose mean gradient norm, in normalised device coordinates, exceeds this are
            cloned or split. (2023)
        percent_dense: adc: fraction of the extent; among these, larger Gaussians are split, smaller ones cloned. (2023)
        split_shrink: adc: divisor of the scales of the two children of a split. (2023)
        min_opacity: Gaussians below this opacity are pruned (2023) or relocated (2024).
        prune_scale: adc: fraction of the extent; larger Gaussians are pruned after the first opacity reset; 0 prunes
            none. (2023)
        prune_screen_size: adc: Gaussians with a larger half axis in an image, px, are pruned after the first opacity
            reset; 0 prunes none. (2023 has 20, but it never took effect there)
        reset_every: adc: iterations between opacity resets while densifying; 0 for none. (2023)
        reset_opacity: adc: upper bound of opacities after a reset. (2023)
        mcmc_stop: mcmc: `densify_stop` of this strategy. (2024's code)
        mcmc_start_opacity: mcmc: `start_opacity` of this strategy. (2024's code)
        mcmc_start_scale: mcmc: `start_scale` of this strategy. (2024's code)
        mcmc_growth: mcmc: growth factor of the number of Gaussians per densification, up to the cap. (2024, section
            4.3)
        mcmc_noise: mcmc: noise on the means, relative to their learning rate. (2024, section 4.1: lambda_noise)
        mcmc_opacity_weight: mcmc: weight of the mean opacity in the loss. (2024, eq. 10: lambda_o)
        mcmc_scale_weight: mcmc: weight of the mean scale in the loss. (2024, eq. 10: lambda_Sigma)

    Raises:
        ArgumentError: a value is outside its range; the message names it.
    """

    iterations: int = RECIPE_ITERATIONS
    seed: int = 0
    means_rate: float = 1.6e-4
    means_rate_final: float = 1.6e-6
    means_rate_iterations: int = 30_000
    quats_rate: float = 1e-3
    scales_rate: float = 5e-3
    sh0_rate: float = 2.5e-3
    sh_rest_rate: float = 2.5e-3 / 20
    opacities_rate: float = 5e-2
    adam_eps: float = 1e-15
    ssim_weight: float = 0.2
    sh_degree: int = SH_MAX_DEGREE
    sh_every: int = 1_000
    view_order: str = "shuffled"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    random_background: bool = False
    antialiased: bool = False
    jacobian_limit: float | None = 1.3
    start_opacity: float = 0.1
    start_scale: float = 1.0
    strategy: str = "adc"
    max_gaussians: int | None = None
    over_cap: str = "strongest"
    densify_start: int = 500
    densify_stop: int = 15_000
    densify_every: int = 100
    grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    split_shrink: float = 1.6
    min_opacity: float = 0.005
    prune_scale: float = 0.1
    prune_screen_size: float = 0.0
    reset_every: int = 3_000
    reset_opacity: float = 0.01
    mcmc_stop: int = 25_000
    mcmc_start_opacity: float = 0.5
    mcmc_start_scale: float = 0.1
    mcmc_growth: float = 1.05
    mcmc_noise: float = 5e5
    mcmc_opacity_weight: float = 0.01
    mcmc_scale_weight: float = 0.01

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("iterations", "means_rate_iterations", "densify_every"):
            whole_number(name, getattr(self, name), 1)
        for name in ("sh_every", "reset_every", "densify_start"):
            whole_number(name, getattr(self, name), 0)
        whole_number("seed", self.seed, 0, 2**63 - 1)
        whole_number("sh_degree", self.sh_degree, 0, SH_MAX_DEGREE)
        for name, strategy in (("densify_stop", "adc"), ("mcmc_stop", "mcmc")):
            whole_number(name, getattr(self, name), self.densify_start if strategy == self.strategy else 0)
        if self.max_gaussians is not None:
            whole_number("max_gaussians", self.max_gaussians, 1)
        for name in _NOT_NEGATIVE:
            in_range(name, getattr(self, name), 0.0)
        for name in ("ssim_weight", "min_opacity"):
            in_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("start_opacity", "mcmc_start_opacity", "reset_opacity"):
            in_range(name, getattr(self, name), 0.0, 1.0 - 1e-6, open_low=True)
        for name in ("start_scale", "mcmc_start_scale", "split_shrink", "adam_eps"):
            in_range(name, getattr(self, name), 0.0, open_low=True)
        in_range("mcmc_growth", self.mcmc_growth, 1.0)
        if self.jacobian_limit is not None:
            in_range("jacobian_limit", self.jacobian_limit, 1.0)
        float64_array("background", self.background, (3,))
        one_of("view_order", self.view_order, VIEW_ORDERS)
        one_of("strategy", self.strategy, STRATEGIES)
        one_of("over_cap", self.over_cap, OVER_CAP)

    @property
    def start(self) -> tuple[float, float]:
        """Opacity and scale factor of the start cloud, by strategy."""
        if self.strategy == "mcmc":
            return self.mcmc_start_opacity, self.mcmc_start_scale
        return self.start_opacity, self.start_scale

    @property
    def learning_rates(self) -> dict[str, float]:
        """Adam's rate of every raw parameter by name; that of the means before the extent and its schedule."""
        return {
            "means": self.means_rate,
            "quats": self.quats_rate,
            "log_scales": self.scales_rate,
            "sh0": self.sh0_rate,
            "sh_rest": self.sh_rest_rate,
            "logit_opacities": self.opacities_rate,
        }


_NOT_NEGATIVE = (
    "means_rate",
    "means_rate_final",
    "quats_rate",
    "scales_rate",
    "sh0_rate",
    "sh_rest_rate",
    "opacities_rate",
    "grad_threshold",
    "percent_dense",
    "prune_scale",
    "prune_screen_size",
    "mcmc_noise",
    "mcmc_opacity_weight",
    "mcmc_scale_weight",
)

ONLY_FOR = {
    "adc": (
        "over_cap",
        "densify_stop",
        "grad_threshold",
        "percent_dense",
        "split_shrink",
        "prune_scale",
        "prune_screen_size",
        "reset_every",
        "reset_opacity",
    ),
    "mcmc": (
        "mcmc_stop",
        "mcmc_start_opacity",
        "mcmc_start_scale",
        "mcmc_growth",
        "mcmc_noise",
        "mcmc_opacity_weight",
        "mcmc_scale_weight",
    ),
}
"""Fields that one strategy looks at and the others do not."""

MILESTONES = (
    "means_rate_iterations",
    "sh_every",
    "densify_start",
    "densify_stop",
    "mcmc_stop",
    "reset_every",
)
"""Fields that `recipe` stretches with the run; the interval of densification is not among them."""


def recipe(iterations: int = RECIPE_ITERATIONS, *, rescale: bool = True, **changes: Any) -> TrainConfig:  # noqa: ANN401
    """Make the configuration of a run of any length.

    Milestones keep their place relative to the length of the run: with 7,000 iterations densification ends at
    3,500 instead of 15,000. Runs under 3,000 iterations do not reset opacities.

    Args:
        iterations: Number of steps.
        rescale: Stretch the milestones; False keeps the plain numbers of 30,000 iterations.
        changes: Fields of `TrainConfig` that are set as they are.

    Raises:
        ArgumentError: a value is outside its range, or there is no such field.
    """
    whole_number("iterations", iterations, 1)
    for name in changes:
        one_of("field", name, [field.name for field in fields(TrainConfig)])
    plain = TrainConfig()
    stretched: dict[str, Any] = {}
    if rescale:
        for name in MILESTONES:
            stretched[name] = max(1, round(getattr(plain, name) * iterations / RECIPE_ITERATIONS))
    if iterations < SHORT_RUN:
        stretched["reset_every"] = 0
    return TrainConfig(**{"iterations": iterations, **stretched, **changes})
