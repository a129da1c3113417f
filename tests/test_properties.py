"""Properties of the image that hold for every scene, tested by hypothesis."""

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from hypothesis.extra.numpy import arrays

from gsplat_edu import Camera, build_cov3d_batch, quat_to_R, quat_to_R_batch, render_gaussians

pytestmark = pytest.mark.fuzz

CAM = Camera(np.eye(3), (0, 0, 0), fx=20, fy=22, cx=9.3, cy=6.8, H=14, W=19)


def floats(shape, low, high):
    return arrays(np.float64, shape, elements=st.floats(low, high, allow_subnormal=False))


def unit_quats(shape):
    """Generate quaternions that are not near zero."""
    return floats(shape, 0.1, 1.0)


@st.composite
def scenes(draw):
    """Generate up to six splats in front of CAM; their depths differ by at least 0.1, so none tie."""
    n = draw(st.integers(1, 6))
    depths = 1.0 + 0.2 * np.arange(n) + draw(floats(n, 0.0, 0.1))
    means = np.concatenate([draw(floats((n, 2), -1.0, 1.0)), depths[:, None]], axis=1)
    scales, quats = draw(floats((n, 3), 0.0, 0.5)), draw(unit_quats((n, 4)))
    return means, scales, quats, draw(floats((n, 3), 0.0, 1.0)), draw(floats(n, 0.0, 1.0))


def splats(scene):
    means, scales, quats, colors, opacities = scene
    return means, build_cov3d_batch(scales, quat_to_R_batch(quats)), colors, opacities


SUBNORMAL = tuple(
    np.array(each) for each in ([[0, 0, 1.0]], [[1.04e-161, 0, 0]], [[0.5, 1, 1, 1]], [[0.0, 0, 0]], [0.0])
)
"""A splat whose covariance is subnormal, so that rounding makes it asymmetric."""


@given(scenes(), unit_quats(4), floats(3, -10.0, 10.0))
@example(SUBNORMAL, np.ones(4), np.zeros(3))
def test_moving_the_world_and_the_camera_together_changes_nothing(scene, quat, shift):
    """x -> Q x + t for the means, Sigma -> Q Sigma Q', R -> R Q', eye -> Q eye + t.

    extent="exact" and stop="none" are used because the chapter's boxes consist of whole pixels and may grow by one
    when a mean moves by a rounding error. Rounding: coordinates up to 12 have errors of 12 eps, which fx / z = 22 turns
    into 6e-14 px. The slope of alpha is at most 1 / sqrt(0.3 e) = 1.1 per px. Relative errors of Sigma2d (up to 2e2
    px²) enter the exponent as 16 eps x 2e2 / 0.3. Together, these are below 1e-10. An alpha exactly at the floor may be
    dropped on one side only, so such a pixel may differ by 1/255.
    """
    means, cov3ds, colors, opacities = splats(scene)
    Q = quat_to_R(quat)
    moved = Camera(CAM.R @ Q.T, Q @ CAM.eye + shift, CAM.fx, CAM.fy, CAM.cx, CAM.cy, CAM.H, CAM.W)
    options = {"extent": "exact", "stop": "none"}
    before, _ = render_gaussians(CAM, means, cov3ds, colors, opacities, **options)
    after, _ = render_gaussians(moved, means @ Q.T + shift, Q @ cov3ds @ Q.T, colors, opacities, **options)
    difference = np.abs(after - before).max(axis=-1)
    at_the_floor = difference > 1e-10
    assert at_the_floor.sum() <= 1 and difference.max() <= 1.001 / 255


@given(
    scenes(),
    st.sampled_from(["box3sigma", "exact"]),
    st.sampled_from(["box", "tile", "none"]),
    floats(3, 0.0, 1.0),
)
def test_transmittance_and_colours_stay_in_range(scene, extent, stop, bg):
    _, _, colors, _ = scene = splats(scene)
    image, T = render_gaussians(CAM, *scene, bg=bg, extent=extent, stop=stop)
    assert (T >= 0).all() and (T <= 1).all()
    low, high = np.minimum(colors.min(0), bg), np.maximum(colors.max(0), bg)
    assert (image >= low - 1e-12).all() and (image <= high + 1e-12).all(), (
        "a convex combination, up to rounding"
    )


@given(scenes(), st.randoms(use_true_random=False))
def test_the_order_of_the_input_does_not_matter(scene, random):
    scene = splats(scene)
    order = list(range(len(scene[0])))
    random.shuffle(order)
    image, T = render_gaussians(CAM, *scene)
    shuffled_image, shuffled_T = render_gaussians(CAM, *(a[order] for a in scene))
    np.testing.assert_array_equal(shuffled_image, image)
    np.testing.assert_array_equal(shuffled_T, T)
