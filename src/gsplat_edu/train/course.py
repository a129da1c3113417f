"""The course's training of the sphere: its settings, and every difference from the paper.

The paper is Kerbl et al. 2023. The sphere trains for 800 iterations on images of 128 px; the paper trains for
30,000 on images of a thousand pixels and more. Most differences follow from that. Each item states what this
training does and, in brackets, what the paper or its code does.

1.  The means' learning rate is 1e-3 throughout. (1.6e-4 times the scene's extent, falling a
    hundredfold.) The Gaussians have to move far in few steps.
2.  The loss is L1. (0.8 L1 + 0.2 (1 - SSIM).)
3.  Colour is spherical harmonics of degree 0, as the sphere looks the same from every direction. (Degree 3,
    reached by one degree every 1,000 iterations.)
4.  Opacity is never reset. (Every 3,000 iterations, which this run does not reach.)
5.  Nothing is pruned for its size, neither in the image nor in the world. (Both.)
6.  The number of Gaussians is capped: survivors come first, then clones, then split children, and those over
    the cap are dropped from the end; the parent of dropped children is removed too. (No cap.)
7.  Densification runs every 100 iterations, first at 100 and last before 600. (Every 100 from 500 to 15,000.)
8.  The scene's extent is the radius of the camera orbit. (1.1 times the largest distance of a camera
    from the cameras' centre.)
9.  Views are drawn with replacement. (Each view once before any is repeated.)
10. Adam's eps is 1e-8. (1e-15.)
11. The start is a random cloud in the unit ball, with Gaussians of one size (`gsplat_edu.train.initialize`).
    (The points of structure from motion, sized by the distance to their neighbours.)
12. On the dense backend, gradients are averaged over the renders in which a Gaussian is in front of the
    camera. (Over those in which it also touches the image.)
13. Means nearer than 0.05 are culled (0.2), and the Jacobian of the projection is not clamped (at 1.3 times
    the half field of view).
14. Gaussians stay in the order in which they were made, so that the chapter's own loop draws the same children.
    (The paper's code does not sort either; every other training of this package sorts along a Morton curve.)
15. Images have one size throughout. (The first iterations run at a lower resolution.)
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
