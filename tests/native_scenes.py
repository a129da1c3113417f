"""Hard scenes for kernels, and their images by the NumPy reference with exact extents and tile stops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsplat_edu import Camera, build_cov3d_batch, eval_sh, project_cov3d, quat_to_R_batch, render_gaussians
from gsplat_edu.base.constants import DILATION
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussian_math import opacity_compensation
from gsplat_edu.scene.gaussians import Gaussians

BACKGROUND = (0.2, 0.5, 0.9)


@dataclass(frozen=True)
class Scene:
    """Raw parameters as NumPy arrays, and the camera that looks at them."""

    camera: Camera
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    sh: np.ndarray
    logits: np.ndarray

    def gaussians(self, dtype: torch.dtype = torch.float64) -> Gaussians:
        tensor = lambda array: torch.tensor(array, dtype=dtype)  # noqa: E731
        return Gaussians(
            means=tensor(self.means),
            quats=tensor(self.quats),
            log_scales=tensor(self.log_scales),
            sh0=tensor(self.sh[:, :1]),
            sh_rest=tensor(self.sh[:, 1:]),
            logit_opacities=tensor(self.logits),
        )

    def truth(
        self, degree: int = 3, antialiased: bool = False, dilation: float = DILATION
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return image, transmittance and expected depth of the reference."""
        covs = build_cov3d_batch(np.exp(self.log_scales), quat_to_R_batch(self.quats))
        toward = self.means - self.camera.eye
        colors = eval_sh(degree, self.sh, toward / np.linalg.norm(toward, axis=-1, keepdims=True))
        means_cam = self.camera.world_to_cam(self.means)
        opacities = 1 / (1 + np.exp(-self.logits))
        if antialiased:
            front = means_cam[:, 2] > 0.05
            flat = project_cov3d(covs[front], means_cam[front], self.camera)
            opacities[front] *= opacity_compensation(flat, dilation)
        exact = {"extent": "exact", "stop": "tile", "dilation": dilation}
        image, T = render_gaussians(self.camera, self.means, covs, colors, opacities, bg=BACKGROUND, **exact)
        depths = np.repeat(means_cam[:, 2:], 3, axis=1)
        depth, _ = render_gaussians(self.camera, self.means, covs, depths, opacities, **exact)
        return image, T, depth[..., 0]


def camera(W: int, H: int) -> Camera:
    """Return a camera three units in front of the origin, with the principal point off the image centre."""
    R = quat_to_R_batch([(1.0, 0.02, -0.03, 0.1)])[0]
    return Camera(R, (0.1, -0.05, -3.0), fx=1.1 * W, fy=1.2 * W, cx=0.52 * W, cy=0.47 * H, H=H, W=W)


def random(n: int, size: tuple[int, int] = (41, 35), seed: int = 0, **changes: np.ndarray) -> Scene:
    """Return n random Gaussians with distinct depths and harmonics of degree 3."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-0.8, 0.8, (n, 3))
    means[:, 2] = rng.permutation(n) / max(n, 1) - 0.5
    parts = {
        "means": means,
        "quats": rng.normal(size=(n, 4)),
        "log_scales": rng.normal(size=(n, 3)) * 0.6 - 2.3,
        "sh": rng.normal(size=(n, 16, 3)) * np.where(np.arange(16) == 0, 1.0, 0.3)[None, :, None],
        "logits": rng.normal(size=n) * 1.5,
    }
    return Scene(camera(*size), **parts | changes)


def smooth_scene(seed: int, n: int = 5) -> Scene:
    """Return a few Gaussians, each wider than the image, so that alpha is far above the floor at every pixel."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(n, 16, 3)) * 0.05
    sh[:, 0] += 0.5
    return Scene(
        camera(11, 9),
        means=np.stack([*rng.uniform(-0.3, 0.3, (2, n)), np.linspace(-0.5, 0.5, n)], axis=1),
        quats=rng.normal(size=(n, 4)),
        log_scales=rng.uniform(-0.6, 0.2, (n, 3)),
        sh=sh,
        logits=rng.uniform(-0.5, 1.0, n),
    )


def assert_smooth(scene: Scene, settings: RenderSettings) -> None:
    gaussians = scene.gaussians()
    depths = np.sort(scene.camera.world_to_cam(scene.means)[:, 2])
    assert np.diff(depths).min() > 1e-3, "no depths swap"
    for i in range(len(gaussians)):
        alone = gaussians.map(lambda t, i=i: t[i : i + 1])
        alpha = 1 - render(alone, scene.camera, settings=settings, backend="cpu").transmittance
        assert alpha.min() > 1.5 / 255 and alpha.max() < 0.95, "no alpha is near the floor or the clamp"
        assert render(alone, scene.camera, settings=RenderSettings(), backend="cpu").image.min() > 0.0
    assert len(render(gaussians, scene.camera, backend="cpu").visible) == len(gaussians)


def _spread(n: int) -> np.ndarray:
    """Return differences between the axes, so that rotations have an effect and a gradient."""
    return np.random.default_rng(n).uniform(-0.4, 0.4, (n, 3))


def _needles() -> Scene:
    rng = np.random.default_rng(1)
    thin = np.log(np.stack([np.full(60, 0.5), np.full(60, 0.005), np.full(60, 0.005)], axis=1))
    return random(60, seed=1, log_scales=rng.permuted(thin, axis=1))


def _layers(n: int = 3000) -> Scene:
    """Return thousands of faint layers over the same few pixels."""
    rng = np.random.default_rng(2)
    means = np.stack([rng.normal(size=n) * 0.05, rng.normal(size=n) * 0.05, np.linspace(-1, 1, n)], axis=1)
    return random(n, (20, 18), seed=2, means=means, logits=rng.normal(size=n) - 3.0)


SCENES = {
    "random": random(80),
    "needles 100:1": _needles(),
    "larger than the image": random(20, seed=3, log_scales=0.8 + _spread(20), logits=np.full(20, -0.8)),
    "smaller than a pixel": random(200, seed=4, log_scales=-8.0 + _spread(200)),
    "thousands of layers": _layers(),
    "opaque, tiles stop": random(150, seed=5, log_scales=-0.5 + _spread(150), logits=np.full(150, 9.0)),
    "nearly transparent": random(100, seed=6, logits=np.linspace(-5.6, -5.4, 100)),
    "ties in depth": random(
        60, seed=7, means=np.random.default_rng(7).uniform(-0.8, 0.8, (60, 3)) * (1, 1, 0)
    ),
    "one pixel": random(40, (1, 1), seed=8, log_scales=-1.0 + _spread(40), logits=np.full(40, -2.0)),
    "17 x 33": random(60, (17, 33), seed=9),
    "one Gaussian": random(1, seed=10),
    "partly behind": random(80, seed=11, means=np.random.default_rng(11).uniform(-4, 4, (80, 3))),
}
"""Scenes by their difficulty. In the scene with ties, a camera axis is along z, so that depths tie exactly."""

SCENES["ties in depth"] = Scene(
    **{
        **SCENES["ties in depth"].__dict__,
        "camera": Camera(np.eye(3), (0, 0, -3.0), 45.0, 49.0, 21.0, 16.5, 35, 41),
    }
)
