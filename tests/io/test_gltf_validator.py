"""Khronos' validator accepts every kind of binary glTF that we write, and rejects a damaged one."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gsplat_edu.io.mesh_files import read_mesh, write_mesh
from gsplat_edu.scene.mesh import Mesh, Texture

FOLDER = Path(__file__).parents[1] / "npm"
"""Has the package.json and the lock with the validator's version."""


def validated(*files):
    """Return the validator's report of each file, or skip the test if Node or the validator is not installed."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    if not (FOLDER / "node_modules" / "gltf-validator").is_dir():
        pytest.skip("gltf-validator is not installed: npm ci --prefix tests/npm")
    words = [node, FOLDER / "validate.mjs", *files]
    finished = subprocess.run(words, capture_output=True, text=True, timeout=300, check=True)
    return json.loads(finished.stdout)


def some_mesh(count):
    """Random triangles that use all vertices."""
    rng = np.random.default_rng(count)
    return Mesh(rng.normal(size=(count, 3)), rng.permutation(count)[: count // 3 * 3].reshape(-1, 3)).used()


def test_our_files_have_no_errors_and_no_warnings(tmp_path):
    rng = np.random.default_rng(1)
    plain, large = some_mesh(60), some_mesh(70_000)  # the large one needs 32-bit indices
    colored = Mesh(plain.vertices, plain.faces, rng.random((len(plain.vertices), 3), dtype=np.float32))
    uvs = rng.random((len(plain.faces), 3, 2), dtype=np.float32)
    image = rng.integers(0, 256, (16, 32, 3), dtype=np.uint8)
    textured = Mesh(plain.vertices, plain.faces, None, Texture(image, uvs))
    unused = Mesh(np.concatenate([plain.vertices, np.ones((2, 3))]), plain.faces)
    cases = {
        "plain": (plain, {}),
        "large": (large, {}),
        "colored": (colored, {"unit": "cm"}),
        "textured": (textured, {}),
        "jpeg": (textured, {"jpeg": 90}),
        "unused": (unused, {"unit": "m"}),
    }
    for name, (mesh, options) in cases.items():
        write_mesh(tmp_path / f"{name}.glb", mesh, **options)
    found = validated(*(tmp_path / f"{name}.glb" for name in cases))
    for name, (mesh, _) in cases.items():
        report = found[str(tmp_path / f"{name}.glb")]
        assert (report["numErrors"], report["numWarnings"]) == (0, 0), (name, report["messages"])
        assert report["triangles"] == len(mesh.faces), name


def test_the_validator_finds_an_error(tmp_path):
    """It would not accept just anything."""
    path = tmp_path / "a.glb"
    write_mesh(path, some_mesh(60))
    data = path.read_bytes()
    assert data.count(b'"indices":') == 1
    path.write_bytes(data.replace(b'"mode":4', b'"mode":9'))
    assert validated(path)[str(path)]["numErrors"] > 0
    path.write_bytes(data)
    assert len(read_mesh(path).faces) == 20
