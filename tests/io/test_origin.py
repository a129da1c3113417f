"""Scenes far from zero: every format keeps the splats to the bit and the origin in double, or says that it cannot."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io import spz
from gsplat_edu.io.edit import Filter, Similarity, joined
from gsplat_edu.io.formats import LOD_META, SOG_META, TILESET, losses, read_scene, write_scene
from gsplat_edu.io.lod import tiles
from gsplat_edu.io.ply import MEANS, OPACITY, QUATS, SCALES, SH0
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import origin_of, rotation_between
from gsplat_edu.viewer import page
from scene_files import random_scene, suffixes

ORIGINS = [(1e3, -2e3, 10.0), (1e5, 2e5, -3e3), (500000.0, 4649776.0, 120.0), (3.9e6, 3.1e5, 5.02e6)]

SUFFIXES = suffixes()


def written(path, scene):
    if path.suffix == ".html":
        page.write(path, scene)
        return page.read(path)
    write_scene(path, scene)
    return read_scene(path)


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("suffix", [*SUFFIXES, ".html", f"/{SOG_META}", f"/{LOD_META}"])
def test_a_far_scene_has_the_bits_of_the_same_scene_near_zero(tmp_path, suffix, origin):
    earth = Earth.at_place(47.0, 8.0, 400.0)
    near = replace(random_scene(60, 3), up=(0.0, 0.6, 0.8), unit="cm", earth=earth)
    far = replace(near, origin=origin)
    places = [tmp_path / kind / f"scene{suffix}" for kind in ("near", "far")]
    for place in places:
        place.parent.mkdir(parents=True)
    expected, found = (written(place, scene) for place, scene in zip(places, (near, far), strict=True))
    for name, tensor in found.gaussians.tensors().items():
        assert torch.equal(tensor, expected.gaussians.tensors()[name]), name
    if suffix in (".splat", ".ksplat", ".csv"):
        assert found.origin == (0.0, 0.0, 0.0)
        (said,) = [loss for loss in losses(f"a{suffix}", far) if "origin" in loss]
        assert all(f"{x:.15g}" in said for x in origin)
        return
    kept = None if suffix == ".html" else earth  # a page is for everybody; where photos were taken is not
    assert (found.origin, found.unit, found.earth) == (origin, "cm", kept)
    np.testing.assert_allclose(found.up, (0.0, 0.6, 0.8), atol=1e-15)


def strangers_ply(path, positions, kind):
    """Write a scene PLY whose coordinates have a NumPy type, as other programs do."""
    names = [*MEANS, *SH0, *OPACITY, *SCALES, *QUATS]
    table = np.zeros(len(positions), dtype=[(name, kind if name in MEANS else "<f4") for name in names])
    for axis, name in enumerate(MEANS):
        table[name] = positions[:, axis]
    table["rot_0"] = 1.0
    types = {"<f4": "float", "<f8": "double", "<i4": "int"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {types[kind if name in MEANS else '<f4']} {name}" for name in names]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + table.tobytes())


@pytest.mark.parametrize("origin", ORIGINS)
def test_doubles_of_another_program_keep_their_details(tmp_path, origin):
    positions = np.random.default_rng(0).normal(size=(500, 3)) + origin
    strangers_ply(tmp_path / "a.ply", positions, "<f8")
    scene = read_scene(tmp_path / "a.ply")
    found = scene.gaussians.means.double().numpy() + np.array(scene.origin)
    # coordinates below 8 are rounded to float32, half a step of 2^-21, and the middle to whole numbers
    assert np.abs(found - positions).max() < 2**-21
    assert len(np.unique(found[:, 1])) == 500, "float32 has steps of 0.5 at 4.6e6"


def test_floats_and_whole_numbers_of_another_program_stay_what_they_are(tmp_path):
    rng = np.random.default_rng(1)
    for kind, positions in (
        ("<f4", (rng.normal(size=(99, 3)) + ORIGINS[2]).astype(np.float32)),
        ("<i4", rng.integers(20_000_000, 20_000_900, size=(99, 3))),  # beyond 2^24
    ):
        strangers_ply(tmp_path / "a.ply", positions, kind)
        scene = read_scene(tmp_path / "a.ply")
        assert np.array_equal(scene.gaussians.means.double().numpy() + np.array(scene.origin), positions)


def test_an_origin_follows_the_middle_and_no_stray_position():
    rng = np.random.default_rng(2)
    room = rng.normal(size=(200, 3))
    assert not origin_of(room).any()
    stray = room.copy()
    stray[:3] = 1e7
    assert not origin_of(stray).any(), "three splats of 200 far away move nothing"
    stray[3] = np.nan
    np.testing.assert_array_equal(
        origin_of(stray + ORIGINS[2]), np.round(np.median(room + ORIGINS[2], axis=0))
    )
    assert not origin_of(rng.uniform(-9e3, 9e3, size=(200, 3))).any(), "a large place around zero"
    assert not origin_of(np.full((4, 3), 90.0)).any() and not origin_of(np.full((2, 3), np.inf)).any()
    np.testing.assert_array_equal(origin_of(np.full((1, 3), -600.4)), np.full(3, -600.0))


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_transform_acts_in_double_before_it_rounds(origin):
    """Taken home from the map by one transform, a scene has the bits it has without the map."""
    scene = random_scene(50)
    home = Similarity(np.eye(3), 1.0, -np.array(origin)).scene(replace(scene, origin=origin))
    assert home.origin == (0.0, 0.0, 0.0) and torch.equal(home.gaussians.means, scene.gaussians.means)

    away = Similarity(np.eye(3), 1.0, np.array(origin)).scene(scene)
    found = away.gaussians.means.double().numpy() + np.array(away.origin)
    exact = scene.gaussians.means.double().numpy() + np.array(origin)
    assert any(away.origin) and np.abs(found - exact).max() < 2**-21

    turn = rotation_between((0.0, -1.0, 0.0), (0.0, 0.6, 0.8))
    turned = Similarity(turn, 2.0, np.array([7.0, 0.0, 0.0])).scene(replace(scene, origin=origin))
    found = turned.gaussians.means.double().numpy() + np.array(turned.origin)
    exact = 2.0 * (scene.gaussians.means.double().numpy() + np.array(origin)) @ turn.T + np.array(
        (7.0, 0.0, 0.0)
    )
    # means below 16 are rounded to 2^-21, double rounds sums at 1e7 to 2^-29
    assert np.abs(found - exact).max() < 2**-20


def test_scenes_with_other_origins_are_joined_and_cropped_where_they_lie():
    first = replace(random_scene(40, seed=1), origin=(500000.0, 4649776.0, 120.0))
    second = replace(random_scene(40, seed=2), origin=(500010.0, 4649776.0, 120.0))
    both = joined([first, second])
    assert both.origin == first.origin
    exact = second.gaussians.means.double().numpy() + np.array((10.0, 0.0, 0.0))
    # coordinates below 16 are rounded to half a step of 2^-20
    assert np.abs(both.gaussians.means[40:].double().numpy() - exact).max() <= 2**-21
    box = (500005.0, 4649000.0, 0.0, 500020.0, 4650000.0, 300.0)
    kept = Filter(box=box).apply(both)
    assert torch.equal(kept.gaussians.means, both.gaussians.means[40:])


def glb_document(path):
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def rotated(quaternion, vector):
    """Rotate by (x, y, z, w): v + 2 u x (u x v + w v)."""
    u, w = np.array(quaternion[:3]), quaternion[3]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.6, 0.0, -0.8)])
def test_the_root_of_a_glb_points_up_and_lies_at_the_origin(tmp_path, up):
    scene = replace(random_scene(20), up=up, origin=ORIGINS[2])
    write_scene(tmp_path / "a.glb", scene)
    (node,) = glb_document(tmp_path / "a.glb")["nodes"]
    signs = np.array((1.0, -1.0, -1.0))  # our y and z point the other way in glTF
    turn = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(rotated(turn, signs * up), (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(node["translation"], rotated(turn, signs * ORIGINS[2]), rtol=1e-14)


def test_the_root_of_a_tileset_points_up_and_lies_at_the_origin(tmp_path):
    scene = replace(random_scene(50), up=(0.6, 0.0, -0.8), origin=ORIGINS[3])
    tiles.write(tmp_path / TILESET, scene)
    matrix = np.array(json.loads((tmp_path / TILESET).read_text())["root"]["transform"]).reshape(4, 4).T

    def in_tiles(vector):  # right, forward, up
        x, y, z = vector
        return np.array((x, z, -y))

    np.testing.assert_allclose(matrix[:3, :3] @ in_tiles(scene.up), (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], matrix[:3, :3] @ in_tiles(ORIGINS[3]), rtol=1e-14)


@pytest.mark.parametrize(
    "content", [b'{"origin":[1,2]}', b'{"origin":"x"}', b'{"origin":[1,2,1e31]}', b"{nope"]
)
def test_a_damaged_origin_of_an_spz_is_named(tmp_path, content):
    write_scene(tmp_path / "a.spz", replace(random_scene(3), origin=ORIGINS[0]))
    data = bytearray((tmp_path / "a.spz").read_bytes())
    start = data.index(b'{"origin"')
    (length,) = struct.unpack_from("<I", data, start - 4)
    data[start : start + length] = content.ljust(length)
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(SceneFormatError, match="origin"):
        spz.read(tmp_path / "a.spz")
