"""The dense renderer: the mathematics of the NumPy reference, batched in torch for autograd.

Every splat is evaluated at every pixel: without boxes and early termination, which affects cost but not values. The
names end in _t, as in the course; any float dtype works.

Chapter: 09_train_in_3d.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DET_FLOOR, SH_OFFSET, THINNEST
from gsplat_edu.base.derivatives import inside_torch_func
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import first_index, in_range, whole_number
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch.sight import Through, directions_through_lens, like, through_lens
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians, check_tensor, quat_to_R_t
from gsplat_edu.scene.sh import basis_terms, num_coefficients
from gsplat_edu.scene.sight import seam_shift

CHUNK = 16
"""Number of splats that are evaluated at once. It affects speed and rounding only; with 16, a chunk fits a core's cache
at 128 px (`benchmarks/dense.py`)."""


class DenseRender(NamedTuple):
    """The result of `render_t`."""

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    means2d: Float[Tensor, "M 2"]  # px, near to far; retains its gradient on request
    visible: Int64[Tensor, " M"]  # index of the Gaussian for each row of means2d


class _Thresholds(NamedTuple):
    """Alpha below the smallest is zero; alpha above the largest is the largest."""

    smallest: float
    largest: float


class Screen(NamedTuple):
    """The visible splats in the image, near to far."""

    means2d: Float[Tensor, "M 2"]
    ellipses: Float[Tensor, "M 3"]  # A, m, C: d' Sigma2d^-1 d = A (dx - m dy)² + C dy², Sigma2d dilated
    visible: Int64[Tensor, " M"]
    depths: Float[Tensor, " M"]
    variances: Float[Tensor, "M 2"]  # xx and yy of the dilated 2D covariance, px^2
    factor: Float[Tensor, " M"] | None  # of the opacity, of antialiasing and motion blur; None for 1


def eval_sh_t(degree: int, sh: Float[Tensor, "N K 3"], dirs: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Evaluate the colours of N Gaussians, differentiably: max(0, sum_i b_i(d) sh_i + 0.5).

    Args:
        degree: Highest degree to use, 0 to 3.
        sh: (N, K, 3) coefficients, K >= (degree + 1)².
        dirs: (N, 3) unit vectors from the camera to each Gaussian.

    Returns:
        (N, 3) colours, at least 0.

    Raises:
        ShapeError: a shape differs, N differs, or K is too small for the degree.
        ArgumentError: the degree is not 0, 1, 2 or 3, or an entry is NaN or infinite.

    Differentiable in: sh, and dirs as free variables of the polynomials.
    """
    count = num_coefficients(degree)
    sizes: dict[str, int] = {}
    check_tensor("sh", sh, ("N", "K", 3), sizes)
    check_tensor("dirs", dirs, ("N", 3), sizes)
    if sizes["K"] < count:
        raise ShapeError(
            f"sh: degree {degree} needs {count} coefficients per channel, got shape {tuple(sh.shape)}"
        )
    terms = basis_terms(degree, *(axis[:, None] for axis in dirs.unbind(-1)))
    color = torch.full_like(sh[:, 0], SH_OFFSET)
    for term, coefficient in zip(terms, sh.unbind(1), strict=False):
        color = color + term * coefficient
    return torch.clamp(color, min=0.0)


def render_t(
    means: Float[Tensor, "N 3"],
    cov3ds: Float[Tensor, "N 3 3"],
    colors: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    cam: CameraLike,
    alpha_min: float = ALPHA_MIN,
    chunk: int = 512,
    track_means2d: bool = False,
) -> DenseRender:
    """Render Gaussians, differentiably, on black.

    alpha_i = min(0.99, o_i exp(-d' Sigma2d_i^-1 d / 2)), 0 below alpha_min
    image = sum_i T_i alpha_i c_i,  T_i = product over j nearer than i of (1 - alpha_j)

    Args:
        means: (N, 3) centres, world units.
        cov3ds: (N, 3, 3) covariances, world units squared; validity is not checked.
        colors: (N, 3) any range.
        opacities: (N,) 0 to 1.
        cam: A `Camera` or any object with its members; means at depth 0.05 or nearer are culled.
        alpha_min: Alpha below this is zero. 0 makes the image smooth, for finite differences.
        chunk: Number of splats evaluated at once, near to far. It bounds a temporary and affects speed.
        track_means2d: Retain the gradient of means2d, for density control.

    Returns:
        image (H, W, 3), final transmittance (H, W), means2d (M, 2) px and the indices (M,) of the visible
        Gaussians, near to far. A scene without visible Gaussians is black, and its gradients are zero.

    Raises:
        ShapeError: a shape differs, or the arguments have different N.
        ArgumentError: an entry is NaN or infinite, an opacity is outside 0 to 1, alpha_min is negative,
                chunk is not a whole number of at least 1, or `cam` is not a camera.

    Differentiable in: means, cov3ds, colors, opacities. Not in: the camera.
    Source: Kerbl et al. 2023, eq. 2-5.
    """
    cam = as_camera("cam", cam)
    _check(means, cov3ds, colors, opacities)
    alpha_min, chunk = in_range("alpha_min", alpha_min, 0.0), whole_number("chunk", chunk, 1)

    screen = project_visible(means, cov3ds, cam)
    if track_means2d and screen.means2d.requires_grad:
        screen.means2d.retain_grad()
    colors, opacities = colors[screen.visible], _dimmed(opacities, screen)
    image, T = _composite(screen, colors, opacities, cam, _Thresholds(alpha_min, ALPHA_MAX), chunk)
    return DenseRender(image, T, screen.means2d, screen.visible)


def render_dense(
    gaussians: Gaussians,
    camera: Camera | CameraTensors,
    settings: RenderSettings,
    extra: Extra,
) -> RenderOutput:
    """Render raw parameters: the backend torch of `gsplat_edu.render.api.render`.

    Args:
        gaussians: N Gaussians.
        camera: The camera.
        settings: The settings.
        extra: Background and features.

    Returns:
        The view. Differentiable in every raw parameter, background, features and a camera of tensors.

    Raises:
        ArgumentError: a parameter is NaN or infinite, or a quaternion has zero length.
    """
    gaussians.check_finite()
    degree = min(settings.sh_degree, gaussians.sh_degree)
    colors = eval_sh_t(degree, gaussians.sh, _viewing_directions(gaussians.means, camera))
    R, scales = quat_to_R_t(gaussians.quats), torch.exp(gaussians.log_scales)
    screen = project_visible(gaussians.means, R * scales[:, None, :], camera, settings, factors=(R, scales))
    if screen.means2d.requires_grad and not inside_torch_func():  # which refuses it
        screen.means2d.retain_grad()
    opacities = _dimmed(gaussians.opacities, screen)
    channels = [colors[screen.visible]] + ([screen.depths[:, None]] if settings.depth else [])
    if extra.features is not None:
        channels.append(extra.features[screen.visible])
    thresholds = _Thresholds(ALPHA_MIN, settings.alpha_max)
    mixed, T = _composite(screen, torch.cat(channels, dim=1), opacities, camera, thresholds, CHUNK)
    median = _median(screen, opacities, camera, thresholds, CHUNK) if settings.median_depth else None
    return RenderOutput(
        image=mixed[..., :3] + T[..., None] * extra.background,
        transmittance=T,
        depth=mixed[..., 3] if settings.depth else None,
        visible=screen.visible,
        radii=_radii(screen, opacities),
        num_pairs=None,
        grad_norms=functools.partial(_grad_norms, screen, camera),
        features=None if extra.features is None else mixed[..., 3 + settings.depth :],
        median_depth=median,
    )


def _dimmed(opacities: Float[Tensor, " N"], screen: Screen) -> Float[Tensor, " M"]:
    """Return the opacities with which the visible splats are drawn."""
    visible = opacities[screen.visible]
    return visible if screen.factor is None else visible * screen.factor


@torch.no_grad()
def _radii(screen: Screen, opacities: Float[Tensor, " M"]) -> Float[Tensor, "M 2"]:
    """Return the half extents of the ellipses alpha >= 1/255, px."""
    level = 2.0 * torch.log((opacities / ALPHA_MIN).clamp(min=1.0))
    return torch.sqrt(level[:, None] * screen.variances)


def _grad_norms(screen: Screen, camera: Camera | CameraTensors) -> Float[Tensor, " M"]:
    """Return the norms of the gradients of the image positions; see `RenderOutput.means2d_grad_norms`."""
    gradient = screen.means2d.grad
    if gradient is None:
        if len(screen.visible):
            raise ArgumentError("means2d: has no gradient; call backward on a loss of this image first")
        gradient = torch.zeros_like(screen.means2d)
    half_size = torch.tensor([camera.W / 2, camera.H / 2], dtype=gradient.dtype, device=gradient.device)
    length: Tensor = torch.linalg.vector_norm(gradient * half_size, dim=-1)
    return length


def _composite(
    screen: Screen,
    colors: Float[Tensor, "M C"],
    opacities: Float[Tensor, " M"],
    cam: Camera | CameraTensors,
    thresholds: _Thresholds,
    chunk: int,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
    """Composite C channels over zero, near to far; return them and the final transmittance."""
    # Empty sums connect the image to the inputs, so that backward returns zeros if nothing is visible.
    tie = sum(tensor[:0].sum() for tensor in (screen.means2d, screen.ellipses, colors, opacities))
    dtype, device = colors.dtype, colors.device
    image = torch.zeros(cam.H, cam.W, colors.shape[1], dtype=dtype, device=device) + tie
    T = torch.ones(cam.H, cam.W, dtype=dtype, device=device)
    for start in range(0, len(screen.visible), chunk):
        part = slice(start, start + chunk)
        alpha = _alpha(screen.means2d[part], screen.ellipses[part], opacities[part], cam, thresholds)
        T_before, T_after = _transmittances(T, alpha)
        image = image + torch.einsum("nyx,nc->yxc", T_before * alpha, colors[part])
        T = T_after[-1]
    return image, T


def _transmittances(T: Float[Tensor, "H W"], alpha: Float[Tensor, "k H W"]) -> tuple[Tensor, Tensor]:
    """Return the transmittance before and after each of k splats."""
    T_after = T * torch.cumprod(1.0 - alpha, dim=0)
    return torch.cat([T[None], T_after[:-1]], dim=0), T_after


@torch.no_grad()
def _median(
    screen: Screen,
    opacities: Float[Tensor, " M"],
    cam: Camera | CameraTensors,
    thresholds: _Thresholds,
    chunk: int,
) -> Float[Tensor, "H W"]:
    """Return the depth of the splat at which the transmittance falls below one half; 0 where it does not."""
    T = screen.depths.new_ones(cam.H, cam.W)
    found = torch.zeros_like(T)
    for start in range(0, len(screen.visible), chunk):
        part = slice(start, start + chunk)
        alpha = _alpha(screen.means2d[part], screen.ellipses[part], opacities[part], cam, thresholds)
        T_before, T_after = _transmittances(T, alpha)
        crosses = (T_before >= 0.5) & (T_after < 0.5)
        found += torch.einsum("nyx,n->yx", crosses.to(T), screen.depths[part])
        T = T_after[-1]
    return found


def _viewing_directions(means: Float[Tensor, "N 3"], camera: Camera | CameraTensors) -> Float[Tensor, "N 3"]:
    """Return directions from the camera to the means; a mean at the camera, which is culled, gets the zero vector."""
    if not camera.pinhole:
        return directions_through_lens(means, camera)
    offset = means - like(means, camera.eye)
    squared = (offset * offset).sum(dim=-1, keepdim=True)
    # where() twice keeps the square root's infinite slope at 0 out of the chain rule.
    return torch.where(squared > 0, offset / torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)


def _check(
    means: Float[Tensor, "N 3"],
    cov3ds: Float[Tensor, "N 3 3"],
    colors: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
) -> None:
    sizes: dict[str, int] = {}
    check_tensor("means", means, ("N", 3), sizes)
    check_tensor("cov3ds", cov3ds, ("N", 3, 3), sizes)
    check_tensor("colors", colors, ("N", 3), sizes)
    check_tensor("opacities", opacities, ("N",), sizes)
    if bool((outside := (opacities < 0) | (opacities > 1)).any()):
        raise ArgumentError(f"opacities{first_index(outside.numpy(force=True))}: is outside 0 to 1")


def project_visible(
    means: Float[Tensor, "N 3"],
    shapes: Float[Tensor, "N 3 3"],
    cam: Camera | CameraTensors,
    settings: RenderSettings | None = None,
    *,
    factors: tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3"]] | None = None,
) -> Screen:
    """Project; `shapes` are covariances, or M = R S if the factors are given, which keeps the digits of thin ones."""
    settings = settings or RenderSettings()
    through = _through_pinhole if cam.pinhole else through_lens
    means2d, JW, z, visible, blur = through(means, cam, settings)
    if factors is not None:
        rows_of_M = JW @ shapes[visible]
        cov2d = rows_of_M @ rows_of_M.mT
        # |n|² = a c - b² without cancellation; n is the cross product of the rows of J W R S, computed from that of J
        # W.
        axes, (s0, s1, s2) = factors[0][visible], factors[1][visible].unbind(-1)
        normal = torch.linalg.cross(JW[:, 0], JW[:, 1])[:, None, :] @ axes
        normal = normal[:, 0] * torch.stack([s1 * s2, s2 * s0, s0 * s1], dim=-1)
        det_before = (normal * normal).sum(dim=-1)
    else:
        cov2d = JW @ shapes[visible] @ JW.mT
        det_before = cov2d[:, 0, 0] * cov2d[:, 1, 1] - cov2d[:, 0, 1] ** 2
    a0, b, c0 = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
    a, c = a0 + settings.dilation, c0 + settings.dilation
    det = det_before + settings.dilation * (a0 + c0) + settings.dilation * settings.dilation
    # The light of a splat goes with the root of its determinant: that of what is kept, by that of what is drawn.
    kept_det = det_before.clamp(min=DET_FLOOR) if settings.antialiased else det
    if blur is not None:
        det = det + _blur_of_det(
            blur, rows_of_M if factors is not None else None, (a0, b, c0), settings.dilation
        )
        a, b, c = a + blur[:, 0] ** 2, b + blur[:, 0] * blur[:, 1], c + blur[:, 1] ** 2
    if bool((thin := det <= THINNEST * (a + c)).any()):  # before the divisions, whose gradients would be NaN
        kept = torch.nonzero(~thin)[:, 0]
        rows_of = (each[kept] for each in (means2d, visible, z, a, b, c, det, kept_det))
        means2d, visible, z, a, b, c, det, kept_det = rows_of
    ellipses = torch.stack([c / det, b / c, 1 / c], dim=-1)
    dims = settings.antialiased or blur is not None
    factor = torch.sqrt(kept_det / det) if dims else None
    return Screen(means2d, ellipses, visible, z, torch.stack([a, c], dim=-1), factor)


def _blur_of_det(
    blur: Float[Tensor, "M 2"],
    rows_of_M: Float[Tensor, "M 2 3"] | None,
    flat: tuple[Tensor, Tensor, Tensor],
    dilation: float,
) -> Float[Tensor, " M"]:
    """Return det(Sigma2d + d I + g g') - det(Sigma2d + d I) = g' adj(Sigma2d + d I) g, without cancellation."""
    x, y = blur.unbind(-1)
    if rows_of_M is not None:
        across = x[:, None] * rows_of_M[:, 1] - y[:, None] * rows_of_M[:, 0]
        own = (across * across).sum(dim=-1)
    else:
        a, b, c = flat
        own = (x * x * c - 2 * x * y * b + y * y * a).clamp(min=0.0)
    return own + dilation * (x * x + y * y)


def _through_pinhole(
    means: Float[Tensor, "N 3"], cam: Camera | CameraTensors, settings: RenderSettings
) -> Through:
    """Return what a pinhole at rest sees of the visible means."""
    R = like(means, cam.R)
    means_cam = (means - like(means, cam.eye)) @ R.T
    visible = torch.nonzero(means_cam[:, 2] > settings.z_near)[:, 0]
    visible = visible[torch.argsort(means_cam[visible, 2], stable=True)]
    x, y, z = means_cam[visible].unbind(-1)
    means2d = torch.stack([cam.fx * x / z + cam.cx, cam.fy * y / z + cam.cy], dim=-1)
    zero = torch.zeros_like(z)
    (x_low, x_high), (y_low, y_high) = cam.jacobian_bounds(settings.jacobian_limit)
    x_z = (x / z).clamp(like(z, x_low), like(z, x_high))
    y_z = (y / z).clamp(like(z, y_low), like(z, y_high))
    rows = [[cam.fx / z, zero, -cam.fx * x_z / z], [zero, cam.fy / z, -cam.fy * y_z / z]]
    JW = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2) @ R
    return Through(means2d, JW, z, visible, None)


def _alpha(
    means2d: Float[Tensor, "k 2"],
    ellipses: Float[Tensor, "k 3"],
    opacities: Float[Tensor, " k"],
    cam: Camera | CameraTensors,
    thresholds: _Thresholds,
) -> Float[Tensor, "k H W"]:
    u, v = (axis[:, None, None] for axis in means2d.unbind(-1))
    A, m, C = (axis[:, None, None] for axis in ellipses.unbind(-1))
    dx = torch.arange(cam.W, dtype=means2d.dtype, device=means2d.device) - u
    if cam.projection.kind == "equirectangular":
        dx = (
            dx
            - like(u, seam_shift(np.arange(cam.W), u.double().numpy(force=True)[..., 0], cam.W))[:, None, :]
        )
    dy = torch.arange(cam.H, dtype=means2d.dtype, device=means2d.device)[:, None] - v
    power = -0.5 * A * (dx - m * dy) ** 2 - 0.5 * C * dy * dy
    alpha = (opacities[:, None, None] * torch.exp(power)).clamp(max=thresholds.largest)
    return alpha * (alpha >= thresholds.smallest)
