"""PlayCanvas' splat-transform reads what we write, and we what it writes, with the same values."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.scene.gaussian_math import build_cov3d_batch, quat_to_R_batch
from gsplat_edu.scene.gaussians import Gaussians
from lcc_files import lcc_scene, write_lcc, write_lcc2
from scene_files import matched, random_scene

NPM = Path(__file__).parents[1] / "npm" / "node_modules" / "@playcanvas" / "splat-transform"


def converted(source, target, *options):
    """Convert with the program; skip the test without it."""
    node = shutil.which("node")
    if node is None or not NPM.is_dir():
        pytest.skip("splat-transform is not installed: npm ci --prefix tests/npm")
    words = [node, NPM / "bin" / "cli.mjs", "-q", "-w", "-g", "cpu", *options, source, target]
    subprocess.run(list(map(str, words)), capture_output=True, timeout=300, check=True)
    return read_scene(target).gaussians


def check_same(ours, its, quats=0.0):
    """Each splat has the same values, in the same order.

    Args:
        ours, its: The Gaussians.
        quats: Tolerance of rotations of length 1.
    """
    for name, tensor in ours.tensors().items():
        other = its.tensors()[name]
        if name == "quats" and quats:
            a, b = (torch.nn.functional.normalize(q, dim=1) for q in (tensor, other))
            assert (1.0 - (a * b).sum(dim=1).abs() <= quats).all()
        else:
            assert torch.equal(tensor, other), name


@pytest.mark.parametrize(
    "name",
    [
        "a.ply",
        "a.compressed.ply",
        "a.sog",
        "sog/meta.json",
        "lod/lod-meta.json",
        "a.ksplat",
        "a.spz",
        "a.splat",
    ],
)
def test_it_reads_our_files_as_we_do(tmp_path, name):
    """It keeps the axes of an SPZ, whose y points up; ours come back as they were.

    A .splat has rotations of 8 bits, which it does not scale to length 1 again before they are compared.
    """
    write_scene(tmp_path / name, random_scene(400))
    ours, its = read_scene(tmp_path / name).gaussians, converted(tmp_path / name, tmp_path / "its.ply")
    if name == "a.spz":
        its = half_turned(its)
    if name == "lod/lod-meta.json":  # it joins all levels, of which this scene has one
        ours = matched(ours, its)
    check_same(ours, its, quats=1e-4 if name == "a.splat" else 0.0)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.sog", "sog/meta.json", "a.spz"])
def test_we_read_its_files_as_it_does(tmp_path, name):
    write_scene(tmp_path / "scene.ply", random_scene(400))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    ours = converted(tmp_path / "scene.ply", tmp_path / name)
    its = converted(tmp_path / name, tmp_path / "its.ply")
    if name == "a.spz":
        its = half_turned(its)
    check_same(ours, its)


@pytest.mark.parametrize("name", ["a.csv", "a.glb"])
def test_we_read_what_only_it_writes(tmp_path, name):
    """A GLB has activated values, whose logarithms and logits round."""
    given = random_scene(400).gaussians
    write_scene(tmp_path / "scene.ply", given)
    back = converted(tmp_path / "scene.ply", tmp_path / name)
    given = matched(given, back)
    for of_back, of_given in (
        (back.means, given.means),
        (back.sh0, given.sh0),
        (back.sh_rest, given.sh_rest),
    ):
        torch.testing.assert_close(of_back, of_given, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(back.log_scales, given.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.opacities, given.opacities, rtol=0, atol=1e-6)
    # it turns each ellipsoid of a GLB by half a turn about its own x axis, which changes nothing
    shapes = [
        build_cov3d_batch(one.scales.double().numpy(), quat_to_R_batch(one.quats.double().numpy()))
        for one in (given, back)
    ]
    np.testing.assert_allclose(shapes[1], shapes[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["lcc", ".sog", ".spz"])
def test_it_reads_lcc_as_we_do(tmp_path, kind):
    """It takes the finest level without the environment, and turns it from z up to the axes of a PLY, y down."""
    finest = [lcc_scene(60, 1), lcc_scene(40, 2)]
    if kind == "lcc":
        path = write_lcc(tmp_path / "meta.lcc", finest, lcc_scene(10, 3), None)
    else:
        path = tmp_path / "meta.lcc2"
        write_lcc2(path, Gaussians.concatenated(finest), lcc_scene(10, 3), lcc_scene(5, 4), kind)
    its = converted(path, tmp_path / "its.ply", "--select-lod", "0")
    ours = Similarity(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), 1.0, np.zeros(3)).gaussians(
        read_scene(path).gaussians[:100]
    )
    assert len(its) == 100
    for name in ("means", "log_scales", "sh0", "sh_rest", "logit_opacities"):
        torch.testing.assert_close(its.tensors()[name], ours.tensors()[name], rtol=1e-5, atol=1e-5)
    a, b = (torch.nn.functional.normalize(one.quats, dim=1) for one in (ours, its))
    assert (1.0 - (a * b).sum(dim=1).abs() <= 1e-6).all()
