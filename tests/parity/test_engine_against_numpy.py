"""The engine's frames against the NumPy reference.

Every step is backward stable, as in the native float32 kernels: up to a rounding, its result is exact for parameters
that differ by a few eps. WGSL promises less than IEEE for some operations: division errs by 2.5 ULP, exp2(p) by 3 + 2
|p|, at most 19 where alpha is above 1/255, log2 by 2^-21 near 1. The relative error of an alpha is then at most 19
eps from exp2, ln 2 x 2^-21 = 3 eps from log2, and what the errors of s and t give, which is the change of the pixel
when the parameters move by 4 eps (times 4, because only eight random moves are tried). A pixel is a sum of w c with
weights that sum to at most 1, so 22 eps of the brightest colour bound the first two, in front of 100 eps for the
rounding of the sum. A pixel with an alpha that close to 1/255 may gain or lose 1/255 of a colour: two such pixels per
scene are allowed.
"""

import numpy as np
import pytest

from engine.frames import drawn
from float32_backends import sensitivity
from native_scenes import SCENES, random

EPS = float(np.finfo(np.float32).eps)


@pytest.mark.parametrize("name", [name for name in SCENES if name != "ties in depth"])
def test_image_transmittance_and_depth(pool, name):
    scene = SCENES[name]
    found = drawn(pool, scene)
    truth, truth_T, truth_depth = scene.truth()
    bright = max(1.0, np.abs(truth).max())
    error = np.maximum(np.abs(found.image - truth).max(axis=-1), np.abs(found.transmittance - truth_T))
    over = error > 4 * sensitivity(scene) + 122 * EPS * bright
    assert over.sum() <= 2 and error.max() < 1.1 * bright / 255
    assert np.abs(found.depth - truth_depth).max() < 1.1 * max(1.0, truth_depth.max()) / 255
    assert np.median(np.abs(found.depth - truth_depth)) <= 122 * EPS * max(1.0, truth_depth.max())


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 1000, 20_000])
def test_counts_around_a_batch(pool, count):
    """Small Gaussians, so that the reference, which loops over them, takes seconds at most.

    With thousands of them, several alphas may be within rounding of 1/255; the mean error tells these from a wrong
    formula.
    """
    scene = random(count, (90, 61), seed=count, log_scales=np.full((count, 3), -3.5))
    found = drawn(pool, scene)
    truth, truth_T, _ = scene.truth()
    bright = max(1.0, np.abs(truth).max())
    assert np.abs(found.image - truth).max() < 2.2 * bright / 255
    assert np.abs(found.image - truth).mean() < 10 * EPS * bright
    assert np.abs(found.transmittance - truth_T).max() < 2.2 / 255
