"""Tilesets are read: ours into the scene's own coordinates, those of others into the tileset's."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.lod import tiles
from gsplat_edu.io.lod.tiles_reading import FROM_SCENE
from scene_files import matched, random_scene, refused

STEP = 2.0**-12
"""Of a position in SPZ."""


def test_ours_comes_back_into_its_own_coordinates(tmp_path):
    """Each splat once, of the finest level."""
    scene = replace(
        random_scene(900, 3), origin=(450_000.0, -12.0, 5_600_000.0), up=(0.0, 0.6, 0.8), unit="m"
    )
    tiles.write(tmp_path / "tileset.json", scene, tiles.tile_options(leaf=100))
    back = read_scene(tmp_path)
    assert (back.origin, back.unit) == (scene.origin, "m") and len(back.gaussians) == 900
    np.testing.assert_allclose(back.up, scene.up)
    given = matched(scene.gaussians, back.gaussians)
    assert (given.means - back.gaussians.means).abs().max() <= STEP / 2 * (1 + 1e-6)


def stranger(folder, tree, parts):
    """Write a tileset of another program, whose tiles hold scenes; return its path."""
    for name, scene in parts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(tiles.glb(scene))
    path = folder / "tileset.json"
    path.write_text(json.dumps({"asset": {"version": "1.1"}, "geometricError": 1, "root": tree}))
    return path


def placed(matrix):
    return np.asarray(matrix).T.reshape(-1).tolist()


def test_transforms_of_tiles_apply_from_the_inside_out(tmp_path):
    """z of tiles is glTF's y, which is minus y here."""
    scene = random_scene(40, 3)
    turn, lift = np.eye(4), np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    lift[:3, 3] = 10, 20, 30
    child = {"transform": placed(turn), "content": {"uri": "a.glb"}}
    path = stranger(tmp_path, {"transform": placed(lift), "children": [child]}, {"a.glb": scene})
    back = read_scene(path)
    assert back.up == (0.0, 0.0, 1.0) and back.unit == "m"
    move = np.eye(4)
    move[:3, :3] = turn[:3, :3] @ FROM_SCENE
    move[:3, 3] = 10, 20, 30
    expected = Similarity.of_matrix(move).scene(scene)
    found = torch.from_numpy(np.array(back.origin)) + back.gaussians.means
    torch.testing.assert_close(found, expected.gaussians.means.double(), rtol=0, atol=STEP)


@pytest.mark.parametrize(("refine", "kept"), [("REPLACE", 40), ("ADD", 60)])
def test_children_replace_a_tile_or_add_to_it(tmp_path, refine, kept):
    """A further tileset in a folder of its own is the child."""
    parts = {"coarse.glb": random_scene(20, 0), "fine/a.glb": random_scene(40, 0, seed=1)}
    tree = {
        "refine": refine,
        "content": {"uri": "coarse.glb"},
        "children": [{"content": {"uri": "fine/in.json"}}],
    }
    path = stranger(tmp_path, tree, parts)
    inner = {"asset": {"version": "1.1"}, "root": {"content": {"uri": "a.glb?v=1"}}}
    (tmp_path / "fine" / "in.json").write_text(json.dumps(inner))
    assert len(read_scene(path).gaussians) == kept


def test_splats_on_earth_have_the_ellipsoids_normal_as_up(tmp_path):
    latitude, longitude = np.radians(50.85), np.radians(4.35)
    up = np.array(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    )
    squared = np.array([6_378_137.0, 6_378_137.0, 6_356_752.314245]) ** 2
    place = np.eye(4)
    place[:3, 3] = squared * up / np.sqrt((squared * up * up).sum()) + 60.0 * up
    tree = {"transform": placed(place), "content": {"uri": "a.glb"}}
    back = read_scene(stranger(tmp_path, tree, {"a.glb": random_scene(40, 0)}))
    np.testing.assert_allclose(back.up, up, atol=1e-6)
    assert (
        back.earth.place_of(place[:3, 3])
        == "50.850000, 4.350000 degrees, 60.0 m above the ellipsoid (WGS 84)"
    )
    middle = np.array(back.origin) + back.gaussians.means.double().numpy().mean(axis=0)
    assert np.linalg.norm(middle - place[:3, 3]) < 1.0, "in double"


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"content": {"uri": "../a.glb"}}, "does not lie below the tileset"),
        ({"content": {"uri": "https://far.example/a.glb"}}, "does not lie below the tileset"),
        ({"content": {"uri": "b.glb"}}, "lacks b.glb"),
        ({"content": {"uri": "a.b3dm"}}, "is no binary glTF"),
        ({"implicitTiling": {}, "content": {"uri": "a.glb"}}, "implicit tiling"),
        ({"transform": [0.0] * 16, "content": {"uri": "a.glb"}}, "singular"),
        ({"transform": [1.0] * 3}, "root.transform: is .* but has to have 16 entries"),
        ({}, "no tile with splats"),
        ({"content": {"uri": "tileset.json"}}, "tiles deeper than"),
    ],
)
def test_what_is_not_supported_is_named(tmp_path, tree, said):
    folder = tmp_path / "tiles"
    path = stranger(folder, tree, {"a.glb": random_scene(3, 0), "a.b3dm": random_scene(3, 0)})
    (tmp_path / "a.glb").write_bytes((folder / "a.glb").read_bytes())
    with pytest.raises(SceneFormatError, match=said):
        read_scene(path)


def test_a_tileset_cut_anywhere_is_refused(tmp_path):
    write_scene(tmp_path / "tileset.json", random_scene(40, 0))
    data = (tmp_path / "tileset.json").read_bytes()
    for end in range(0, len(data) - 1, 16):
        (tmp_path / "tileset.json").write_bytes(data[:end])
        refused(tmp_path / "tileset.json")
