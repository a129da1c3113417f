"""Images of 2D splats equal those of the reference renderer."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera, ShapeError, render_gaussians
from gsplat_edu.base.constants import DILATION
from gsplat_edu.fit2d.splats import Splats2D, ellipses_2d, random_splats_2d, render_2d


@pytest.mark.parametrize("background", [(0, 0, 0), (0.9, 0.2, 0.4)])
def test_the_image_matches_render_gaussians(rough, background):
    """Flat splats parallel to the image have the exact 2D covariance s² f² / z² anywhere, without approximation."""
    height, width, focal = 37, 43, 40.0
    z = np.linspace(2.0, 5.0, len(rough))
    camera = Camera(np.eye(3), (0, 0, 0), focal, focal, 21.5, 18.5, height, width)
    means = np.concatenate([(rough.means - (21.5, 18.5)) * z[:, None] / focal, z[:, None]], axis=1)
    covariances = np.zeros((len(rough), 3, 3))
    covariances[:, :2, :2] = (rough.cov2d - DILATION * np.eye(2)) * (z**2 / focal**2)[:, None, None]
    image, transmittance = render_gaussians(
        camera, means, covariances, rough.colors, rough.opacities, background, extent="exact", stop="none"
    )
    ours = render_2d(rough, height, width, background)
    assert np.abs(ours.image - image).max() < 1e-12
    assert np.abs(ours.transmittance - transmittance).max() < 1e-12


def test_the_covariance_is_the_rotated_squared_scales():
    splats = Splats2D(np.zeros((1, 2)), np.log([[3.0, 0.5]]), np.array([0.7]), np.ones((1, 3)), np.zeros(1))
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s], [s, c]])
    assert np.allclose(splats.cov2d[0], R @ np.diag([9.0, 0.25]) @ R.T + 0.3 * np.eye(2), rtol=1e-14)
    assert np.allclose(splats.factors[0], R @ np.diag([3.0, 0.5]), rtol=1e-14)


def test_ellipses_are_level_sets_of_the_exponent(rough):
    curves = ellipses_2d(rough, deviations=2.0)
    d = curves - rough.means[:, None]
    levels = np.einsum("npi,nij,npj->np", d, np.linalg.inv(rough.cov2d), d)
    assert np.allclose(levels, 4.0, rtol=1e-6)


def test_opacities_do_not_overflow():
    splats = random_splats_2d(3, 4, 4, np.random.default_rng(0))
    extreme = Splats2D(**splats.arrays() | {"logit_opacities": np.array([-1e4, 0.0, 1e4])})
    assert np.array_equal(extreme.opacities, [0.0, 0.5, 1.0])


def test_the_start_covers_the_image():
    splats = random_splats_2d(40, 30, 60, np.random.default_rng(4))
    assert len(splats) == 40
    assert (splats.means >= -0.5).all() and (splats.means <= (59.5, 29.5)).all()
    assert np.allclose(splats.scales, 0.5 * np.sqrt(45.0)) and np.all(splats.opacities == 0.5)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("means", np.zeros((3, 3)), "means: expected shape"),
        ("angles", np.zeros(2), "angles: expected shape"),
        ("colors", np.full((3, 3), np.nan), r"colors\[0, 0\]: is nan"),
    ],
)
def test_invalid_splats_are_refused(as_shipped, name, value, match):
    splats = random_splats_2d(3, 4, 4, np.random.default_rng(0))
    with pytest.raises(ArgumentError, match=match):
        Splats2D(**splats.arrays() | {name: value})


def test_an_overflowing_scale_is_named():
    splats = random_splats_2d(3, 4, 4, np.random.default_rng(0))
    arrays = splats.arrays() | {"log_scales": np.array([[0, 0], [0, 400.0], [0, 0]])}
    with pytest.raises(ArgumentError, match=r"log_scales\[1\]: is too large"):
        render_2d(Splats2D(**arrays), 4, 4)


def test_sizes_and_backgrounds_are_checked(as_shipped):
    splats = random_splats_2d(3, 4, 4, np.random.default_rng(0))
    with pytest.raises(ArgumentError, match="height: is 0"):
        render_2d(splats, 0, 4)
    with pytest.raises(ShapeError, match="background"):
        render_2d(splats, 4, 4, (0, 0))
    with pytest.raises(ArgumentError, match="count: is 0"):
        random_splats_2d(0, 4, 4, np.random.default_rng(0))
