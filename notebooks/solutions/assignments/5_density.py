"""Assignment 5, density control: where Gaussians come from and go. For chapters 09 and 16; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/5_density.py
"""

import numpy as np

ASSIGNMENT = "density"


def signal(gradients, seen):
    """Return how strongly each Gaussian is pulled (N,): the mean length of its gradients over the views that see it.

    gradients (V, N, 2) are those by the centre on the image, 0 where a view does not see it; seen is (V, N).
    """
    return np.linalg.norm(gradients, axis=-1).sum(axis=0) / seen.sum(axis=0)


def decision(signal, scales, opacities, extent):
    """Return what becomes of each Gaussian (N,): 0 it stays, 1 it is cloned, 2 it is split, 3 it is pruned.

    Below an opacity of 0.005 it is pruned. Else, with a signal above 0.0002, it is split if the largest of its scales,
    (N, 3), is above a hundredth of the scene's extent, and cloned if not.
    """
    large = scales.max(axis=1) > 0.01 * extent
    chosen = np.where(signal > 0.0002, np.where(large, 2, 1), 0)
    return np.where(opacities < 0.005, 3, chosen)


def split(mean, R, scales, noise):
    """Return the means (2, 3) of a Gaussian's two children, and the scales (3,) of each: smaller by a factor of 1.6.

    The children are drawn from the parent, with mean (3,), rotation R (3, 3), whose columns are its axes, and scales
    (3,); noise (2, 3) is normal, with variance 1.
    """
    return mean + (noise * scales) @ R.T, scales / 1.6


def shared_opacity(opacity, copies):
    """Return the opacity of each of so many copies in one place which together are as opaque as the one before them."""
    return 1 - (1 - opacity) ** (1 / copies)
