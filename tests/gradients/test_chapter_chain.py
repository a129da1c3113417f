"""Chapter 13's hand-derived chain against autograd and finite differences, in float64.

The functions are the chapter's own: its cells are executed as a reader would, and `by_hand` is taken from them.

The scenes are smooth. Every Gaussian is wider than the small image, so every alpha is far above the floor 1/255 and
below the clamp; no colour is near zero, no depths swap, and no x/z is near the bound of the Jacobian's clamp.
"""

import os
from collections.abc import Iterator
from typing import Any
from unittest import mock

import jupytext
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from chapters import ROOT
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from native_scenes import Scene, assert_smooth, camera

NUDGE = np.finfo(float).eps ** (1 / 5)  # best for differences with an error of h⁴


@pytest.fixture(scope="module")
def chapter() -> Iterator[dict[str, Any]]:
    """Execute the chapter's cells and return its names."""
    names: dict[str, Any] = {"__name__": "chapter"}
    with mock.patch.dict(os.environ, GSPLAT_EDU_BUDGET="reduced"):
        for cell in jupytext.read(ROOT / "notebooks" / "source" / "13_back_to_the_parameters.py").cells:
            if cell.cell_type == "code":
                exec(cell.source, names)
    yield names
    plt.close("all")


def scene(degree: int) -> Scene:
    """Return three Gaussians, near to far; the last is so far aside that a limit of 1.3 clamps its x/z and y/z."""
    rng = np.random.default_rng(degree)
    view = camera(11, 9)
    means = np.stack([*rng.uniform(-0.3, 0.3, (2, 3)), np.linspace(-0.5, 0.5, 3)], axis=1)
    means[2] = view.eye + view.R.T @ [3.0, 2.4, 3.5]
    sh = 0.05 * rng.normal(size=(3, (degree + 1) ** 2, 3))
    sh[:, 0] += 0.5
    log_scales = rng.uniform(-0.6, 0.2, (3, 3))
    log_scales[2] += 1.0
    return Scene(view, means, rng.normal(size=(3, 4)), log_scales, sh, rng.uniform(-0.5, 1.0, 3))


def loss(
    built: Scene, gaussians: Gaussians, weights: np.ndarray, limit: float | None, backend: str
) -> torch.Tensor:
    """Return the sum of weights times image."""
    settings = RenderSettings(jacobian_limit=limit)
    image = render(gaussians, built.camera, settings=settings, backend=backend).image
    return (image * torch.tensor(weights)).sum()


def arrays(built: Scene) -> dict[str, np.ndarray]:
    """Return the raw parameters under the chapter's names."""
    return {
        "means": built.means,
        "log_scales": built.log_scales,
        "quats": built.quats,
        "logit_opacities": built.logits,
        "sh": built.sh,
    }


def from_arrays(view, parts: dict[str, np.ndarray]) -> Scene:
    return Scene(
        view, parts["means"], parts["quats"], parts["log_scales"], parts["sh"], parts["logit_opacities"]
    )


def by_hand(chapter, built: Scene, weights: np.ndarray, limit: float | None) -> dict[str, np.ndarray]:
    rows = [{name: part[i] for name, part in arrays(built).items()} for i in range(len(built.means))]
    return chapter["by_hand"](rows, built.camera, weights, limit)[1]


def by_package(built: Scene, weights: np.ndarray, limit: float | None, backend: str) -> dict[str, np.ndarray]:
    """Return the gradients of autograd through the dense renderer ("torch"), or of the native kernels ("cpu")."""
    gaussians = built.gaussians().trainable()
    loss(built, gaussians, weights, limit, backend).backward()
    found = {name: tensor.grad.numpy() for name, tensor in gaussians.tensors().items()}
    return found | {"sh": np.concatenate([found.pop("sh0"), found.pop("sh_rest")], axis=1)}


def by_differences(built: Scene, weights: np.ndarray, limit: float | None) -> dict[str, np.ndarray]:
    """Return (4 D(h) - D(2h)) / 3, D the central difference, which leaves h⁴ and eps / h: some 1e-13 of the loss."""
    slopes = {}
    for name, part in arrays(built).items():
        slopes[name] = np.empty_like(part)
        for at in np.ndindex(part.shape):

            def moved(step, name=name, part=part, at=at):
                changed = part.copy()
                changed[at] += step
                there = from_arrays(built.camera, arrays(built) | {name: changed})
                return float(loss(there, there.gaussians(), weights, limit, "torch"))

            once, twice = ((moved(k * NUDGE) - moved(-k * NUDGE)) / (2 * k * NUDGE) for k in (1, 2))
            slopes[name][at] = (4 * once - twice) / 3
    return slopes


def gap(mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> float:
    """Return the largest difference, relative to each parameter's largest slope."""
    assert mine.keys() == theirs.keys()
    return max(
        float(np.abs(mine[name] - other).max() / np.abs(other).max()) for name, other in theirs.items()
    )


@pytest.mark.parametrize("limit", [None, 1.3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_chain_by_hand_agrees_with_autograd_kernels_and_differences(chapter, degree, limit):
    """Autograd sums the same products in another order: hundreds of roundings of 1e-16. Differences are off by some
    1e-13 of the loss and of its fifth derivatives, at most a thousand times the largest slope."""
    built = scene(degree)
    assert_smooth(built, RenderSettings(jacobian_limit=limit))
    p = built.camera.world_to_cam(built.means)
    low, high = np.transpose(built.camera.jacobian_bounds(1.3))
    outside = (p[:, :2] / p[:, 2:] < low) | (p[:, :2] / p[:, 2:] > high)
    assert outside.tolist() == [[False, False]] * 2 + [[True, True]]
    assert np.abs(p[:, None, :2] / p[:, None, 2:] - np.stack([low, high])).min() > 100 * NUDGE

    weights = np.random.default_rng(9).normal(size=(9, 11, 3))
    mine = by_hand(chapter, built, weights, limit)
    assert gap(mine, by_package(built, weights, limit, "torch")) < 1e-12
    assert gap(mine, by_package(built, weights, limit, "cpu")) < 1e-9  # as in tests/native/test_gradients.py
    assert gap(mine, by_differences(built, weights, limit)) < 1e-9


def test_the_clamp_changes_the_gradient(chapter):
    built, weights = scene(3), np.random.default_rng(9).normal(size=(9, 11, 3))
    assert gap(by_hand(chapter, built, weights, 1.3), by_hand(chapter, built, weights, None)) > 0.01


def no_projection(unit_bar, vector):
    return unit_bar / np.linalg.norm(vector)


def constant_jacobian(u_bar, J_bar, x):
    r, z = x.p[:2] / x.p[2], x.p[2]
    return np.array([*(x.focal * u_bar / z), -(x.focal * u_bar) @ r / z])


def always_clamped(u_bar, J_bar, x):
    r, z = x.p[:2] / x.p[2], x.p[2]
    return np.array([*(x.focal * u_bar / z), -((x.focal * u_bar) @ r + (J_bar * x.J).sum()) / z])


@pytest.mark.parametrize(
    ("link", "wrong"),
    [
        ("unit_backward", no_projection),
        ("mean_backward", constant_jacobian),
        ("mean_backward", always_clamped),
        ("harmonic_slopes", lambda d: np.zeros((16, 3))),
    ],
)
def test_a_wrong_link_is_found(chapter, monkeypatch, link, wrong):
    built, weights = scene(3), np.random.default_rng(9).normal(size=(9, 11, 3))
    monkeypatch.setitem(chapter, link, wrong)
    assert gap(by_hand(chapter, built, weights, 1.3), by_package(built, weights, 1.3, "torch")) > 1e-4
