"""A ball of flat splats, whose surface is known."""

import numpy as np
import torch

from gsplat_edu import Gaussians

RADIUS = 0.8
COUNT = 3_000


def ball(opacity_logit=4.0):
    """Return flat splats on a ball, in stripes of two colours."""
    index = np.arange(COUNT) + 0.5
    z, turn = 1 - 2 * index / COUNT, np.pi * (1 + 5**0.5) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    # the rotation that takes the z axis, which is the shortest, to the normal
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(COUNT)], axis=1)
    shade = np.where(np.sin(8 * normals[:, 1]) > 0, 1.0, -1.0)
    as_tensor = torch.tensor
    return Gaussians(
        means=as_tensor(RADIUS * normals, dtype=torch.float32),
        quats=as_tensor(quats, dtype=torch.float32),
        log_scales=as_tensor(np.log(np.tile([0.035, 0.035, 0.002], (COUNT, 1))), dtype=torch.float32),
        sh0=as_tensor(shade[:, None, None] * np.array([1.0, 0.0, -1.0]), dtype=torch.float32),
        sh_rest=torch.zeros(COUNT, 0, 3),
        logit_opacities=torch.full((COUNT,), float(opacity_logit)),
    )
