"""The numbers of the course's training, named, and every way in which it differs from the paper.

The paper is Kerbl et al. 2023. The sphere is learned in 800 iterations where the paper takes 30,000, on
images of 128 px where the paper's have a thousand and more; most of what follows comes from that. Each
item names what is done here and, in brackets, what the paper or its code does.

1.  The means' learning rate is 1e-3 throughout. (1.6e-4 times the scene's extent, falling a
    hundredfold.) The cloud has a long way to go and few steps to go it in.
2.  The loss is L1. (0.8 L1 + 0.2 (1 - SSIM).)
3.  Colour is spherical harmonics of degree 0, as the sphere looks alike from everywhere. (Degree 3, one
    more every 1,000 iterations.)
4.  Opacity is never reset. (Every 3,000 iterations, which this run does not reach.)
5.  Nothing is pruned for its size, neither in the image nor in the world. (Both.)
6.  There is a cap on the number of Gaussians: survivors come first, then clones, then split children,
    and what is over the cap is cut from the end; a parent whose children are cut is gone all the same.
    (No cap.)
7.  Densification runs every 100 iterations from 100 to before 600. (Every 100 from 500 to 15,000.)
8.  The scene's extent is the radius of the camera orbit. (1.1 times the largest distance of a camera
    from the cameras' centre.)
9.  Views are drawn with replacement. (Each view once before any comes again.)
10. Adam's eps is 1e-8. (1e-15.)
11. The start is a random cloud in the unit ball, all of one size (`gsplat_edu.train.initialize`). (The
    points of structure-from-motion, sized by the distance to their neighbours.)
12. Gradients are averaged over the renders in which a Gaussian is in front of the camera. (In which it
    also reaches the image.)
13. Means nearer than 0.05 are culled (0.2), and the Jacobian of the projection is not clamped at the
    edge of the field of view (at 1.3 times it).
14. Images have one size throughout. (The first iterations run at a lower resolution.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from gsplat_edu.validation import in_range, whole_number


@dataclass(frozen=True)
class DensityConfig:
    """When and where the number of Gaussians changes.

    Args:
        start: No iteration before this one densifies.
        stop: Neither this iteration nor a later one does.
        every: Iterations that are a multiple of this densify.
        grad_threshold: A Gaussian whose mean gradient norm (in normalised device coordinates) is above
            this fails to explain its place and is cloned or split.
        percent_dense: Fraction of the extent: offenders with a larger scale are split, the others cloned.
        extent: Size of the scene, world units.
        min_opacity: Gaussians below this opacity are pruned.
        split_shrink: Children of a split have their parent's scales divided by this.
        max_gaussians: Cap on the number of Gaussians.
    """

    start: int = 100
    stop: int = 600
    every: int = 100
    grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    extent: float = 3.0
    min_opacity: float = 0.005
    split_shrink: float = 1.6
    max_gaussians: int = 1600

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("stop", self.stop, whole_number("start", self.start, 0))
        for name in ("every", "max_gaussians"):
            whole_number(name, getattr(self, name), 1)
        for name in ("grad_threshold", "percent_dense"):
            in_range(name, getattr(self, name), 0.0)
        for name in ("extent", "split_shrink"):
            in_range(name, getattr(self, name), 0.0, open_low=True)
        in_range("min_opacity", self.min_opacity, 0.0, 1.0)


@dataclass(frozen=True)
class TrainConfig:
    """One training run.

    Args:
        iterations: Number of steps; each renders one view.
        seed: Seed of the view order.
        learning_rates: Adam's rate of every raw parameter by name; one that is not named does not move.
    """

    iterations: int = 800
    seed: int = 9
    learning_rates: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType(
            {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "sh0": 2.5e-3, "logit_opacities": 5e-2}
        )
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("iterations", self.iterations, 1)
        whole_number("seed", self.seed, 0)
        for name, rate in self.learning_rates.items():
            in_range(f"learning_rates[{name!r}]", rate, 0.0)
