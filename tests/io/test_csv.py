"""CSV scenes: bits survive, columns are found by name, and a damaged row is named by its number."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.ply import LARGEST_LOGIT
from scene_files import random_scene, refused


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip_keeps_every_bit(tmp_path, rest):
    scene = random_scene(200, rest)
    scene.gaussians.means[:3, 0] = torch.tensor([1e-45, -3.4e38, -0.0])
    write_scene(tmp_path / "a.csv", scene)
    back = read_scene(tmp_path / "a.csv").gaussians.tensors()
    for name, tensor in scene.gaussians.tensors().items():
        assert torch.equal(tensor.view(torch.int32), back[name].view(torch.int32)), name


def test_python_reads_the_columns_of_a_ply(tmp_path):
    scene = random_scene(3, 3)
    write_scene(tmp_path / "a.csv", scene)
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    g = scene.gaussians
    assert list(rows[0])[:6] == ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    for k, row in enumerate(rows):
        assert np.float32(row["opacity"]) == g.logit_opacities[k].numpy()
        assert np.float32(row["rot_3"]) == g.quats[k, 3].numpy()
        assert np.float32(row["f_rest_4"]) == g.sh_rest[k, 1, 1].numpy(), "channel by channel"
        assert row["x"] == str(np.float32(g.means[k, 0]))


def test_other_orders_and_columns_line_ends_and_map_coordinates_are_read(tmp_path):
    names = "id,rot_0,rot_1,rot_2,rot_3,opacity,scale_0,scale_1,scale_2,f_dc_0,f_dc_1,f_dc_2,z,y,x"
    row = "wall,1,0,0,0,inf,-1,-2,-3,.5,.25,0,120.5,4649776.125,500000.75"
    (tmp_path / "a.csv").write_bytes(f"{names}\r\n{row}\r\n{row}\r\n".encode())
    scene = read_scene(tmp_path / "a.csv")
    assert scene.gaussians.sh_degree == 0 and len(scene.gaussians) == 2
    place = scene.gaussians.means.double().numpy()[0] + scene.origin
    assert place.tolist() == [500000.75, 4649776.125, 120.5]
    assert scene.gaussians.logit_opacities.tolist() == [LARGEST_LOGIT] * 2


def test_a_scene_without_splats_is_a_header(tmp_path):
    scene = random_scene(3)
    write_scene(tmp_path / "a.csv", replace(scene, gaussians=scene.gaussians.map(lambda t: t[:0])))
    assert len(read_scene(tmp_path / "a.csv").gaussians) == 0


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda row: row.replace(",", ",x", 1), "no number in column y"),
        (lambda row: row.rpartition(",")[0], "22 columns"),
        (lambda row: "nan" + row[row.index(",") :], "NaN"),
        (lambda row: "1e39" + row[row.index(",") :], "infinite"),
        (lambda row: "", "1 columns"),
    ],
)
def test_a_damaged_row_is_named(tmp_path, edit, said):
    path = tmp_path / "a.csv"
    write_scene(path, random_scene(20, 3))
    rows = path.read_text().splitlines()
    rows[7] = edit(rows[7])
    path.write_text("\n".join(rows) + "\n")
    message = refused(path)
    assert "row 7 after the header" in message and said in message


def test_missing_columns_are_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("label,x,y,z\na,1,2,3\n")
    assert "lacks f_dc_0" in refused(path)
