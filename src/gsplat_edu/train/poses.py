"""Poses and intrinsics of the cameras, learned with the scene and anchored to the given ones.

R_i' = exp([w_i]x) R_i,  eye_i' = eye_i + extent t_i,  with (w, t) = D - Q Qᵀ D

A common move of all cameras and of the scene changes no image, so nothing in the photos holds it. The columns of Q span
these moves to first order: three shifts, three turns about the cameras' centre, and a change of scale. Subtracting what
D has of them fixes the gauge: the cameras can move relative to one another, but not all together, and the scene stays
in the frame of the capture.

Views with equal intrinsics share a lens: fx' = fx exp(a), fy' = fy exp(b), cx' = cx + c W, cy' = cy + d H.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsplat_edu.camera import Camera
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.threads import one_thread
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.view_model import Identity

TWISTS, LENSES = "twists", "lenses"
"""Names of the parameters."""

FINAL = 0.01
"""The rates fall log-linearly to this share, over as many iterations as that of the means; then they are constant."""


class Refinement(Identity):
    """Corrections of the poses, the intrinsics or both, as a view model.

    Args:
        cameras: The cameras of the training views, at their full size.
        config: The settings: which of the two, rates, and the length of the schedule.
        extent: Size of the scene, world units.
    """

    def __init__(self, cameras: Sequence[Camera], config: TrainConfig, extent: float) -> None:
        self._extent, self._learns = extent, config.refine
        keys = [lens_key(camera) for camera in cameras]
        self._lenses_by_key = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        self._lens_of = [self._lenses_by_key[key] for key in keys]
        self._gauge = torch.from_numpy(gauge(cameras, extent))
        self._twists = torch.zeros(len(cameras), 6, dtype=torch.float64).requires_grad_()
        self._lenses = torch.zeros(len(self._lenses_by_key), 4, dtype=torch.float64).requires_grad_()
        # Each view is drawn once in as many steps as there are views. The root of Adam's second moment is smaller than
        # the view's gradient by the root of their number, so its steps are larger than the rate by that factor.
        of_poses = functools.partial(
            _rate, config.pose_rate / math.sqrt(len(cameras)), config.means_rate_iterations
        )
        of_lenses = functools.partial(_rate, config.lens_rate, config.means_rate_iterations)
        self._groups = {
            TWISTS: ParameterGroup(of_poses, eps=config.adam_eps, per_gaussian=False),
            LENSES: ParameterGroup(of_lenses, eps=config.adam_eps, per_gaussian=False),
        }

    def _names(self) -> list[str]:
        wanted = {"poses": [TWISTS], "intrinsics": [LENSES], "both": [TWISTS, LENSES]}
        return wanted[self._learns]

    def parameters(self) -> Mapping[str, Tensor]:
        """Return D, (views, 6), and the lenses, (lenses, 4), as far as they are learned."""
        tensors = {TWISTS: self._twists, LENSES: self._lenses}
        return {name: tensors[name] for name in self._names()}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return their groups."""
        return {name: self._groups[name] for name in self._names()}

    def camera(self, index: int, camera: Camera | CameraTensors) -> CameraTensors:
        """Return the corrected camera of a training view, at the size of the given one."""
        given = camera if isinstance(camera, CameraTensors) else CameraTensors.of(camera)
        if TWISTS in self._names():
            twist: Tensor = _Anchored.apply(self._twists, self._gauge, index)  # type: ignore[no-untyped-call]
            given = given.moved(torch.cat([twist[:3], self._extent * twist[3:]]))
        if LENSES in self._names():
            given = given.with_intrinsics(refined_intrinsics(given, self._lenses[self._lens_of[index]]))
        return given

    def refined(self, index: int, camera: Camera) -> Camera:
        """Return the corrected camera as numbers."""
        with torch.no_grad():
            return self.camera(index, camera).value()

    def with_refined_lens(self, camera: Camera) -> Camera:
        """Return a camera with the refined intrinsics of its lens, if a training view was taken with that lens."""
        index = self._lenses_by_key.get(lens_key(camera))
        if index is None or LENSES not in self._names():
            return camera
        with torch.no_grad():
            given = CameraTensors.of(camera)
            return given.with_intrinsics(refined_intrinsics(given, self._lenses[index])).value()


def lens_key(camera: Camera) -> tuple[float, ...]:
    """Return what the views of one lens have in common: their intrinsics and size."""
    return camera.fx, camera.fy, camera.cx, camera.cy, float(camera.W), float(camera.H)


def refined_intrinsics(camera: CameraTensors, lens: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
    """Return the intrinsics of a camera after the change (a, b, c, d) of its lens."""
    fx, fy, cx, cy = camera.intrinsics.unbind()
    a, b, c, d = lens.unbind()
    return torch.stack([fx * a.exp(), fy * b.exp(), cx + c * camera.W, cy + d * camera.H])


def gauge(cameras: Sequence[Camera], extent: float) -> Float64[np.ndarray, "views 6 k"]:
    """Return an orthonormal basis of the first-order moves of all cameras together: shifts, turns and scale.

    Args:
        cameras: The cameras.
        extent: Unit of the shifts, world units.

    Returns:
        (views, 6, k) a move of k as (w, t) for each camera; k is 7, or less where moves coincide (a single view).
    """
    eyes = np.stack([camera.eye for camera in cameras])
    offsets = (eyes - eyes.mean(axis=0)) / extent
    moves = []
    for axis in np.eye(3):
        moves.append(np.concatenate([np.zeros_like(offsets), np.tile(axis, (len(eyes), 1))], axis=1))
        turned = np.stack([-camera.R @ axis for camera in cameras])
        moves.append(np.concatenate([turned, np.cross(axis, offsets)], axis=1))
    moves.append(np.concatenate([np.zeros_like(offsets), offsets], axis=1))
    columns = np.stack([move.ravel() for move in moves], axis=1)
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept = sizes > 1e-9 * max(sizes.max(), 1e-300)
    return np.ascontiguousarray(basis[:, kept]).reshape(len(eyes), 6, -1)


def _rate(rate: float, iterations: int, iteration: int) -> float:
    return float(rate * FINAL ** min(iteration / max(iterations, 1), 1.0))


class _Anchored(torch.autograd.Function):
    """A view's row of D - Q Qᵀ D, with the sums on one thread: their rounding depends on the number of threads."""

    @staticmethod
    def forward(ctx: Any, twists: Tensor, basis: Tensor, index: int) -> Tensor:  # noqa: ANN401
        ctx.index = index
        ctx.save_for_backward(basis)
        with one_thread():
            shares = (basis * twists[:, :, None]).sum(dim=(0, 1))
            return twists[index] - (basis[index] * shares).sum(dim=1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (basis,) = ctx.saved_tensors
        with one_thread():
            shares = (basis[ctx.index] * grad[:, None]).sum(dim=0)
            found = -(basis * shares).sum(dim=2)
        found[ctx.index] += grad
        return found, None, None
