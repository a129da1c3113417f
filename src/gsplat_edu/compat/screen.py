"""gsplat's pinhole and its harmonics, natively: each a step of the graph, with a gradient of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int32, Int64
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.threads import native_threads
from gsplat_edu.ops.kernels import kernel, native_array

INSTEAD = 'render of gsplat_edu with backend="torch"'
"""What has second derivatives."""


class Solids(NamedTuple):
    """Gaussians of B batches: covariances, or the quaternions and scales that make them."""

    means: Float[Tensor, "B N 3"]
    covars: Float[Tensor, "B N 6"] | None = None
    quats: Float[Tensor, "B N 4"] | None = None
    scales: Float[Tensor, "B N 3"] | None = None


class Lens(NamedTuple):
    """Size of the image, px, and which Gaussians count."""

    width: int
    height: int
    eps2d: float
    near: float
    far: float
    radius_clip: float


class OnScreen(NamedTuple):
    """N Gaussians of B batches in C cameras each, where `drawable`."""

    centres: Float64[Tensor, "B C N 2"]
    depths: Float64[Tensor, "B C N"]
    conics: Float64[Tensor, "B C N 3"]
    compensations: Float64[Tensor, "B C N"]
    spreads: Float64[Tensor, "B C N 3"]
    """xx, xy and yy of the covariance before eps2d, px²."""
    drawable: Bool[Tensor, "B C N"]
    """Between near and far, and not too thin to be drawn."""


def through_pinhole(
    solids: Solids,
    viewmats: Float[Tensor, "B C 4 4"],
    Ks: Float[Tensor, "B C 3 3"],
    lens: Lens,
    margin: float,
) -> OnScreen:
    """Project every Gaussian into every camera of its batch.

    Args:
        solids: The Gaussians.
        viewmats: World to camera; the last row is not read.
        Ks: Intrinsics, px; skew is not read.
        lens: Size of the image and limits.
        margin: x/z and y/z are clamped inside the Jacobian at the edge of the image, moved outwards by this fraction.

    Differentiable in: solids, viewmats, Ks. What is not between near and far has a depth of 1 in all formulas but its
    own.
    """
    found = _Screen.apply((lens, margin), *solids, viewmats, Ks)  # type: ignore[no-untyped-call]
    return OnScreen(*found)


@first_derivative_only("gsplat's projection", INSTEAD)
class _Screen(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        limits: tuple[Lens, float],
        means: Tensor,
        covars: Tensor | None,
        quats: Tensor | None,
        scales: Tensor | None,
        viewmats: Tensor,
        Ks: Tensor,
    ) -> tuple[Tensor, ...]:
        given = Solids(
            *(None if t is None else t.detach().contiguous() for t in (means, covars, quats, scales))  # type: ignore[arg-type]
        )
        found = screen(given, viewmats, Ks, *limits)
        ctx.limits = limits
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*given, viewmats, Ks)
        ctx.mark_non_differentiable(found.drawable)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        *kept, viewmats, Ks = ctx.saved_tensors
        lens, margin = ctx.limits
        return None, *screen_gradients(Solids(*kept), viewmats, Ks, lens, margin, grads[:5])


def screen(solids: Solids, viewmats: Tensor, Ks: Tensor, lens: Lens, margin: float) -> OnScreen:
    """Project as `through_pinhole` does, outside of any graph; all tensors are contiguous."""
    (B, C), N = viewmats.shape[:2], solids.means.shape[1]
    shapes = ((B, C, N, 2), (B, C, N), (B, C, N, 3), (B, C, N), (B, C, N, 3))
    out = [torch.empty(shape, dtype=torch.float64) for shape in shapes]
    drawable = torch.empty((B, C, N), dtype=torch.uint8)
    names = ("centres", "depths", "conics", "compensations", "spreads", "drawable")
    for b, c, given in _cameras((lens, margin), solids, viewmats, Ks):
        own = {name: native_array(each[b, c]) for name, each in zip(names, (*out, drawable), strict=True)}
        kernel("screen_f", solids.means.dtype)(**given, **own)
    return OnScreen(*(*out, drawable.view(torch.bool)))


def screen_gradients(
    solids: Solids,
    viewmats: Tensor,
    Ks: Tensor,
    lens: Lens,
    margin: float,
    grads: Sequence[Tensor | None],
) -> list[Tensor | None]:
    """Return the gradients of `screen`: of the solids, of which some are None, of viewmats and of Ks.

    Args:
        solids: Those given to `screen`.
        viewmats: Its cameras' matrices.
        Ks: Its cameras' intrinsics.
        lens: Its lens.
        margin: Its margin.
        grads: Gradients of the first five fields of its result, float64; None for zero.
    """
    arriving = [None if g is None else g.contiguous() for g in grads]
    gradients = [None if t is None else torch.zeros_like(t) for t in solids]
    to_viewmats, to_Ks = torch.zeros_like(viewmats), torch.zeros_like(Ks)
    names = ("grad_centres", "grad_depths", "grad_conics", "grad_compensations", "grad_spreads")
    into = ("grad_means", "grad_covars", "grad_quats", "grad_scales")
    for b, c, given in _cameras((lens, margin), solids, viewmats, Ks):
        own = {
            name: None if g is None else native_array(g[b, c])
            for name, g in zip(names, arriving, strict=True)
        }
        own |= {name: native_array(g[b]) for name, g in zip(into, gradients, strict=True) if g is not None}
        found = kernel("screen_backward_f", solids.means.dtype)(**given, **own)
        sums = torch.tensor(found, dtype=torch.float64)
        to_viewmats[b, c, :3] = sums[:12].view(3, 4)
        for k in (0, 1):
            to_Ks[b, c, k, k], to_Ks[b, c, k, 2] = sums[12 + k], sums[14 + k]
    return [*gradients, to_viewmats, to_Ks]


def _cameras(limits: tuple[Lens, float], kept: Sequence[Tensor | None], viewmats: Tensor, Ks: Tensor) -> Any:  # noqa: ANN401
    """Yield batch, camera and the arguments of the kernel for each camera."""
    lens, margin = limits
    common: dict[str, Any] = {"margin": margin, "eps2d": lens.eps2d, "z_near": lens.near, "z_far": lens.far}
    common |= {"size": (lens.width, lens.height), "threads": native_threads()}
    matrices, intrinsics = viewmats[..., :3, :].flatten(2).tolist(), Ks.tolist()
    for b, rows in enumerate(matrices):
        given = dict(zip(("means", "covars", "quats", "scales"), kept, strict=True))
        scene = {name: None if t is None else native_array(t[b]) for name, t in given.items()}
        scene = {name: each for name, each in scene.items() if each is not None or name == "covars"}
        for c, matrix in enumerate(rows):
            K = intrinsics[b][c]
            yield b, c, {**common, **scene, "viewmat": matrix, "K": (K[0][0], K[1][1], K[0][2], K[1][2])}


def box_radii(
    found: OnScreen, opacities: Float[Tensor, "B C N"] | None, compensated: bool, lens: Lens, extent: float
) -> Int32[Tensor, "B C N 2"]:
    """Return the half sizes of the boxes, px, rounded up; 0 for Gaussians that are not drawn.

    Args:
        found: The Gaussians on the screen.
        opacities: Make the boxes tighter; None for boxes that suit every opacity.
        compensated: Whether the compensations multiply the opacities.
        lens: Size of the image and limits.
        extent: The largest half size, standard deviations.
    """
    radii = torch.empty(*found.depths.shape, 2, dtype=torch.int32)
    flat = {"centres": found.centres.view(-1, 2), "spreads": found.spreads.view(-1, 3)}
    flat |= {"drawable": found.drawable.view(-1).view(torch.uint8), "radii": radii.view(-1, 2)}
    kernel("radii_f", torch.float64 if opacities is None else opacities.dtype)(
        **{name: native_array(tensor.detach()) for name, tensor in flat.items()},
        opacities=None if opacities is None else native_array(opacities.detach().reshape(-1).contiguous()),
        compensations=native_array(found.compensations.detach().view(-1)) if compensated else None,
        size=(lens.width, lens.height),
        eps2d=lens.eps2d,
        extent=extent,
        radius_clip=lens.radius_clip,
        threads=native_threads(),
    )
    return radii


def harmonic_colors(
    degree: int,
    directions: Float[Tensor, "M 3"],
    coefficients: Float[Tensor, "R K 3"],
    rows: Int64[Tensor, " M"],
    ends: Sequence[int],
) -> Float[Tensor, "M 3"]:
    """Evaluate harmonics of degree 0 to 3 without offset and floor.

    Args:
        degree: The degree; K is at least (degree + 1)².
        directions: Of any length; 0 has the colour of degree 0 only.
        coefficients: The coefficients.
        rows: The row of `coefficients` for each direction.
        ends: Where the rows of each image end; within an image no row occurs twice.

    Differentiable in: directions, coefficients.
    """
    found: Tensor = _Harmonics.apply(degree, directions, coefficients, rows, ends)  # type: ignore[no-untyped-call]
    return found


@first_derivative_only("gsplat's harmonics", INSTEAD)
class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        degree: int,
        directions: Tensor,
        coefficients: Tensor,
        rows: Tensor,
        ends: Sequence[int],
    ) -> Tensor:
        directions, coefficients = directions.detach().contiguous(), coefficients.detach().contiguous()
        ctx.degree, ctx.ends = degree, ends
        ctx.save_for_backward(directions, coefficients, rows)
        return harmonics(degree, directions, coefficients, rows, ends)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        directions, coefficients, rows = ctx.saved_tensors
        found = harmonic_gradients(ctx.degree, directions, coefficients, rows, ctx.ends, grad)
        return None, found[0] if ctx.degree else None, found[1], None, None


def harmonics(
    degree: int, directions: Tensor, coefficients: Tensor, rows: Tensor, ends: Sequence[int]
) -> Tensor:
    """Evaluate harmonics as `harmonic_colors` does, outside of any graph; all tensors are contiguous."""
    colors = torch.empty_like(directions)
    for part, given in _images(degree, directions, coefficients, rows, ends):
        kernel("harmonics_f", colors.dtype)(**given, colors=native_array(colors[part]))
    return colors


def harmonic_gradients(
    degree: int,
    directions: Tensor,
    coefficients: Tensor,
    rows: Tensor,
    ends: Sequence[int],
    grad: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the gradients of `harmonics` with respect to directions and coefficients; `grad` is that of the result."""
    grad = grad.contiguous()
    to_directions, to_coefficients = torch.empty_like(directions), torch.empty_like(coefficients)
    for part, given in _images(degree, directions, coefficients, rows, ends):
        kernel("harmonics_backward_f", grad.dtype)(
            **given,
            grad_colors=native_array(grad[part]),
            grad_directions=native_array(to_directions[part]),
            grad_coefficients=native_array(to_coefficients),
            overwrites=not part.start,
        )
    return to_directions, to_coefficients


def _images(degree: int, directions: Tensor, coefficients: Tensor, rows: Tensor, ends: Sequence[int]) -> Any:  # noqa: ANN401
    """Yield the range of each image, and the arguments of the kernel for it."""
    for begin, end in zip([0, *ends], ends, strict=False):
        part = slice(begin, end)
        yield (
            part,
            {
                "degree": degree,
                "directions": native_array(directions[part]),
                "coefficients": native_array(coefficients),
                "rows": native_array(rows[part]),
                "threads": native_threads(),
            },
        )
