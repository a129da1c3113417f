"""3D Tiles: the tree, its errors and boxes, and the contents of the tiles."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io import spz
from gsplat_edu.io.axes import POSITION_SIGNS
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import read_scene, stored_bytes, write_scene
from gsplat_edu.io.lod import tiles
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.earth import Earth, earth_centred, local_axes
from scene_files import random_scene

LEAF = 200


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiles") / "tileset.json"
    scene = random_scene(1500, 3)
    tiles.write(path, scene, tiles.tile_options(leaf=LEAF))
    return scene, path


def all_tiles(tile):
    yield tile
    for child in tile.get("children", []):
        yield from all_tiles(child)


def unpacked(path):
    """Return the glTF and its splats, read without the package's GLB reader."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data)) and length % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    rest, kind = struct.unpack_from("<I4s", data, 20 + size)
    body = data[28 + size :]
    assert kind == b"BIN\0" and len(body) == rest == document["buffers"][0]["byteLength"]
    packed = body[: document["bufferViews"][0]["byteLength"]]
    assert (
        packed[:2] == b"\x1f\x8b"
        and body[len(packed) :] == bytes(len(body) - len(packed))
        and len(body) % 4 == 0
    )
    other = path.with_suffix(".spz")
    other.write_bytes(packed)
    scene = spz.read(other)
    other.unlink()
    return document, scene


def test_the_tileset_names_its_extensions(written):
    meta = json.loads(written[1].read_bytes())
    assert meta["asset"]["version"] == "1.1"
    assert meta["extensionsUsed"] == meta["extensionsRequired"] == ["3DTILES_content_gltf"]
    splats = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert meta["extensions"]["3DTILES_content_gltf"] == {
        "extensionsUsed": splats,
        "extensionsRequired": splats,
    }
    assert set(meta["root"]) == {
        "boundingVolume",
        "geometricError",
        "refine",
        "content",
        "children",
        "transform",
    }


def test_errors_fall_from_the_root_to_zero(written):
    meta = json.loads(written[1].read_bytes())
    assert meta["geometricError"] >= meta["root"]["geometricError"] > 0
    for tile in all_tiles(meta["root"]):
        assert tile["refine"] == "REPLACE"
        assert all(child["geometricError"] <= tile["geometricError"] for child in tile.get("children", []))
        assert (tile["geometricError"] == 0) == ("children" not in tile)


def test_finest_tiles_are_the_scene_and_every_tile_is_small(written):
    scene, path = written
    meta = json.loads(path.read_bytes())
    finest = []
    for tile in all_tiles(meta["root"]):
        document, held = unpacked(path.parent / tile["content"]["uri"])
        assert 0 < len(held.gaussians) <= LEAF
        means = held.gaussians.means.numpy()
        # right, forward, up
        places = np.stack([means[:, 0], means[:, 2], -means[:, 1]], axis=1)
        box = np.array(tile["boundingVolume"]["box"])
        assert (np.abs(places - box[:3]) <= np.abs(box[3:].reshape(3, 3)).sum(axis=0) + 1e-3).all()
        accessor = document["accessors"][0]
        low, high = (means * POSITION_SIGNS).min(axis=0), (means * POSITION_SIGNS).max(axis=0)
        np.testing.assert_allclose(accessor["min"], low, atol=1e-6)
        np.testing.assert_allclose(accessor["max"], high, atol=1e-6)
        assert all(a["count"] == len(means) and "bufferView" not in a for a in document["accessors"])
        if "children" not in tile:
            finest.append(held.gaussians.means)
    found = torch.cat(finest)
    assert len(found) == 1500
    exactly = torch.cdist(scene.gaussians.means.double(), found.double()).amin(dim=1)
    assert float(exactly.max()) < 1e-5


def test_a_tile_declares_splats_as_cesium_expects(written):
    document, _ = unpacked(written[1].parent / "tiles" / "0.glb")
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert document["extensionsUsed"] == document["extensionsRequired"] == names
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][names[0]]["extensions"] == {names[1]: {"bufferView": 0}}
    assert list(primitive["attributes"]) == [
        "POSITION",
        "COLOR_0",
        *(f"KHR_gaussian_splatting:{name}" for name in ("SCALE", "ROTATION")),
        *(f"KHR_gaussian_splatting:SH_DEGREE_1_COEF_{i}" for i in range(3)),
    ]


def test_spz_versions_2_and_4_have_the_same_values(tmp_path):
    """Only rotations are stored differently, with 8 bits per component."""
    scene = random_scene(200, 8)
    scene = Scene(scene.gaussians, antialiased=True)
    (tmp_path / "2.spz").write_bytes(spz.packed_version_2(scene))
    write_scene(tmp_path / "4.spz", scene)
    two, four = read_scene(tmp_path / "2.spz"), read_scene(tmp_path / "4.spz")
    assert two.antialiased is four.antialiased is True
    for name, tensor in two.gaussians.tensors().items():
        if name != "quats":
            assert torch.equal(tensor, four.gaussians.tensors()[name]), name
    a, b = (torch.nn.functional.normalize(s.gaussians.quats) for s in (two, scene))
    # x, y and z are off by half a step of 1/127.5; w follows from them and is off by more where it is small
    assert float((a * b).sum(dim=1).abs().min()) > 0.99
    assert float((a * b).sum(dim=1).abs().median()) > 0.9999


def test_the_scenes_up_becomes_z(tmp_path):
    turned = Similarity.of_matrix([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]]).scene(random_scene(50, 0))
    tiles.write(tmp_path / "tileset.json", turned)
    root = json.loads((tmp_path / "tileset.json").read_bytes())["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    x, y, z = turned.up
    np.testing.assert_allclose(matrix[:3, :3] @ [x, z, -y], [0, 0, 1], atol=1e-9)
    tiles.write(tmp_path / "upright" / "tileset.json", random_scene(50, 0))
    root = json.loads((tmp_path / "upright" / "tileset.json").read_bytes())["root"]
    assert root["transform"] == np.eye(4).reshape(-1).tolist()


def test_nodes_above_the_coarsest_level_have_no_content(tmp_path):
    options = tiles.tile_options(smallest=10_000, leaf=100)
    tiles.write(tmp_path / "tileset.json", random_scene(700, 0), options)
    meta = json.loads((tmp_path / "tileset.json").read_bytes())
    found = list(all_tiles(meta["root"]))
    assert [("content" in tile) for tile in found] == [("children" not in tile) for tile in found]
    for tile in found:
        if "children" in tile:
            assert tile["geometricError"] > 1


def test_a_tileset_has_the_size_of_its_files_and_a_splat(tmp_path):
    write_scene(tmp_path / "tileset.json", random_scene(30, 0))
    size = sum(file.stat().st_size for file in tmp_path.rglob("*.*") if file.is_file())
    assert stored_bytes(tmp_path / "tileset.json") == size
    with pytest.raises(ArgumentError, match="are none"):
        tiles.write(tmp_path / "b" / "tileset.json", random_scene(0, 0))


def test_a_scene_whose_place_is_known_lies_there_and_reads_back(tmp_path):
    earth = Earth.at_place(47.0, 8.0, 400.0)
    scene = replace(
        random_scene(30, 3), origin=(200.0, -50.0, 10.0), up=(0.0, 0.0, 1.0), unit="m", earth=earth
    )
    path = tmp_path / "tileset.json"
    write_scene(path, scene)
    root = np.array(json.loads(path.read_text())["root"]["transform"]).reshape(4, 4).T
    means = np.sort(scene.gaussians.means.double().numpy() + scene.origin, axis=0)
    # as another program sees it: from the tiles' axes (x, z, -y of ours) by the root to the globe
    found = read_scene(path)
    assert (found.earth, found.origin) == (earth, scene.origin)
    tiles_axes = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=float)
    there = root @ [*(tiles_axes @ (1.0, 2.0, 3.0)), 1.0]
    np.testing.assert_allclose(there[:3], earth.rows @ [201.0, -48.0, 13.0, 1.0], atol=1e-8)
    np.testing.assert_allclose(
        np.sort(found.gaussians.means.double().numpy() + found.origin, axis=0), means, atol=1e-3
    )


def test_a_scene_in_the_coordinates_of_a_map_lies_on_the_globe(tmp_path):
    """UTM's zone 33 has its middle at 15 degrees east; the scene's y is north there."""
    earth = Earth.of(np.eye(3), (500_000.0, 0.0, 0.0), "EPSG:32633")
    scene = replace(random_scene(30, 3), up=(0.0, 0.0, 1.0), unit="m", earth=earth)
    write_scene(tmp_path / "tileset.json", scene)
    root = np.array(json.loads((tmp_path / "tileset.json").read_text())["root"]["transform"]).reshape(4, 4).T
    east, north, up = local_axes(0.0, 15.0)
    expected = earth_centred([(0.0, 15.0, 0.0)])[0] + (east + 2.0 * north) / 0.9996 + 3.0 * up
    np.testing.assert_allclose(
        (root @ [1.0, 3.0, -2.0, 1.0])[:3], expected, atol=1e-5
    )  # tiles: right, up, back
    assert read_scene(tmp_path / "tileset.json").earth == earth
    unknown = replace(scene, earth=Earth.of(np.eye(3), (0, 0, 0), "EPSG:999999"))
    write_scene(tmp_path / "b" / "tileset.json", unknown)
    upright = json.loads((tmp_path / "b" / "tileset.json").read_text())["root"]["transform"]
    assert np.abs(np.array(upright)).max() <= 1.0
