"""A renderer written from the two specifications in conformance/; each convention can be broken on purpose.

It imports nothing from the package. Unbroken, it is a third implementation that passes the conformance kit; broken,
it shows that the kit can fail.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from simple_lens import LensConventions, View, is_pinhole, nearest_copy, see

Arrays = dict[str, Any]

FACTORS = tuple(np.sqrt(np.array((1, 3, 3, 3, 15, 15, 5, 15, 15, 35, 105, 21, 7, 21, 105, 35)) / np.pi)) * (
    np.array((2, 2, 2, 2, 2, 2, 4, 2, 4, 4 * 2**0.5, 2, 4 * 2**0.5, 4, 4 * 2**0.5, 4, 4 * 2**0.5)) ** -1.0
)
SIGNS = np.array((1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1))


@dataclass(frozen=True)
class Conventions:
    """The conventions of the specification, of which a test replaces one."""

    pixel_offset: float = 0.0
    dilation: float = 0.3
    alpha_max: float | None = None  # None takes the setting
    alpha_min: float = 1 / 255
    largest_distance: float = np.inf  # standard deviations beyond which an ellipse is cut
    largest_deviation: float = np.inf  # px; larger Gaussians are dropped
    drops_means_outside: bool = False
    most_layers: int = 10**9
    axes_swapped: bool = False
    sh_signs: bool = True
    sh_order: tuple[int, ...] = tuple(range(16))
    sh_offset: float = 0.5
    sh_floor: bool = True
    sh_ceiling: float = np.inf
    sh_degree: int | None = None  # None takes the setting
    toward_camera: bool = False
    quaternion: tuple[int, ...] = (0, 1, 2, 3)
    normalised: bool = True
    transposed: bool = False
    clamps_jacobian: bool = True
    limit: float | None = None  # None takes the setting
    clamp_centre: str = "image"  # or "principal point"
    order: str = "z"  # or "distance", "input"
    ties: str = "first"  # or "last"
    z_near: float | None = None  # None takes the setting
    near_included: bool = False
    compensates: bool = True
    compensation_power: float = 0.5
    depth: str = "z"  # or "distance", "divided by alpha"
    features_over: float = 0.0
    background: float = 1.0
    median_below: float = 0.5
    stop: str = "never"  # or "before" the Gaussian that takes T of a pixel below stop_at
    stop_at: float = 1e-4
    refuses_empty: bool = False
    lens: LensConventions = field(default_factory=LensConventions)
    # these change gradients, but no outputs
    clamp_passes: bool = False
    floor_passes: bool = False
    cut_passes: bool = False
    jacobian_passes: bool = False
    direction_detached: bool = False
    jacobian_detached: bool = False
    lens_jacobian_detached: bool = False
    compensation_detached: bool = False
    length_detached: bool = False
    transmittance_detached: bool = False


class SimpleRenderer:
    """The two functions that the kit's runner takes."""

    def __init__(self, conventions: Conventions | None = None) -> None:
        self.c = conventions or Conventions()

    def render(self, gaussians: Arrays, camera: Arrays, settings: Arrays) -> Arrays:
        leaves = _leaves(gaussians, camera, settings, tracked=False)
        found = self._outputs(leaves, camera, settings)
        return {name: value.numpy(force=True) for name, value in found.items()}

    def gradients(self, gaussians: Arrays, camera: Arrays, settings: Arrays, upstream: Arrays) -> Arrays:
        leaves = _leaves(gaussians, camera, settings, tracked=True)
        found = self._outputs(leaves, camera, settings)
        sum((found[name] * torch.tensor(weight)).sum() for name, weight in upstream.items()).backward()
        return {n: (torch.zeros_like(v) if v.grad is None else v.grad).numpy() for n, v in leaves.items()}

    def _outputs(self, x: dict[str, Tensor], camera: Arrays, settings: Arrays) -> dict[str, Tensor]:
        c, shape = self.c, (camera["height"], camera["width"])
        if c.refuses_empty and len(x["means"]) == 0:
            raise ValueError("no Gaussians")
        pinhole = is_pinhole(camera)
        view = (
            self._through_pinhole(x, camera, settings)
            if pinhole
            else see(x, camera, settings["jacobian_limit"], c.lens)
        )
        drawn = self._order(x, view, settings)
        colours = self._colours(x, view.direction, settings)[drawn]
        means2d, cov = view.places[drawn], self._ellipses(x, view, drawn)
        alpha = self._alpha(x, drawn, means2d, cov, settings, camera, view.blur)
        before, after = self._transmittance(alpha)
        w = (before.detach() if c.transmittance_detached else before) * alpha
        T = after[-1] if len(drawn) else x["means"].new_ones(shape)
        z = view.depth[drawn]
        distance = (x["means"] - x["eye"])[drawn].norm(dim=-1)
        depth = torch.einsum("nyx,n->yx", w, z if c.depth != "distance" else distance)
        if c.depth == "divided by alpha":
            depth = depth / (1 - T).clamp(min=1e-12)
        crosses = ((before >= c.median_below) & (after < c.median_below)).to(w)
        return {
            "image": torch.einsum("nyx,nc->yxc", w, colours) + c.background * T[..., None] * x["background"],
            "transmittance": T,
            "alpha": 1 - T,
            "depth": depth,
            "median_depth": torch.einsum("nyx,n->yx", crosses, z).detach(),
            "features": torch.einsum("nyx,nc->yxc", w, x["features"][drawn]) + c.features_over * T[..., None],
        }

    def _order(self, x: dict[str, Tensor], view: View, settings: Arrays) -> Tensor:
        c, z = self.c, view.depth.detach()
        near = settings["z_near"] if c.z_near is None else c.z_near
        drawn = torch.nonzero(view.seen & (z >= near if c.near_included else z > near))[:, 0]
        distance = (x["means"] - x["eye"]).detach().norm(dim=-1)
        key = {"z": z, "distance": distance, "input": torch.zeros_like(z)}[c.order]
        if c.ties == "last":
            drawn = drawn.flip(0)
        return drawn[torch.argsort(key[drawn], stable=True)]

    def _colours(self, x: dict[str, Tensor], offset: Tensor, settings: Arrays) -> Tensor:
        c = self.c
        d = offset / offset.norm(dim=-1, keepdim=True)
        d = (d.detach() if c.direction_detached else d) * (-1 if c.toward_camera else 1)
        degree = settings["sh_degree"] if c.sh_degree is None else c.sh_degree
        used = min(x["sh"].shape[1], (degree + 1) ** 2)
        basis = torch.stack(_polynomials(*d.unbind(-1)), dim=-1) * torch.tensor(FACTORS)
        basis = (basis * torch.tensor(SIGNS) if c.sh_signs else basis)[:, list(c.sh_order)]
        raw = torch.einsum("nk,nkc->nc", basis[:, :used], x["sh"][:, :used]) + c.sh_offset
        floored = raw.clamp(min=0.0 if c.sh_floor else -np.inf, max=c.sh_ceiling)
        return raw + (floored - raw).detach() if c.floor_passes else floored

    def _through_pinhole(self, x: dict[str, Tensor], camera: Arrays, settings: Arrays) -> View:
        offset = x["means"] - x["eye"]
        px, py, depth = (offset @ x["R"].T).unbind(-1)
        near = self.c.z_near if self.c.z_near is not None else settings["z_near"]
        z = torch.where(depth.detach() < near, torch.ones_like(depth), depth)  # those are not drawn
        fx, fy = x["fx"], x["fy"]
        means2d = torch.stack([fx * px / z + x["cx"], fy * py / z + x["cy"]], dim=-1)
        sides = (("fx", "cx", "width"), ("fy", "cy", "height"))
        ratios = [
            self._clamped(ratio, x, names, camera, settings)
            for ratio, names in zip((px / z, py / z), sides, strict=True)
        ]
        zero = torch.zeros_like(z)
        rows = [[fx / z, zero, -fx * ratios[0] / z], [zero, fy / z, -fy * ratios[1] / z]]
        J = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        everywhere = torch.ones(len(z), dtype=torch.bool)
        # detached before the rotation, which is no part of the Jacobian
        JW = (J.detach() if self.c.jacobian_detached else J) @ x["R"]
        return View(means2d, JW, depth, offset, everywhere)

    def _ellipses(self, x: dict[str, Tensor], view: View, drawn: Tensor) -> Tensor:
        """Return covariances in the image before the dilation, (M, 2, 2)."""
        c = self.c
        q = x["quats"][drawn][:, list(c.quaternion)]
        length = q.norm(dim=-1, keepdim=True)
        q = q / (length.detach() if c.length_detached else length) if c.normalised else q
        Q = _rotation(q)
        JW = view.JW[drawn].detach() if c.lens_jacobian_detached else view.JW[drawn]
        M = JW @ ((Q.mT if c.transposed else Q) * torch.exp(x["log_scales"][drawn])[:, None])
        return M @ M.mT

    def _clamped(
        self,
        ratio: Tensor,
        x: dict[str, Tensor],
        names: tuple[str, str, str],
        camera: Arrays,
        settings: Arrays,
    ) -> Tensor:
        limit = settings["jacobian_limit"] if self.c.limit is None else self.c.limit
        if limit is None or not self.c.clamps_jacobian:
            return ratio
        f, middle, size = x[names[0]], x[names[1]], camera[names[2]]
        centre = (size - 1) / 2 if self.c.clamp_centre == "image" else middle
        low, high = ((centre + side * limit * size / 2 - middle) / f for side in (-1, 1))
        clamped = torch.minimum(torch.maximum(ratio, low), high)
        return ratio + (clamped - ratio).detach() if self.c.jacobian_passes else clamped

    def _alpha(
        self,
        x: dict[str, Tensor],
        drawn: Tensor,
        means2d: Tensor,
        cov: Tensor,
        settings: Arrays,
        camera: Arrays,
        blur: Tensor | None,
    ) -> Tensor:
        c, shape = self.c, (camera["height"], camera["width"])
        dilated = cov + c.dilation * torch.eye(2, dtype=cov.dtype)
        opacity = torch.sigmoid(x["logit_opacities"][drawn])
        if blur is not None:
            b = blur[drawn]
            blurred = dilated + b[:, :, None] * b[:, None, :] / 12
            opacity = opacity * (torch.linalg.det(dilated) / torch.linalg.det(blurred)) ** c.lens.blur_factor
            dilated = blurred
        if settings["antialiased"] and c.compensates:
            factor = (
                torch.linalg.det(cov).clamp(min=1e-12) / torch.linalg.det(dilated)
            ) ** c.compensation_power
            opacity = opacity * (factor.detach() if c.compensation_detached else factor)
        rows, columns = np.mgrid[: shape[0], : shape[1]] + c.pixel_offset
        grid = (rows, columns) if c.axes_swapped else (columns, rows)
        d = torch.tensor(np.stack(grid, axis=-1)) - means2d[:, None, None]
        d = torch.stack([nearest_copy(d[..., 0], camera, c.lens), d[..., 1]], dim=-1)
        square = torch.einsum("nyxi,nij,nyxj->nyx", d, torch.linalg.inv(dilated), d)
        raw = opacity[:, None, None] * torch.exp(-0.5 * square)
        clamped = raw.clamp(max=settings["alpha_max"] if c.alpha_max is None else c.alpha_max)
        alpha = raw + (clamped - raw).detach() if c.clamp_passes else clamped
        kept = (alpha >= c.alpha_min) & (square <= c.largest_distance**2)
        largest = dilated.diagonal(dim1=-2, dim2=-1).amax(dim=-1).sqrt()
        kept &= (largest <= c.largest_deviation)[:, None, None]
        if c.drops_means_outside:
            inside = (means2d > -0.5) & (means2d < torch.tensor(shape[::-1]) - 0.5)
            kept &= inside.all(dim=-1)[:, None, None]
        if c.cut_passes:
            return alpha - (alpha * ~kept).detach()
        return alpha * kept

    def _transmittance(self, alpha: Tensor) -> tuple[Tensor, Tensor]:
        c = self.c
        alpha = alpha * (torch.arange(len(alpha))[:, None, None] < c.most_layers)
        after = torch.cumprod(1 - alpha, dim=0)
        before = torch.cat([torch.ones_like(alpha[:1]), after[:-1]])
        if c.stop == "before":
            live = after >= c.stop_at
            after = torch.where(live, after, after.where(live, torch.inf).cummin(dim=0).values)
            before = torch.where(live, before, 0.0)
        return before, after


def _leaves(gaussians: Arrays, camera: Arrays, settings: Arrays, *, tracked: bool) -> dict[str, Tensor]:
    names = ["R", "eye", "fx", "fy", "cx", "cy"]
    names += ["distortion"] if camera["distortion"].any() else []
    names += ["turn", "shift"] if camera["readout"] != "none" or camera["exposure"] else []
    given = gaussians | {"background": settings["background"]} | {name: camera[name] for name in names}
    return {n: torch.tensor(v, dtype=torch.float64, requires_grad=tracked) for n, v in given.items()}


def _rotation(q: Tensor) -> Tensor:
    """Return the matrices of v -> q v q*, whose columns are the images of the three axes."""
    w, v = q[:, :1], q[:, 1:]
    axes = torch.eye(3, dtype=q.dtype)
    columns = []
    for axis in axes:
        turned = torch.linalg.cross(v, axis.expand_as(v))
        columns.append(axis + 2 * (w * turned + torch.linalg.cross(v, turned)))
    return torch.stack(columns, dim=-1)


def _polynomials(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Return the harmonics of degrees 0 to 3 without factors and signs, on the unit sphere."""
    return [
        *(torch.ones_like(x), y, z, x),
        *(x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y),
        *(y * (3 * x * x - y * y), x * y * z, y * (5 * z * z - 1), z * (5 * z * z - 3)),
        *(x * (5 * z * z - 1), z * (x * x - y * y), x * (x * x - 3 * y * y)),
    ]
