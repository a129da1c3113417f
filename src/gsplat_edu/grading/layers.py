"""Assignment 2: opacities of layers, their order, and the colour of a pixel.

It follows chapters 02 and 05.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN
from gsplat_edu.grading.assignment import Answer, Part


def _alpha_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    drawn = [
        (
            *draws.normal(size=2),
            (draws.uniform(0.2, 0.6), draws.uniform(-0.2, 0.2), draws.uniform(0.2, 0.6)),
            0.7,
        )
        for _ in range(4)
    ]
    steep = (3.0, 0.1, 3.0)
    return [*drawn, (0.0, 0.0, steep, 1.0), (2.0 + draws.uniform(), 1.0, steep, 0.9)]  # the clamp, the floor


def _unclamped(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> float:
    A, B, C = conic
    return float(opacity * np.exp(-0.5 * (A * dx * dx + 2 * B * dx * dy + C * dy * dy)))


def _alpha(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> float:
    value = min(_unclamped(dx, dy, conic, opacity), ALPHA_MAX)
    return value if value >= ALPHA_MIN else 0.0


def _without_floor(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> float:
    return min(_unclamped(dx, dy, conic, opacity), ALPHA_MAX)


def _without_clamp(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> float:
    value = _unclamped(dx, dy, conic, opacity)
    return value if value >= ALPHA_MIN else 0.0


def _half_mixed(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> float:
    A, B, C = conic
    return _alpha(dx, dy, (A, B / 2, C), opacity)


def _order_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [(draws.permutation(n) + 0.5,) for n in (5, 9, 20)] + [
        (np.array([2.0, 1.0, 2.0, 1.0, 2.0] * 100),)
    ]


def _composite_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [(draws.uniform(0, 0.9, n), draws.uniform(size=(n, 3)), draws.uniform(size=3)) for n in (1, 3, 8)]


def _composite(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray) -> Answer:
    left = np.cumprod(np.concatenate([[1.0], 1 - np.asarray(alphas)]))
    return (left[:-1] * alphas) @ colors + left[-1] * np.asarray(background)


def _unweighted(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray) -> Answer:
    return alphas @ colors + np.prod(1 - alphas) * background


def _lit_background(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray) -> Answer:
    return _composite(alphas, colors, np.zeros(3)) + background


PARTS = (
    Part(
        "alpha",
        3,
        _alpha_cases,
        _alpha,
        {
            f"alphas are not limited to {ALPHA_MAX}": _without_clamp,
            "alphas below 1/255 have to be 0": _without_floor,
            "the mixed term counts twice: 2 B dx dy": _half_mixed,
            "alphas have neither the limit of 0.99 nor the floor of 1/255": _unclamped,
        },
    ),
    Part(
        "order",
        2,
        _order_cases,
        lambda depths: np.argsort(depths, kind="stable"),
        {
            "the order is from far to near": lambda depths: np.argsort(-depths, kind="stable"),
            "these are the ranks of the splats, not their indices in order": lambda depths: np.argsort(
                np.argsort(depths, kind="stable")
            ),
            "splats of equal depth have to stay in their order": lambda depths: (
                len(depths) - 1 - np.argsort(depths[::-1], kind="stable")
            ),
        },
    ),
    Part(
        "composite",
        5,
        _composite_cases,
        _composite,
        {
            "the layers are taken from far to near": lambda alphas, colors, background: _composite(
                alphas[::-1], colors[::-1], background
            ),
            "the background has to be weighted by the light that is left": _lit_background,
            "the background is missing": lambda alphas, colors, background: _composite(
                alphas, colors, np.zeros(3)
            ),
            "each layer has to be weighted by the light that those in front of it leave": _unweighted,
        },
    ),
)
"""The functions of the assignment: `alpha`, `order` and `composite`."""
