"""The backend cuda agrees with the NumPy reference and the native kernels in float64. On a machine without a GPU, the
kernels run in Triton's interpreter. Scenes and bounds are those of the native float32
kernels (tests/native). Forward: four times each pixel's change when the parameters move by 4 eps, plus the rounding of
the sum. Backward: 3e-4 of the largest gradient, or 4e-3 for ill-conditioned conics. Batches hold 16 Gaussians, so most
scenes have tiles with several. 41 x 35 and 17 x 33 px are not multiples of a tile.
"""

import dataclasses

import numpy as np
import pytest
import torch

from float32_backends import (
    ILL_CONDITIONED,
    POISON,
    POSE,
    SETTINGS,
    SMALLER,
    images_and_gradients,
    sensitivity,
)
from gsplat_edu import Camera
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.render.settings import RenderSettings
from native_scenes import BACKGROUND, random


@pytest.mark.parametrize("name", [name for name in SMALLER if name != "ties in depth"])
def test_images_match_the_reference(device, name):
    scene = SMALLER[name]
    values, _, _ = images_and_gradients(scene, "cuda", device)
    truth, truth_T, truth_depth = scene.truth()
    bright = max(1.0, np.abs(values["image"]).max())
    error = np.maximum(np.abs(values["image"] - truth).max(axis=-1), np.abs(values["T"] - truth_T))
    over = error > 4 * sensitivity(scene) + 100 * np.finfo(np.float32).eps * bright
    assert over.sum() <= 2 and error.max() < 1.1 * bright / 255
    assert np.abs(values["depth"] - truth_depth).max() < 1.1 * max(1.0, truth_depth.max()) / 255


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", SMALLER)
def test_gradients_match_the_native_kernels_in_float64(device, name, antialiased):
    """Scenes with ties are included. A camera axis is along z, so depths that are equal in float64 are equal in
    float32."""
    settings = dataclasses.replace(SETTINGS, antialiased=antialiased, jacobian_limit=1.3)
    values, gradients, out = images_and_gradients(SMALLER[name], "cuda", device, settings)
    truths, expected, oracle = images_and_gradients(SMALLER[name], "cpu", device, settings)
    assert abs(out.num_pairs - oracle.num_pairs) <= 2 and len(out.visible) == len(oracle.visible)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    bound = 4e-3 if name in ILL_CONDITIONED else 3e-4
    for key, truth in expected.items():
        parts = len(SMALLER[name].means) if key in POSE else 1  # the camera's is a sum over all Gaussians
        assert np.abs(gradients[key] - truth).max() <= parts * bound * np.abs(truth).max(), key


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_sh_degrees(device, degree):
    settings = dataclasses.replace(SETTINGS, sh_degree=degree)
    _, gradients, _ = images_and_gradients(SMALLER["random"], "cuda", device, settings)
    _, expected, _ = images_and_gradients(SMALLER["random"], "cpu", device, settings)
    for key, truth in expected.items():
        assert np.abs(gradients[key] - truth).max() <= 3e-4 * np.abs(truth).max(), key


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # divisions by zero whose results are not used
@pytest.mark.parametrize("dilation", [0.0, 0.1, 1.0])
def test_dilations(device, dilation):
    """The scene has Gaussians of a few pixels, which float32 resolves, and a line, which is not drawn without
    dilation."""
    scene = random(20, (17, 33), seed=3)
    scene.log_scales[7] = (-1.0, -60.0, -60.0)
    settings = dataclasses.replace(SETTINGS, dilation=dilation)
    values, gradients, out = images_and_gradients(scene, "cuda", device, settings)
    truths, expected, oracle = images_and_gradients(scene, "cpu", device, settings)
    assert set(out.visible.tolist()) == set(oracle.visible.tolist())
    assert (7 in out.visible) == (dilation > 0)
    for key, truth in truths.items():
        assert np.abs(values[key] - truth).max() < 1.1 * max(1.0, np.abs(truth).max()) / 255, key
    for key, truth in expected.items():
        parts = 20 if key in POSE else 1  # the camera's is a sum over all Gaussians
        assert np.abs(gradients[key] - truth).max() <= parts * 4e-3 * np.abs(truth).max(), key
        if dilation == 0 and len(truth) == 20:
            assert np.all(gradients[key][7] == 0), key


def test_two_runs_give_the_same_bits(device):
    scene = random(20, (17, 33), seed=3)
    first, second = (images_and_gradients(scene, "cuda", device)[:2] for _ in range(2))
    for ours, other in zip(first, second, strict=True):
        for key, array in ours.items():
            np.testing.assert_array_equal(array, other[key], err_msg=key)


def test_several_cameras_and_no_depth(device):
    scene = random(30, (20, 18), seed=5)
    gaussians = scene.gaussians(torch.float32).to(torch.device(device))
    settings = RenderSettings(depth=False)
    stack = render(gaussians, [scene.camera, scene.camera], settings=settings, backend="cuda")
    assert stack.image.shape == (2, 18, 20, 3) and stack.depth is None
    assert torch.equal(stack.image[0], stack.image[1])


@pytest.mark.parametrize("kind", ["empty", "behind", "faint", "one"])
def test_almost_empty_scenes(device, kind):
    scene = random(0 if kind == "empty" else 1 if kind == "one" else 9, (17, 33), seed=2)
    gaussians = scene.gaussians(torch.float32).to(torch.device(device))
    if kind == "behind":
        gaussians.means[:, 2] -= 100.0
    if kind == "faint":
        gaussians.logit_opacities[:] = -9.0
    gaussians = gaussians.trainable()
    out = render(gaussians, scene.camera, settings=SETTINGS, backend="cuda")
    out.image.sum().backward()
    assert (out.num_pairs > 0) == (kind == "one") == bool(len(out.visible))
    if kind != "one":
        expected = torch.tensor(BACKGROUND, device=device).expand(33, 17, 3)
        torch.testing.assert_close(out.image.detach(), expected)
        assert all((t.grad == 0).all() for t in gaussians.tensors().values())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the interpreter computes with NumPy, which warns
@pytest.mark.parametrize(("name", "value"), POISON)
def test_one_bad_gaussian_does_not_affect_others(device, name, value):
    scene = random(20, (17, 33), seed=3)
    good = scene.gaussians(torch.float32).to(torch.device(device))
    bad = good.map(torch.clone)
    bad.tensors()[name][7] = value
    without = good.map(lambda t: torch.cat([t[:7], t[8:]])).trainable()
    bad = bad.trainable()
    images = [render(g, scene.camera, settings=SETTINGS, backend="cuda").image for g in (bad, without)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for key, tensor in bad.tensors().items():
        assert (tensor.grad[7] == 0).all(), key
        assert torch.equal(torch.cat([tensor.grad[:7], tensor.grad[8:]]), without.tensors()[key].grad), key


def test_means_far_outside_their_tiles(device):
    """The mean of a wide Gaussian is 400 px outside the image, and shifting the moments that far loses no digits."""
    scene = random(4, (41, 35), seed=6)
    far = scene.gaussians(torch.float64)
    far.means[0, 0] += 25.0
    far.log_scales[0] = 2.2
    found = []
    for backend, dtype in (("cuda", torch.float32), ("cpu", torch.float64)):
        where = torch.device(device if backend == "cuda" else "cpu")
        moved = far.map(lambda t, dtype=dtype: t.to(dtype)).to(where).trainable()
        out = render(moved, scene.camera, settings=SETTINGS, backend=backend)
        out.image.square().sum().backward()
        found.append({key: tensor.grad.double().cpu() for key, tensor in moved.tensors().items()})
    assert float(found[1]["means"][0].abs().max()) > 0
    for key, truth in found[1].items():
        assert float((found[0][key] - truth).abs().max()) <= 3e-4 * float(truth.abs().max()), key


def test_float64_is_refused(device):
    scene = random(3, (8, 8))
    with pytest.raises(ArgumentError, match=r"^means: are torch.float64"):
        render(scene.gaussians(torch.float64).to(torch.device(device)), scene.camera, backend="cuda")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_without_a_gpu_auto_uses_the_cpu_and_cuda_is_refused(monkeypatch):
    assert resolve_backend("auto") == "cpu"
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    assert resolve_backend("auto") == "cpu"
    with pytest.raises(BackendUnavailableError, match="torch sees no GPU; use the backend cpu"):
        resolve_backend("cuda")


def test_a_camera_is_uploaded_once(device):
    from gsplat_edu.render.triton.rasterize import _camera_rows

    scene = random(3, (8, 8))
    gaussians = scene.gaussians(torch.float32).to(torch.device(device))
    other = Camera.posed(scene.camera.R, scene.camera.eye, scene.camera.intrinsics)
    before = len(_camera_rows)
    rows = []
    for _ in range(2):
        render(gaussians, other, backend="cuda")
        rows.append(next(iter(_camera_rows[other].values())))
    assert len(_camera_rows) == before + 1 and rows[0] is rows[1]


@pytest.mark.parametrize("channels", [1, 3, 7, 32])
def test_features_and_median_depth_match_the_native_kernels(device, channels):
    """As for colours, the bound is 3e-4 of the largest gradient.

    The median depth may differ where the transmittance is within float32 rounding of one half.
    """
    scene = random(24, (20, 17), seed=channels)
    settings = RenderSettings(median_depth=True, alpha_max=0.97, z_near=0.2)
    found = []
    for backend, dtype, where in (("cuda", torch.float32, device), ("cpu", torch.float64, "cpu")):
        gaussians = scene.gaussians(dtype).to(torch.device(where)).trainable()
        generator = torch.Generator().manual_seed(channels)
        features = torch.randn(24, channels, generator=generator, dtype=torch.float64)
        features = features.to(gaussians.means).requires_grad_()
        out = render(gaussians, scene.camera, settings=settings, features=features, backend=backend)
        draw = torch.randn(out.features.shape, generator=generator, dtype=torch.float64).to(out.features)
        ((out.features * draw).sum() + out.image.sum() + out.mean_depth.sum()).backward()
        values = {"features": out.features, "image": out.image, "median": out.median_depth}
        gradients = {name: tensor.grad for name, tensor in gaussians.tensors().items()}
        gradients["of features"] = features.grad
        found.append([{k: t.detach().double().cpu() for k, t in d.items()} for d in (values, gradients)])
    (values, gradients), (truths, expected) = found
    for key in ("features", "image"):
        assert (values[key] - truths[key]).abs().max() < 1.1 * max(1.0, truths[key].abs().max()) / 255
        assert (values[key] - truths[key]).abs().median() < 1e-5
    assert ((values["median"] - truths["median"]).abs() > 1e-5).sum() <= 2 and truths["median"].max() > 2
    for key, truth in expected.items():
        assert (gradients[key] - truth).abs().max() <= 3e-4 * truth.abs().max(), key


def test_features_of_another_dtype_are_refused(device):
    gaussians = random(3, (16, 16)).gaussians(torch.float32).to(torch.device(device))
    with pytest.raises(ArgumentError, match="^features: are torch.float64"):
        render(
            gaussians,
            random(3).camera,
            features=torch.zeros(3, 2, dtype=torch.float64, device=device),
            backend="cuda",
        )
