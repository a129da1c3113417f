"""A capture far from zero: every command gives what the checkpoint has, and files with a y axis stand upright."""

import json
import re
import struct

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.mesh_files import read_mesh
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.train.checkpoint import list_checkpoints, read_checkpoint
from gsplat_edu.viewer.export import read_back

ORIGINS = [(1e3, -2e3, 40.0), (3.9e6, 3.1e5, 5.02e6)]

EXACT = [".ply", ".glb"]
"""Formats whose splats draw the same pixels as the run's."""


def called(capsys, *words):
    assert main([str(word) for word in words]) == 0
    return capsys.readouterr().out


def moved_views(move, size=24):
    """Return the procedural capture after a transform."""
    views, points, colors = procedural_capture(size, 6)
    views = [type(view)(move.camera(view.camera), view.image, name=view.name) for view in views]
    return views, move.s * points @ move.R.T + move.t, colors


@pytest.fixture(scope="module", params=ORIGINS, ids=["1e3", "5e6"])
def made(request, tmp_path_factory):
    """A capture at an origin, and a run of it."""
    root = tmp_path_factory.mktemp("far")
    write_colmap(root / "capture", *moved_views(Similarity(np.eye(3), 1.0, np.array(request.param))))
    words = ["--out", root / "run", "--iterations", "30", "--set", "densify_start=5", "--backend", "cpu"]
    words += ["--export", root / "exported.ply"]
    assert main([str(word) for word in ("train", root / "capture", *words)]) == 0
    return root, np.array(request.param)


def frames(folder):
    return {path.name: np.array(Image.open(path)) for path in sorted(folder.glob("*.png"))}


def test_the_runs_scene_and_its_export_have_the_bits_of_the_checkpoint(made):
    root, origin = made
    run = RunFolder(root / "run")
    state, _ = read_checkpoint(list_checkpoints(run.checkpoints)[-1])
    means = state["gaussians.means"]
    for scene in (open_source(root / "run").scene, read_scene(root / "exported.ply")):
        assert torch.equal(scene.gaussians.means, means)
        assert np.abs(np.array(scene.origin) - origin).max() < 5.0, "it lies among the cameras"
        places = scene.gaussians.means.double().numpy() + np.array(scene.origin) - origin
        assert np.abs(np.median(places, axis=0)).max() < 1.0, "the object lies where the capture has it"


def test_every_command_scores_and_draws_what_the_training_did(made, capsys, tmp_path):
    root, _ = made
    scores = RunFolder(root / "run").read_metrics()["test"]
    called(capsys, "eval", root / "run")
    again = RunFolder(root / "run").read_metrics()["test"]
    assert (again["psnr"], again["ssim"]) == (scores["psnr"], scores["ssim"])
    called(capsys, "render", root / "run", "--dataset", "--out", tmp_path / "run")
    expected = frames(tmp_path / "run")
    for suffix in EXACT:
        file = tmp_path / f"a{suffix}"
        said = called(capsys, "convert", root / "run", file, "--verify")
        assert re.search(r"PSNR 100\.00 dB", said)
        called(capsys, "render", file, "--dataset", root / "capture", "--out", tmp_path / suffix)
        for name, picture in frames(tmp_path / suffix).items():
            assert np.array_equal(picture, expected[name]), (suffix, name)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".sog", ".html"])
def test_other_formats_lose_what_they_lose_near_zero(made, capsys, tmp_path, suffix):
    root, _ = made
    said = called(capsys, "convert", root / "run", tmp_path / f"a{suffix}", "--verify")
    assert float(re.search(r"PSNR ([\d.]+) dB", said)[1]) > 35.0
    assert read_back(tmp_path / f"a{suffix}").origin == open_source(root / "run").origin
    assert "which a" in said and "stores in double" in said


def test_a_training_begins_from_the_file_where_the_run_ended(made, capsys, tmp_path):
    root, _ = made
    begin = ["--out", tmp_path / "next", "--iterations", "1", "--set", "means_rate=0", "--backend", "cpu"]
    called(capsys, "train", root / "capture", "--from", root / "exported.ply", *begin)
    before, after = (open_source(path).scene.gaussians.means for path in (root / "run", tmp_path / "next"))
    assert len(before) == len(after)
    assert torch.equal(*(torch.sort(means.flatten()).values for means in (before, after)))


def test_meshes_lie_where_the_capture_is(made, capsys, tmp_path):
    root, origin = made
    for suffix in (".ply", ".glb"):
        called(capsys, "mesh", root / "run", tmp_path / f"a{suffix}", "--voxel", "0.2")
    double, single = (read_mesh(tmp_path / f"a{suffix}").vertices for suffix in (".ply", ".glb"))
    middle = np.median(double, axis=0) - origin
    assert np.abs(middle).max() < 5.0
    # a glTF's vertices are rounded to float32 below 16, half a step of 2^-20 along each axis; some become one
    for some, others in ((double, single), (single, double)):
        assert cKDTree(some).query(others)[0].max() < 2**-20


def test_a_crop_and_a_transform_act_on_the_captures_coordinates(made, capsys, tmp_path):
    root, origin = made
    low, high = origin - 0.5, origin + np.array((0.5, 0.6, 0.7))
    box = ",".join(f"{x:.17g}" for x in (*low, *high))
    home = ",".join(f"{-x:.17g}" for x in origin)
    called(capsys, "convert", root / "run", tmp_path / "a.ply", f"--crop={box}", f"--transform=move={home}")
    scene, source = read_scene(tmp_path / "a.ply"), open_source(root / "run")
    places = source.scene.gaussians.means.double().numpy() + np.array(source.origin)
    inside = ((places >= low) & (places <= high)).all(axis=1)
    assert inside.any() and scene.origin == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(scene.gaussians.means.numpy(), places[inside] - origin, atol=1e-6)
    assert "origin" in called(capsys, "info", root / "exported.ply")


@pytest.mark.parametrize(("axis", "sign"), [(2, 1.0), (1, 1.0), (0, -1.0)])
def test_files_of_a_capture_with_a_vertical_axis_stand_upright(capsys, tmp_path, axis, sign):
    """A transforms.json with z (or another axis) up, its cameras tilted by six degrees, gives exactly that axis."""
    up = sign * np.eye(3)[axis]
    third = np.eye(3)[(axis + 1) % 3]
    rows = np.stack(
        [np.cross(third, up), -up, -third]
    )  # the capture's right, down and forward in the new axes
    rows *= np.sign(np.linalg.det(rows))
    tilt = np.radians(6.0)
    lean = np.array([[np.cos(tilt), -np.sin(tilt), 0.0], [np.sin(tilt), np.cos(tilt), 0.0], [0.0, 0.0, 1.0]])
    turn = rows.T @ lean
    turn = turn if np.dot(turn @ (0.0, -1.0, 0.0), up) > 0 else -turn @ np.diag([1.0, 1.0, -1.0])
    views, points, colors = moved_views(Similarity(turn, 1.0, np.zeros(3)))
    write_transforms(tmp_path / "capture", views, points, colors)
    words = ["--out", tmp_path / "run", "--iterations", "2", "--backend", "cpu"]
    called(capsys, "train", tmp_path / "capture", *words)
    assert RunFolder(tmp_path / "run").read_config()["up"] == pytest.approx(list(up), abs=0)
    called(capsys, "convert", tmp_path / "run", tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    (node,) = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])["nodes"]
    x, y, z, w = node["rotation"]
    u, v = np.array((x, y, z)), np.array((1.0, -1.0, -1.0)) * up
    shown = v + 2.0 * np.cross(u, np.cross(u, v) + w * v)
    np.testing.assert_allclose(shown, (0.0, 1.0, 0.0), atol=1e-12)
    assert read_scene(tmp_path / "a.glb").up == pytest.approx(tuple(up))
    said = called(capsys, "convert", tmp_path / "run", tmp_path / "a.spz", "--verify")
    assert float(re.search(r"PSNR ([\d.]+) dB", said)[1]) > 35.0
    assert read_scene(tmp_path / "a.spz").up == pytest.approx(tuple(up))


def test_a_damaged_origin_or_place_of_a_run_is_one_line(made, capsys, tmp_path):
    root, _ = made
    run = RunFolder(root / "run")
    config = run.read_config()
    try:
        origins = [({"origin": wrong}, "origin") for wrong in ([1.0, 2.0], "far", [1e31, 0.0, 0.0])]
        places = [
            ({"scale": {"earth": "here 1"}}, "place on earth"),
            ({"scale": {"earth": []}}, "scale.earth"),
        ]
        for wrong, said in (*origins, *places):
            run.write_config(config | wrong)
            assert main(["convert", str(root / "run"), str(tmp_path / "a.ply")]) == 2
            error = capsys.readouterr().err
            assert f"config.json: {said}" in error and error.count("\n") == 1
    finally:
        run.write_config(config)
