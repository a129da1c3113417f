"""A far shell behind all other splats is found; other scenes have none."""

import numpy as np

from gsplat_edu.parts.sky.find import fibonacci
from gsplat_edu.scene.shells import far_shell


def scene(count=5_000):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, 3)) * rng.lognormal(sigma=0.7, size=(count, 1)) + (3.0, 1.0, -2.0)


def test_a_shell_is_found_beside_outliers():
    shell = 300.0 * fibonacci(2_000)
    shell = shell[shell[:, 1] < 0]
    strays = 40.0 * fibonacci(10)
    points = np.concatenate([scene(), shell, strays, [[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]])
    found = far_shell(points)
    assert found.sum() == len(shell) and found[5_000 : 5_000 + len(shell)].all()
    np.testing.assert_array_equal(
        far_shell(0.01 * points[:, [2, 0, 1]] + 7.0), found, "moved, turned and scaled"
    )


def test_scenes_without_a_shell_have_none():
    rng = np.random.default_rng(1)
    background = rng.normal(size=(1_000, 3)) * rng.uniform(5, 60, (1_000, 1))
    for points in (
        scene(),
        np.concatenate([scene(), background]),  # distances without a gap
        np.concatenate([scene(), [[1e4, 0, 0]]]),  # one outlier
        fibonacci(1_000),  # a shell without a scene inside
        np.zeros((5, 3)),
        np.full((5, 3), np.nan),
        np.zeros((0, 3)),
    ):
        assert not far_shell(points).any()
