"""Poses and intrinsics of the cameras, learned with the scene and anchored to the given ones.

R_i' = exp([w_i]x) R_i,  eye_i' = eye_i + extent t_i,  with (w, t) = D - Q Qᵀ D

Moving all cameras and the scene together changes no image, so the photos do not determine such moves. The columns of Q
span them to first order: three shifts, three turns about the cameras' centre, and a change of scale. Subtracting the
projection of D onto these columns fixes the gauge: the cameras can move relative to one another, but not all together,
and the scene stays in the frame of the capture.

The poses are measured, not learned by gradient descent: whenever a view is drawn, D moves by the step that its render
and its photo ask for (`gsplat_edu.train.pose_step`), and the next render of the view uses it.

Views with equal intrinsics share a lens, which Adam learns:
fx' = fx exp(a), fy' = fy exp(b), cx' = cx + c W, cy' = cy + d H.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.camera import Camera
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.feed import Target
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.pose_step import pose_step
from gsplat_edu.train.view_model import Chain, Identity, Rows, ViewModel, ViewRender

TWISTS, LENSES = "twists", "lenses"
"""Names of the parameters."""

WARM_UP = 0.05
"""Fraction of the run before poses are first moved, because the scene has to take shape first."""

FINAL = 0.01
"""Final learning rate as a fraction of the initial one. The rate falls log-linearly until the means' rate is final."""


class Refinement(Identity):
    """Corrections of the poses, the intrinsics or both, as a view model.

    Args:
        cameras: The cameras of the training views, at their full size.
        config: The settings: which of the two, the spread, the rate, and the length of the schedule.
        extent: Size of the scene, world units.
    """

    def __init__(self, cameras: Sequence[Camera], config: TrainConfig, extent: float) -> None:
        self._learns = config.refine
        keys = [lens_key(camera) for camera in cameras]
        self._lenses_by_key = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        self._lens_of = [self._lenses_by_key[key] for key in keys]
        self._gauge = torch.from_numpy(gauge(cameras, extent))
        self._twists = torch.zeros(len(cameras), 6, dtype=torch.float64)
        self._lenses = torch.zeros(len(self._lenses_by_key), 4, dtype=torch.float64).requires_grad_()
        units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
        self._units, self._spread = units, config.pose_spread * units
        self._begin = WARM_UP * config.means_rate_iterations
        rate = functools.partial(_rate, config.lens_rate, config.means_rate_iterations)
        self._group = ParameterGroup(rate, eps=config.adam_eps, per_gaussian=False)

    @property
    def needs_depth(self) -> bool:
        """Return whether poses are refined."""
        return TWISTS in self._names()

    def _names(self) -> list[str]:
        wanted = {"poses": [TWISTS], "intrinsics": [LENSES], "both": [TWISTS, LENSES]}
        return wanted[self._learns]

    def parameters(self) -> Mapping[str, Tensor]:
        """Return those of D, (views, 6), and of the lenses, (lenses, 4), that are learned."""
        tensors = {TWISTS: self._twists, LENSES: self._lenses}
        return {name: tensors[name] for name in self._names()}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return the group of the lenses: gradients do not move the poses."""
        return {name: self._group for name in self._names() if name == LENSES}

    def camera(self, index: int, camera: Camera | CameraTensors) -> Camera | CameraTensors:
        """Return the corrected camera of a training view, at the size of the given one."""
        given = camera if isinstance(camera, CameraTensors) else CameraTensors.of(camera)
        if TWISTS in self._names():
            given = given.moved(self._moved(index))
        if LENSES in self._names():
            given = given.with_intrinsics(refined_intrinsics(given, self._lenses[self._lens_of[index]]))
        # without tensors, the kernels compute no gradient of the camera
        return given if any(tensor.requires_grad for tensor in given.tensors()) else given.value()

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return the row of the view, moved by the step that this render and the photo ask for."""
        if TWISTS not in self._names():
            return {}
        row = self._twists[index]
        if iteration < self._begin:
            return {TWISTS: row}
        if render.camera is None or render.depth is None:
            raise ArgumentError("render: has no camera or no depth, but poses are measured with both")
        camera = render.camera.value() if isinstance(render.camera, CameraTensors) else render.camera
        moved = self._moved(index)
        step = pose_step(
            render.image, render.depth, camera, target.image, moved, self._spread, mask=target.mask
        )
        return {TWISTS: row + step / self._units}

    def _moved(self, index: int) -> Float64[Tensor, "6"]:
        """Return a view's row of D - Q Qᵀ D, radians and world units."""
        with one_thread():  # the rounding of sums depends on the number of threads
            shares = (self._gauge * self._twists[:, :, None]).sum(dim=(0, 1))
            return (self._twists[index] - (self._gauge[index] * shares).sum(dim=1)) * self._units

    def refined(self, index: int, camera: Camera) -> Camera:
        """Return the corrected camera as numbers."""
        with torch.no_grad():
            found = self.camera(index, camera)
            return found.value() if isinstance(found, CameraTensors) else found

    def with_refined_lens(self, camera: Camera) -> Camera:
        """Return a camera with the refined intrinsics of its lens, if a training view was taken with that lens."""
        index = self._lenses_by_key.get(lens_key(camera))
        if index is None or LENSES not in self._names():
            return camera
        with torch.no_grad():
            given = CameraTensors.of(camera)
            return given.with_intrinsics(refined_intrinsics(given, self._lenses[index])).value()


def refinement_of(model: ViewModel) -> Refinement | None:
    """Return the part of a view model that refines the cameras; None if it refines none."""
    models = model.models if isinstance(model, Chain) else (model,)
    return next((part for part in models if isinstance(part, Refinement)), None)


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
