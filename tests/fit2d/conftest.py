"""Fixtures shared by the tests of fit2d."""

import numpy as np
import pytest

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN
from gsplat_edu.fit2d.splats import Splats2D, render_2d


@pytest.fixture
def smooth():
    """Splats, an image size and a background for which every pixel depends smoothly on every parameter. Every splat
    is wider than the image, so no alpha is near the floor. No opacity is near the clamp, and splats are ordered by
    index.
    """
    rng = np.random.default_rng(21)
    splats = Splats2D(
        means=rng.uniform(2, 6, (5, 2)),
        log_scales=np.log(rng.uniform(2.5, 4, (5, 2))),
        angles=rng.uniform(-3, 3, 5),
        colors=rng.uniform(-0.2, 1.2, (5, 3)),
        logit_opacities=rng.uniform(-0.5, 1, 5),
    )
    alphas = np.array([f.alpha for f in render_2d(splats, 9, 8).footprints])
    assert alphas.shape == (5, 9, 8) and alphas.min() > 1.5 * ALPHA_MIN and alphas.max() < 0.9 * ALPHA_MAX
    return splats, 9, 8, (0.2, 0.5, 0.1)


@pytest.fixture
def rough():
    """Splats whose render is discontinuous: needles, specks, some outside, some at the clamp, some below the floor."""
    rng = np.random.default_rng(22)
    count = 60
    logits = rng.normal(0, 3, count)
    logits[:4] = 12.0, 8.0, -7.0, -20.0
    means, log_scales = rng.uniform(-10, 50, (count, 2)), rng.uniform(-4, 3, (count, 2))
    means[:4], log_scales[:4] = (20.2, 17.9), 1.5
    return Splats2D(
        means=means,
        log_scales=log_scales,
        angles=rng.uniform(-10, 10, count),
        colors=rng.normal(0.5, 0.5, (count, 3)),
        logit_opacities=logits,
    )
