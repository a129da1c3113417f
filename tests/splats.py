"""Scenes shared by tests of runs and commands."""

import torch

from gsplat_edu import C0
from gsplat_edu.scene.gaussians import Gaussians


def splats_on(points, colors) -> Gaussians:
    """Return a ball of fixed size at every point, in the point's colour."""
    count = len(points)
    return Gaussians(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), -2.5),
        sh0=torch.tensor((colors - 0.5) / C0, dtype=torch.float32)[:, None],
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.full((count,), 2.0),
    )
