"""Poses, lenses and rolling shutters of the cameras, learned with the scene and anchored to the given ones.

R_i' = exp([w_i]x) R_i,  eye_i' = eye_i + extent t_i,  with (w, t) = D - Q Qᵀ D

Moving all cameras and the scene together changes no image, so the photos do not determine such moves. The columns of Q
span them to first order: three shifts, three turns about the cameras' centre, and a change of scale. Subtracting the
projection of D onto these columns fixes the gauge: the cameras can move relative to one another, but not all together,
and the scene stays in the frame of the capture.

The poses are measured, not learned by gradient descent: whenever a view is drawn, D moves by the step that its render
and its photo ask for (`gsplat_edu.parts.poses.step`), and the next render of the view uses it.

Views with equal intrinsics share a lens, which Adam learns:
fx' = fx exp(a), fy' = fy exp(b), cx' = cx + c W, cy' = cy + d H, and k' = k + e W / (fx r^n) for coefficients of the
distortion that act at the n-th power of the radius; r is that of the image's corner, so that a unit of e moves the
corner by the width.

The motion during the readout is measured as the poses are, view by view. Its prior is centred at the given motion, or
at rest. A common turn of all views about their x axis is nearly a change of fy: only the prior fixes it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.parts.poses.step import pose_step
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import COEFFICIENTS
from gsplat_edu.scene.shutter import readout_times
from gsplat_edu.train.config import REFINEMENTS, TrainConfig
from gsplat_edu.train.feed import Target
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.rendered import Needs
from gsplat_edu.train.view_model import Chain, Identity, Rows, ViewModel, ViewRender

TWISTS, LENSES, DISTORTIONS, MOTIONS = "twists", "lenses", "distortions", "motions"
"""Names of the parameters."""

WORDS = {
    "poses": (TWISTS,),
    "intrinsics": (LENSES,),
    "both": (TWISTS, LENSES),
    "lens": (LENSES, DISTORTIONS),
    "shutter": (MOTIONS,),
    "all": (TWISTS, LENSES, DISTORTIONS, MOTIONS),
}
"""The parameters that each word of the setting `refine` learns."""

LEARNED = {
    value: tuple(name for word in value.split("+") for name in WORDS[word])
    for value in REFINEMENTS
    if value != "none"
}
"""The parameters that each value of the setting `refine` learns: words joined by +."""

NEED_LENSES = tuple(name for name, learned in LEARNED.items() if {DISTORTIONS, MOTIONS} & set(learned))
"""Values of `refine` that make every camera one that is not a pinhole at rest."""

FREE = {"perspective": ("k1", "k2", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Coefficients that are learned, by kind of projection: the first one, and the others if the given lens has them.
Photos say too little about all at once."""

LENS_WARM_UP = 0.2
"""Fraction of the run before a lens with distortion is learned. From the beginning, the unformed scene pulls it off: a
right lens was 0.5 px off after 2,000 iterations, and 0.2 px with a third of the run as warm-up."""

MOTION_SPREAD = 25.0
"""Standard deviation of the motion during a readout, in those of a pose (`pose_spread`): a turn of 0.25 radians. With
5, a shutter of 20 px came back by a third only."""

WARM_UP = 0.05
"""Fraction of the run before poses are first moved, because the scene has to take shape first."""

FINAL = 0.01
"""Final learning rate as a fraction of the initial one. The rate falls log-linearly until the means' rate is final."""


class Refinement(Identity):
    """Corrections of the poses, the lenses and the motions during the readout, as a view model.

    Args:
        cameras: The cameras of the training views, at their full size.
        config: The settings: which of them, the spread, the rate, and the length of the schedule.
        extent: Size of the scene, world units.
    """

    def __init__(self, cameras: Sequence[Camera], config: TrainConfig, extent: float) -> None:
        self._learns = config.refine
        keys = [lens_key(camera) for camera in cameras]
        self._lenses_by_key = {key: number for number, key in enumerate(dict.fromkeys(keys))}
        self._lens_of = [self._lenses_by_key[key] for key in keys]
        self._gauge = torch.from_numpy(gauge(cameras, extent))
        self._twists = torch.zeros(len(cameras), 6, dtype=torch.float64)
        self._motions = torch.zeros(len(cameras), 6, dtype=torch.float64)
        count = len(self._lenses_by_key)
        self._lenses = torch.zeros(count, 4, dtype=torch.float64).requires_grad_()
        self._distortions = torch.zeros(count, len(COEFFICIENTS), dtype=torch.float64).requires_grad_()
        units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
        self._units, self._spread = units, config.pose_spread * units
        self._begin = WARM_UP * config.means_rate_iterations
        begin = LENS_WARM_UP * config.means_rate_iterations if DISTORTIONS in self._names() else 0.0
        rate = functools.partial(_rate, config.lens_rate, config.means_rate_iterations, begin)
        self._group = ParameterGroup(rate, eps=config.adam_eps, per_gaussian=False)

    @property
    def needs(self) -> Needs:
        """Every pixel, and the median depth if poses or motions are refined."""
        return Needs(median_depth=TWISTS in self._names() or MOTIONS in self._names())

    def _names(self) -> tuple[str, ...]:
        return LEARNED[self._learns]

    def parameters(self) -> Mapping[str, Tensor]:
        """Return those of D, (views, 6), lenses, (lenses, 4), distortions and motions, (views, 6), that are learned."""
        tensors = {TWISTS: self._twists, LENSES: self._lenses}
        tensors |= {DISTORTIONS: self._distortions, MOTIONS: self._motions}
        return {name: tensors[name] for name in self._names()}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return the group of lenses and distortions: gradients do not move poses and motions."""
        return {name: self._group for name in self._names() if name in (LENSES, DISTORTIONS)}

    def camera(self, index: int, camera: Camera | CameraTensors) -> Camera | CameraTensors:
        """Return the corrected camera of a training view, at the size of the given one."""
        given = camera if isinstance(camera, CameraTensors) else CameraTensors.of(camera)
        if TWISTS in self._names():
            given = given.moved(self._moved(index))
        given = self._through_lens(self._lens_of[index], given)
        if MOTIONS in self._names():
            start = torch.zeros(6, dtype=torch.float64) if given.motion is None else given.motion
            given = dataclasses.replace(given, motion=start + self._motions[index] * self._units)
        # without tensors, the kernels compute no gradient of the camera
        return given if any(tensor.requires_grad for tensor in given.tensors()) else given.value()

    def measure(self, index: int, render: ViewRender, target: Target, iteration: int) -> Rows:
        """Return the row of the view, moved by the step that this render and the photo ask for."""
        measured = {TWISTS: self._twists, MOTIONS: self._motions}
        rows = {name: measured[name][index] for name in self._names() if name in measured}
        if iteration < self._begin or not rows:
            return rows
        if render.camera is None or render.depth is None:
            raise ArgumentError("render: has no camera or no depth, but poses are measured with both")
        camera = render.camera.value() if isinstance(render.camera, CameraTensors) else render.camera
        measure = functools.partial(
            pose_step, render.image, render.depth, camera, target.image, mask=target.mask
        )
        if TWISTS in rows:
            rows[TWISTS] = rows[TWISTS] + measure(self._moved(index), self._spread) / self._units
        if MOTIONS in rows:
            times = readout_times(camera.readout, camera.H, camera.W)
            motion = self._motions[index] * self._units
            step = measure(motion, MOTION_SPREAD * self._spread, times=times)
            rows[MOTIONS] = rows[MOTIONS] + step / self._units
        return rows

    def _through_lens(self, lens: int, given: CameraTensors) -> CameraTensors:
        """Return a camera with the changes of its lens."""
        units = distortion_units(given)
        if LENSES in self._names():
            given = given.with_intrinsics(refined_intrinsics(given, self._lenses[lens]))
        if DISTORTIONS in self._names() and units is not None:
            start = torch.zeros_like(units) if given.coefficients is None else given.coefficients
            given = dataclasses.replace(given, coefficients=start + units * self._distortions[lens])
        return given

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
        if index is None:
            return camera
        with torch.no_grad():
            return self._through_lens(index, CameraTensors.of(camera)).value()


def refinement_of(model: ViewModel) -> Refinement | None:
    """Return the part of a view model that refines the cameras; None if it refines none."""
    models = model.models if isinstance(model, Chain) else (model,)
    return next((part for part in models if isinstance(part, Refinement)), None)


def lens_key(camera: Camera) -> Intrinsics:
    """Return what the views of one lens have in common: their intrinsics, size and projection."""
    return camera.intrinsics


def distortion_units(camera: CameraTensors) -> Float64[Tensor, "15"] | None:
    """Return the units in which the coefficients of a camera's distortion are learned; 0 for those that are not.

    Args:
        camera: The camera.

    Returns:
        (15,) as `gsplat_edu.scene.projection.COEFFICIENTS`; None if the kind of projection has no distortion.
    """
    free = FREE.get(camera.projection.kind)
    if free is None:
        return None
    fx, fy, cx, cy = camera.intrinsics.detach().tolist()
    corner = math.hypot(max(cx, camera.W - 1 - cx) / fx, max(cy, camera.H - 1 - cy) / fy)
    powers = {"k1": 3, "k2": 5, "k3": 7, "k4": 9, "p1": 2, "p2": 2}
    values = (
        [0.0] * len(COEFFICIENTS) if camera.coefficients is None else camera.coefficients.detach().tolist()
    )
    has = {name for name, value in zip(COEFFICIENTS, values, strict=True) if value}
    units = [
        camera.W / fx / corner ** powers[name] if name == free[0] or (name in free and name in has) else 0.0
        for name in COEFFICIENTS
    ]
    return torch.tensor(units, dtype=torch.float64)


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


def _rate(rate: float, iterations: int, begin: float, iteration: int) -> float:
    if iteration < begin:
        return 0.0
    return float(rate * FINAL ** min(iteration / max(iterations, 1), 1.0))
