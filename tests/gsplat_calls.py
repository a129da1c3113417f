"""Arguments of a small call of `rasterization`."""

import torch

N, C = 6, 2


def arguments(**changes):
    g = torch.Generator().manual_seed(0)
    viewmats = torch.eye(4).repeat(C, 1, 1)
    viewmats[:, 2, 3] = 4.0
    given = {
        "means": torch.randn(N, 3, generator=g),
        "quats": torch.randn(N, 4, generator=g),
        "scales": torch.full((N, 3), 0.2),
        "opacities": torch.full((N,), 0.7),
        "colors": torch.rand(N, 3, generator=g),
        "viewmats": viewmats,
        "Ks": torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]).repeat(C, 1, 1),
        "width": 16,
        "height": 12,
    }
    return given | changes
