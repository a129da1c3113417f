"""Assignment 3: links of the chain of gradients, from a pixel back to a splat's parameters.

It follows chapters 08, 12 and 13.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_edu.grading.assignment import Answer, Part


def _alpha_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (
            *draws.normal(size=2),
            (draws.uniform(0.2, 0.6), draws.uniform(-0.2, 0.2), draws.uniform(0.2, 0.6)),
            0.7,
        )
        for _ in range(4)
    ]


def _alpha_gradient(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> Answer:
    A, B, C = conic
    alpha = opacity * np.exp(-0.5 * (A * dx * dx + 2 * B * dx * dy + C * dy * dy))
    return np.array([-alpha * (A * dx + B * dy), -alpha * (B * dx + C * dy)])


def _unmixed_gradient(dx: float, dy: float, conic: tuple[float, float, float], opacity: float) -> Answer:
    A, B, C = conic
    alpha = opacity * np.exp(-0.5 * (A * dx * dx + 2 * B * dx * dy + C * dy * dy))
    return np.array([-alpha * A * dx, -alpha * C * dy])


def _layer_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (draws.uniform(0.1, 0.9, n), draws.uniform(size=(n, 3)), draws.uniform(size=3), draws.normal(size=3))
        for n in (1, 4, 9)
    ]


def _layer_gradient(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray, g: np.ndarray) -> Answer:
    left = np.cumprod(np.concatenate([[1.0], 1 - alphas]))
    shown = left[:-1] * alphas * (colors @ g)
    behind = left[-1] * (background @ g) + np.cumsum(shown[::-1])[::-1] - shown
    return left[:-1] * (colors @ g) - behind / (1 - alphas)


def _own_light_only(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray, g: np.ndarray) -> Answer:
    left = np.cumprod(np.concatenate([[1.0], 1 - alphas]))
    return left[:-1] * (colors @ g)


def _undivided(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray, g: np.ndarray) -> Answer:
    own = _own_light_only(alphas, colors, background, g)
    return own + (_layer_gradient(alphas, colors, background, g) - own) * (1 - alphas)


def _matrix_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    cases = []
    for _ in range(4):
        half = draws.normal(size=(2, 2))
        cases.append((draws.normal(size=(2, 2)), half @ half.T + 0.3 * np.eye(2)))
    return cases


def _inverse_gradient(gradient: np.ndarray, cov: np.ndarray) -> Answer:
    inverse = np.linalg.inv(cov)
    return -inverse.T @ gradient @ inverse.T


def _unit_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [(draws.normal(size=4), draws.uniform(1.5, 3) * draws.normal(size=4)) for _ in range(4)]


def _unit_gradient(gradient: np.ndarray, quat: np.ndarray) -> Answer:
    length = np.linalg.norm(quat)
    unit = quat / length
    return (gradient - unit * (unit @ gradient)) / length


PARTS = (
    Part(
        "alpha_gradient",
        2,
        _alpha_cases,
        _alpha_gradient,
        {
            "the sign is wrong: alpha falls away from the centre": lambda dx, dy, conic, opacity: (
                -_alpha_gradient(dx, dy, conic, opacity)
            ),
            "the half of the exponent is left: the derivative of dx² / 2 is dx": lambda dx, dy, conic, opacity: (
                0.5 * _alpha_gradient(dx, dy, conic, opacity)
            ),
            "the mixed term, B dx dy, depends on both": _unmixed_gradient,
        },
    ),
    Part(
        "layer_gradient",
        4,
        _layer_cases,
        _layer_gradient,
        {
            "a layer also darkens what is behind it": _own_light_only,
            "the background is behind each layer, too": lambda alphas, colors, background, g: _layer_gradient(
                alphas, colors, np.zeros(3), g
            ),
            "what is behind a layer has its factor 1 - alpha in it; divide by that": _undivided,
        },
    ),
    Part(
        "inverse_gradient",
        2,
        _matrix_cases,
        _inverse_gradient,
        {
            "the sign is wrong: an inverse falls when the matrix grows": lambda gradient, cov: (
                -_inverse_gradient(gradient, cov)
            ),
            "the inverse belongs on both sides": lambda gradient, cov: -gradient @ np.linalg.inv(cov),
        },
    ),
    Part(
        "unit_gradient",
        2,
        _unit_cases,
        _unit_gradient,
        {
            "the part along the quaternion has to go: its length does not matter": lambda gradient, quat: (
                gradient / np.linalg.norm(quat)
            ),
            "it has to be divided by the quaternion's length": lambda gradient, quat: (
                _unit_gradient(gradient, quat) * np.linalg.norm(quat)
            ),
        },
    ),
)
"""The functions of the assignment: `alpha_gradient`, `layer_gradient`, `inverse_gradient` and `unit_gradient`."""
