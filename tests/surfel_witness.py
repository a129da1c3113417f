"""A witness of gsplat's 2D Gaussians: its own projection in torch, and its rules of compositing at every pixel.

gsplat composites in CUDA only; its version in torch needs CUDA for the list of pixels, and nerfacc. The rules: a splat
is seen in the tiles that its box meets; s = min(a² + b², 2 |m - p|²) with the place (a, b) where the ray meets the
splat; alpha = min(0.999, o exp(-s / 2)), zero below 1/255; a pixel stops before the splat that would take T to 1e-4 or
below.
"""

import pytest
import torch

impl = pytest.importorskip("gsplat.cuda._torch_impl_2dgs", reason="gsplat is not installed (extra dev)")
harmonics = pytest.importorskip("gsplat.cuda._torch_impl")
depth_to_normal = pytest.importorskip("gsplat.utils").depth_to_normal

NAMES = ("images", "alphas", "normals", "surf_normals", "distortions", "medians")


def projected(t, width, height, radius_clip=0.0, **limits):
    """Return radii, means2d, depths, ray transforms and normals of gsplat.

    Its torch code multiplies a normal by the third scale, its kernels do not; with a scale of 1 they agree. And only
    the kernels leave out splats whose box has half sizes of at most radius_clip.
    """
    scales = torch.cat([t["scales"][:, :2], torch.ones_like(t["scales"][:, 2:])], dim=-1)
    radii, *others = impl._fully_fused_projection_2dgs(
        t["means"], t["quats"], scales, t["viewmats"], t["Ks"], width, height, **limits
    )
    return radii * (radii > radius_clip).any(dim=-1, keepdim=True), *others


def composited(splats, radii, width, height, tile_size=16):
    """Composite the splats (means2d by pixel, transforms, opacities, colours, normals) of one image, near to far."""
    centers, transforms, opacities, colors, normals = splats
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=colors.dtype) + 0.5 for n in (height, width)), indexing="ij"
    )
    image, T = torch.zeros(height, width, colors.shape[1], dtype=colors.dtype), torch.ones_like(x)
    normal = torch.zeros(height, width, 3, dtype=colors.dtype)
    distortion, before, median = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    ended = torch.zeros(height, width, dtype=torch.bool)
    for k in range(len(colors)):
        u, v, w = transforms[k]
        cross = torch.linalg.cross(x[..., None] * w - u, y[..., None] * w - v)
        solid = (cross[..., :2] / cross[..., 2:]).square().sum(-1)
        flat = 2 * ((centers[..., k, 0] - x) ** 2 + (centers[..., k, 1] - y) ** 2)
        alpha = (opacities[k] * torch.exp(-0.5 * torch.minimum(solid, flat))).clamp(max=0.999)
        met = torch.ones_like(ended)
        for at, axis in ((x, 0), (y, 1)):
            tile, m = torch.floor(at / tile_size), centers[0, 0, k, axis].detach()
            low = torch.floor((m - radii[k, axis]) / tile_size)
            met &= (tile >= low) & (tile < torch.ceil((m + radii[k, axis]) / tile_size))
        alpha = torch.where(met & (alpha >= 1 / 255), alpha, 0.0)
        ended = ended | (T * (1 - alpha) <= 1e-4)
        weight, z = torch.where(ended, 0.0, alpha) * T, colors[k, -1]
        distortion = distortion + 2 * weight * (z * (1 - T) - before)
        before = before + weight * z
        median = torch.where((weight > 0) & (T > 0.5), z, median)
        image, normal = image + weight[..., None] * colors[k], normal + weight[..., None] * normals[k]
        T = T - weight
    return image, T, normal, distortion, median


def rendered(t, width, height, mode="RGB", sh_degree=None, tile_size=16, depth_mode="expected", **limits):
    """Render with gsplat's rules; return the six results, and the nodes of the graph that its strategies read."""
    radii, means2d, depths, transforms, normals = projected(t, width, height, **limits)
    C, colors = len(radii), t["colors"]
    if sh_degree is not None:
        directions = t["means"][None] - torch.inverse(t["viewmats"])[:, None, :3, 3]
        coefficients = colors.expand(C, *colors.shape[-3:])
        colors = (harmonics._spherical_harmonics(sh_degree, directions, coefficients) + 0.5).clamp_min(0.0)
    colors = colors.expand(C, *colors.shape[-2:])
    if mode != "RGB":
        colors = torch.cat([colors[..., :0] if mode in ("D", "ED") else colors, depths[..., None]], dim=-1)
    used = transforms * 1.0  # a node for the gradient of compositing alone
    found, of_pixels = [], []
    for c in range(C):
        drawn = torch.nonzero((radii[c] > 0).all(-1))[:, 0]
        drawn = drawn[torch.argsort(depths[c, drawn].detach().float(), stable=True)]
        centers = means2d[c].expand(height, width, -1, 2)
        of_pixels.append(centers)
        opacities = t["opacities"][drawn]
        splats = (centers[:, :, drawn], used[c, drawn], opacities, colors[c, drawn], normals[c, drawn])
        found.append(composited(splats, radii[c, drawn], width, height, tile_size))
    image, T, normal, distortion, median = (torch.stack(each) for each in zip(*found, strict=True))
    if t.get("backgrounds") is not None and mode.startswith("RGB"):
        behind = T[..., None] * t["backgrounds"][:, None, None]
        image = image + torch.nn.functional.pad(behind, (0, image.shape[-1] - behind.shape[-1]))
    alpha, median = 1 - T[..., None], median[..., None]
    if mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)], dim=-1)
    poses, surface = torch.linalg.inv(t["viewmats"]), None
    if mode.startswith("RGB+"):
        deep = image[..., -1:] if depth_mode == "expected" else median
        surface = depth_to_normal(deep, poses, t["Ks"]).squeeze(0)
    normal = torch.einsum("cij,chwj->chwi", poses[:, :3, :3], normal)
    nodes = {
        "means2d": means2d,
        "transforms": transforms,
        "used": used,
        "of_pixels": of_pixels,
        "radii": radii,
    }
    return (image, alpha, normal, surface, distortion[..., None], median), nodes
