"""The one door to rendering: raw parameters and a camera in, an image and what training needs out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians, cov3d_t
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch_reference import eval_sh_t, render_t


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """One rendered view.

    Args:
        image: (H, W, 3) over the background, not clipped.
        transmittance: (H, W) light that passed all Gaussians, in [0, 1].
        visible: (M,) indices of the Gaussians in front of the camera.
        means2d: (M, 2) their means in the image, px; collects a gradient in backward.
    """

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    visible: Int64[Tensor, " M"]
    means2d: Float[Tensor, "M 2"]

    def means2d_grad_norms(self) -> Float[Tensor, " M"]:
        """Return the signal of density control: |(gx W/2, gy H/2)|, g = d loss / d means2d.

        The factors turn pixels into normalised device coordinates, so that one threshold serves every image
        size. Zero for Gaussians the loss does not reach.

        Raises:
            ArgumentError: backward has not run through this image.
        """
        if self.means2d.grad is None:
            if len(self.visible):
                raise ArgumentError("means2d: has no gradient; call backward on a loss of this image first")
            return torch.zeros_like(self.means2d[:, 0])
        H, W = self.transmittance.shape
        half_size = torch.tensor([W / 2, H / 2], dtype=self.means2d.dtype, device=self.means2d.device)
        norms: Float[Tensor, " M"] = torch.linalg.vector_norm(self.means2d.grad * half_size, dim=-1)
        return norms


def render(
    gaussians: Gaussians, camera: Camera, *, settings: RenderSettings | None = None, backend: str = "auto"
) -> RenderOutput:
    """Render Gaussians as seen by a camera.

    Args:
        gaussians: N Gaussians, raw parameters, any float dtype.
        camera: The camera.
        settings: Background and SH degree; the defaults where None.
        backend: "auto", or a backend by name (see `gsplat_edu.render.backends`).

    Returns:
        The image and what density control needs.

    Raises:
        BackendUnavailableError: the backend does not run here.
        ArgumentError: a parameter is NaN or infinite, or a quaternion has zero length.

    Differentiable in: every raw parameter of the Gaussians. Not in: the camera.
    """
    settings = settings or RenderSettings()
    resolve_backend(backend)  # the dense torch renderer is the only one so far
    gaussians.check_finite()
    degree = min(settings.sh_degree, gaussians.sh_degree)
    dense = render_t(
        gaussians.means,
        cov3d_t(gaussians.log_scales, gaussians.quats),
        eval_sh_t(degree, gaussians.sh, _viewing_directions(gaussians.means, camera)),
        gaussians.opacities,
        camera,
        chunk=settings.dense_chunk,
        track_means2d=True,
    )
    background = torch.tensor(settings.background, dtype=dense.image.dtype, device=dense.image.device)
    image = dense.image + dense.transmittance[..., None] * background
    return RenderOutput(image, dense.transmittance, dense.visible, dense.means2d)


def _viewing_directions(means: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, "N 3"]:
    """Point from the camera to each mean; a mean at the camera, which is culled, gets the zero vector."""
    offset = means - torch.tensor(camera.eye, dtype=means.dtype, device=means.device)
    squared = (offset * offset).sum(dim=-1, keepdim=True)
    # where() twice, so that the square root's infinite slope at 0 never meets the chain rule.
    return torch.where(squared > 0, offset / torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)
