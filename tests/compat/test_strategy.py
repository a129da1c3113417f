"""gsplat's `DefaultStrategy` trains through our `rasterization` and `rasterization_2dgs`, unmodified."""

import numpy as np
import pytest
import torch

from gsplat_edu.compat.gsplat import rasterization, rasterization_2dgs
from gsplat_edu.data.procedural import RADIUS, START_NOISE, procedural_capture

gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed (extra dev)")
STEPS = 300
RATES = {"means": 2e-3, "scales": 2e-2, "quats": 2e-2, "opacities": 5e-2, "colors": 3e-2}


def matrices(camera):
    """Convert our camera to gsplat's viewmat and K, whose pixel centres are at +0.5."""
    viewmat, K = np.eye(4), np.eye(3)
    viewmat[:3, :3], viewmat[:3, 3] = camera.R, -camera.R @ camera.eye
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
    return [torch.tensor(m, dtype=torch.float32)[None] for m in (viewmat, K)]


def start(points, colors):
    n = len(points)
    return torch.nn.ParameterDict(
        {
            "means": torch.tensor(points, dtype=torch.float32),
            "scales": torch.full((n, 3), float(np.log(0.1))),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
            "opacities": torch.zeros(n),
            "colors": torch.logit(torch.tensor(colors, dtype=torch.float32).clamp(0.02, 0.98)),
        }
    )


def draw(params, cameras, flat=False, **options):
    """Return images and meta."""
    viewmats, Ks = (torch.cat(each) for each in zip(*cameras, strict=True))
    images, *_, meta = (rasterization_2dgs if flat else rasterization)(
        means=params["means"],
        quats=params["quats"],
        scales=torch.exp(params["scales"]),
        opacities=torch.sigmoid(params["opacities"]),
        colors=torch.sigmoid(params["colors"]),
        viewmats=viewmats,
        Ks=Ks,
        width=24,
        height=18,
        **options,
    )
    return images, meta


def psnr(image, photo):
    return -10.0 * torch.log10(((image - photo) ** 2).mean(dim=(-3, -2, -1)))


@pytest.mark.parametrize(
    ("packed", "absgrad", "cameras_at_once", "flat"),
    [(False, False, 1, False), (True, True, 2, False), (True, False, 1, True)],
)
def test_the_default_strategy_trains_through_our_rasterization(packed, absgrad, cameras_at_once, flat):
    """The start points are off by 0.03 world units, 0.26 px at the cameras' distance. An image that is off by that much
    differs from the photo by 0.26 px times its slope. Training starts farther away than that, and has to end closer."""
    torch.manual_seed(0)  # the strategy's split draws from the global generator
    views, points, colors = procedural_capture(24, 6)
    photos = torch.tensor(np.stack([view.image for view in views]), dtype=torch.float32) / 255
    cameras = [matrices(view.camera) for view in views]
    params = start(points, colors)
    optimizers = {name: torch.optim.Adam([p], lr=RATES[name]) for name, p in params.items()}
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=50,
        refine_every=50,
        absgrad=absgrad,
        grow_grad2d=8e-4 if absgrad else 2e-4,
        key_for_gradient="gradient_2dgs" if flat else "means2d",
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    shift = START_NOISE * views[0].camera.fx / RADIUS
    moved = (1 - shift) * photos + shift * photos.roll(1, dims=2)
    bound = psnr(moved[:, :, 1:], photos[:, :, 1:])
    with torch.no_grad():
        before = psnr(draw(params, cameras, flat)[0], photos)
    for step in range(STEPS):
        chosen = [(step * cameras_at_once + k) % len(views) for k in range(cameras_at_once)]
        images, info = draw(params, [cameras[k] for k in chosen], flat, packed=packed, absgrad=absgrad)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        ((images - photos[chosen]) ** 2).mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    with torch.no_grad():
        after = psnr(draw(params, cameras, flat)[0], photos)
    assert len(params["means"]) > len(points)  # the scene has grown
    assert bool((before < bound).all()) and bool((after > bound).all()), (before, bound, after)
