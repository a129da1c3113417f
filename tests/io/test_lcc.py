"""XGRIDS' LCC and LCC2, written by an independent writer after the white papers (`lcc_files`)."""

import json
import struct

import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.formats import LOD_META, file_in, read_scene, stored_bytes, write_scene
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer.export import check_target
from lcc_files import BOUNDS, PORTABLE, QUALITY, lcc_scene, small_lcc, small_lcc2, write_lcc, write_lcc2
from scene_files import random_scene, refused


def check_rounded(given, back, scale, harmonics):
    """Each value is the given one rounded to the format's steps; bounds are those of the environment or of the rest."""
    assert torch.equal(given.means, back.means)
    torch.testing.assert_close(C0 * back.sh0, C0 * given.sh0, rtol=0, atol=0.5 / 255 + 1e-6)
    torch.testing.assert_close(back.opacities, given.opacities, rtol=0, atol=0.5 / 255 + 1e-6)
    torch.testing.assert_close(back.scales, given.scales, rtol=0, atol=0.5 * scale / 65535 + 1e-6)
    torch.testing.assert_close(back.sh_rest, given.sh_rest, rtol=0, atol=0.5 * 2 * harmonics / 1023 + 1e-6)
    # a component is off by half a step of sqrt(2) / 1023, each of the three; the largest by at most sqrt(3) of it
    same = (back.quats * given.quats).sum(dim=1, keepdim=True).sign() * back.quats
    torch.testing.assert_close(same, given.quats, rtol=0, atol=1.7321 * 0.5 * 2**0.5 / 1023 + 1e-6)


def test_the_finest_level_of_each_cell_and_the_environment_are_read(tmp_path):
    cells, environment = [lcc_scene(50, 1), lcc_scene(30, 2)], lcc_scene(20, 3, most=0.49)
    path = write_lcc(tmp_path / "scene.lcc", cells, lcc_scene(10, 4), environment)
    scene = read_scene(path)
    assert scene.up == (0.0, 0.0, 1.0) and scene.unit == "m"
    finest = Gaussians.concatenated(cells)
    check_rounded(finest, scene.gaussians[:80], BOUNDS["scale"], BOUNDS["shcoef"])
    check_rounded(environment, scene.gaussians[80:], BOUNDS["envscale"], BOUNDS["envshcoef"])


def test_a_portable_file_has_no_harmonics(tmp_path):
    path = write_lcc(tmp_path / "a.lcc", [lcc_scene(9)], lcc_scene(2), lcc_scene(3), PORTABLE)
    assert not (tmp_path / "shcoef.bin").exists()
    found = read_scene(path).gaussians
    assert (len(found), found.sh_degree) == (12, 0)


@pytest.mark.parametrize(("kind", "degree"), [(QUALITY, 3), (PORTABLE, 0)])
def test_without_a_type_the_attributes_say_whether_there_are_harmonics(tmp_path, kind, degree):
    path = write_lcc(tmp_path / "a.lcc", [lcc_scene(5)], lcc_scene(2), None, kind)
    meta = json.loads(path.read_text())
    del meta["fileType"]
    if kind == PORTABLE:
        meta["attributes"] = [part for part in meta["attributes"] if "sh" not in part["name"]]
    path.write_text(json.dumps(meta))
    assert read_scene(path).gaussians.sh_degree == degree


def test_names_of_files_may_be_in_upper_case(tmp_path):
    path = write_lcc(tmp_path / "A.LCC", [lcc_scene(5)], lcc_scene(2), lcc_scene(3))
    for name in ("index", "data", "shcoef", "environment"):
        (tmp_path / f"{name}.bin").rename(tmp_path / f"{name.capitalize()}.bin")
    assert len(read_scene(path).gaussians) == 8


@pytest.mark.parametrize("kind", [".ply", ".sog", ".spz"])
def test_the_leaves_of_an_lcc2_are_read_in_its_axes(tmp_path, kind):
    finest, environment = lcc_scene(21, 1), lcc_scene(4, 3)
    scene = read_scene(write_lcc2(tmp_path / "scene.lcc2", finest, lcc_scene(6, 2), environment, kind))
    given, back = Gaussians.concatenated([finest, environment]), scene.gaussians
    assert (scene.up, scene.unit, len(back)) == ((0.0, 0.0, 1.0), "m", 25)
    if kind == ".ply":
        assert all(torch.equal(tensor, given.tensors()[name]) for name, tensor in back.tensors().items())
    # SOG has 16 bits of the logarithm between the extremes; SPZ 24 with 12 binary places
    distance = (back.means[:, None] - given.means[None]).norm(dim=2).min(dim=1).values
    assert distance.max() < 1e-3


@pytest.mark.parametrize("small", [small_lcc, small_lcc2])
def test_a_folder_stands_for_its_only_file(tmp_path, small):
    path = small(tmp_path)
    assert file_in(path.parent) == path
    assert len(read_scene(path.parent).gaussians) == 24
    assert stored_bytes(path) == sum(file.stat().st_size for file in path.parent.rglob("*.*"))


@pytest.mark.parametrize("suffix", [".lcc", ".lcc2"])
def test_writing_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for write in (lambda: check_target("OUT", path), lambda: write_scene(path, random_scene(2))):
        with pytest.raises(ArgumentError, match="is read, but not written"):
            write()
    assert not path.exists()


def change(path, **fields):
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def negative_scale(path):
    attributes = json.loads(path.read_text())["attributes"]
    attributes[0]["min"] = [-1.0, 0.0, 0.0]
    change(path, attributes=attributes)


def overlapping(path):
    index = bytearray((path.parent / "index.bin").read_bytes())
    second = len(index) // 2
    index[second + 8 : second + 16] = struct.pack("<Q", 32)
    (path.parent / "index.bin").write_bytes(index)


def cut(name, to):
    def do(path):
        file = path.parent / name
        file.write_bytes(file.read_bytes()[:to])

    return do


def link_out(path):
    (path.parent / "data.bin").rename(path.parent.parent / "elsewhere.bin")
    (path.parent / "data.bin").symlink_to(path.parent.parent / "elsewhere.bin")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: path.write_text("{"), "is not JSON"),
        (lambda path: path.write_text("[]"), "has to be an object"),
        (lambda path: change(path, totalLevel=0), "totalLevel"),
        (lambda path: change(path, totalLevel=3), "index.bin: its cells do not have 3 levels"),
        (lambda path: change(path, encoding="PLAIN"), "encoding: must be COMPRESS"),
        (lambda path: change(path, attributes=[]), "attributes: has no scale"),
        (negative_scale, "negative scale"),
        (overlapping, "overlap"),
        (lambda path: (path.parent / "index.bin").unlink(), "index.bin is missing"),
        (lambda path: (path.parent / "shcoef.bin").unlink(), "shcoef.bin is missing"),
        (cut("data.bin", 700), "data.bin: is too short"),
        (cut("shcoef.bin", 1000), "shcoef.bin: is too short"),
        (cut("environment.bin", 95), "environment.bin: is not a whole number of splats"),
        (link_out, "leads out of its folder"),
    ],
)
def test_damage_is_named(tmp_path, damage, said):
    path = small_lcc(tmp_path)
    damage(path)
    assert said in refused(path)


def test_cells_or_an_environment_suffice(tmp_path):
    path = small_lcc(tmp_path)
    (path.parent / "index.bin").write_bytes(b"")
    assert len(read_scene(path).gaussians) == 4
    (path.parent / "environment.bin").unlink()
    assert "has no splats at its finest level" in refused(path)


def changed_root(path, **fields):
    change(path, root=json.loads(path.read_text())["root"] | fields)


def more_splats(path):
    root = json.loads(path.read_text())["root"]
    root["child"]["0"]["child"]["0"]["data"]["3dgs"]["count"] = 99
    change(path, root=root)


def twice(path):
    root = json.loads(path.read_text())["root"]
    root["child"]["0"]["child"]["2"]["data"]["3dgs"]["start"] = 0
    change(path, root=root)


def deep(path):
    node: dict = {"data": {"3dgs": {"name": 0, "start": 0, "count": 1}}}
    for _ in range(100):
        node = {"child": {"0": node}}
    changed_root(path, child={"0": node})


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: change(path, total_splats=3), "is a draft of LCC2"),
        (lambda path: change(path, root=None), "root"),
        (lambda path: changed_root(path, splatFiles=["../a.ply"]), "splatFiles"),
        (lambda path: changed_root(path, splatFiles=[]), "there are 0 files"),
        (lambda path: changed_root(path, splatFiles=["a.obj"] * 4), "a.obj is missing"),
        (lambda path: changed_root(path, child={}, data=None), "has no splats"),
        (more_splats, "has fewer splats than its leaves"),
        (twice, "two leaves have the same splats"),
        (deep, "nodes deep"),
        (cut("data/3dgs/2.ply", 900), "data/3dgs/2.ply: "),
    ],
)
def test_damage_of_an_lcc2_is_named(tmp_path, damage, said):
    path = small_lcc2(tmp_path)
    damage(path)
    assert said in refused(path)


def test_a_file_of_an_lcc2_of_another_format_is_refused(tmp_path):
    path = small_lcc2(tmp_path)
    (path.parent / "a.obj").touch()
    changed_root(path, splatFiles=["a.obj"] * 4)
    assert "a.obj: must end in .ply, .spz, .sog" in refused(path)


def test_a_folder_with_levels_of_ours_counts_first(tmp_path):
    path = small_lcc(tmp_path)
    (path.parent / LOD_META).touch()
    assert file_in(path.parent) == path.parent / LOD_META
