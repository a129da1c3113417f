"""Assignment 5: which Gaussians are cloned, split and pruned, and what becomes of them.

It follows chapters 09 and 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_edu.grading.assignment import Answer, Part
from gsplat_edu.scene.gaussian_math import quat_to_R
from gsplat_edu.train.config import TrainConfig

KEEP, CLONE, SPLIT, PRUNE = range(4)

PAPER = TrainConfig(strategy="adc")
"""The settings of Kerbl et al. 2023."""


def _signal_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    cases = []
    for views, count in ((3, 2), (8, 6)):
        seen = draws.uniform(size=(views, count)) < 0.6
        seen[0] = True
        seen[1, 0] = False
        cases.append((draws.normal(size=(views, count, 2)) * seen[..., None], seen))
    return cases


def _signal(gradients: np.ndarray, seen: np.ndarray) -> Answer:
    return np.linalg.norm(gradients, axis=-1).sum(axis=0) / seen.sum(axis=0)


def _length_of_mean(gradients: np.ndarray, seen: np.ndarray) -> Answer:
    return np.linalg.norm(gradients.sum(axis=0), axis=-1) / seen.sum(axis=0)


def _decision_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    extent = draws.uniform(2, 4)
    small = PAPER.adc.percent_dense * extent
    return [
        (
            draws.uniform(0, 2, 24) * PAPER.adc.grad_threshold,
            small * 10.0 ** draws.uniform(-1, 1, (24, 3)),
            draws.choice([0.001, 0.004, 0.1, 0.9], 24),
            extent,
        )
        for _ in range(3)
    ]


def _decision(signal: np.ndarray, scales: np.ndarray, opacities: np.ndarray, extent: float) -> Answer:
    large = scales.max(axis=1) > PAPER.adc.percent_dense * extent
    grows = signal > PAPER.adc.grad_threshold
    chosen = np.where(grows, np.where(large, SPLIT, CLONE), KEEP)
    return np.where(opacities < PAPER.min_opacity, PRUNE, chosen)


def _small_split(signal: np.ndarray, scales: np.ndarray, opacities: np.ndarray, extent: float) -> Answer:
    chosen = _decision(signal, scales, opacities, extent)
    return np.select([chosen == CLONE, chosen == SPLIT], [SPLIT, CLONE], chosen)


def _mean_scale(signal: np.ndarray, scales: np.ndarray, opacities: np.ndarray, extent: float) -> Answer:
    return _decision(signal, scales.mean(axis=1, keepdims=True), opacities, extent)


def _grown_first(signal: np.ndarray, scales: np.ndarray, opacities: np.ndarray, extent: float) -> Answer:
    grown = _decision(signal, scales, np.ones_like(opacities), extent)
    return np.where((grown == KEEP) & (opacities < PAPER.min_opacity), PRUNE, grown)


def _without_extent(signal: np.ndarray, scales: np.ndarray, opacities: np.ndarray, extent: float) -> Answer:
    return _decision(signal, scales, opacities, 1.0)


def _split_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (
            draws.normal(size=3),
            quat_to_R(draws.normal(size=4)),
            draws.uniform(0.1, 2, 3),
            draws.normal(size=(2, 3)),
        )
        for _ in range(4)
    ]


def _split(
    mean: np.ndarray, R: np.ndarray, scales: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return mean + (noise * scales) @ R.T, scales / PAPER.adc.split_shrink


def _narrow_split(mean: np.ndarray, R: np.ndarray, scales: np.ndarray, noise: np.ndarray) -> Answer:
    return mean + noise @ R.T, scales / PAPER.adc.split_shrink


def _unturned_split(mean: np.ndarray, R: np.ndarray, scales: np.ndarray, noise: np.ndarray) -> Answer:
    return mean + noise * scales, scales / PAPER.adc.split_shrink


def _large_split(mean: np.ndarray, R: np.ndarray, scales: np.ndarray, noise: np.ndarray) -> Answer:
    return _split(mean, R, scales, noise)[0], scales


PARTS = (
    Part(
        "signal",
        2,
        _signal_cases,
        _signal,
        {
            "opposite pulls must not cancel: take the mean of the lengths, not the length of the mean": _length_of_mean,
            "the mean is over the views that see the Gaussian": lambda gradients, seen: _signal(
                gradients, np.ones_like(seen)
            ),
            "this is the sum over the views; divide by how many see the Gaussian": lambda gradients, seen: (
                _signal(gradients, seen) * seen.sum(axis=0)
            ),
        },
    ),
    Part(
        "decision",
        3,
        _decision_cases,
        _decision,
        {
            "small Gaussians are cloned and large ones split": _small_split,
            "a Gaussian is large if its largest scale is, not their mean": _mean_scale,
            "a faint Gaussian is pruned even if its gradient is large": _grown_first,
            "how large is too large depends on the scene's extent": _without_extent,
        },
    ),
    Part(
        "split",
        3,
        _split_cases,
        _split,
        {
            "the children's offsets have to be as wide as the parent: noise times scales": _narrow_split,
            "the offsets have to be turned as the parent is": _unturned_split,
            f"the children have to be smaller, by a factor of {PAPER.adc.split_shrink}": _large_split,
        },
    ),
    Part(
        "shared_opacity",
        2,
        lambda draws: [(draws.uniform(0.1, 0.95), n) for n in (2, 3, 7)],
        lambda opacity, copies: 1 - (1 - opacity) ** (1 / copies),
        {
            "opacities do not add: what the copies leave of the light multiplies": lambda opacity, copies: (
                opacity / copies
            ),
            "copies of the same opacity are together more opaque than one": lambda opacity, copies: opacity,
        },
    ),
)
"""The functions of the assignment: `signal`, `decision`, `split` and `shared_opacity`."""
