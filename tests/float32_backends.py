"""What the tests of the backends that compute in float32, cuda and webgpu, share: scenes, and a loss of all images."""

import dataclasses

import numpy as np
import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, SCENES

SETTINGS = RenderSettings(background=BACKGROUND)
SMALLER = {name: scene for name, scene in SCENES.items() if name != "thousands of layers"}
SMALLER["hundreds of layers"] = dataclasses.replace(
    SCENES["thousands of layers"],
    **{
        key: getattr(SCENES["thousands of layers"], key)[::10]
        for key in ("means", "quats", "log_scales", "sh", "logits")
    },
)
POSE = ("R", "eye", "intrinsics")
ILL_CONDITIONED = ("needles 100:1", "partly behind")


def images_and_gradients(scene, backend, device="cpu", settings=SETTINGS):
    """Return images, and gradients of a loss with random weights for all pixels of image, transmittance and depth."""
    dtype = torch.float64 if backend == "cpu" else torch.float32
    where = device if backend == "cuda" else "cpu"
    gaussians = scene.gaussians(dtype).to(torch.device(where)).trainable()
    background = torch.tensor(BACKGROUND, dtype=dtype, device=where, requires_grad=True)
    camera = CameraTensors.of(scene.camera)
    for tensor in camera.tensors():
        tensor.requires_grad_()
    out = render(gaussians, camera, settings=settings, background=background, backend=backend)
    generator = torch.Generator().manual_seed(3)
    draws = [
        torch.randn(t.shape, generator=generator, dtype=torch.float64)
        for t in (out.image, out.transmittance, out.depth)
    ]
    images = (out.image, out.transmittance, out.depth)
    sum((t * draw.to(t)).sum() for t, draw in zip(images, draws, strict=True)).backward()
    norms = torch.zeros(len(gaussians), dtype=dtype, device=where)
    norms[out.visible] = out.means2d_grad_norms()
    gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    gradients |= {"background": background.grad, "means2d": norms}
    gradients |= {name: getattr(camera, name).grad for name in POSE}
    values = {"image": out.image, "T": out.transmittance, "depth": out.depth}
    numpy = lambda found: {k: t.detach().double().cpu().numpy() for k, t in found.items()}  # noqa: E731
    return numpy(values), numpy(gradients), out


def sensitivity(scene) -> np.ndarray:
    """Return the largest change of each pixel over eight perturbations of the parameters by 4 float32 eps."""
    rng = np.random.default_rng(0)
    exact = scene.gaussians()
    base = render(exact, scene.camera, settings=SETTINGS, backend="cpu").image.numpy()
    worst = np.zeros(base.shape[:2])
    for _ in range(8):
        noise = lambda t: t * (1 + 4 * 1.2e-7 * torch.tensor(rng.choice([-1.0, 1.0], t.shape)))  # noqa: E731
        moved = render(exact.map(noise), scene.camera, settings=SETTINGS, backend="cpu").image.numpy()
        worst = np.maximum(worst, np.abs(moved - base).max(axis=-1))
    return worst


POISON = (
    ("means", np.nan),
    ("quats", 0.0),
    ("log_scales", np.inf),
    ("sh0", np.inf),
    ("sh_rest", np.nan),
    ("logit_opacities", np.nan),
)
"""A value that no Gaussian may have, for each parameter."""
