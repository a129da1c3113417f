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
from gsplat_edu.render.numpy_reference import screen_splats
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussian_math import opacity_compensation
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter, readout_pace
from gsplat_edu.scene.sight import seam_shift
from kit_lenses import plans
from kit_scenes import Arrays, Plan
from run import CASES, EPSILON, INPUT_ROUNDINGS, PINHOLE, T_STOP, load_cases, tolerance

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
    "distortion",
    "turn",
    "shift",
)

COEFFICIENT_UNITS = 4.0 ** -np.array((1, 2, 3, 4, 5, 6, 1, 2, 3, 0, 0, 0, 1, 0, 1))
"""Units of the steps in coefficients of a distortion: past 90 degrees, k6 multiplies an angle to the power of 13."""


def camera_inputs(plan: Plan) -> list[str]:
    """Return the names of the camera's differentiable inputs: those of lens and shutter only where it has them."""
    sphere = plan.camera["projection"] == "equirectangular"
    names = ["R", "eye", *(INTRINSICS[2:] if sphere else INTRINSICS)]
    names += ["distortion"] if np.any(plan.camera["distortion"]) else []
    return names + (["turn", "shift"] if _moves(plan.camera) else [])


def _moves(camera: Arrays) -> bool:
    """Return whether a camera moves while it is read, or while it is exposed."""
    return camera["readout"] != "none" or camera["exposure"] > 0


def flat_inputs(plan: Plan) -> Arrays:
    """Return all differentiable inputs by name, as float64 arrays."""
    numbers = {name: np.asarray(plan.camera[name], np.float64) for name in camera_inputs(plan)}
    return plan.gaussians | {"background": plan.settings["background"]} | numbers


# The NumPy reference.


def colours(plan: Plan, x: Arrays) -> np.ndarray:
    """Return the colours before the floor: sum_i b_i(d) sh_i + 0.5."""
    offset, _ = _seen(plan, _camera(plan, x), x)
    used = min(x["sh"].shape[1], (plan.settings["sh_degree"] + 1) ** 2)
    basis = sh_basis(offset / np.linalg.norm(offset, axis=-1, keepdims=True))[:, :used]
    return np.einsum("nk,nkc->nc", basis, x["sh"][:, :used]) + SH_OFFSET


def _camera(plan: Plan, x: Arrays) -> Camera:
    given = plan.camera | x
    numbers = [float(given[name]) for name in INTRINSICS]
    camera = Camera(x["R"], x["eye"], *numbers, H=given["height"], W=given["width"])
    distortion = None
    if np.any(given["distortion"]):
        distortion = Distortion(tuple(given["distortion"].tolist()), given["radial_first"])
    motion = given["turn"], given["shift"], given["readout"], given["exposure"]
    shutter = RollingShutter(*motion) if _moves(given) else None
    return camera.through(Projection(given["projection"], distortion), shutter)


def _seen(plan: Plan, camera: Camera, x: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Return directions from the camera to the means, of any length, and depths; 1 and 0 for means it does not see."""
    if camera.pinhole:
        return x["means"] - x["eye"], camera.world_to_cam(x["means"])[:, 2]
    seen = camera.sight(x["means"], plan.settings["z_near"])
    directions = np.stack(np.broadcast_arrays(*seen.direction), axis=-1)
    return np.where(seen.valid[:, None], directions, 1.0), np.where(seen.valid, seen.depth, 0.0)


def _activated(plan: Plan, x: Arrays) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """Return camera, covariances, opacities as composited, and depths."""
    camera = _camera(plan, x)
    covs = build_cov3d_batch(np.exp(x["log_scales"]), quat_to_R_batch(x["quats"]))
    opacities = 1 / (1 + np.exp(-x["logit_opacities"]))
    _, depths = _seen(plan, camera, x)
    if plan.settings["antialiased"]:
        front = np.flatnonzero(depths > plan.settings["z_near"])
        opacities[front] *= opacity_compensation(_flat(plan, camera, x["means"][front], covs[front]))
    return camera, covs, opacities, depths


def _flat(plan: Plan, camera: Camera, means: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """Return the covariances in the image before the dilation, of means that the camera sees."""
    limit = plan.settings["jacobian_limit"]
    if camera.pinhole:
        return project_cov3d(covs, camera.world_to_cam(means), camera, jacobian_limit=limit)
    rows = np.stack(
        [np.stack(row, axis=-1) for row in camera.sight(means, jacobian_limit=limit).jacobian], axis=-2
    )
    return np.asarray(rows @ covs @ np.swapaxes(rows, -1, -2))


def composited(plan: Plan, x: Arrays, stop: str = "tile") -> Arrays:
    """Return image, transmittance, depth and features of the NumPy reference."""
    camera, covs, opacities, depths = _activated(plan, x)
    columns = np.concatenate([np.maximum(colours(plan, x), 0.0), depths[:, None], x["features"]], axis=1)
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


def alphas(plan: Plan, x: Arrays, by_pixel: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return order (M,), depths (M,) and alphas (M, H, W) before clamp and cut-off, near to far.

    Args:
        plan: The case.
        x: Its inputs.
        by_pixel: Whether each pixel of a panorama sees the nearest copy of a mean; otherwise, each tile does.
    """
    camera, covs, opacities, depths = _activated(plan, x)
    order, means2d, cov2d, factor = screen_splats(
        camera, x["means"], covs, plan.settings["z_near"], plan.settings["jacobian_limit"]
    )
    rows, columns = np.mgrid[: camera.H, : camera.W]
    d = np.stack([columns, rows], axis=-1) - means2d[:, None, None]
    if camera.projection.kind == "equirectangular":
        d[..., 0] -= (
            (camera.W * np.round(d[..., 0] / camera.W)) if by_pixel else _tile_copies(camera, means2d)
        )
    power = -0.5 * np.einsum("nyxi,nij,nyxj->nyx", d, np.linalg.inv(cov2d), d)
    return order, depths[order], (factor * opacities[order])[:, None, None] * np.exp(power)


def _tile_copies(camera: Camera, means2d: np.ndarray) -> np.ndarray:
    """Return the whole turns, px, by which a panorama's tiles of 16 columns see each mean moved."""
    return seam_shift(np.arange(camera.W), means2d[:, :1], camera.W)[:, None, :]


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
    still = "turn" not in leaves
    camera = CameraTensors(
        leaves["R"],
        leaves["eye"],
        torch.stack([leaves.get(n, torch.tensor(plan.camera[n], dtype=torch.float64)) for n in INTRINSICS]),
        plan.camera["height"],
        plan.camera["width"],
        _camera(plan, x).projection,
        leaves.get("distortion"),
        None if still else torch.cat([leaves["turn"], leaves["shift"]]),
        "down" if still else plan.camera["readout"],
        plan.camera["exposure"],
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
    x = dict.fromkeys(INPUTS, np.zeros(())) | x  # those that the camera lacks are not used
    found = {name: np.abs(x[name]) for name in ("sh", "features", "background", "fx", "fy")}
    found["means"] = np.abs(x["means"]) + np.abs(x["eye"])
    found["quats"] = np.linalg.norm(x["quats"], axis=-1, keepdims=True) + np.zeros(4)
    found |= {name: np.maximum(np.abs(x[name]), 1.0) for name in ("log_scales", "logit_opacities")}
    found |= {name: np.maximum(np.abs(x[name]), 1.0) for name in ("cx", "cy")}
    found |= {"R": np.ones((3, 3)), "eye": np.abs(x["eye"])}
    found |= {name: np.abs(x[name]) for name in ("distortion", "turn", "shift")}
    if exact_depths:
        found["means"][:, 2] = 0.0
        found["R"], found["eye"] = np.zeros((3, 3)), np.zeros(3)
    return found


def perturbed(plan: Plan, step: float) -> Iterator[Arrays]:
    """Yield the inputs with every number moved up or down at random by `step` times its magnitude."""
    rng, x = np.random.default_rng(0), flat_inputs(plan)
    magnitudes = _magnitudes(x, plan.exact_depths)
    for _ in range(DRAWS):
        yield {n: x[n] + step * rng.choice([-1.0, 1.0], x[n].shape) * magnitudes[n] for n in INPUTS if n in x}


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
    others = [name for name in PINHOLE if not np.array_equal(plan.camera[name], PINHOLE[name])]
    vectors = ["R", "eye", *(name for name in others if isinstance(PINHOLE[name], np.ndarray))]
    numbers = [name for name in plan.camera if name not in PINHOLE or name in others]
    arrays |= {f"camera.{name}": plan.camera[name] for name in vectors}
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
        "camera": {name: plan.camera[name] for name in numbers if name not in vectors},
        "settings": {name: value for name, value in plan.settings.items() if name != "background"},
        "stopped": _stopped(plan, x) if plan.stops else {},
    }
    return {name: np.array(array, order="C") for name, array in arrays.items()}, about


def _stopped(plan: Plan, x: Arrays) -> dict[str, float]:
    """Return how far each output may move behind T_STOP: that share of the largest number composited there."""
    largest = {
        "image": max(colours(plan, x).max(), x["background"].max()),
        "transmittance": 1.0,
        "depth": _seen(plan, _camera(plan, x), x)[1].max(),
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
    tiles, pixels = (alphas(plan, x, by_pixel)[2] for by_pixel in (False, True))
    assert np.array_equal(tiles * (tiles >= ALPHA_MIN), pixels * (pixels >= ALPHA_MIN)), (
        f"{plan.name}: a Gaussian is as wide as the panorama"
    )
    assert _unsolved(plan, x) < 1e-11, f"{plan.name}: Newton's method does not reach the rows of means"
    if plan.smooth:
        assert not any(base[name].any() for name in ("cut", "clamped", "floored")), (
            f"{plan.name}: is not smooth"
        )
    if plan.gradients:
        _check_gradients(plan, x, every)


def _unsolved(plan: Plan, x: Arrays) -> float:
    """Return how far places of means, px, are from where a camera at rest sees them at the time of the place."""
    camera, worst = _camera(plan, x), 0.0
    if camera.shutter is None:
        return worst
    seen, pace = camera.sight(x["means"]), readout_pace(camera.readout, camera.H, camera.W)
    axis = camera.shutter.axis
    for at in np.flatnonzero(seen.valid):
        place = np.array([seen.u[at], seen.v[at]])
        time = pace * (place[axis] - ((camera.W, camera.H)[axis] - 1) / 2)
        R = camera.shutter.rotation(time) @ camera.R
        rest = Camera.posed(R, camera.eye + time * camera.shutter.shift, camera.intrinsics)
        u, v, _ = rest.project(rest.world_to_cam(x["means"][at]))
        worst = max(worst, float(np.abs(place - (u, v)).max()))
    return worst


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
            unit = COEFFICIENT_UNITS[at] if name == "distortion" else 1.0
            slope = _slope(loss, x, name, at, 1e-5 * unit)
            assert abs(slope - gradient.flat[at]) <= bound / unit, (
                f"{plan.name}: d/d {name}[{at}] is {gradient.flat[at]}, but {slope}"
            )


def _slope(loss: Callable[[Arrays], float], x: Arrays, name: str, at: int, step: float) -> float:
    ends = []
    for sign in (1, -1):
        y = x | {name: x[name].copy()}
        y[name].flat[at] += sign * step
        ends.append(loss(y))
    return (ends[0] - ends[1]) / (2 * step)


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
