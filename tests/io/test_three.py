"""three.js reads what we write with the same values: its loaders of PLY, SPZ, KSPLAT, .splat and glTF."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.scene.gaussian_math import build_cov3d_batch, quat_to_R_batch
from scene_files import matched, random_scene

NPM = Path(__file__).parents[1] / "npm"

Y_UP = ("a.spz", "a.glb")
"""Files whose y points up."""

UPPER = [0, 1, 2, 4, 5, 8]
"""Of a symmetric matrix, row by row."""


def geometry(path):
    """Return what its loader makes of a file, by the names of its attributes; skip the test without it."""
    node = shutil.which("node")
    if node is None or not (NPM / "node_modules" / "three").is_dir():
        pytest.skip("three is not installed: npm ci --prefix tests/npm")
    words = [node, NPM / "three_splats.mjs", path]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, timeout=300, check=True)
    return {name: np.array(values) for name, values in json.loads(done.stdout).items()}


def packed_bytes(found, degree):
    """Return a band of harmonics: three bytes a coefficient, 128 for 0, and unused ones at the end of a splat."""
    words = found[f"sphericalHarmonics{degree}"].astype("<u4")
    values = words.view(np.uint8).reshape(len(found["position"]) // 3, -1)
    return values[:, : 3 * (2 * degree + 1)].reshape(len(values), -1, 3)


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat", "a.ksplat", "a.glb"])
def test_its_loaders_read_what_we_write(tmp_path, name):
    """It keeps colours, opacities and harmonics as bytes, which it rounds from what the file has."""
    write_scene(tmp_path / name, random_scene(400))
    found, ours = geometry(tmp_path / name), read_scene(tmp_path / name).gaussians
    if name in Y_UP:
        ours = half_turned(ours)
    places = torch.from_numpy(found["position"].reshape(-1, 3)).float()
    ours = matched(ours, replace(ours, means=places))
    np.testing.assert_allclose(places.numpy(), ours.means.numpy(), rtol=0, atol=1e-6)
    shapes = build_cov3d_batch(ours.scales.double().numpy(), quat_to_R_batch(ours.quats.double().numpy()))
    np.testing.assert_allclose(
        found["covariance"].reshape(-1, 6),
        shapes.reshape(-1, 9)[:, UPPER],
        rtol=1e-5,
        atol=1e-6 * shapes.max(),
    )
    colors = 255 * np.concatenate([C0 * ours.sh0[:, 0] + 0.5, ours.opacities[:, None]], axis=1)
    assert np.abs(found["color"].reshape(-1, 4) - colors.clip(0, 255)).max() <= 1.0
    for degree in range(1, ours.sh_degree + 1):
        rest = ours.sh_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1].numpy()
        assert np.abs(packed_bytes(found, degree) - (128 * rest + 128).clip(0, 255)).max() <= 1.0
