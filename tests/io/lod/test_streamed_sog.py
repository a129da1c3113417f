"""Streamed SOGs: tree, files, order and levels, written and read."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.formats import format_of, read_scene, stored_bytes, write_scene
from gsplat_edu.io.lod import codec
from gsplat_edu.io.lod.levels import (
    LodOptions,
    build_levels,
    counts_of,
    leaves_of,
    level_of,
    morton_order,
    with_levels,
)
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.scene.morton import morton_codes
from scene_files import random_scene
from systems import needs_posix

SMALL = LodOptions(smallest=200, chunk=900, leaf=300)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A scene of 3000 splats in leaves of 188, and its lod-meta.json."""
    path = tmp_path_factory.mktemp("lod") / "scene-lod" / "lod-meta.json"
    scene = random_scene(3000, 3)
    codec.write(path, scene, SMALL)
    return scene, path


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def document(path):
    return json.loads(path.read_bytes())


def nodes(node):
    yield node
    for child in node.get("children", []):
        yield from nodes(child)


def leaves(path):
    return [node for node in nodes(document(path)["tree"]) if "lods" in node]


def test_levels_halve_until_the_smallest(written):
    _, path = written
    meta = document(path)
    assert meta["version"] == 1 and meta["lodErrors"] is True
    assert meta["lodLevels"] == len(meta["counts"]) == 5
    assert meta["counts"][0] == 3000 and meta["counts"][-1] <= 200 < meta["counts"][-2]
    assert meta["count"] == sum(meta["counts"])
    for fine, coarse in zip(meta["counts"], meta["counts"][1:], strict=False):
        assert fine / 2 <= coarse <= fine / 2 + 8  # each of the 16 leaves rounds up


def test_the_tree_is_as_specified(written):
    """A node has two children or levels; boxes are unions; a leaf has every level, with errors ascending from 0."""
    _, path = written
    for node in nodes(document(path)["tree"]):
        assert ("children" in node) != ("lods" in node)
        if "children" in node:
            assert len(node["children"]) == 2
            boxes = [child["bound"] for child in node["children"]]
            assert node["bound"]["min"] == np.min([box["min"] for box in boxes], axis=0).tolist()
            assert node["bound"]["max"] == np.max([box["max"] for box in boxes], axis=0).tolist()
            continue
        assert list(node["lods"]) == ["0", "1", "2", "3", "4"]
        assert node["lods"]["0"]["count"] <= 300
        assert node["errors"][0] == 0 and node["errors"] == sorted(node["errors"])
        assert node["errors"][1] > 0
        numbers = [*node["bound"]["min"], *node["bound"]["max"], *node["errors"]]
        assert all(float(f"{number:.7g}") == number for number in numbers)


def test_runs_fill_the_files_of_one_level_in_morton_order(written):
    _, path = written
    meta = document(path)
    runs = {}
    for leaf in leaves(path):
        for level, run in leaf["lods"].items():
            runs.setdefault(run["file"], []).append((run["offset"], run["count"], level, leaf))
    assert sorted(runs) == list(range(len(meta["filenames"])))
    for file, found in runs.items():
        read = sog.read(path.parent / meta["filenames"][file]).gaussians
        assert len(read) == sum(count for _, count, _, _ in found) <= 900
        assert len({level for _, _, level, _ in found}) == 1
        assert meta["filenames"][file].startswith(f"{found[0][2]}_")
        end = 0
        for offset, count, _, leaf in sorted(found, key=lambda run: run[0]):
            assert offset == end
            end += count
            part = read.map(lambda t, offset=offset, end=end: t[offset:end])
            # the ellipsoids lie in the box up to a SOG's rounding
            reach = torch.sqrt(torch.einsum("nii->ni", cov3d_t(part.log_scales, part.quats)))
            slack = 0.02 * (1 + float(reach.max()))
            assert bool((part.means - reach >= torch.tensor(leaf["bound"]["min"]) - slack).all())
            assert bool((part.means + reach <= torch.tensor(leaf["bound"]["max"]) + slack).all())
            # rounding moves a few points to a neighbouring cell of 16, so nearly all steps along the curve ascend
            cells = part.means.numpy() - part.means.numpy().min(axis=0)
            cells = (cells / cells.max(axis=0) * 65535).astype(np.uint16) >> 12
            codes = morton_codes(cells).astype(np.int64)
            if count > 60:
                assert (np.diff(codes) < 0).mean() < 0.15, "in a random order, half of the steps ascend"


def test_the_order_is_exactly_mortons():
    leaf = leaves_of(build_levels(random_scene(700, 0).gaussians, LodOptions(smallest=100)))[0]
    for level in leaf.levels:
        means = level.means.double().numpy()
        low, high = means.min(axis=0), means.max(axis=0)
        codes = morton_codes(((means - low) / (high - low) * 65535).astype(np.uint16))
        assert (np.diff(codes.astype(np.int64)) >= 0).all()
        np.testing.assert_array_equal(morton_order(level.means.numpy()), np.arange(len(means)))


def test_the_finest_level_is_the_scene_and_a_leaf_covers_the_same_region_at_all_levels():
    scene = random_scene(1000, 3)
    root = build_levels(scene.gaussians, LodOptions(smallest=100, leaf=130))
    finest = level_of(root, 0)
    rows = torch.cdist(finest.means, scene.gaussians.means).argmin(dim=1)
    assert sorted(rows.tolist()) == list(range(1000))
    for name, tensor in finest.tensors().items():
        np.testing.assert_array_equal(tensor.numpy(), scene.gaussians.tensors()[name][rows].numpy())
    for leaf in leaves_of(root):
        low, high = (f(leaf.levels[0].means, 0) for f in (torch.amin, torch.amax))
        for level in leaf.levels[1:]:  # the mean of points in a box lies in the box
            assert bool(((level.means >= low - 1e-6) & (level.means <= high + 1e-6)).all())


def test_reading_gives_the_finest_level_and_round_trips(written, tmp_path):
    scene, path = written
    back = read_scene(path.parent)
    assert (len(back.gaussians), back.antialiased, back.up) == (3000, False, (0.0, -1.0, 0.0))
    rows = torch.cdist(back.gaussians.means, scene.gaussians.means).argmin(dim=1)
    assert len(set(rows.tolist())) > 2990  # a few that nearly coincide may swap places by rounding
    assert float((back.gaussians.means - scene.gaussians.means[rows]).abs().max()) < 5e-4
    assert float((back.gaussians.opacities - scene.gaussians.opacities[rows]).abs().mean()) < 3e-3
    codec.write(tmp_path / "b" / "lod-meta.json", back, SMALL)
    again = read_scene(tmp_path / "b")
    rows = torch.cdist(again.gaussians.means, back.gaussians.means).argmin(dim=1)
    assert float((again.gaussians.means - back.gaussians.means[rows]).abs().max()) < 5e-4


def test_the_same_bytes_for_any_number_of_threads(tmp_path, threads):
    written = []
    for count in (1, 2):
        threads(count)
        path = tmp_path / str(count) / "lod-meta.json"
        codec.write(path, random_scene(4000, 3), LodOptions(smallest=500, chunk=2000, leaf=1000))
        written.append({str(f.relative_to(path.parent)): f.read_bytes() for f in path.parent.rglob("*.*")})
    assert written[0] == written[1] and len(written[0]) > 30


@pytest.mark.parametrize("count", [0, 1, 5])
def test_tiny_scenes(tmp_path, count):
    write_scene(tmp_path / "lod-meta.json", random_scene(count, 0))
    assert len(read_scene(tmp_path).gaussians) == count
    assert document(tmp_path / "lod-meta.json")["counts"] == [count]


def test_levels_end_with_one_splat_a_leaf(tmp_path):
    write = LodOptions(smallest=1, chunk=64, leaf=64)
    codec.write(tmp_path / "lod-meta.json", random_scene(100, 0), write)
    assert document(tmp_path / "lod-meta.json")["counts"] == [100, 50, 26, 14, 8, 4, 2]


def test_some_levels_can_be_replaced():
    """Refining replaces levels. Boxes are updated, the order is Morton's again, and other levels stay."""
    root = build_levels(random_scene(400, 0).gaussians, LodOptions(smallest=120, leaf=100))
    old = leaves_of(root)
    moved = [leaf.levels[1].map(lambda t: t.flip(0)) for leaf in old]
    for part in moved:
        part.means[:] += 10.0
    new = leaves_of(with_levels(root, {1: moved}))
    assert counts_of(new) == counts_of(old)
    for before, after in zip(old, new, strict=True):
        assert after.levels[0] is before.levels[0] and (after.high > before.high + 5).all()
        np.testing.assert_array_equal(
            morton_order(after.levels[1].means.numpy()), np.arange(len(after.levels[1]))
        )


def test_sizes_are_checked():
    with pytest.raises(ArgumentError, match="smallest"):
        LodOptions(smallest=0)
    assert LodOptions(chunk=100).leaf == 100


def test_the_files_and_their_bytes_are_listed(written):
    _, path = written
    assert format_of(path).name == "PlayCanvas streamed SOG"
    assert format_of(Path("my.lod-meta.json.ply")).suffix == ".ply"
    files = codec.named_files(path)
    assert sum(file.stat().st_size for file in path.parent.rglob("*.*")) == stored_bytes(path)
    assert set(files) == {file.relative_to(path.parent).as_posix() for file in path.parent.rglob("*.*")}


@needs_posix
def test_the_environment_that_other_programs_write_is_read(written, tmp_path):
    _, path = written
    (tmp_path / "lod-meta.json").write_text(
        json.dumps({**document(path), "environment": "env/meta.json"}), encoding="utf-8"
    )
    for name in document(path)["filenames"]:
        (tmp_path / name).parent.symlink_to(path.parent / name.split("/")[0])
    sog.write(tmp_path / "env" / "meta.json", random_scene(7, 0))
    with pytest.raises(SceneFormatError, match="leads out of its folder"):
        read_scene(tmp_path)
    copied = path.parent / "with-env.json"
    copied.write_bytes((tmp_path / "lod-meta.json").read_bytes())
    (path.parent / "env").mkdir()
    for file in (tmp_path / "env").iterdir():
        (path.parent / "env" / file.name).write_bytes(file.read_bytes())
    assert len(codec.read(copied).gaussians) == 3007
