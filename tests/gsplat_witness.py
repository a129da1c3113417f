"""A witness of gsplat: its own projection and harmonics in torch, and its compositing, evaluated at every pixel.
gsplat composites in CUDA only. Its rules are few: alpha = min(0.999, o exp(-d' Sigma^-1 d / 2)), alpha below 1/255 is
zero, and a pixel stops before the Gaussian that would take its transmittance to 1e-4 or below. This module applies
them to one Gaussian after the other.
"""

import pytest
import torch

torch_impl = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed (extra dev)")


def scene(count=40, cameras=2, dtype=torch.float64, seed=0):
    """Return Gaussians in front of, beside and behind cameras at the origin; every tensor is a leaf."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = normal(count, 3) * torch.tensor([1.0, 0.8, 0.6]) + torch.tensor([0.0, 0.0, 2.2])
    means[-1] = torch.tensor([0.1, 0.2, -1.0])  # behind the cameras
    means[-2] = torch.tensor([3.0, 0.2, 1.0])  # beside the image, where the Jacobian is clamped
    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    for k in range(cameras):
        angle = torch.tensor(0.15 * k)
        viewmats[k, 0, 0] = viewmats[k, 2, 2] = torch.cos(angle)
        viewmats[k, 0, 2], viewmats[k, 2, 0] = torch.sin(angle), -torch.sin(angle)
        viewmats[k, :3, 3] = torch.tensor([0.05 * k, -0.1, 0.3])
    Ks = torch.tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]], dtype=torch.float64).repeat(cameras, 1, 1)
    tensors = {
        "means": means,
        "quats": normal(count, 4),
        "scales": 0.05 + 0.3 * uniform(count, 3),
        "opacities": 0.05 + 0.94 * uniform(count),
        "colors": normal(count, 16, 3) * 0.4,
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": uniform(cameras, 3),
    }
    return {name: tensor.to(dtype).requires_grad_() for name, tensor in tensors.items()}


def smooth():
    """Return few wide Gaussians, above 1/255 and below the clamps in every pixel, for finite differences."""
    tensors = scene(count=4, cameras=2)
    tensors["means"] = torch.tensor([[0.1, 0.2, 2.0], [-0.2, 0.1, 2.5], [0.3, -0.2, 3.0], [0.0, 0.1, 3.5]])
    tensors["scales"] = torch.tensor([[1.5, 1.7, 1.6]]).repeat(4, 1) + 0.1 * torch.arange(4)[:, None]
    tensors["opacities"] = torch.tensor([0.5, 0.6, 0.4, 0.7])
    tensors["colors"] = 0.1 * tensors["colors"].detach()
    return {name: t.detach().double().requires_grad_() for name, t in tensors.items()}


def rendered(tensors, width, height, sh_degree=None, antialiased=False, mode="RGB", **limits):
    """Render with gsplat's torch functions; return images, alphas, and means2d of each camera and of each pixel."""
    t, C = tensors, len(tensors["viewmats"])
    covars = t.get("covars")
    if covars is None:
        covars, _ = torch_impl._quat_scale_to_covar_preci(t["quats"], t["scales"], True, False, triu=False)
    _, means2d, depths, conics, factors = torch_impl._fully_fused_projection(
        t["means"], covars, t["viewmats"], t["Ks"], width, height, calc_compensations=antialiased, **limits
    )
    colors = t["colors"]
    if sh_degree is not None:
        eyes = torch.inverse(t["viewmats"])[:, :3, 3]
        directions = t["means"][None] - eyes[:, None]
        coefficients = colors.expand(C, *colors.shape[-3:])
        colors = (torch_impl._spherical_harmonics(sh_degree, directions, coefficients) + 0.5).clamp_min(0.0)
    colors = colors.expand(C, *colors.shape[-2:])
    if mode != "RGB":
        colors = torch.cat([colors[..., :0] if mode in ("D", "ED") else colors, depths[..., None]], dim=-1)
    opacities = t["opacities"][None] * (factors if antialiased else 1.0)
    near, far = limits.get("near_plane", 0.01), limits.get("far_plane", 1e10)
    images, alphas, of_pixels = [], [], []
    for c in range(C):
        drawn = torch.nonzero((depths[c] > near) & (depths[c] < far))[:, 0]
        drawn = drawn[torch.argsort(depths[c, drawn])]
        centers = means2d[c].expand(height, width, -1, 2)
        of_pixels.append(centers)
        splats = (
            centers[:, :, drawn],
            conics[c, drawn],
            opacities[c % len(opacities), drawn],
            colors[c, drawn],
        )
        background = (
            t["backgrounds"][c] if t.get("backgrounds") is not None and mode.startswith("RGB") else None
        )
        image, T = composited(*splats, background)
        images.append(image)
        alphas.append(1.0 - T[..., None])
    image, alpha = torch.stack(images), torch.stack(alphas)
    if mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)], dim=-1)
    return image, alpha, means2d, of_pixels


def composited(centers, conics, opacities, colors, background=None, alpha_max=0.999):
    """Composite M sorted Gaussians at all pixels, given their centres for each pixel: (H, W, M, 2)."""
    H, W = centers.shape[:2]
    y, x = torch.meshgrid(*(torch.arange(n, dtype=centers.dtype) + 0.5 for n in (H, W)), indexing="ij")
    dx, dy = (torch.stack([x, y], dim=-1)[:, :, None] - centers).unbind(-1)
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp(max=alpha_max)
    image, T = torch.zeros(H, W, colors.shape[1], dtype=centers.dtype), torch.ones(H, W, dtype=centers.dtype)
    ended = torch.zeros(H, W, dtype=torch.bool)
    for k in range(len(colors)):
        now = torch.where(alpha[..., k] < 1.0 / 255.0, 0.0, alpha[..., k])
        ended = ended | (T * (1.0 - now) <= 1e-4)
        now = torch.where(ended, 0.0, now)
        image = image + (T * now)[..., None] * colors[k]
        T = T * (1.0 - now)
    if background is not None:
        behind = T[..., None] * background
        image = image + torch.nn.functional.pad(behind, (0, image.shape[-1] - behind.shape[-1]))
    return image, T
