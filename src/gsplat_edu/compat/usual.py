"""The usual call of `rasterization`: one image of a pinhole, in colours of harmonics of up to degree 3, without depths.

It has the same values and gradients as the stages of gsplat.py, with fewer steps of the graph. One step makes what is
on the screen, colours included; `meta["means2d"]`, `meta["depths"]` and `meta["opacities"]` are its results and lead to
the image. All gradients are computed by hand, on one thread as far as torch computes them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsplat_edu.base.constants import SH_OFFSET
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.threads import one_thread
from gsplat_edu.compat.checks import MOST_DEGREE, Arguments, check_spreads
from gsplat_edu.compat.drawn import joined, lens_of
from gsplat_edu.compat.images import Absgrad, Splats, composite
from gsplat_edu.compat.projection import EXTENT, MARGIN, solids_of
from gsplat_edu.compat.screen import (
    INSTEAD,
    Solids,
    box_radii,
    harmonic_gradients,
    harmonics,
    screen,
    screen_gradients,
)
from gsplat_edu.compat.stages import stage

ABSENT = (
    "covars",
    "backgrounds",
    "extra_signals",
    "radial_coeffs",
    "tangential_coeffs",
    "thin_prism_coeffs",
    "viewmats_rs",
)
"""Arguments that a usual call does not have."""

NAMED = {"camera_model": "pinhole", "rasterize_mode": "classic", "render_mode": "RGB"}
"""Values that other arguments have in it."""

TENSORS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
"""Its tensors."""


def is_usual(a: Arguments) -> bool:
    """Return whether this module draws these arguments."""
    if a.colors is None or a.sh_degree is None or a.sh_degree == MOST_DEGREE or a.batches * a.C != 1:
        return False
    plain = all(getattr(a, name) is None for name in ABSENT)
    plain &= all(getattr(a, name) == value for name, value in NAMED.items())
    return plain and a.colors.shape[-1] == 3 and a.colors.dtype == a.means.dtype


def project_usual(a: Arguments) -> tuple[Tensor, ...]:
    """Return what the stages of gsplat.py return of the geometry, and the colours of the drawn Gaussians, (nnz, 3).

    Differentiable in: every tensor of the arguments.
    """
    tensors = (getattr(a, name) for name in TENSORS)
    found: tuple[Tensor, ...] = _OnScreen.apply(a, *tensors)  # type: ignore[no-untyped-call]
    return found


def image_of(
    a: Arguments,
    positions: Tensor,
    spreads: Tensor,
    colors: Tensor,
    meta: dict[str, Any],
    kept: Absgrad | None,
) -> tuple[Tensor, Tensor]:
    """Return the image and alphas.

    Args:
        a: The arguments.
        positions: (nnz,) the drawn Gaussians.
        spreads: (nnz, 3) their screen covariances.
        colors: (nnz, 3) their colours.
        meta: Centres, depths and opacities; of the drawn ones if packed.
        kept: Collects sums of absolute gradients.
    """
    rows = None if a.packed else positions
    add = None if kept is None else kept.adder(torch.arange(len(positions)) if rows is None else positions)

    def draw(
        means2d: Tensor, depths: Tensor, opacities: Tensor, spreads: Tensor, colors: Tensor
    ) -> list[Tensor]:
        means2d, opacities, order = means2d.view(-1, 2), opacities.view(-1), depths.view(-1) + 0.0  # no -0
        if rows is not None:
            means2d, opacities = _Rows.apply(rows, means2d, opacities)  # type: ignore[no-untyped-call]
            order = order.index_select(0, rows)
        splats = Splats(means2d, spreads, opacities, colors, None, None, None, order)
        image, transmittance = composite(splats, lens_of(a), add)
        lead = (*a.batch, a.C, a.height, a.width)
        return [image.view(*lead, 3), (1.0 - transmittance).view(*lead, 1)]

    means2d = meta["means2d"] if kept is None else kept.means2d
    image, alphas = stage(draw, means2d, meta["depths"].detach(), meta["opacities"], spreads, colors)
    return image, alphas


@first_derivative_only("gsplat's projection", INSTEAD)
class _OnScreen(torch.autograd.Function):
    """Projection, boxes, choice of the drawn Gaussians, and their colours."""

    @staticmethod
    def forward(ctx: Any, a: Arguments, *tensors: Tensor) -> tuple[Tensor, ...]:  # noqa: ANN401
        with one_thread():
            means, quats, scales, opacities, colors, viewmats, Ks = (
                each.detach().contiguous() for each in tensors
            )
            solids, lens = solids_of(means, None, quats, scales), lens_of(a)
            cameras = viewmats.view(1, 1, 4, 4).double(), Ks.view(1, 1, 3, 3).double()
            found = screen(solids, *cameras, lens, MARGIN)
            radii = box_radii(found, opacities.view(1, 1, -1), False, lens, EXTENT)
            positions = torch.logical_and(*radii.view(-1, 2).unbind(-1)).nonzero()[:, 0]
            spreads = found.spreads.view(-1, 3).index_select(0, positions)
            check_spreads("scales", spreads, positions, (a.batch, a.C, a.N))
            shared = [radii, *(each.to(means.dtype) for each in found[:3]), opacities.view(1, 1, -1).clone()]
            if a.packed:
                shared = [joined(each, 3).index_select(0, positions) for each in shared]
            else:
                shared = [each.view(*a.batch, a.C, a.N, *each.shape[3:]) for each in shared]
            inverse, rows = torch.inverse(viewmats.view(4, 4)), (positions, [len(positions)])
            directions = solids.means[0].index_select(0, positions) - inverse[:3, 3]
            coefficients = joined(colors, colors.ndim - 2)
            shades = harmonics(a.sh_degree or 0, directions, coefficients, *rows).add_(SH_OFFSET)
            lit = shades >= 0.0
        ctx.arguments, ctx.shapes = a, [each.shape for each in tensors]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*solids, *cameras, directions, coefficients, positions, lit, inverse)
        ctx.mark_non_differentiable(positions, shared[0])
        return positions, spreads, shades.clamp_(min=0.0), *shared

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        *geometry, directions, coefficients, positions, lit, inverse = ctx.saved_tensors
        a: Arguments = ctx.arguments
        _, of_spreads, of_colors, _, *of_shared = grads

        def of_all(grad: Tensor | None, packed: bool) -> Tensor | None:
            """Return a gradient for all Gaussians, zero for those that are not drawn."""
            if grad is None or not packed:
                return grad if grad is None else joined(grad, len(a.batch) + 2)
            return grad.new_zeros(a.N, *grad.shape[1:]).index_copy_(0, positions, grad)

        with one_thread():
            centres, depths, conics, opacities = (of_all(each, a.packed) for each in of_shared)
            arriving = [centres, depths, conics, None, of_all(of_spreads, True)]
            arriving = [None if each is None else each.double()[None, None] for each in arriving]
            solids, (viewmats, Ks) = Solids(*geometry[:4]), geometry[4:]
            found = screen_gradients(solids, viewmats, Ks, lens_of(a), MARGIN, arriving)
            (means, _, quats, scales, viewmats, Ks), colors = found, None
            assert means is not None
            assert viewmats is not None
            if of_colors is not None:
                rows = (positions, [len(positions)])
                along, colors = harmonic_gradients(
                    a.sh_degree or 0, directions, coefficients, *rows, of_colors * lit
                )
                means[0].index_add_(0, positions, along)
                # The eye is in the last column of V⁻¹, and d(V⁻¹) = -V⁻¹ dV V⁻¹; it is subtracted from the means.
                through = inverse[:3].T @ along.sum(dim=0)
                viewmats = viewmats + torch.outer(through, inverse[:, 3])
            made = (means, quats, scales, opacities, colors, viewmats, Ks)
            shaped = zip(made, ctx.shapes, strict=True)
            return None, *(None if g is None else g.to(means.dtype).view(shape) for g, shape in shaped)


@first_derivative_only("gsplat's rasterization", INSTEAD)
class _Rows(torch.autograd.Function):
    """Different rows of tensors."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:  # noqa: ANN401
        ctx.rows, ctx.shapes = rows, [each.shape for each in tensors]
        return tuple(each.index_select(0, rows) for each in tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        shapes = zip(grads, ctx.shapes, strict=True)
        return None, *(grad.new_zeros(shape).index_copy_(0, ctx.rows, grad) for grad, shape in shapes)
