"""gsplat's camera models, distortion and rolling shutter, through `gsplat_edu.scene.sight`.

gsplat has two projections. Without `with_ut` it takes the Jacobian of the lens, as here, for pinhole, ortho and
fisheye. With it, it moves seven points of each Gaussian through lens and shutter and takes the moments of their
images. Here distortion and shutter have the Jacobian too, which is exact to first order and has gradients for all.

A rolling shutter is given by the poses of its first and last row or column. Between them gsplat interpolates: rotations
along the great circle, and t of p = R x + t linearly. Here the rotation is Cayley's map, and the centre moves in a
straight line. Both have the given poses at the ends. With the angle a between the rotations,

    |w| = 4 tan(a / 4),  the axis is that of Q = R1 R0',  tan(a / 2) axis = vee(Q - Q') / (1 + tr Q)

and half time has C(w / 2) R0 and the centre (e0 + e1) / 2. The rotations differ by less than 0.0042 a³ in between, the
centres by up to a² / 8 times the distance of the centre from the origin of the world.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat.checks import Arguments
from gsplat_edu.render.torch.sight import TORCH
from gsplat_edu.scene.projection import COEFFICIENTS, STEEPEST_FISHEYE, Distortion, Projection
from gsplat_edu.scene.shutter import LARGEST_TURN, readout_axis
from gsplat_edu.scene.sight import Optics, Sight, sight

KINDS_BY_MODEL = {"pinhole": "perspective", "ortho": "orthographic", "fisheye": "fisheye"}
"""Our kinds of projection by gsplat's camera models."""

READOUT_BY_SHUTTER = {
    "ROLLING_TOP_TO_BOTTOM": "down",
    "ROLLING_BOTTOM_TO_TOP": "up",
    "ROLLING_LEFT_TO_RIGHT": "right",
    "ROLLING_RIGHT_TO_LEFT": "left",
}
"""Our readouts by the names of gsplat's rolling shutters."""

PINHOLE_RADIAL = ("k1", "k2", "k3", "d1", "d2", "d3")
"""Names of `radial_coeffs` of a pinhole: numerator and denominator, as OpenCV's k1 to k6."""

FISHEYE_RADIAL = ("k1", "k2", "k3", "k4")
TANGENTIAL = ("p1", "p2")
THIN_PRISM = ("s1", "s2", "s3", "s4")

FARTHEST_RATIO = 1e6
"""Largest tangent of the angle to the axis of an undistorted pinhole with a rolling shutter: none that matters."""

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R' - I of a pose of a rolling shutter."""

CENTRE = 0.5
"""Coordinate of the first pixel's centre in gsplat, px; in this package it is 0."""


class CameraModel(NamedTuple):
    """Lens and shutter of B x C cameras.

    Args:
        kind: One of `gsplat_edu.scene.projection.PROJECTIONS`.
        coefficients: As `gsplat_edu.scene.projection.COEFFICIENTS`; None for no distortion.
        motion: Turn and shift of a rolling shutter; None for a global one.
        readout: The direction of a rolling shutter.
    """

    kind: str = "perspective"
    coefficients: Float[Tensor, "B C 15"] | None = None
    motion: Float[Tensor, "B C 6"] | None = None
    readout: str = "down"

    @property
    def plain(self) -> bool:
        """Whether this is gsplat's pinhole."""
        return self.kind == "perspective" and self.coefficients is None and self.motion is None


def cameras_of(a: Arguments) -> tuple[Float[Tensor, "B C 4 4"], CameraModel]:
    """Return the world-to-camera matrices, of a rolling shutter those at half time, and the lens and shutter.

    Differentiable in: viewmats, viewmats_rs, and the coefficients.
    """
    viewmats, kind = a.viewmats.reshape(-1, a.C, 4, 4), KINDS_BY_MODEL[a.camera_model]
    coefficients = _coefficients(a)
    if a.viewmats_rs is None:
        return viewmats, CameraModel(kind, coefficients)
    readout = READOUT_BY_SHUTTER[a.rolling_shutter.name]
    rows = (a.width, a.height)[readout_axis(readout)]
    middle, motion = half_time(viewmats.double(), a.viewmats_rs.reshape(-1, a.C, 4, 4).double(), rows)
    return middle, CameraModel(kind, coefficients, motion, readout)


def _coefficients(a: Arguments) -> Float[Tensor, "B C 15"] | None:
    """Return gsplat's coefficients in our order; None if there are none."""
    radial = FISHEYE_RADIAL if a.camera_model == "fisheye" else PINHOLE_RADIAL
    given: dict[str, Tensor] = {}
    for names, tensor in (
        (radial, a.radial_coeffs),
        (TANGENTIAL, a.tangential_coeffs),
        (THIN_PRISM, a.thin_prism_coeffs),
    ):
        if tensor is not None:
            given |= dict(zip(names, tensor.double().reshape(-1, a.C, len(names)).unbind(-1), strict=True))
    if not given:
        return None
    zero = torch.zeros_like(next(iter(given.values())))
    return torch.stack([given.get(name, zero) for name in COEFFICIENTS], dim=-1)


def half_time(
    start: Float[Tensor, "B C 4 4"], end: Float[Tensor, "B C 4 4"], rows: int
) -> tuple[Float[Tensor, "B C 4 4"], Float[Tensor, "B C 6"]]:
    """Return the pose at half time, the turn and the shift of a readout, from the poses of its first and last row.

    gsplat's last row has the end pose. Our readout lasts from the upper edge of the first row to the lower edge of the
    last, which is longer by rows / (rows - 1).

    Args:
        start: World to camera for the first row.
        end: World to camera for the last row.
        rows: Rows, or columns, that are read one after the other.

    Returns:
        World to camera at half time, and turn and shift as in `gsplat_edu.scene.shutter.RollingShutter`.

    Raises:
        ArgumentError: a matrix has no rotation, or the camera turns too far.

    Differentiable in: start, end.
    """
    (R0, t0), (R1, t1) = ((each[..., :3, :3], each[..., :3, 3:]) for each in (start, end))
    for name, R in (("viewmats", R0), ("viewmats_rs", R1)):
        error = (R.detach() @ R.detach().mT - torch.eye(3, dtype=R.dtype)).abs()
        if float(error.amax()) > ROTATION_TOLERANCE:
            raise ArgumentError(
                f"{name}: a rolling shutter needs matrices with rotations, of which one has none"
            )
    e0, e1 = -R0.mT @ t0, -R1.mT @ t1
    Q = R1 @ R0.mT
    vee = torch.stack(
        [Q[..., 2, 1] - Q[..., 1, 2], Q[..., 0, 2] - Q[..., 2, 0], Q[..., 1, 0] - Q[..., 0, 1]], -1
    )
    half = vee / (1 + Q.diagonal(dim1=-2, dim2=-1).sum(-1))[..., None]
    whole = 4 * half / (1 + torch.sqrt(1 + (half * half).sum(-1, keepdim=True)))
    longer = rows / max(rows - 1, 1)
    if not bool((longer * whole.detach().norm(dim=-1) <= LARGEST_TURN).all()):
        raise ArgumentError(
            "viewmats_rs: the camera turns by more than a radian in one image; give the poses of its first and last row"
        )
    R = _cayley(whole / 4) @ R0
    eye = 0.5 * (e0 + e1)
    top = torch.cat([R, -R @ eye], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype).expand(*R.shape[:-2], 1, 4)
    motion = longer * torch.cat([whole, (e1 - e0)[..., 0]], dim=-1)
    return torch.cat([top, last], dim=-2), motion


def _cayley(h: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the rotation by 2 atan |h| about h."""
    x, y, z = h.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*h.shape[:-1], 3, 3)
    f = (2 / (1 + (h * h).sum(-1)))[..., None, None]
    return torch.eye(3, dtype=h.dtype) + f * (cross + cross @ cross)


def see(
    means: Float[Tensor, "B N 3"],
    viewmats: Float[Tensor, "B C 4 4"],
    Ks: Float[Tensor, "B C 3 3"],
    size: tuple[int, int],
    model: CameraModel,
    wanted: Bool[Tensor, "B C N"],
) -> tuple[Float[Tensor, "B C N 2"], Float[Tensor, "B C N 2 3"], Bool[Tensor, "B C N"]]:
    """See means through the lens and shutter of each camera.

    Args:
        means: World units.
        viewmats: World to camera, at half time.
        Ks: Intrinsics, px.
        size: Width and height, px.
        model: Lens and shutter.
        wanted: Which means to project in which camera.

    Returns:
        Centres, px; their derivatives by the axes of the world, px per world unit; and which are seen. What is not seen
        has zeros.

    Differentiable in: means, viewmats, Ks, model.
    """
    B, C = viewmats.shape[:2]
    found = [
        _seen(means[b], viewmats[b, c], Ks[b, c], size, _of_camera(model, b, c, Ks[b, c], size), wanted[b, c])
        for b in range(B)
        for c in range(C)
    ]
    centres, jacobians, valid = (
        torch.stack(each).view(B, C, *each[0].shape) for each in zip(*found, strict=True)
    )
    return centres, jacobians, valid


def _of_camera(model: CameraModel, b: int, c: int, K: Float[Tensor, "3 3"], size: tuple[int, int]) -> Optics:
    """Return lens and shutter of one camera; an undistorted lens projects all that it can."""
    coefficients, projection, widest = None, Projection(model.kind), STEEPEST_FISHEYE
    if model.kind == "perspective":
        widest = math.atan(FARTHEST_RATIO)
    if model.coefficients is not None:
        coefficients = model.coefficients[b, c].unbind()
        distorted = Projection(model.kind, Distortion(tuple(model.coefficients[b, c].tolist())))
        (fx, cx), (fy, cy) = ((float(K.detach()[k, k]), float(K.detach()[k, 2])) for k in (0, 1))
        corner = max(cx, size[0] - cx) / fx, max(cy, size[1] - cy) / fy
        widest = distorted.widest(math.hypot(*corner))
    motion = None if model.motion is None else model.motion[b, c].unbind()
    return Optics(projection, coefficients, widest, motion, model.readout)


def _seen(
    means: Float[Tensor, "N 3"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    optics: Optics,
    wanted: Bool[Tensor, " N"],
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2 3"], Bool[Tensor, " N"]]:
    """See means in one camera."""
    R = viewmat[:3, :3]
    eye = torch.linalg.solve(R, -viewmat[:3, 3])  # of any matrix, so that the gradient has all entries
    rows, at = [R[k].unbind() for k in range(3)], (eye[0], eye[1], eye[2])
    lens = (K[0, 0], K[1, 1], K[0, 2] - CENTRE, K[1, 2] - CENTRE)

    def seen(points: Float[Tensor, "M 3"]) -> Sight:
        x, y, z = points.unbind(-1)
        return sight((x, y, z), rows, at, lens, optics, size[::-1], -math.inf, TORCH)

    # Means that are not seen are left out: their numbers, and so their gradients, may be NaN.
    with torch.no_grad():
        valid = wanted & seen(means).valid
        index = valid.nonzero()[:, 0]
    found = seen(means[index])
    centre = torch.stack([found.u, found.v], dim=-1) + CENTRE
    jacobian = torch.stack([torch.stack(row, dim=-1) for row in found.jacobian], dim=-2)
    N = len(means)
    return (
        means.new_zeros(N, 2).index_put((index,), centre),
        means.new_zeros(N, 2, 3).index_put((index,), jacobian.expand(len(index), 2, 3)),
        valid,
    )
