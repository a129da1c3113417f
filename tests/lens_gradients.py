"""What the tests of lenses in float32 share, of the backends webgpu and cuda: all images and gradients against native
ones in float64, with the bound of the pinhole's tests: 3e-4 of the largest entry, for the camera times the number of
Gaussians."""

import torch

from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from lens_scenes import STEPS
from native_scenes import BACKGROUND

SETTINGS = RenderSettings(background=BACKGROUND, median_depth=True)
PANORAMAS = ("panorama", "panorama, moving", "panorama, blurred")
BOUND = 3e-4


def images_and_gradients(scene, camera, backend, settings=SETTINGS, channels=0, device="cpu"):
    """Return images, gradients of randomly weighted values, and the output; coefficients are in units of `STEPS`."""
    dtype = torch.float64 if backend == "cpu" else torch.float32
    gaussians = scene.gaussians(dtype).to(torch.device(device)).trainable()
    tensors = CameraTensors.of(camera)
    for tensor in tensors.tensors():
        tensor.requires_grad_()
    generator = torch.Generator().manual_seed(3)
    features = None
    if channels:
        features = torch.randn(len(gaussians), channels, generator=generator, dtype=torch.float64)
        features = features.to(gaussians.means).requires_grad_()
    out = render(gaussians, tensors, settings=settings, features=features, backend=backend)
    images = {"image": out.image, "T": out.transmittance, "depth": out.depth, "features": out.features}
    images = {name: image for name, image in images.items() if image is not None}
    draws = [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images.values()]
    sum((image * draw.to(image)).sum() for image, draw in zip(images.values(), draws, strict=True)).backward()
    gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
    norms = torch.zeros(len(gaussians), dtype=dtype, device=device)
    norms[out.visible] = out.means2d_grad_norms()
    gradients |= {"means2d": norms} | ({"of features": features.grad} if channels else {})
    for name in ("R", "eye", "intrinsics", "coefficients", "motion"):
        if getattr(tensors, name) is not None:
            gradients[f"camera's {name}"] = getattr(tensors, name).grad
    if tensors.coefficients is not None:
        gradients["camera's coefficients"] = gradients["camera's coefficients"] * STEPS
    return (
        {name: image.detach().double().cpu() for name, image in images.items()},
        {k: g.double().cpu() for k, g in gradients.items()},
        out,
    )


def check_against_native(
    scene, camera, settings=SETTINGS, *, channels=0, bound=BOUND, but=(), backend="webgpu", device="cpu"
):
    """Compare all images and gradients; return the output."""
    values, gradients, out = images_and_gradients(scene, camera, backend, settings, channels, device)
    truths, expected, oracle = images_and_gradients(scene, camera, "cpu", settings, channels)
    assert len(out.visible) == len(oracle.visible) > 0 and abs(out.num_pairs - oracle.num_pairs) <= 2
    for key, truth in truths.items():
        assert (values[key] - truth).abs().max() < 1.1 * max(1.0, float(truth.abs().max())) / 255, key
        assert (values[key] - truth).abs().mean() < 1e-5 * max(1.0, float(truth.abs().max())), key
    assert gradients.keys() == expected.keys()
    for key, truth in ((key, truth) for key, truth in expected.items() if key not in but):
        assert truth.abs().max() > 0, key
        parts = len(scene.means) if key.startswith("camera's") else 1
        assert (gradients[key] - truth).abs().max() <= parts * bound * truth.abs().max(), key
    return out
