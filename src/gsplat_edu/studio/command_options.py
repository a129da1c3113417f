"""The options that a request may give each command, and how their values become words of its command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.quantities import bytes_of, seconds_of
from gsplat_edu.base.text import option_flag, shortened
from gsplat_edu.data.settings import LENS_MODES
from gsplat_edu.scene.given_depth import CAPTURE_AS_DEPTH, POINTS_AS_DEPTH
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.sfm.options import CAMERA_MODELS, MAPPERS, MATCHERS, PANORAMA
from gsplat_edu.sfm.scale_text import check_scale
from gsplat_edu.train.config import APPEARANCES, REFINEMENTS, SETTABLE, SKIES, STRATEGIES
from gsplat_edu.train.length import QUALITIES
from gsplat_edu.train.setting import OUTSIDE_MASKS, TRANSIENTS

LONGEST_TEXT = 200
"""Characters of an option's text."""

Words = list[str]
Option = Callable[[str, Any], Words]
"""Turns name and value of an option into words of the command line."""


def _choice(*values: str) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if value not in values:
            raise RefusedError(f"{name}: is {str(value)[:40]!r}, but has to be one of {', '.join(values)}")
        return [option_flag(name), str(value)]

    return words


def _whole(least: int, most: int) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if type(value) is not int or not least <= value <= most:
            raise RefusedError(
                f"{name}: is {str(value)[:40]}, but has to be a whole number from {least} to {most}"
            )
        return [option_flag(name), str(value)]

    return words


def _number(least: float, most: float) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if type(value) not in (int, float) or not least <= value <= most:  # NaN is not either
            raise RefusedError(
                f"{name}: is {str(value)[:40]}, but has to be a number from {least:g} to {most:g}"
            )
        return [option_flag(name), f"{value:g}" if value == float(f"{value:g}") else repr(value)]

    return words


def _word_or(word: str, number: Option) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        return [option_flag(name), word] if value == word else number(name, value)

    return words


def _switch(name: str, value: Any) -> Words:  # noqa: ANN401
    if not isinstance(value, bool):
        raise RefusedError(f"{name}: is {str(value)[:40]}, but has to be true or false")
    return [option_flag(name)] if value else []


def _text(name: str, value: Any) -> Words:  # noqa: ANN401
    """Pass a short text on; the command checks it."""
    if (
        not isinstance(value, str)
        or not value
        or len(value) > LONGEST_TEXT
        or not value.isprintable()
        or value[0] == "-"
    ):
        raise RefusedError(f"{name}: has to be a short text that does not begin with a dash")
    return [option_flag(name), value]


def _parsed(check: Callable[[str], object]) -> Option:
    """Return an option whose text the command's own parser accepts."""

    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        found = _text(name, value)
        try:
            check(value)
        except RefusedError:
            raise
        except ArgumentError as error:
            raise RefusedError(f"{name}: {error}") from None
        return found

    return words


def _set(name: str, value: Any) -> Words:  # noqa: ANN401
    """Pass settings of the recipe on, given as an object of names and numbers or words."""
    if not isinstance(value, dict):
        raise RefusedError(f'{name}: has to be an object, for example {{"sh_every": 300}}')
    words: Words = []
    for setting, given in value.items():
        if setting not in SETTABLE:
            raise RefusedError(
                f"{name}.{shortened(str(setting))}: is not a setting; docs/RECIPE.md lists them"
            )
        if (
            type(given) not in (int, float, str)
            or not str(given).isprintable()
            or len(str(given)) > LONGEST_TEXT
        ):
            raise RefusedError(f"{name}.{setting}: has to be a number or a short word")
        words += [option_flag(name), f"{setting}={given}"]
    return words


SFM_OPTIONS: Mapping[str, Option] = {
    "frames": _whole(3, 5_000),
    "matcher": _choice(*MATCHERS),
    "mapper": _choice(*MAPPERS),
    "camera_model": _choice(*CAMERA_MODELS),
    "panorama": _choice(*PANORAMA),
    "scale": _parsed(check_scale),
    "max_features": _whole(100, 100_000),
    "max_image_size": _whole(64, 20_000),
    "threads": _whole(0, 1_024),
}

TRAIN_OPTIONS: Mapping[str, Option] = {
    "quality": _choice(*QUALITIES),
    "iterations": _whole(1, 1_000_000),
    "time_limit": _parsed(seconds_of),
    "max_memory": _parsed(bytes_of),
    "max_gaussians": _whole(1, 100_000_000),
    "strategy": _choice(*STRATEGIES),
    "resolution": _word_or(AUTO, _number(0.1, 100_000.0)),
    "test_every": _whole(0, 100_000),
    "appearance": _choice("auto", *APPEARANCES),
    "sky": _choice("auto", *SKIES),
    "transients": _choice("auto", *TRANSIENTS),
    "refine": _choice("auto", *REFINEMENTS),
    "lens": _choice(*LENS_MODES),
    "outside_masks": _choice("auto", *OUTSIDE_MASKS),
    "panorama": _choice(*PANORAMA),
    "scale": _parsed(check_scale),
    "seed": _whole(0, 2**31 - 1),
    "batch": _whole(1, 1_024),
    "sh_degree": _whole(0, 3),
    "eval_every": _whole(0, 1_000_000),
    "save_every": _whole(0, 1_000_000),
    "antialiased": _switch,
    "surface": _switch,
    "depth": _choice(POINTS_AS_DEPTH, CAPTURE_AS_DEPTH),
    "white_background": _switch,
    "random_background": _switch,
    "set": _set,
    "clean": _switch,
    "resume": _switch,
}

DOCTOR_OPTIONS: Mapping[str, Option] = {"resolution": _number(0.1, 100_000.0)}

CLEAN_OPTIONS: Mapping[str, Option] = {"max_loss": _number(0.0, 100.0)}

MESH_OPTIONS: Mapping[str, Option] = {
    "voxel": _number(1e-6, 1e6),
    "faces": _whole(4, 10_000_000),
    "keep": _choice("large", "largest", "all"),
    "max_memory": _parsed(bytes_of),
    "texture": _switch,
}

CONVERT_OPTIONS: Mapping[str, Option] = {
    "sh_degree": _whole(0, 3),
    "min_opacity": _number(0.0, 1.0),
    "verify": _choice("photos"),
}

RENDER_OPTIONS: Mapping[str, Option] = {
    "frames": _whole(1, 100_000),
    "size": _whole(16, 8_192),
    "fps": _whole(1, 240),
    "orbit": _switch,
    "white_background": _switch,
}
