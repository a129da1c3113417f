"""Lenses and shutters for `simple_renderer`, written from conformance/LENSES.md alone.

The ellipse is the derivative of the place at which a mean is seen, by automatic differentiation: no formula of a
Jacobian and none of the shear of a rolling shutter. The time is solved by iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

Arrays = dict[str, Any]

ITERATIONS = 40
"""Each one divides the error of the time by ten or more."""


@dataclass(frozen=True)
class LensConventions:
    """The conventions of lenses, of which a test replaces one."""

    distorts: bool = True
    prism: tuple[int, ...] = (11, 12, 13, 14)
    radial_first: bool | None = None  # None takes the camera's
    lens_ends: bool = True
    behind: bool = True  # whether a fisheye sees z <= 0
    depth: str = "distance"  # or "z", of fisheyes and panoramas
    periodic: bool = True
    parallel: bool = True  # whether directions of an orthographic camera are its axis
    first_time: float = 0.5  # of the centre of the first row, in rows
    rows: int = 0  # the readout takes the time of the image's rows and these
    reverses: bool = True
    columns: bool = True  # whether the readouts right and left are those of columns
    shears: bool = True
    blurs: bool = True
    follows: bool = True  # whether the row that sees a blurred mean changes with its motion
    blur_factor: float = 0.5  # power of the determinants' ratio by which a blurred opacity is lowered
    shifts: bool = True
    clamps: bool = True
    edges_distorted: bool = True  # whether the bounds are those of the image's rays
    # these change gradients, but no outputs
    time_detached: bool = False
    blur_detached: bool = False


@dataclass(frozen=True)
class View:
    """Where a camera sees means.

    Args:
        places: (N, 2) u and v, px.
        JW: (N, 2, 3) derivatives of the places by the means.
        depth: (N,) world units.
        direction: (N, 3) from the camera to the mean, any length.
        seen: (N,) bool.
        blur: (N, 2) motion in the image during an exposure, px; None for none.
    """

    places: Tensor
    JW: Tensor
    depth: Tensor
    direction: Tensor
    seen: Tensor
    blur: Tensor | None = None


def is_pinhole(camera: Arrays) -> bool:
    """Return whether a camera has neither a lens nor a shutter."""
    plain = camera["projection"] == "perspective" and not camera["distortion"].any()
    return bool(plain and camera["readout"] == "none" and not camera["exposure"])


def see(x: dict[str, Tensor], camera: Arrays, limit: float | None, c: LensConventions) -> View:
    """See the means.

    Args:
        x: Has means, R, eye, fx, fy, cx, cy, and what the camera has of distortion, turn and shift.
        camera: The camera.
        limit: That of the Jacobian.
        c: The conventions.
    """
    with torch.enable_grad():
        means = x["means"] if x["means"].requires_grad else x["means"].clone().requires_grad_()
        later = means.new_zeros(len(means), requires_grad=True)  # of the moment within the exposure
        time = _time(means, x, camera, c, later)
        p, offset = _in_camera(means, time, x, c)
        places = _place(p, x, camera, c)
        held = _place(_in_camera(means, time.detach(), x, c)[0], x, camera, c)
        moved = places if c.shears else held
        of = means
        if limit is not None and camera["projection"] == "perspective" and c.clamps:
            of, moved = _clamped(p, time, x, camera, limit, c)
        rows = [torch.autograd.grad(moved[:, k].sum(), of, create_graph=True)[0] for k in (0, 1)]
        blur = None
        if camera["exposure"] and c.blurs:
            of_row = (
                places
                if c.follows
                else _place(_in_camera(means, time.detach() + later, x, c)[0], x, camera, c)
            )
            slopes = [torch.autograd.grad(of_row[:, k].sum(), later, create_graph=True)[0] for k in (0, 1)]
            blur = camera["exposure"] * torch.stack(slopes, dim=1)
            blur = blur.detach() if c.blur_detached else blur
        places = held if c.time_detached else places
    along = camera["projection"] in ("fisheye", "equirectangular") and c.depth == "distance"
    depth = p.norm(dim=-1) if along else p[:, 2]
    if camera["projection"] == "orthographic" and c.parallel:
        offset = x["R"][2].expand_as(offset)
    return View(places, torch.stack(rows, dim=1), depth, offset, _within(p, x, camera, c), blur)


def _time(means: Tensor, x: dict[str, Tensor], camera: Arrays, c: LensConventions, later: Tensor) -> Tensor:
    """Return the times at which the means are seen, -1/2 to 1/2 within the image; 0 for a camera at rest.

    A row sees them `later` than at its own time.
    """
    time = means.new_zeros(len(means))
    if camera["readout"] == "none":
        return time + later
    column = camera["readout"] in ("right", "left") and c.columns
    size = camera["width"] if column else camera["height"]
    sign = -1 if camera["readout"] in ("up", "left") and c.reverses else 1

    def of_place(at: Tensor) -> Tensor:
        place = _place(_in_camera(means, at, x, c)[0], x, camera, c)[:, 0 if column else 1]
        return sign * ((place + c.first_time) / (size + c.rows) - 0.5) + later

    with torch.no_grad():
        for _ in range(ITERATIONS):
            time = of_place(time)
    for _ in range(2):  # at the solution: it stays, and gets its first and second derivatives
        time = time.requires_grad_() if not time.requires_grad else time
        found = of_place(time)
        slope = torch.autograd.grad(found.sum(), time, create_graph=True)[0]
        time = time - (time - found) / (1 - slope)
    return time


def _clamped(
    p: Tensor, time: Tensor, x: dict[str, Tensor], camera: Arrays, limit: float, c: LensConventions
) -> tuple[Tensor, Tensor]:
    """Return the clamped means in world axes, and places of which the ellipses are the derivatives by them.

    Each is read at the time of its mean, and moves with the time of its place from there.
    """
    ratios = p[:, :2] / p[:, 2:]
    low, high = _bounds(x, camera, limit, c)
    inside = torch.cat([torch.minimum(torch.maximum(ratios, low), high), torch.ones_like(p[:, 2:])], dim=1)
    inside, time = (inside * p[:, 2:]).detach(), time.detach()
    eye = x["eye"] if "turn" not in x else x["eye"] + time[:, None] * x["shift"]
    world = (torch.linalg.solve(_rotations(time, x), inside) + eye).detach().requires_grad_()
    place = _place(_in_camera(world, time, x, c)[0], x, camera, c)
    if camera["readout"] == "none":
        return world, place
    column = 0 if camera["readout"] in ("right", "left") else 1
    pace = (-1 if camera["readout"] in ("up", "left") else 1) / (camera["height"], camera["width"])[
        1 - column
    ]
    moment = time
    for _ in range(ITERATIONS):
        now = _place(_in_camera(world, moment, x, c)[0], x, camera, c)[:, column]
        moment = time + pace * (now - place[:, column].detach())
    return world, _place(_in_camera(world, moment, x, c)[0], x, camera, c)


def _bounds(x: dict[str, Tensor], camera: Arrays, limit: float, c: LensConventions) -> tuple[Tensor, Tensor]:
    """Return the least and largest (x/z, y/z): those of the rays of 33 places on each edge, enlarged."""
    size, share = np.array([camera["width"], camera["height"]]), np.linspace(0, 1, 33)
    along = np.stack([np.append(share, share), np.repeat([0.0, 1.0], 33)], axis=1)
    places = torch.tensor(np.concatenate([along, along[:, ::-1]]) * size - 0.5)
    f, middle = (torch.stack([x[a], x[b]]).detach() for a, b in (("fx", "fy"), ("cx", "cy")))
    aim = (places - middle) / f
    rays = aim.clone()
    if "distortion" in x and c.edges_distorted:
        for _ in range(200):  # each one divides the error by three or more
            a, b = _distorted(rays[:, 0], rays[:, 1], x["distortion"].detach(), camera["radial_first"], c)
            rays = rays - (torch.stack([a, b], dim=1) - aim) / 1.5
    low, high = rays.min(dim=0).values, rays.max(dim=0).values
    centre, half = (low + high) / 2, limit * (high - low) / 2
    return centre - half, centre + half


def _in_camera(
    means: Tensor, time: Tensor, x: dict[str, Tensor], c: LensConventions
) -> tuple[Tensor, Tensor]:
    """Return means in the camera's axes at a time, and their offsets from its centre in world axes."""
    if "turn" not in x:
        return (means - x["eye"]) @ x["R"].T, means - x["eye"]
    shift = x["shift"] if c.shifts else torch.zeros_like(x["shift"])
    offset = means - x["eye"] - time[:, None] * shift
    return torch.einsum("nij,nj->ni", _rotations(time, x), offset), offset


def _rotations(time: Tensor, x: dict[str, Tensor]) -> Tensor:
    """Return the rotations of the camera at times, (N, 3, 3)."""
    if "turn" not in x:
        return x["R"].expand(len(time), 3, 3)
    h = 0.5 * time[:, None] * x["turn"]
    zero = torch.zeros_like(time)
    cross = torch.stack(
        [zero, -h[:, 2], h[:, 1], h[:, 2], zero, -h[:, 0], -h[:, 1], h[:, 0], zero], dim=-1
    ).reshape(-1, 3, 3)
    one = torch.eye(3, dtype=time.dtype)
    turned = torch.linalg.solve(one - cross, one + cross)  # Cayley: (I - [h])^-1 (I + [h])
    return torch.einsum("nij,jk->nik", turned, x["R"])


def _place(p: Tensor, x: dict[str, Tensor], camera: Arrays, c: LensConventions) -> Tensor:
    """Return u and v (N, 2) of points in the camera's axes."""
    px, py, pz = p.unbind(-1)
    kind = camera["projection"]
    if kind == "equirectangular":
        a, b = torch.atan2(px, pz), torch.atan2(py, torch.hypot(px, pz))
    elif kind == "orthographic":
        a, b = px, py
    elif kind == "fisheye":
        r = torch.hypot(px, py)
        theta = torch.atan2(r, pz)
        a, b = px / r * theta, py / r * theta
    else:
        a, b = px / pz, py / pz
    if "distortion" in x and c.distorts:
        a, b = _distorted(a, b, x["distortion"], camera["radial_first"], c)
    return torch.stack([x["fx"] * a + x["cx"], x["fy"] * b + x["cy"]], dim=-1)


def _radial(q: Tensor, k: Tensor) -> Tensor:
    above = 1 + sum(k[i] * q ** (i + 1) for i in range(6))
    return above / (1 + sum(k[6 + i] * q ** (i + 1) for i in range(3)))


def _distorted(
    a: Tensor, b: Tensor, k: Tensor, radial_first: bool, c: LensConventions
) -> tuple[Tensor, Tensor]:
    R = _radial(a * a + b * b, k)
    first = radial_first if c.radial_first is None else c.radial_first
    A, B = (R * a, R * b) if first else (a, b)
    Q = A * A + B * B
    p1, p2 = k[9], k[10]
    s1, s2, s3, s4 = (k[i] for i in c.prism)
    return (
        R * a + 2 * p1 * A * B + p2 * (Q + 2 * A * A) + s1 * Q + s2 * Q * Q,
        R * b + p1 * (Q + 2 * B * B) + 2 * p2 * A * B + s3 * Q + s4 * Q * Q,
    )


def _within(p: Tensor, x: dict[str, Tensor], camera: Arrays, c: LensConventions) -> Tensor:
    """Return which points a lens can see: not behind a perspective one, and not beyond its end."""
    kind, p = camera["projection"], p.detach()
    if kind in ("equirectangular", "orthographic"):
        return torch.ones(len(p), dtype=torch.bool)
    r = torch.hypot(p[:, 0], p[:, 1])
    radius = torch.atan2(r, p[:, 2]) if kind == "fisheye" else r / p[:, 2]
    seen = p[:, 2] > 0 if kind == "perspective" or not c.behind else torch.ones_like(r, dtype=torch.bool)
    if "distortion" not in x or not c.lens_ends:
        return seen
    grid = torch.linspace(0, 1, 4000, dtype=p.dtype) * radius[:, None]
    grows = (grid * _radial(grid * grid, x["distortion"].detach())).diff(dim=1) > 0
    return seen & grows.all(dim=1)


def nearest_copy(columns: Tensor, camera: Arrays, c: LensConventions) -> Tensor:
    """Return distances in columns, px, to the nearest copy of a mean in a panorama."""
    if camera["projection"] != "equirectangular" or not c.periodic:
        return columns
    return columns - camera["width"] * torch.round(columns.detach() / camera["width"])
