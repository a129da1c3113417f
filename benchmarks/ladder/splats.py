"""The input of every rung of the ladder: splats on the screen, near to far."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsplat_edu.base.constants import DILATION, Z_NEAR
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.render.numpy_reference import project
from gsplat_edu.scene.camera import Camera

SIGMA = 2.0
"""px: standard deviation of the splats of `scene` before their dilation."""


class Splats(NamedTuple):
    """N splats on a screen of H x W pixels, near to far, every array contiguous float32."""

    means2d: np.ndarray  # (N, 2) px
    conics: np.ndarray  # (N, 3) px^-2: xx, xy, yy of the inverse of the dilated covariance
    colors: np.ndarray  # (N, 3)
    opacities: np.ndarray  # (N,)
    H: int
    W: int

    @property
    def count(self) -> int:
        """The number of splats."""
        return len(self.opacities)

    @property
    def pixels(self) -> int:
        """The number of pixels of the screen."""
        return self.H * self.W

    def cov2d(self) -> np.ndarray:
        """Return the dilated covariances (N, 2, 2) in float64, px²."""
        A, B, C = self.conics.astype(np.float64).T
        return np.stack([C, -B, -B, A], axis=-1).reshape(-1, 2, 2) / (A * C - B * B)[:, None, None]

    def flat(self) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return a camera and 3D Gaussians (means, cov3ds, colors, opacities) that project to these splats.

        Discs on the plane z = 1, seen by a camera of focal length 1 at the origin, are their own projection, exact to
        the last bit of the means. Ties in depth keep their order. So `render_gaussians` draws exactly these splats.
        """
        camera = Camera(np.eye(3), (0, 0, 0), fx=1, fy=1, cx=0, cy=0, H=self.H, W=self.W)
        means, cov3ds = np.ones((self.count, 3)), np.zeros((self.count, 3, 3))
        means[:, :2] = self.means2d
        cov3ds[:, :2, :2] = self.cov2d() - DILATION * np.eye(2)
        return camera, means, cov3ds, self.colors.astype(np.float64), self.opacities.astype(np.float64)


def from_cov2d(
    means2d: ArrayLike, cov2d: np.ndarray, colors: ArrayLike, opacities: ArrayLike, size: tuple[int, int]
) -> Splats:
    """Make splats from dilated covariances (N, 2, 2) for a screen of (H, W) pixels."""
    inverse = np.linalg.inv(cov2d)
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=-1)
    arrays = (np.ascontiguousarray(a, dtype=np.float32) for a in (means2d, conics, colors, opacities))
    return Splats(*arrays, *size)


def projected(
    camera: Camera, means: ArrayLike, cov3ds: ArrayLike, colors: ArrayLike, opacities: ArrayLike
) -> Splats:
    """Project Gaussians as `render_gaussians` does, and round the result to float32."""
    means, cov3ds = np.asarray(means, dtype=np.float64), np.asarray(cov3ds, dtype=np.float64)
    order, means2d, cov2d = project(camera, means, cov3ds, Z_NEAR, None)
    return from_cov2d(
        means2d, cov2d, np.asarray(colors)[order], np.asarray(opacities)[order], (camera.H, camera.W)
    )


def scene(count: int, size: int, seed: int = 0, stretch: float = 1.0) -> Splats:
    """Scatter splats of 2 px over a square screen.

    Args:
        count: Number of splats.
        size: Edge of the screen, px.
        seed: Seed of the generator.
        stretch: Ratio of the axes, 1 for round splats; the area does not change. Directions are random.
    """
    rng = np.random.default_rng(seed)
    means2d, colors = rng.uniform(0, size, (count, 2)), rng.uniform(0, 1, (count, 3))
    opacities, angle = rng.uniform(0.1, 0.99, count), rng.uniform(0, np.pi, count)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    cov2d = SIGMA**2 * (
        stretch * along[:, :, None] * along[:, None] + across[:, :, None] * across[:, None] / stretch
    )
    return from_cov2d(means2d, cov2d + DILATION * np.eye(2), colors, opacities, (size, size))
