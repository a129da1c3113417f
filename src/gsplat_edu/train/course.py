"""The course's training of the sphere: its settings.

Chapter 09 (notebooks/09_train_in_3d.ipynb) says in full where it departs from Kerbl et al. 2023, and why. Beyond that,
Gaussians stay in the order in which they were made, so that the chapter's own loop draws the same children; every other
training sorts them along a Morton curve.
"""

from __future__ import annotations

from gsplat_edu.train.config import TrainConfig

EXTENT = 3.0
"""Size of the sphere's scene, world units: the radius of the camera orbit."""


def course_config(iterations: int = 800, seed: int = 9, max_gaussians: int = 1600) -> TrainConfig:
    """Return the configuration of the chapter's run.

    Args:
        iterations: Number of steps.
        seed: Seed of the view order.
        max_gaussians: Cap on the number of Gaussians.
    """
    return TrainConfig().changed(
        iterations=iterations,
        seed=seed,
        max_gaussians=max_gaussians,
        over_cap="cut",
        means_rate=1e-3 / EXTENT,
        means_rate_final=1e-3 / EXTENT,
        adam_eps=1e-8,
        ssim_weight=0.0,
        sh_degree=0,
        view_order="random",
        jacobian_limit=None,
        densify_start=0,
        densify_stop=600,
        reset_every=0,
    )
