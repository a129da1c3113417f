"""Write the conformance kit's cases from the reference renderers, and check them while doing so.

    python conformance/make.py [FOLDER]

Outputs are those of the NumPy reference in float64, gradients those of the dense torch renderer in float64. Before a
case is written, `verify` checks that the two renderers agree, that no rounding decides what is drawn, and that the
gradients are those of finite differences of the NumPy reference.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save_file

from gsplat_edu import Camera, build_cov3d_batch, project_cov3d, quat_to_R_batch, render_gaussians, sh_basis
from gsplat_edu.base.constants import ALPHA_MIN, SH_OFFSET
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.numpy_reference import project
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussian_math import opacity_compensation
from gsplat_edu.scene.gaussians import Gaussians
from kit_scenes import Arrays, Plan, plans
from run import CASES, EPSILON, INPUT_ROUNDINGS, T_STOP, load_cases, tolerance

DRAWS = 8
"""Perturbations of the inputs from which a sensitivity is measured."""

STEP = 2.0**-30
"""Relative size of those perturbations: linear, and far above rounding."""

DECIDED = 4 * INPUT_ROUNDINGS * EPSILON["float32"]
"""Relative size of perturbations that change no decision (what is drawn, cut, clamped, floored, and in which order)."""

INTRINSICS = ("fx", "fy", "cx", "cy")
INPUTS = (
    "means",
    "quats",
    "log_scales",
    "sh",
    "logit_opacities",
    "features",
    "background",
    "R",
    "eye",
    *INTRINSICS,
)


def flat_inputs(plan: Plan) -> Arrays:
    """Return all differentiable inputs by name, as float64 arrays."""
    numbers = {name: np.asarray(plan.camera[name], np.float64) for name in ("R", "eye", *INTRINSICS)}
    return plan.gaussians | {"background": plan.settings["background"]} | numbers


# The NumPy reference.


def colours(plan: Plan, x: Arrays) -> np.ndarray:
    """Return the colours before the floor: sum_i b_i(d) sh_i + 0.5."""
    offset = x["means"] - x["eye"]
    used = min(x["sh"].shape[1], (plan.settings["sh_degree"] + 1) ** 2)
    basis = sh_basis(offset / np.linalg.norm(offset, axis=-1, keepdims=True))[:, :used]
    return np.einsum("nk,nkc->nc", basis, x["sh"][:, :used]) + SH_OFFSET


def _camera(plan: Plan, x: Arrays) -> Camera:
    numbers = [float(x[name]) for name in INTRINSICS]
    return Camera(x["R"], x["eye"], *numbers, H=plan.camera["height"], W=plan.camera["width"])


def _activated(plan: Plan, x: Arrays) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """Return camera, covariances, opacities as composited, and means in camera coordinates."""
    camera = _camera(plan, x)
    covs = build_cov3d_batch(np.exp(x["log_scales"]), quat_to_R_batch(x["quats"]))
    opacities = 1 / (1 + np.exp(-x["logit_opacities"]))
    means_cam = camera.world_to_cam(x["means"])
    if plan.settings["antialiased"]:
        front = means_cam[:, 2] > plan.settings["z_near"]
        limit = plan.settings["jacobian_limit"]
        opacities[front] *= opacity_compensation(
            project_cov3d(covs[front], means_cam[front], camera, jacobian_limit=limit)
        )
    return camera, covs, opacities, means_cam


def composited(plan: Plan, x: Arrays, stop: str = "tile") -> Arrays:
    """Return image, transmittance, depth and features of the NumPy reference."""
    camera, covs, opacities, means_cam = _activated(plan, x)
    columns = np.concatenate([np.maximum(colours(plan, x), 0.0), means_cam[:, 2:], x["features"]], axis=1)
    columns = np.pad(columns, ((0, 0), (0, -columns.shape[1] % 3)))
    options = {
        "z_near": plan.settings["z_near"],
        "jacobian_limit": plan.settings["jacobian_limit"],
        "extent": "exact",
        "stop": stop,
    }
    parts = []
    for start in range(0, columns.shape[1], 3):
        part, T = render_gaussians(
            camera, x["means"], covs, columns[:, start : start + 3], opacities, **options
        )
        parts.append(part)
    mixed = np.concatenate(parts, axis=-1)
    return {
        "image": mixed[..., :3] + T[..., None] * x["background"],
        "transmittance": T,
        "depth": mixed[..., 3],
        "features": mixed[..., 4 : 4 + x["features"].shape[1]],
    }


def alphas(plan: Plan, x: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return order (M,), depths (M,) and alphas (M, H, W) before clamp and cut-off, near to far."""
    camera, covs, opacities, means_cam = _activated(plan, x)
    order, means2d, cov2d = project(
        camera, x["means"], covs, plan.settings["z_near"], plan.settings["jacobian_limit"]
    )
    rows, columns = np.mgrid[: camera.H, : camera.W]
    d = np.stack([columns, rows], axis=-1) - means2d[:, None, None]
    power = -0.5 * np.einsum("nyxi,nij,nyxj->nyx", d, np.linalg.inv(cov2d), d)
    return order, means_cam[order, 2], opacities[order, None, None] * np.exp(power)


def transmittances(plan: Plan, raw: np.ndarray) -> np.ndarray:
    """Return T before the first and after each Gaussian, (M + 1, H, W)."""
    alpha = np.where(raw < ALPHA_MIN, 0.0, np.minimum(plan.settings["alpha_max"], raw))
    return np.concatenate([np.ones((1, *raw.shape[1:])), np.cumprod(1.0 - alpha, axis=0)])


def median_depth(plan: Plan, x: Arrays) -> np.ndarray:
    """Return the depth of the Gaussian at which T falls below one half, 0 where it does not."""
    _, depths, raw = alphas(plan, x)
    T = transmittances(plan, raw)
    crosses = (T[:-1] >= 0.5) & (T[1:] < 0.5)
    return np.einsum("nyx,n->yx", crosses, depths)


def outputs(plan: Plan, x: Arrays) -> Arrays:
    """Return all outputs: the truth of a case."""
    if plan.settings["alpha_max"] != 0.99:  # the NumPy reference has no such setting
        return dense_outputs(plan, x)
    return composited(plan, x) | {"median_depth": median_depth(plan, x)}


# The dense torch renderer.


def _dense(plan: Plan, x: Arrays, *, tracked: bool) -> tuple[Any, dict[str, torch.Tensor]]:
    leaves = {name: torch.tensor(array, requires_grad=tracked) for name, array in x.items()}
    camera = CameraTensors(
        leaves["R"],
        leaves["eye"],
        torch.stack([leaves[name] for name in INTRINSICS]),
        plan.camera["height"],
        plan.camera["width"],
    )
    gaussians = Gaussians(
        means=leaves["means"],
        quats=leaves["quats"],
        log_scales=leaves["log_scales"],
        sh0=leaves["sh"][:, :1],
        sh_rest=leaves["sh"][:, 1:],
        logit_opacities=leaves["logit_opacities"],
    )
    given = {name: value for name, value in plan.settings.items() if name != "background"}
    settings = RenderSettings(median_depth=True, **given)
    background, features = leaves["background"], leaves["features"]
    out = render(
        gaussians, camera, settings=settings, background=background, features=features, backend="torch"
    )
    return out, leaves


def dense_outputs(plan: Plan, x: Arrays) -> Arrays:
    """Return all outputs of the dense torch renderer."""
    out, _ = _dense(plan, x, tracked=False)
    names = ("image", "transmittance", "depth", "features", "median_depth")
    return {name: getattr(out, name).numpy() for name in names}


def gradients(plan: Plan, x: Arrays, upstream: Arrays) -> Arrays:
    """Return the gradients of sum(upstream * outputs) in all inputs."""
    out, leaves = _dense(plan, x, tracked=True)
    loss = sum((getattr(out, name) * torch.tensor(weight)).sum() for name, weight in upstream.items())
    loss.backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    return {name: np.zeros_like(x[name]) if grad is None else grad.numpy() for name, grad in found.items()}


# Perturbations.


def _magnitudes(x: Arrays, exact_depths: bool) -> Arrays:
    """Return the number whose rounding enters each input: its size, or that of what it is added to or multiplied by."""
    found = {name: np.abs(x[name]) for name in ("sh", "features", "background", "fx", "fy")}
    found["means"] = np.abs(x["means"]) + np.abs(x["eye"])
    found["quats"] = np.linalg.norm(x["quats"], axis=-1, keepdims=True) + np.zeros(4)
    found |= {name: np.maximum(np.abs(x[name]), 1.0) for name in ("log_scales", "logit_opacities")}
    found |= {name: np.maximum(np.abs(x[name]), 1.0) for name in ("cx", "cy")}
    found |= {"R": np.ones((3, 3)), "eye": np.abs(x["eye"])}
    if exact_depths:
        found["means"][:, 2] = 0.0
        found["R"], found["eye"] = np.zeros((3, 3)), np.zeros(3)
    return found


def perturbed(plan: Plan, step: float) -> Iterator[Arrays]:
    """Yield the inputs with every number moved up or down at random by `step` times its magnitude."""
    rng, x = np.random.default_rng(0), flat_inputs(plan)
    magnitudes = _magnitudes(x, plan.exact_depths)
    for _ in range(DRAWS):
        yield {n: x[n] + step * rng.choice([-1.0, 1.0], x[n].shape) * magnitudes[n] for n in INPUTS}


def sensitivities(plan: Plan, upstream: Arrays) -> Arrays:
    """Return the largest change of each output and gradient over all draws, divided by the step."""
    rng, x = np.random.default_rng(1), flat_inputs(plan)

    def values(y: Arrays, weights: Arrays) -> Arrays:
        found = outputs(plan, y)
        return found | (
            {f"gradient.{n}": v for n, v in gradients(plan, y, weights).items()} if upstream else {}
        )

    base, worst = values(x, upstream), {}
    for y in perturbed(plan, STEP):
        weights = {n: w * (1 + STEP * rng.choice([-1.0, 1.0], w.shape)) for n, w in upstream.items()}
        for name, value in values(y, weights).items():
            change = np.abs(value - base[name]) / STEP
            worst[name] = np.maximum(worst.get(name, 0.0), change)
    return {name: change.astype(np.float32) for name, change in worst.items()}


def decisions(plan: Plan, x: Arrays) -> dict[str, np.ndarray]:
    """Return every yes or no on which outputs and gradients depend."""
    order, _, raw = alphas(plan, x)
    T = transmittances(plan, raw)
    found = {"drawn": np.sort(order), "cut": raw < ALPHA_MIN, "median": T < 0.5}
    if not plan.exact_depths:
        found["order"] = order
    if plan.gradients:
        found |= {"clamped": raw > plan.settings["alpha_max"], "floored": colours(plan, x) < 0}
        if (limit := plan.settings["jacobian_limit"]) is not None:
            camera = _camera(plan, x)
            at = camera.world_to_cam(x["means"])[order]
            bounds = np.array(camera.jacobian_bounds(limit))
            found["jacobian"] = (at[:, :2, None] / at[:, 2:, None]) < bounds
    return found


# Files.


def build(plan: Plan) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of a case's file and what its header says."""
    x = flat_inputs(plan)
    truth = outputs(plan, x)
    upstream = {}
    if plan.gradients:
        rng = np.random.default_rng(2)
        names = ("image", "transmittance", "depth", "features")
        upstream = {name: rng.normal(size=truth[name].shape) for name in names}
    arrays = {f"gaussians.{name}": array for name, array in plan.gaussians.items()}
    arrays |= {f"camera.{name}": plan.camera[name] for name in ("R", "eye")}
    arrays["settings.background"] = plan.settings["background"]
    arrays |= {f"truth.{name}": array for name, array in truth.items()}
    arrays |= {f"upstream.{name}": array for name, array in upstream.items()}
    if upstream:
        arrays |= {f"gradient.{name}": value for name, value in gradients(plan, x, upstream).items()}
    arrays |= {f"sensitivity.{name}": array for name, array in sensitivities(plan, upstream).items()}
    about = {
        "name": plan.name,
        "shows": plan.shows,
        "hint": plan.hint,
        "camera": {name: value for name, value in plan.camera.items() if name not in ("R", "eye")},
        "settings": {name: value for name, value in plan.settings.items() if name != "background"},
        "stopped": _stopped(plan, x) if plan.stops else {},
    }
    return {name: np.array(array, order="C") for name, array in arrays.items()}, about


def _stopped(plan: Plan, x: Arrays) -> dict[str, float]:
    """Return how far each output may move behind T_STOP: that share of the largest number composited there."""
    largest = {
        "image": max(colours(plan, x).max(), x["background"].max()),
        "transmittance": 1.0,
        "depth": _camera(plan, x).world_to_cam(x["means"])[:, 2].max(),
        "features": np.abs(x["features"]).max(),
    }
    return {name: T_STOP * float(value) for name, value in largest.items()}


def verify(plan: Plan, *, every: int = 1) -> None:
    """Check a case before it is written.

    Args:
        plan: The case.
        every: Check one in so many numbers of the gradients.

    Raises:
        AssertionError: the witnesses disagree, or rounding decides what is drawn.
    """
    x = flat_inputs(plan)
    assert all(np.array_equal(a, a.astype(np.float32)) for a in x.values()), (
        f"{plan.name}: inputs are float32"
    )
    base = decisions(plan, x)
    for y in perturbed(plan, DECIDED):
        for name, value in decisions(plan, y).items():
            assert np.array_equal(value, base[name]), f"{plan.name}: rounding decides {name}"
    T = transmittances(plan, alphas(plan, x)[2])[-1]
    assert plan.stops == bool((T < 2 * T_STOP).any()), f"{plan.name}: T stop"
    if plan.smooth:
        assert not any(base[name].any() for name in ("cut", "clamped", "floored")), (
            f"{plan.name}: is not smooth"
        )
    if plan.gradients:
        _check_gradients(plan, x, every)


def _check_gradients(plan: Plan, x: Arrays, every: int) -> None:
    """Compare the gradients with central differences of the NumPy reference.

    The error of a central difference is h² f'''/6 plus rounding, eps |f| / h. With h = 1e-5, both are far below the
    bound.
    """
    rng = np.random.default_rng(2)
    names = ("image", "transmittance", "depth", "features")
    shapes = {name: array.shape for name, array in composited(plan, x).items()}
    upstream = {name: rng.normal(size=shapes[name]) for name in names}

    def loss(y: Arrays) -> float:
        found = composited(plan, y)
        return float(sum((found[name] * weight).sum() for name, weight in upstream.items()))

    for name, gradient in gradients(plan, x, upstream).items():
        bound = 1e-6 * max(float(np.abs(gradient).max()), 1.0)
        for at in range(0, gradient.size, every):
            slope = _slope(loss, x, name, at)
            assert abs(slope - gradient.flat[at]) <= bound, (
                f"{plan.name}: d/d {name}[{at}] is {gradient.flat[at]}, but {slope}"
            )


def _slope(loss: Callable[[Arrays], float], x: Arrays, name: str, at: int) -> float:
    ends = []
    for sign in (1, -1):
        y = x | {name: x[name].copy()}
        y[name].flat[at] += sign * 1e-5
        ends.append(loss(y))
    return (ends[0] - ends[1]) / 2e-5


def write(plan: Plan, folder: Path) -> Path:
    """Write one case; return its file."""
    arrays, about = build(plan)
    path = folder / f"{plan.name}.safetensors"
    save_file(arrays, path, metadata={"case": json.dumps(about)})
    return path


def agrees(plan: Plan, path_of: Path) -> None:
    """Check that the dense torch renderer agrees with a written case, within the tolerance of float64.

    Raises:
        AssertionError: it does not.
    """
    (case,) = load_cases([plan.name], path_of)
    for name, value in dense_outputs(plan, flat_inputs(plan)).items():
        error = np.abs(value - case.truth[name])
        assert (error <= tolerance(case, name, "float64")).all(), (
            f"{plan.name}: {name} is off by {error.max()}"
        )


def main(folder: Path = CASES) -> None:
    """Verify and write all cases, and print their sizes."""
    folder.mkdir(parents=True, exist_ok=True)
    total = 0
    for plan in plans():
        verify(plan)
        size = write(plan, folder).stat().st_size
        agrees(plan, folder)
        total += size
        print(f"{plan.name:<26}{size / 1e3:8.1f} kB")
    for stale in {path.stem for path in folder.glob("*.safetensors")} - {plan.name for plan in plans()}:
        print(f"{stale}: is no longer made; delete its file")
    print(f"{len(plans())} cases, {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
