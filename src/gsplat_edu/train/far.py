"""The sphere that far splats lie on, and which splats belong to it.

Density control adds, removes and sorts splats, so those of the sky are known by their distance, not by their index.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from gsplat_edu.render.planes import depth_features
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

MOST_IN_SHELL = 0.4
"""Splits may raise the shell's Gaussians to at most this fraction of all. Without the limit, 62 % of the Gaussians of
`benchmarks/sky.py` become sky with adc."""


@dataclass(frozen=True, eq=False)
class Shell:
    """A sphere around the cameras, far behind the scene.

    Args:
        centre: (3,) world units.
        radius: World units.
    """

    centre: Float64[np.ndarray, "3"]
    radius: float

    def holds(self, means: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Return which means lie nearer to the sphere than to its centre, or beyond it.

        Args:
            means: (N, 3) world units.
        """
        away = means.detach() - torch.from_numpy(self.centre).to(means)
        x, y, z = away.unbind(dim=1)
        return x * x + y * y + z * z > (self.radius / 2) ** 2

    def within_quota(
        self, selected: Bool[Tensor, " N"], scores: Float[Tensor, " N"], means: Float[Tensor, "N 3"]
    ) -> Bool[Tensor, " N"]:
        """Leave out the splats of the shell with the lowest scores, so that it does not outgrow the scene.

        Args:
            selected: (N,) which Gaussians could be split, each into two.
            scores: (N,) how much they need it.
            means: (N, 3) world units.
        """
        far = self.holds(means)
        room = max(int(MOST_IN_SHELL * len(means)) - int(far.sum()), 0)
        candidates = torch.nonzero(selected & far)[:, 0]
        if len(candidates) <= room:
            return selected
        order = torch.argsort(scores[candidates], descending=True, stable=True)
        chosen = selected.clone()
        chosen[candidates[order[room:]]] = False
        return chosen


def features_before(
    shell: Shell, gaussians: Gaussians, camera: Camera, normals: Float[Tensor, "N 3"] | None
) -> Float[Tensor, "N C"]:
    """Return features that composite to the depth, alpha and normals of what lies before a shell.

    Its splats get zeros. They still lie behind the others, whose weights they do not change.

    Args:
        shell: Where the far splats lie.
        gaussians: N Gaussians.
        camera: The camera that renders them.
        normals: (N, 3) `facing_normals`; None to leave them out.

    Returns:
        (N, 2) as of `depth_features`, or (N, 5) with the normals after them; `without_shell` reads the composite.
    """
    near = ~shell.holds(gaussians.means)
    depths = depth_features(gaussians, camera, near)
    return depths if normals is None else torch.cat([depths, normals * near[:, None]], dim=1)
