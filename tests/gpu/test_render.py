"""The backend cuda: images agree with the NumPy reference, and what it refuses.

On a machine without a GPU, the kernels run in Triton's interpreter. Bounds are those of the native float32 kernels:
four times each pixel's change when the parameters move by 4 eps, plus the rounding of the sum. parity/test_float32.py
has its gradients.
"""

import numpy as np
import pytest
import torch

from float32_backends import (
    SMALLER,
    images_and_gradients,
    sensitivity,
)
from gsplat_edu import Camera
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.render.settings import RenderSettings
from native_scenes import random


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


def test_several_cameras_and_no_depth(device):
    scene = random(30, (20, 18), seed=5)
    gaussians = scene.gaussians(torch.float32).to(torch.device(device))
    settings = RenderSettings(depth=False)
    stack = render(gaussians, [scene.camera, scene.camera], settings=settings, backend="cuda")
    assert stack.image.shape == (2, 18, 20, 3) and stack.depth is None
    assert torch.equal(stack.image[0], stack.image[1])


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
    from gsplat_edu.render.cuda.render import camera_rows

    scene = random(3, (8, 8))
    gaussians = scene.gaussians(torch.float32).to(torch.device(device))
    other = Camera.posed(scene.camera.R, scene.camera.eye, scene.camera.intrinsics)
    before = len(camera_rows)
    rows = []
    for _ in range(2):
        render(gaussians, other, backend="cuda")
        rows.append(next(iter(camera_rows[other].values())))
    assert len(camera_rows) == before + 1 and rows[0] is rows[1]


def test_features_of_another_dtype_are_refused(device):
    gaussians = random(3, (16, 16)).gaussians(torch.float32).to(torch.device(device))
    with pytest.raises(ArgumentError, match="^features: are torch.float64"):
        render(
            gaussians,
            random(3).camera,
            features=torch.zeros(3, 2, dtype=torch.float64, device=device),
            backend="cuda",
        )
