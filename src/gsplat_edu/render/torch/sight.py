"""Any projection and shutter in torch: `gsplat_edu.scene.sight` on tensors, for the dense renderer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.render.camera_tensors import CameraTensors, split_camera
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection_formulas import Operations
from gsplat_edu.scene.sight import Optics, Sight, sight

TORCH = Operations(torch.sqrt, torch.atan2, torch.where, torch.maximum)
"""The operations of `gsplat_edu.scene.projection_formulas` on tensors."""


class Through(NamedTuple):
    """The visible means in the image, near to far."""

    means2d: Float[Tensor, "M 2"]  # px
    JW: Float[Tensor, "M 2 3"]  # px per world unit
    depths: Float[Tensor, " M"]  # world units
    visible: Int64[Tensor, " M"]
    blur: Float[Tensor, "M 2"] | None  # px, see `gsplat_edu.scene.sight.Sight`


def like(tensor: Tensor, values: Tensor | np.ndarray | float | tuple[float, ...]) -> Tensor:
    """Return a camera's numbers with the dtype and on the device of a tensor."""
    if isinstance(values, Tensor):
        return values.to(tensor)
    return torch.tensor(values, dtype=tensor.dtype, device=tensor.device)


def through_lens(
    means: Float[Tensor, "N 3"], cam: Camera | CameraTensors, settings: RenderSettings
) -> Through:
    """Project means through any projection and shutter.

    Args:
        means: (N, 3) world units.
        cam: The camera.
        settings: The smallest depth, and the limit of the Jacobian.

    Returns:
        What the camera sees of the visible means.
    """
    # Means that are not seen are left out first: their numbers, and so their gradients, may be NaN.
    with torch.no_grad():
        seen = seen_by(means, cam, settings.z_near, settings.jacobian_limit)
        visible = torch.nonzero(seen.valid)[:, 0]
        visible = visible[torch.argsort(seen.depth[visible], stable=True)]
    seen = seen_by(means[visible], cam, settings.z_near, settings.jacobian_limit)
    JW = torch.stack([torch.stack(row, dim=-1) for row in seen.jacobian], dim=-2)
    blur = None if seen.blur is None else torch.stack(seen.blur, dim=-1)
    return Through(torch.stack([seen.u, seen.v], dim=-1), JW, seen.depth, visible, blur)


def seen_by(
    means: Float[Tensor, "N 3"],
    cam: Camera | CameraTensors,
    z_near: float,
    jacobian_limit: float | None = None,
) -> Sight:
    """Return where a camera sees means, in their dtype and on their device; see `gsplat_edu.scene.sight.sight`.

    Args:
        means: (N, 3) world units.
        cam: The camera.
        z_near: Smallest depth, world units.
        jacobian_limit: As for `Camera.jacobian_bounds`, whose bounds are constants for the gradients.
    """
    R, eye = like(means, cam.R), like(means, cam.eye)
    fx, fy, cx, cy = (like(means, each) for each in (cam.fx, cam.fy, cam.cx, cam.cy))
    optics = Optics(
        cam.projection,
        None if cam.coefficients is None else like(means, cam.coefficients).unbind(),
        cam.widest,
        None if cam.motion is None else like(means, cam.motion).unbind(),
        cam.readout,
        None if jacobian_limit is None else split_camera(cam)[0].jacobian_bounds(jacobian_limit),
        cam.exposure,
    )
    rows = [R[k].unbind() for k in range(3)]
    points, at = (means[:, 0], means[:, 1], means[:, 2]), (eye[0], eye[1], eye[2])
    return sight(points, rows, at, (fx, fy, cx, cy), optics, (cam.H, cam.W), z_near, TORCH)


def directions_through_lens(
    means: Float[Tensor, "N 3"], camera: Camera | CameraTensors
) -> Float[Tensor, "N 3"]:
    """Return unit vectors from the camera to the means when they are seen; zero where they are not.

    Args:
        means: (N, 3) world units.
        camera: The camera.
    """
    with torch.no_grad():
        seen = torch.nonzero(seen_by(means, camera, 0.0).valid)[:, 0]
    directions = torch.stack(
        [row.expand(len(seen)) for row in seen_by(means[seen], camera, 0.0).direction], dim=-1
    )
    unit = torch.nn.functional.normalize(directions, dim=-1)
    return torch.zeros_like(means).index_put((seen,), unit)
