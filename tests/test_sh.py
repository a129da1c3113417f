import numpy as np
import pytest

from gsplat_edu import C0, eval_sh, sh_basis

SAMPLES = 400_000


def directions(n, seed=0):
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_basis_is_orthonormal_over_the_sphere():
    """Monte Carlo: 4 pi E[b_i b_j] = delta_ij.

    Every |b_i b_j| has a second moment below 1 on the sphere (the largest, E[b_i^4], is 0.06 for xyz), so the
    estimate has a standard deviation below 4 pi sqrt(0.06 / SAMPLES) = 4.9e-3. Five of those: 0.025.
    """
    basis = sh_basis(directions(SAMPLES))
    gram = 4 * np.pi * basis.T @ basis / SAMPLES
    np.testing.assert_allclose(gram, np.eye(16), atol=0.025)


def test_order_and_signs_are_those_of_the_field():
    """Spot values from the definition: b_1..3 go as -y, z, -x; b_6 is the m = 0 harmonic of degree 2."""
    axes = sh_basis(np.eye(3))
    c1 = np.sqrt(3 / (4 * np.pi))
    np.testing.assert_allclose(axes[:, 0], C0)
    np.testing.assert_allclose(axes[:, 1:4], c1 * np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]), atol=1e-15)
    c20 = np.sqrt(5 / (16 * np.pi))
    np.testing.assert_allclose(axes[:, 6], [-c20, -c20, 2 * c20])
    diagonal = sh_basis(np.array([1, 1, 1]) / np.sqrt(3))
    positive, negative = [4, 10], [5, 7]  # xy and xyz; -yz and -xz
    assert (diagonal[positive] > 0).all() and (diagonal[negative] < 0).all()


def test_degrees_are_eigenfunctions_of_rotation():
    """The sum of squares over one degree is (2 l + 1) / (4 pi) in every direction (Unsöld's theorem)."""
    basis = sh_basis(directions(100))
    for degree in range(4):
        band = basis[:, degree**2 : (degree + 1) ** 2]
        np.testing.assert_allclose((band**2).sum(-1), (2 * degree + 1) / (4 * np.pi))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_the_floored_sum(degree):
    rng = np.random.default_rng(1)
    dirs, sh = directions(50), rng.normal(size=(50, 16, 3))
    colors = eval_sh(degree, sh, dirs)
    basis = sh_basis(dirs)
    for n in range(50):
        total = sum(basis[n, i] * sh[n, i] for i in range((degree + 1) ** 2)) + 0.5
        np.testing.assert_allclose(colors[n], np.maximum(total, 0), atol=1e-14)
    assert (colors == 0).any(), "the floor was reached"
    just_enough = eval_sh(degree, sh[:, : (degree + 1) ** 2], dirs)
    np.testing.assert_allclose(just_enough, colors, atol=1e-15)


def test_leading_axes_are_kept():
    assert sh_basis(directions(6).reshape(2, 3, 3)).shape == (2, 3, 16)
    assert sh_basis((0, 0, 1)).shape == (16,)
