import numpy as np

from gsplat_edu import sphere_shell


def test_sphere_shell_draws_azimuths_then_polar_angles():
    rng = np.random.default_rng(3)
    t = rng.uniform(0, 2 * np.pi, 40)
    p = np.arccos(rng.uniform(-1, 1, 40))
    means, _, colors, opacities = sphere_shell(n=40, seed=3, opacity=0.6)
    expected = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], -1)
    np.testing.assert_array_equal(means, expected)
    np.testing.assert_array_equal(colors, (means + 1) / 2)
    np.testing.assert_array_equal(opacities, 0.6)


def test_disks_are_tangent_to_the_sphere():
    means, cov3ds, _, _ = sphere_shell(n=200, s_t=0.06, s_n=0.01)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", cov3ds, means), 0.01**2 * means, rtol=0, atol=1e-17)
    eigenvalues = np.linalg.eigvalsh(cov3ds)
    np.testing.assert_allclose(
        eigenvalues, np.broadcast_to([1e-4, 36e-4, 36e-4], (200, 3)), rtol=0, atol=1e-16
    )


def test_defaults():
    means, cov3ds, colors, opacities = sphere_shell()
    assert means.shape == (2500, 3) and cov3ds.shape == (2500, 3, 3)
    assert colors.shape == (2500, 3) and np.all(opacities == 0.8)
