import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu import C0, eval_sh, sh_basis
from gsplat_edu.scene.sh import sh_rotation

SAMPLES = 400_000


def directions(n, seed=0):
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_the_basis_is_orthonormal_over_the_sphere():
    """Monte Carlo estimates 4 pi E[b_i b_j] = delta_ij. E[(b_i b_j)²] <= max E[b_i^4] by Cauchy and Schwarz, and the
    test computes the fourth moments from the samples. So the standard deviation of the estimate is at most 4 pi
    sqrt(max E[b^4] / SAMPLES), near 2.5e-3, of which five are allowed.
    """
    basis = sh_basis(directions(SAMPLES))
    deviation = 4 * np.pi * np.sqrt((basis**4).mean(axis=0).max() / SAMPLES)
    assert deviation < 3e-3, "the bound is small enough"
    gram = 4 * np.pi * basis.T @ basis / SAMPLES
    np.testing.assert_allclose(gram, np.eye(16), rtol=0, atol=5 * deviation)


def real_harmonic(degree, m, dirs):
    """Evaluate one real harmonic from its definition by Legendre polynomials.

    Y = N P(cos theta) (-1)^m times sqrt(2) cos(m phi) for m > 0, sqrt(2) sin(|m| phi) for m < 0, 1 for m = 0;
    P_l^m(z) = (1 - z²)^(m/2) d^m P_l / dz^m.
    """
    order = abs(m)
    z, phi = dirs[:, 2], np.arctan2(dirs[:, 1], dirs[:, 0])
    legendre = np.polynomial.Legendre.basis(degree).deriv(order)(z) * (1 - z * z) ** (order / 2)
    factor = (2 * degree + 1) / (4 * np.pi) * math.factorial(degree - order) / math.factorial(degree + order)
    angular = 1.0 if m == 0 else np.sqrt(2) * (np.cos(m * phi) if m > 0 else np.sin(order * phi))
    return (-1) ** order * np.sqrt(factor) * legendre * angular


def test_order_and_signs_follow_the_convention():
    dirs = directions(200)
    orders = [(degree, m) for degree in range(4) for m in range(-degree, degree + 1)]
    expected = np.stack([real_harmonic(degree, m, dirs) for degree, m in orders], axis=-1)
    # rounding of sums of a few terms of order 1
    np.testing.assert_allclose(sh_basis(dirs), expected, rtol=0, atol=1e-13)
    assert (sh_basis(dirs)[:, 0] == C0).all()


def test_the_power_of_each_degree_is_constant():
    """The sum of squares over one degree is (2 l + 1) / (4 pi) in every direction (Unsöld's theorem)."""
    basis = sh_basis(directions(100))
    for degree in range(4):
        band = basis[:, degree**2 : (degree + 1) ** 2]
        np.testing.assert_allclose((band**2).sum(-1), (2 * degree + 1) / (4 * np.pi))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_the_sum_floored_at_zero(degree):
    rng = np.random.default_rng(1)
    dirs, sh = directions(50), rng.normal(size=(50, 16, 3))
    colors = eval_sh(degree, sh, dirs)
    basis = sh_basis(dirs)
    for n in range(50):
        total = sum(basis[n, i] * sh[n, i] for i in range((degree + 1) ** 2)) + 0.5
        np.testing.assert_allclose(colors[n], np.maximum(total, 0), rtol=0, atol=1e-14)
    assert (colors == 0).any(), "some colours are below the floor"
    just_enough = eval_sh(degree, sh[:, : (degree + 1) ** 2], dirs)
    np.testing.assert_allclose(just_enough, colors, rtol=0, atol=1e-15)


def test_leading_axes_are_kept():
    assert sh_basis(directions(6).reshape(2, 3, 3)).shape == (2, 3, 16)
    assert sh_basis((0, 0, 1)).shape == (16,)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_give_the_rotated_function(degree):
    """Both sides are float64 sums of about a dozen products of numbers of order 1."""
    turn = Rotation.random(random_state=degree).as_matrix()
    M = sh_rotation(degree, turn)
    count = (degree + 1) ** 2
    c = np.random.default_rng(1).normal(size=count - 1)
    dirs = directions(200, seed=2)
    np.testing.assert_allclose(
        sh_basis(dirs)[:, 1:count] @ (M @ c), sh_basis(dirs @ turn)[:, 1:count] @ c, atol=1e-13
    )
    np.testing.assert_allclose(M @ M.T, np.eye(count - 1), atol=1e-13)
    np.testing.assert_allclose(sh_rotation(degree, turn.T), M.T, atol=1e-13)
