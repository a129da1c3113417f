"""The settings of a training, each with its meaning and source.

The defaults are those of Kerbl et al. 2023's code ("2023" below), and of Kheradmand et al. 2024 for the strategy mcmc;
those of the strategy fast are ours. Iterations count from 0: "at iteration i" means with or after step i + 1.

`TrainConfig` holds the settings common to all runs; `AdcConfig`, `McmcConfig` and `FastConfig` hold those of one
strategy. The command line, config.json and docs/RECIPE.md use one flat list of them, `SETTINGS`, made from the fields'
metadata.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from gsplat_edu.base.constants import AUTO, SH_MAX_DEGREE
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import one_of, whole_number
from gsplat_edu.train.checks import (
    OneOf,
    Whole,
    accept_at_least_1 as _at_least_1,
    accept_cap as _cap,
    accept_color as _color,
    accept_flag as _flag,
    accept_fraction as _fraction,
    accept_not_negative as _not_negative,
    accept_opacity as _opacity,
    accept_positive as _positive,
)
from gsplat_edu.train.part import PLUGGED_PARTS, PLUGGED_STRATEGIES, default_settings
from gsplat_edu.train.setting import (
    ALPHA_BACKGROUNDS,
    ASKED,
    BY_DEFAULT,
    DEPTH_KINDS,
    LENGTH,
    OUTSIDE_MASKS,
    OWN_STRATEGIES,
    PHOTOS,
    PURPOSE,
    REGIONS,
    TRANSIENTS,
    Option,
    Plain,
    Setting as Setting,
)
from gsplat_edu.train.strategy_config import AdcConfig, FastConfig, McmcConfig, documented, number
from gsplat_edu.train.tempo import Tempo, accept_tempo as _tempo

RECIPE_ITERATIONS = 30_000
"""Length of the run for which the recipe's milestones are defined."""

SHORT_RUN = 3_000
"""Runs shorter than this do not reset opacities: there is no time to recover."""

STRATEGIES = (*OWN_STRATEGIES, "none", *PLUGGED_STRATEGIES)
VIEW_ORDERS = ("shuffled", "random")
APPEARANCES = ("none", "exposure", "vignetting")
SKIES = ("none", "shell")
REFINEMENTS = (
    *("none", "poses", "intrinsics", "both", "lens", "shutter"),
    *("poses+lens", "poses+shutter", "both+shutter", "lens+shutter", "all"),
)

FROM_SCENE = {"means_rate": 1.6e-5, "sh_every": 0}
"""Defaults of a run that starts from a trained scene. Its Gaussians are nearly in place, so the means' rate starts at
the geometric mean of the recipe's initial and final rates. Its harmonics are trained, so all of them are in use."""

FOR_FAST = {
    "means_rate_final": 1.6e-5,
    "quats_rate": 2e-3,
    "scales_rate": 1e-2,
    "sh0_rate": 5e-3,
    "sh_rest_rate": 5e-3 / 8,
    "opacities_rate": 0.1,
    "sh_every": 3_000,
    "min_opacity": 0.02,
}
"""What differs for the strategy fast in 30,000 iterations: its runs are short, so steps are larger."""

FAST_DENSIFICATIONS = 20
"""The recipe fast densifies at least this often: a Gaussian has two children, and few points have to become many."""

DEFAULT_STRATEGY = "fast"
"""Default of `gsplat-edu train`. `TrainConfig` itself defaults to adc, since fast needs a cap."""

FAST_FROM_SCENE = {"fast_start_factor": 1.0}
"""Further default of a fast run that starts from a scene: small photos would undo its detail."""


@documented
@dataclass(frozen=True)
class TrainConfig:
    """One training run; see `recipe` for runs of other lengths than 30,000 iterations.

    `adc`, `mcmc` and `fast` hold the settings of the strategies; only those of `strategy` are used. A value out of
    range raises an `ArgumentError` that names it.
    """

    iterations: int = number(
        RECIPE_ITERATIONS,
        Whole(1),
        "Number of images to train on; a step renders `batch` of them.",
        "2023",
        option=Option(
            plain=Plain("Iterations instead of a quality", group=LENGTH, again="Train longer"), common=True
        ),
    )
    batch: int = number(
        1, Whole(1, 4096), "Views of a step; rates grow with its root.", "Zhao et al. 2024", option=Option()
    )
    tempo: str = number(
        "",
        _tempo,
        "How a run with a time limit stretched its schedule: iterations of the recipe, then FROM:END for each change.",
        "ours",
    )
    seed: int = number(
        0,
        Whole(0),
        "Seed of the view order, splits, relocations, noise, and of the choice of start points over the cap.",
        option=Option(common=True),
        in_trials=True,
    )
    means_rate: float = number(
        1.6e-4, _not_negative, "Initial learning rate of the means, times the scene's extent.", "2023"
    )
    means_rate_final: float = number(
        1.6e-6, _not_negative, "Final learning rate of the means; log-linear between, then constant.", "2023"
    )
    means_rate_iterations: int = number(
        30_000,
        Whole(1),
        "Iteration at which the learning rate of the means is final.",
        "2023",
        milestone=True,
    )
    quats_rate: float = number(1e-3, _not_negative, "Learning rate of the quaternions.", "2023")
    scales_rate: float = number(5e-3, _not_negative, "Learning rate of the log scales.", "2023")
    sh0_rate: float = number(2.5e-3, _not_negative, "Learning rate of the degree-0 harmonic.", "2023")
    sh_rest_rate: float = number(
        2.5e-3 / 20,
        _not_negative,
        "Learning rate of the higher harmonics: a twentieth of that of degree 0.",
        "2023",
    )
    opacities_rate: float = number(
        5e-2, _not_negative, "Learning rate of the logit opacities.", "2023; newer forks use 0.025"
    )
    adam_eps: float = number(
        1e-15, _positive, "Adam's epsilon, the floor under the root of its second moment.", "2023"
    )
    ssim_weight: float = number(0.2, _fraction, "k of the loss (1 - k) L1 + k (1 - SSIM).", "2023, eq. 7")
    sh_degree: int = number(
        SH_MAX_DEGREE,
        Whole(0, SH_MAX_DEGREE),
        "Highest degree of spherical harmonics.",
        "2023",
        option=Option(),
        in_trials=True,
    )
    sh_every: int = number(
        1_000,
        Whole(0),
        "Iterations between increases of the degree in use; 0 uses all degrees from the start.",
        "2023",
        milestone=True,
    )
    view_order: str = number(
        "shuffled",
        OneOf(VIEW_ORDERS),
        '"shuffled" shows each view once before any is repeated; "random" draws with replacement.',
        "2023",
        only="course",
    )
    appearance: str = number(
        "none",
        OneOf(APPEARANCES),
        '"exposure": measure the exposure and white balance of each photo while training, and correct the render by'
        ' them before it is compared; "vignetting": also its vignetting; "none": compare the render itself.',
        "ours",
        option=Option(
            auto=BY_DEFAULT,
            plain=Plain(
                "Brightness",
                {
                    "": "decide from the photos",
                    "exposure": "even out brightness and colour",
                    "vignetting": "even out dark corners too",
                    "none": "keep as photographed",
                },
                PHOTOS,
                again="Train with exposure correction",
            ),
            common=True,
        ),
        in_trials=True,
    )
    sky: str = number(
        "none",
        OneOf(SKIES),
        '"shell": start with far splats wherever photos show the sky; "none": without.',
        only="start",
        option=Option(
            auto=BY_DEFAULT,
            plain=Plain(
                "Sky",
                {
                    "": "decide from the photos",
                    "shell": "put it far away",
                    "none": "treat it like the rest",
                },
                PHOTOS,
                again="Train with a sky",
            ),
            common=True,
        ),
    )
    refine: str = number(
        "none",
        OneOf(REFINEMENTS),
        "Which numbers of the cameras are learned with the scene: poses; intrinsics; both; the lens, which is the"
        " intrinsics and the distortion; the motion during the readout of a rolling shutter; several of these, such as"
        " poses+lens; all; or none.",
        option=Option(
            auto=ASKED,
            plain=Plain(
                "Camera positions",
                {
                    "": "as placed",
                    AUTO: "refine what makes held-out photos match better",
                    "poses": "refine positions and directions",
                    "both": "refine positions, directions and focal lengths",
                    "all": "refine them and the lenses, too",
                },
                PHOTOS,
                again="Train and refine the camera positions",
            ),
            instead_in_blocks="refine the cameras of the whole first, with --resolution",
        ),
        in_trials=True,
    )
    transients: str = number(
        "none",
        OneOf(TRANSIENTS),
        '"mask": find and mask what only single photos show, such as passers-by; "none": use all pixels.',
        option=Option(
            auto=ASKED,
            plain=Plain(
                "What moved between the photos",
                {"": "keep it", "mask": "leave it out", AUTO: "leave it out if there are enough photos"},
                PHOTOS,
                again="Train and mask what moved",
            ),
        ),
    )
    outside_masks: str = number(
        "ignore",
        OneOf(OUTSIDE_MASKS),
        'What the scene shows where masks exclude pixels. "ignore": anything; "empty": nothing, as around an object.',
        option=Option(
            auto=BY_DEFAULT,
            plain=Plain(
                "Outside of the photos' masks",
                {
                    "": "decide from the masks",
                    "empty": "empty: the masks cut out an object",
                    "ignore": "ignore: the masks hide something in front",
                },
                PHOTOS,
                again="Train with the other choice for masks",
            ),
        ),
        in_trials=True,
    )
    pose_spread: float = number(
        1e-2,
        _positive,
        "How far off the given poses are expected to be, radians and fractions of the extent: where photos say little,"
        " they hold.",
        in_trials=True,
    )
    lens_rate: float = number(
        2e-4,
        _not_negative,
        "Initial learning rate of the intrinsics, relative; it falls to a hundredth.",
        in_trials=True,
    )
    region: str = number(
        "capture",
        OneOf(REGIONS),
        'Which pixels count. "capture": those that may show the box of the capture\'s region.json, if it has one;'
        ' "none": all.',
    )
    background: tuple[float, float, float] = number(
        (0.0, 0.0, 0.0),
        _color,
        "Background colour, RGB, 0 to 1; photos with alpha are laid on it, and the scene learns it.",
        "2023",
        option=Option(),
        in_trials=True,
    )
    random_background: bool = number(
        False, _flag, "Draw a new background colour for every iteration.", option=Option()
    )
    alpha_background: str = number(
        "random",
        OneOf(ALPHA_BACKGROUNDS),
        'What lies behind photos with alpha. "random": a new colour for every iteration, so that the scene is as'
        ' transparent as the photos; "fixed": the background.',
    )
    antialiased: bool = number(
        False,
        _flag,
        "Train for antialiased rendering: Mip-Splatting's opacity factor.",
        "Yu et al. 2024",
        option=Option(),
        in_trials=True,
    )
    jacobian_limit: float | None = number(
        1.3,
        _at_least_1,
        "Clamp of the projection's Jacobian, in half fields of view; none clamps nothing.",
        "2023's code",
        in_trials=True,
    )
    start_opacity: float = number(0.1, _opacity, "Opacity of the initial Gaussians.", "2023", only="start")
    start_scale: float = number(
        1.0,
        _positive,
        "Factor on the initial scales, which are the root mean squared distance to 3 neighbours.",
        "2023",
        only="start",
    )
    strategy: str = number(
        "adc",
        OneOf(STRATEGIES),
        '"adc": clone, split, prune, reset; "mcmc": relocate, grow, add noise; "fast": small photos first, split by'
        ' score up to a planned number; "none" keeps the number of Gaussians.',
        option=Option(
            plain=Plain(
                "Recipe",
                {
                    "": "the fast one",
                    "mcmc": "MCMC: random moves, needs a number of splats",
                    "adc": "the one of 2023, 30,000 iterations",
                },
                LENGTH,
            ),
            common=True,
        ),
    )
    max_gaussians: int | None = number(
        None,
        _cap,
        "Cap on the number of Gaussians; mcmc and fast require one.",
        option=Option(
            plain=Plain("Splats at most", group=LENGTH, again="Train with {value} splats at most"),
            common=True,
        ),
    )
    densify_start: int = number(
        500, Whole(0), "Density control begins after this iteration.", "2023, 2024", milestone=True
    )
    densify_every: int = number(
        100,
        Whole(1),
        "Density control runs at the multiples of this, so first at 600; never scaled, except for short fast runs.",
        "2023, 2024",
    )
    min_opacity: float = number(
        0.005,
        _fraction,
        "adc and fast prune Gaussians below this opacity, mcmc relocates them.",
        "2023, 2024",
    )
    surface: bool = number(
        False,
        _flag,
        "Learn a surface, for meshes: normals and neighbouring photos agree with the depth, and Gaussians are flat. It"
        " takes 2.2 to 2.8 times as long and costs about 0.3 dB of PSNR, 1 dB on the object.",
        option=Option(
            plain=Plain("Purpose", {"": "to look at", "true": "for a mesh: learn surfaces"}, PURPOSE),
            common=True,
        ),
    )
    surface_start: int = number(
        9_000,
        Whole(0),
        "Iteration from which `surface` learns from normals, flatness and patches.",
        "ours",
        milestone=True,
        only="surface",
    )
    surface_every: int = number(
        4,
        Whole(1),
        "`surface` acts in every n-th step, with n times its weights.",
        "ours",
        only="surface",
    )
    normal_weight: float = number(
        0.03,
        _not_negative,
        "Weight of the distance between normals and those of the depth.",
        "2DGS",
        only="surface",
    )
    patch_weight: float = number(
        0.05,
        _not_negative,
        "Weight of patches that differ from a neighbouring photo's; 0: no patches.",
        "ours",
        only="surface",
    )
    flat_weight: float = number(
        0.01,
        _not_negative,
        "Weight of the mean smallest scale, as a fraction of the extent.",
        "ours",
        only="surface",
    )
    depth_kind: str = number(
        "auto",
        OneOf(DEPTH_KINDS),
        'Values of the maps of --depth. "z": camera depth; "ray": length of the ray; "auto": one of these, by the'
        ' points that photos see; "inverse": a network\'s inverse depth, with a scale and a shift for each photo.',
        only="depth",
    )
    depth_unit: float = number(
        0.0,
        _not_negative,
        "World units for a unit of the maps of --depth; 0 finds it from the points.",
        "ours",
        only="depth",
    )
    depth_weight: float = number(
        0.1,
        _not_negative,
        "Weight of the relative difference from the depth of maps.",
        "ours",
        only="depth",
    )
    points_weight: float = number(
        0.01,
        _not_negative,
        "Weight of the difference of 1 / z from that of points, times the extent.",
        "gsplat",
        only="depth",
    )
    depth_every: int = number(
        2,
        Whole(1),
        "Depth is compared in every n-th step, with n times its weight.",
        "ours",
        only="depth",
    )
    adc: AdcConfig = dataclasses.field(default=AdcConfig())
    mcmc: McmcConfig = dataclasses.field(default=McmcConfig())
    fast: FastConfig = dataclasses.field(default=FastConfig())
    plugged: Mapping[str, Any] = dataclasses.field(default_factory=default_settings, hash=False)

    def __post_init__(self) -> None:
        """Check the ranges."""
        values = self.flat()
        for setting in SETTINGS:
            setting.check(setting.name, values[setting.name])
        stop = {"adc": "densify_stop", "mcmc": "mcmc_stop", "fast": "fast_stop"}.get(self.strategy)
        if stop is not None:
            whole_number(stop, values[stop], self.densify_start)
        if over := self.iterations % self.batch:
            told = f"is {self.iterations}, but has to be a multiple of batch = {self.batch}"
            raise ArgumentError(f"iterations: {told}, for example {self.iterations - over + self.batch}")

    def flat(self) -> dict[str, Any]:
        """Return every setting by its flat name, in the order of `SETTINGS`; config.json holds this."""
        return {setting.name: getattr(self._holder(setting), setting.attribute) for setting in SETTINGS}

    def record(self) -> dict[str, Any]:
        """Return `flat` for config.json: settings of plug-ins only where they differ from their defaults."""
        return {
            name: value
            for name, value in self.flat().items()
            if BY_NAME[name].plugin is None or value != BY_NAME[name].default
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> TrainConfig:
        """Return the configuration that `record` returned and JSON kept, which has lists for tuples.

        Raises:
            ArgumentError: a value is out of range, or a setting is unknown.
            TypeError: a value has the wrong type.
        """
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}
        return cls().changed(**values)

    @property
    def plugins(self) -> tuple[str, ...]:
        """The plug-ins that the training uses: its strategy, and parts whose settings differ from their defaults."""
        changed = (BY_NAME[name].plugin for name in self.record())
        used = (*changed, self.strategy if self.strategy in PLUGGED_STRATEGIES else None)
        return tuple(dict.fromkeys(name for name in used if name is not None))

    def settings_of(self, part: str) -> Any:  # noqa: ANN401
        """Return the settings of a part: those of a plug-in, or all, which have those of ours."""
        return self.plugged.get(part, self)

    def _holder(self, setting: Setting) -> Any:  # noqa: ANN401
        """Return the object with a setting."""
        if setting.plugin is not None:
            return self.plugged[setting.plugin]
        return self if setting.strategy is None else getattr(self, setting.strategy)

    def changed(self, **changes: Any) -> TrainConfig:  # noqa: ANN401
        """Return a copy with some settings changed, given by their flat names.

        Raises:
            ArgumentError: a value is out of range, or a setting is unknown.
        """
        parts: dict[str | None, dict[str, Any]] = {None: {}}
        for name, value in changes.items():
            one_of("field", name, list(BY_NAME))
            setting = BY_NAME[name]
            parts.setdefault(setting.plugin or setting.strategy, {})[setting.attribute] = value
        own = {
            name: dataclasses.replace(getattr(self, name), **parts.get(name, {})) for name in OWN_STRATEGIES
        }
        plugged = {
            name: dataclasses.replace(settings, **parts.get(name, {}))
            for name, settings in self.plugged.items()
        }
        return dataclasses.replace(self, **own, plugged=plugged, **parts[None])

    @property
    def start(self) -> tuple[float, float]:
        """Opacity and scale factor of the initial Gaussians for the strategy."""
        if self.strategy == "mcmc":
            return self.mcmc.start_opacity, self.mcmc.start_scale
        return self.start_opacity, self.start_scale

    @property
    def corrects_colors(self) -> bool:
        """Whether an image gets the exposure of its photo before they are compared."""
        return self.appearance != "none"

    @property
    def learning_rates(self) -> dict[str, float]:
        """Adam's rate of every raw parameter by name; for the means, the initial rate without the extent."""
        return {
            "means": self.means_rate,
            "quats": self.quats_rate,
            "log_scales": self.scales_rate,
            "sh0": self.sh0_rate,
            "sh_rest": self.sh_rest_rate,
            "logit_opacities": self.opacities_rate,
        }


def _settings(kind: type, strategy: str | None, prefix: str = "", part: str | None = None) -> list[Setting]:
    return [
        Setting(f"{prefix}{field.name}", field.name, strategy, part, field.default, **field.metadata)
        for field in fields(kind)
        if field.metadata
    ]


SETTINGS: tuple[Setting, ...] = (
    *_settings(TrainConfig, None),
    *_settings(AdcConfig, "adc"),
    *_settings(McmcConfig, "mcmc", "mcmc_"),
    *_settings(FastConfig, "fast", "fast_"),
    *(
        one
        for name, part in PLUGGED_PARTS.items()
        for one in _settings(part.Settings, None, f"{name}_", name)
    ),
    *(one for name, kind in PLUGGED_STRATEGIES.items() for one in _settings(kind.Settings, name, f"{name}_")),
)
"""All settings of a training, those of plug-ins last."""

BY_NAME = {setting.name: setting for setting in SETTINGS}

WITH_OPTION = {setting.name: setting.option for setting in SETTINGS if setting.option is not None}
"""The options of the settings that `gsplat-edu train` has one for, by name."""

SETTABLE = {setting.name: setting for setting in SETTINGS if setting.settable}
"""The settings that `gsplat-edu train --set` gives, by name."""

ONLY_FOR = {
    strategy: tuple(setting.name for setting in SETTINGS if setting.strategy == strategy)
    for strategy in (*OWN_STRATEGIES, *PLUGGED_STRATEGIES)
}
"""Settings that only one strategy uses."""

ONLY_WITH = {
    option: tuple(setting.name for setting in SETTINGS if setting.only == option)
    for option in dict.fromkeys(setting.only for setting in SETTINGS)
    if option not in ("", "start", "course")
}
"""Settings that only a training with an option uses, for example with `surface`, by the option's name."""

FOR_START = tuple(setting.name for setting in SETTINGS if setting.only == "start")
"""Settings that only a start from points uses."""

MILESTONES = tuple(setting.name for setting in SETTINGS if setting.milestone)
"""Settings that `recipe` scales with the length of the run; the densification interval is not one of them."""


def recipe(iterations: int = RECIPE_ITERATIONS, *, rescale: bool = True, **changes: Any) -> TrainConfig:  # noqa: ANN401
    """Make the configuration of a run of any length.

    Milestones scale with the length of the run: with 7,000 iterations densification ends at 3,500 instead of 15,000.
    Runs under 3,000 iterations do not reset opacities. Fast runs under 2,000 densify every 20th of the run. A `tempo`
    names the length that milestones scale with.

    Args:
        iterations: Number of steps.
        rescale: Scale the milestones; False keeps the values for 30,000 iterations.
        changes: Settings by their flat names; they are not scaled.

    Raises:
        ArgumentError: a value is out of range, or a setting is unknown.
    """
    whole_number("iterations", iterations, 1)
    length = Tempo.parsed(changes.get("tempo", ""), iterations).length
    scaled: dict[str, Any] = dict(FOR_FAST) if changes.get("strategy") == "fast" else {}
    if rescale and scaled:
        scaled["densify_every"] = min(max(length // FAST_DENSIFICATIONS, 1), TrainConfig.densify_every)
    if rescale:
        for setting in SETTINGS:
            if setting.milestone:
                full = scaled.get(setting.name, setting.default)
                scaled[setting.name] = max(1, round(full * length / RECIPE_ITERATIONS))
    if length < SHORT_RUN:
        scaled["reset_every"] = 0
    return TrainConfig().changed(**{"iterations": iterations, **scaled, **changes})


def short_config(config: TrainConfig, iterations: int, **changes: Any) -> TrainConfig:  # noqa: ANN401
    """Return the configuration of a short training: the recipe fast with a run's settings that change the image.

    Args:
        config: The run's configuration.
        iterations: Number of steps.
        changes: Settings that differ from the run's, by their flat names.
    """
    values = config.flat()
    kept = {setting.name: values[setting.name] for setting in SETTINGS if setting.in_trials}
    return recipe(iterations, **{"strategy": "fast", **kept, **changes})


def stretched(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return a configuration whose milestones are moved in proportion to a new number of iterations.

    Args:
        config: The configuration, for a run without a tempo.
        iterations: New number of iterations, a multiple of the batch.

    Raises:
        ArgumentError: the number is out of range.
    """
    whole_number("iterations", iterations, 1)
    values = config.flat()
    moved = {
        name: max(round(values[name] * iterations / config.iterations), 1)
        for name in MILESTONES
        if values[name]
    }
    return config.changed(iterations=iterations, **moved)
