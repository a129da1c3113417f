"""Write the settings of the recipe fast for the WebAssembly trainer, so that each is defined once.

    python tools/generate_recipe.py

They come from `gsplat_edu.train` and constants. It writes wasm/recipe.h, a structure whose numbers have the order of
`FIELDS`, and src/gsplat_edu/tab/web/recipe.js, their values for 30,000 iterations and which of them scale with the
length of a run. A test compares the files with this script's output.
"""

from __future__ import annotations

import re
from pathlib import Path

from gsplat_edu.base import constants
from gsplat_edu.train.capacity import LEAST_PLANNED, PLANNED, PLANNED_PIXELS, PLANNED_VIEWS, SEPARATE
from gsplat_edu.train.config import (
    FAST_DENSIFICATIONS,
    MILESTONES,
    RECIPE_ITERATIONS,
    TrainConfig,
    recipe,
)
from gsplat_edu.train.feed import SMALLEST_SIDE
from gsplat_edu.train.initialize import NEIGHBOURS, SMALLEST_DISTANCE, START_SCALE
from gsplat_edu.train.objective import FEW_VISIBLE

ROOT = Path(__file__).resolve().parent.parent
HEADER = ROOT / "wasm" / "recipe.h"
MODULE = ROOT / "src" / "gsplat_edu" / "tab" / "web" / "recipe.js"

FIELDS = (
    *("iterations", "seed", "max_gaussians"),
    *("means_rate", "means_rate_final", "means_rate_iterations"),
    *("quats_rate", "scales_rate", "sh0_rate", "sh_rest_rate", "opacities_rate", "adam_eps"),
    *("ssim_weight", "sh_degree", "sh_every", "jacobian_limit", "start_opacity", "start_scale"),
    *("densify_start", "densify_every", "min_opacity"),
    *(
        "fast_start_factor",
        "fast_full_size",
        "fast_stop",
        "fast_decay_start",
        "fast_decay",
        "fast_opacity_weight",
    ),
)
"""The settings that the trainer reads, by their flat names."""

CONSTANTS = {
    "SMALLEST_SIDE": SMALLEST_SIDE,
    "NEIGHBOURS": NEIGHBOURS,
    "SMALLEST_DISTANCE": SMALLEST_DISTANCE,
    "START_SCALE": START_SCALE,
    "FEW_VISIBLE": FEW_VISIBLE,
}
"""What the trainer knows besides."""


def header() -> str:
    """Return the text of the header."""
    lines = [
        "// Made by tools/generate_recipe.py from src/gsplat_edu/train. Do not edit.",
        "// clang-format off",
        "#pragma once",
        "",
        "namespace gsplat {",
        "",
        "// The settings of a training with the recipe fast; `gsplat_edu.train.config` says what they mean.",
        "struct Recipe {",
        *(f"    double {name};" for name in FIELDS),
        "    double background[3];",
        "};",
        "",
        *(f"constexpr double {name} = {value!r};" for name, value in CONSTANTS.items()),
    ]
    return "\n".join([*lines, "", "}  // namespace gsplat", ""])


def values() -> dict[str, float]:
    """Return the settings for 30,000 iterations, before anything is scaled; 0 for those that a run has to give."""
    flat = recipe(RECIPE_ITERATIONS, strategy="fast", max_gaussians=1).flat()
    given = {name: flat[name] for name in FIELDS}
    return given | {"max_gaussians": 0}


def module() -> str:
    """Return the text of the JavaScript module."""
    scaled = [name for name in FIELDS if name in MILESTONES]
    numbers = {
        "RECIPE_ITERATIONS": RECIPE_ITERATIONS,
        "FAST_DENSIFICATIONS": FAST_DENSIFICATIONS,
        "DENSIFY_EVERY": TrainConfig.densify_every,
        "PLANNED": PLANNED,
        "PLANNED_PIXELS": PLANNED_PIXELS,
        "PLANNED_VIEWS": PLANNED_VIEWS,
        "LEAST_PLANNED": LEAST_PLANNED,
        "SEPARATE": SEPARATE,
        "Z_NEAR": constants.Z_NEAR,
        "DILATION": constants.DILATION,
        "ALPHA_MAX": constants.ALPHA_MAX,
        "C0": constants.C0,
    }
    lines = [
        "// Made by tools/generate_recipe.py from src/gsplat_edu/train and base/constants.py. Do not edit.",
        "",
        *(f"export const {name} = {_written(value)};" for name, value in numbers.items()),
        "",
        "// The settings of the recipe fast for RECIPE_ITERATIONS, in the order in which the module reads them.",
        "export const RECIPE = {",
        *(f"  {name}: {_written(value)}," for name, value in values().items()),
        "};",
        "",
        "// Those that scale with the length of a run.",
        "export const MILESTONES = [",
        *(f'  "{name}",' for name in scaled),
        "];",
    ]
    return "\n".join([*lines, ""])


def _written(value: float) -> str:
    """Return a number as JavaScript's formatter writes it: 1.6e-5, not 1.6e-05."""
    return re.sub(r"e-0(\d)$", r"e-\1", repr(value))


if __name__ == "__main__":
    HEADER.write_text(header())
    MODULE.write_text(module())
