"""A scene whose photos are known: a textured ball in a room, photographed from a ring of cameras."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from lab.captures.plant import floaters

CPU = load_backend("cpu")

SETTINGS = RenderSettings(depth=False, sh_degree=0, jacobian_limit=1.3)

SIZE, RADIUS = 40, 2.4


def shell(count: int, radius: float, size: float, seed: int) -> Gaussians:
    """Return opaque splats on a sphere, with a pattern of colours."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    unit = points / radius
    waves = np.stack([np.sin(5 * unit[:, 0]), np.sin(6 * unit[:, 1] + 1), np.cos(4 * unit[:, 2])], axis=1)
    return Gaussians(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(size)),
        sh0=torch.tensor(0.4 * waves / C0, dtype=torch.float32)[:, None],
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.full((count,), 3.0),
    )


def camera(k: int, count: int, size: int = SIZE) -> Camera:
    angle = 2 * math.pi * k / count
    eye = RADIUS * np.array([math.sin(angle), 0.3 * math.sin(3 * angle), -math.cos(angle)])
    return Camera(look_at(eye, (0, 0, 0)), eye, size, size, (size - 1) / 2, (size - 1) / 2, size, size)


def photographed(scene: Gaussians, cameras, mask=None) -> list[View]:
    """Photograph a scene with our own renderer, rounded to bytes."""
    views = []
    for k, one in enumerate(cameras):
        with torch.no_grad():
            image = render(scene, one, settings=SETTINGS, backend="cpu").image
        pixels = np.round(255 * image.clamp(0, 1).numpy()).astype(np.uint8)
        views.append(View(one, pixels, mask=mask, name=f"view_{k:02d}.png"))
    return views


@pytest.fixture(scope="session")
def room() -> Gaussians:
    """A ball of 400 splats in a room of 900."""
    return Gaussians.concatenated([shell(400, 0.7, 0.07, 1), shell(900, 6.0, 0.5, 2)])


@pytest.fixture(scope="session")
def rings() -> tuple[list[View], list[View]]:
    """The cameras of training and of held-out views."""
    cameras = [camera(k, 40) for k in range(40)]
    return [c for k, c in enumerate(cameras) if k % 5], cameras[::5]


@pytest.fixture(scope="session")
def planted(room, rings):
    """The room with 60 floaters as its last rows."""
    return Gaussians.concatenated([room, floaters(room, rings[0], SETTINGS, 60, seed=3)])


@pytest.fixture
def set_threads():
    """Set the number of threads; the old number is restored after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)
