"""KSPLAT at all levels, compared with the code that defines the format."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0, POINT_SUFFIXES
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.formats import FORMATS
from gsplat_edu.io.ksplat import HALF_STEPS, IN_BUCKET, LEVELS, STEPS_PER_SPLAT, read, write
from gsplat_edu.io.ply import save_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.studio.commands import FORMATS as EXPORTED
from gsplat_edu.studio.library import SCENE_ENDINGS
from scene_files import kept_file, matched, random_scene, refused

WEB = Path(__file__).parents[2] / "src" / "gsplat_edu" / "studio" / "web"
NPM = Path(__file__).parents[1] / "npm"

every_level = pytest.mark.parametrize("level", LEVELS)


def viewer(*words):
    """Run the viewer's own code; skip the test without it."""
    node = shutil.which("node")
    if node is None or not (NPM / "node_modules" / "@mkkellogg" / "gaussian-splats-3d").is_dir():
        pytest.skip("GaussianSplats3D is not installed: npm ci --prefix tests/npm")
    words = [node, NPM / "ksplat.mjs", *map(str, words)]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=True).stdout


def check_close(given, back, level, down=False):
    """Each parameter of the same splats in the same order is off by at most half a step of its level.

    Args:
        given, back: The Gaussians.
        level: Of the file.
        down: Values were rounded down instead of to nearest, so they may be off by a whole step.
    """
    part = 1.0 if down else 0.5  # of a step
    half = part * 2.0**-10 * (1 + 1e-3)  # a float16 has 11 bits
    relative = half if level else 2.0**-23
    size = given.log_scales.double().mean(dim=1).median().exp()
    step = size / STEPS_PER_SPLAT if level else 0.0
    assert ((given.means - back.means).abs() <= step / 2 + 1e-5 * given.means.abs()).all()
    assert ((given.scales - back.scales).abs() <= relative * given.scales + part * 2.0**-24).all()
    quats = torch.nn.functional.normalize(given.quats, dim=1)
    assert ((quats - back.quats).abs() <= half).all()
    most = part / 255 + 1e-6
    colors = (C0 * given.sh0 + 0.5).clamp(0, 1)
    assert ((C0 * back.sh0 + 0.5 - colors).abs() <= most).all()
    assert ((back.opacities - given.opacities).abs() <= most).all()
    kept = given.sh_rest[:, : back.sh_rest.shape[1]]
    spread = float(kept.max() - kept.min()) if kept.numel() else 0.0
    bounds = {0: 0.0, 1: half * kept.abs() + part * 2.0**-23, 2: part * spread / 255 + 1e-6}
    assert ((kept - back.sh_rest).abs() <= bounds[level]).all()


@every_level
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_a_round_trip_stays_within_half_a_step(tmp_path, level, rest, count):
    scene, path = random_scene(count, rest), tmp_path / "a.ksplat"
    scene.gaussians.means[::2] *= 100.0  # over many buckets
    write(path, scene, level)
    back = read(path).gaussians
    assert len(back) == count and back.sh_degree == min(scene.gaussians.sh_degree, 2)
    if count:
        check_close(matched(scene.gaussians, back), back, level)


@every_level
def test_the_viewers_code_reads_what_we_write(tmp_path, level):
    path = tmp_path / "a.ksplat"
    scene = random_scene(3000, 8)
    scene.gaussians.means[::2] *= 100.0  # many buckets, of which some are full
    write(path, scene, level)
    seen, ours = json.loads(viewer("read", path)), read(path).gaussians
    assert len(seen["centers"]) == 3 * len(ours)
    centers = np.reshape(seen["centers"], (-1, 3))
    np.testing.assert_allclose(centers, ours.means.numpy(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.reshape(seen["scales"], (-1, 3)), ours.scales.numpy(), rtol=1e-5)
    xyzw = np.reshape(seen["rotations"], (-1, 4))
    turns = np.abs((np.roll(xyzw, 1, axis=1) * ours.quats.numpy()).sum(axis=1))
    np.testing.assert_allclose(turns, 1.0, atol=2e-3)
    colors = np.reshape(seen["colors"], (-1, 4)) / 255
    np.testing.assert_allclose(colors[:, :3], C0 * ours.sh0[:, 0].numpy() + 0.5, atol=1e-5)
    np.testing.assert_allclose(colors[:, 3], ours.opacities.numpy(), atol=1e-3 + 0.25 / 255)
    np.testing.assert_allclose(np.reshape(seen["sh"], (-1, 8, 3)), ours.sh_rest.numpy(), atol=1e-5)


@every_level
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_we_read_what_the_viewers_code_writes(tmp_path, level, degree):
    scene = random_scene(3000, 8)
    scene.gaussians.means[:1000] /= 50
    save_ply(tmp_path / "a.ply", scene.gaussians)
    viewer("write", tmp_path / "a.ply", level, degree, tmp_path / "a.ksplat")
    back = read(tmp_path / "a.ksplat").gaussians
    assert len(back) == 3000 and back.sh_degree == degree
    given = matched(scene.gaussians, back)
    step = 5.0 / 2 / HALF_STEPS if level else 0.0
    assert ((given.means - back.means).abs() <= step + 1e-5 * given.means.abs()).all()
    check_close(replace(given, means=back.means), back, level, down=True)


def test_a_file_of_another_program_is_read():
    path = kept_file("formats/splat_fixtures/minimal.ksplat")
    ours = read(path).gaussians
    np.testing.assert_array_equal(ours.means.numpy(), [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(ours.opacities.numpy(), 230 / 255, rtol=1e-6)


def test_a_crowded_place_fills_buckets(tmp_path):
    scene = random_scene(1000, 0)
    scene.gaussians.means[:] /= 1e4
    write(tmp_path / "a.ksplat", scene)
    section = np.frombuffer((tmp_path / "a.ksplat").read_bytes(), "<u4", count=10, offset=4096)
    assert section[2] == IN_BUCKET and section[8] == 3 and section[9] == 1
    assert section[7] == (tmp_path / "a.ksplat").stat().st_size - 5120


def test_sections_of_other_degrees_are_joined(tmp_path):
    """The header of a file with two sections is put together from two files with one."""
    scenes = random_scene(20, 8), random_scene(30, 0, seed=1)
    headers, sections, bodies = [], [], []
    for index, scene in enumerate(scenes):
        write(tmp_path / f"{index}.ksplat", scene, 0)
        data = (tmp_path / f"{index}.ksplat").read_bytes()
        headers.append(np.frombuffer(data[:4096], "<u4").copy())
        sections.append(data[4096:5120])
        bodies.append(data[5120:])
    headers[0][[1, 2, 3, 4]] = 2, 2, 50, 50
    (tmp_path / "a.ksplat").write_bytes(b"".join([headers[0].tobytes(), *sections, *bodies]))
    back = read(tmp_path / "a.ksplat").gaussians
    assert torch.equal(back.means, torch.cat([scene.gaussians.means for scene in scenes]))
    assert torch.equal(back.sh_rest[:20], scenes[0].gaussians.sh_rest) and not back.sh_rest[20:].any()


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (1, b"\x02", "version 0.1"),
        (20, b"\x03\x00", "level 0, 1 or 2"),
        (40, b"\x00\x00\xc0\x7f", "damaged"),
        (4096 + 40, b"\x03\x00", "damaged"),
        (4096 + 8, b"\x07\x00", "buckets"),
        (4096 + 16, b"\x00\x00\xc0\x7f", "position"),
    ],
)
def test_damage_is_named(tmp_path, at, value, said):
    scene, path = random_scene(600, 8), tmp_path / "a.ksplat"
    scene.gaussians.means[:] /= 1e4  # full buckets
    write(path, scene, 2)
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    assert said in refused(path)


def test_extreme_values_are_clamped(tmp_path):
    g = random_scene(4, 8).gaussians
    scene = Scene(
        replace(
            g,
            means=torch.tensor([3e30, -3e30, 0.0, 1.0])[:, None].repeat(1, 3),
            log_scales=torch.tensor([200.0, 0.0, -50.0, -3e38])[:, None].repeat(1, 3),
            sh_rest=torch.tensor([3e38, -3e38, 5.0, -5.0])[:, None, None].repeat(1, 8, 3),
        )
    )
    for level in LEVELS:
        write(tmp_path / "a.ksplat", scene, level)
        back = read(tmp_path / "a.ksplat").gaussians
        assert len(back) == 4
        assert all(torch.isfinite(tensor).all() for tensor in back.tensors().values())


def test_an_unknown_level_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match="level"):
        write(tmp_path / "a.ksplat", random_scene(1), 3)


def test_the_studio_takes_in_and_writes_every_format():
    """The studio's server does not load torch, so it has lists of its own."""
    read = (found for found in FORMATS if found.suffix not in POINT_SUFFIXES)
    assert {Path(f"a{found.suffix}").suffix for found in read} == set(SCENE_ENDINGS)
    assert {found.suffix[1:] for found in FORMATS} | {"html"} == set(EXPORTED)
    dropped = re.search(r"^const SCENES = /(.*)/i;$", (WEB / "intake.js").read_text(), re.MULTILINE)[1]
    assert all(re.search(dropped, f"a{ending}") for ending in SCENE_ENDINGS)
