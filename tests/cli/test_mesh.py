"""`gsplat-edu mesh`: files of every format, what it says, and what it refuses."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from gsplat_edu import write_scene
from gsplat_edu.cli.main import main
from gsplat_edu.io.mesh_files import MESH_FORMATS, read_mesh, write_mesh
from gsplat_edu.io.scene import Scene
from gsplat_edu.jobs import emitter
from gsplat_edu.options.mesh import SUFFIXES
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.mesh import Mesh
from splat_ball import RADIUS, ball


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    write_scene(path, ball())
    return path


@pytest.fixture(autouse=True)
def small_orbit(monkeypatch):
    """Fewer and smaller views around a scene without cameras: a sixtieth of the pixels."""
    monkeypatch.setattr("gsplat_edu.cli.mesh.ORBIT_VIEWS", 20)
    monkeypatch.setattr("gsplat_edu.cli.mesh.ORBIT_SIZE", 160)


def test_a_scene_without_cameras_is_seen_from_around(scene, tmp_path, capsys):
    out = tmp_path / "ball.glb"
    assert main(["mesh", str(scene), str(out), "--voxel", "0.05", "--backend", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "no photo is compared (a scene file has no photos; give its run)" in said
    assert "the scene has no cameras: 20 views around it are used" in said
    assert "is seen by 3 views or more" in said and "1 connected part" in said
    assert "no triangle passes through another one" in said
    mesh = read_mesh(out)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).mean() < 0.03
    assert mesh.colors is not None


def test_the_truth_is_compared_and_a_collider_is_coarse(scene, tmp_path, capsys):
    truth = tmp_path / "truth.ply"
    assert main(["mesh", str(scene), str(truth), "--voxel", "0.05", "--backend", "cpu"]) == 0
    out = tmp_path / "collider.obj"
    words = [
        "mesh",
        str(scene),
        str(out),
        "--voxel",
        "0.1",
        "--faces",
        "300",
        "--truth",
        str(truth),
        "--tau",
        "0.05",
    ]
    assert main([*words, "--collider", "--backend", "cpu"]) == 0
    said = capsys.readouterr().out
    assert (
        "the cameras see 100 % of the truth" in said
        and "against the truth: accuracy" in said
        and "F1" in said
        and "degrees" in said
    )
    assert len(read_mesh(out).faces) <= 300


@pytest.mark.parametrize("name", ["a.glb", "a.obj"])
def test_a_mesh_keeps_the_place_on_earth_and_info_says_it(tmp_path, capsys, name):
    place = Earth.at_place(47.0, 8.0, 400.0)
    write_scene(tmp_path / "ball.ply", replace(Scene(ball()), unit="m", earth=place))
    out, scene = tmp_path / name, str(tmp_path / "ball.ply")
    assert main(["mesh", scene, str(out), "--voxel", "0.1", "--backend", "cpu"]) == 0
    capsys.readouterr()
    assert main(["info", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"mesh       {out}, " in said and " vertices\n" in said and "1 unit = 1 m" in said
    assert re.search(
        r"on earth   middle at (47\.0000|46\.9999)\d+, (8\.0000|7\.9999)\d+ degrees, (400|399)", said
    )


def test_info_of_a_damaged_mesh_names_the_fault(tmp_path, capsys):
    (tmp_path / "a.obj").write_text("v 0 0 0\nf 1 2 3\n")
    assert main(["info", str(tmp_path / "a.obj")]) == 2
    assert "line 2: the face names vertex 1" in capsys.readouterr().err
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement face 1\nend_header\n")
    assert main(["info", str(tmp_path / "a.ply")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture
def small_page(monkeypatch):
    monkeypatch.setattr("gsplat_edu.cli.mesh.MOST_FACES", 2_000)


def test_a_mesh_fits_a_page_unless_all_triangles_are_wanted(scene, tmp_path, capsys, small_page):
    out = tmp_path / "ball.ply"
    assert main(["mesh", str(scene), str(out), "--backend", "cpu"]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[1].startswith("planned: voxels of ") and "at most 2,000 triangles" in said
    few = len(read_mesh(out).faces)
    assert 1_200 < few <= 2_000
    assert main(["mesh", str(scene), str(out), "--backend", "cpu", "--faces", "all"]) == 0
    assert "instead of" not in capsys.readouterr().out
    assert len(read_mesh(out).faces) > 3 * few
    # a given voxel is kept, and the triangles are reduced
    assert main(["mesh", str(scene), str(out), "--backend", "cpu", "--voxel", "0.03"]) == 0
    assert "voxels of 0.03 world units" in capsys.readouterr().out
    assert len(read_mesh(out).faces) <= 2_000


def test_what_does_not_fit_is_refused_before_anything_is_written(scene, tmp_path, capsys):
    out = tmp_path / "ball.ply"
    words = ["mesh", str(scene), str(out), "--backend", "cpu", "--max-memory", "600MiB"]
    assert main([*words, "--voxel", "0.001"]) == 2
    error = capsys.readouterr().err.strip()
    assert "voxel: 0.001 needs about" in error and "600 MiB are allowed" in error and "\n" not in error
    assert not out.exists()


def test_a_job_shows_the_stage_that_runs(scene, tmp_path, monkeypatch, small_page):
    events = tmp_path / "events"
    monkeypatch.setattr(emitter, "_emitter", emitter.Emitter(events))
    assert main(["mesh", str(scene), str(tmp_path / "ball.ply"), "--backend", "cpu", "--voxel", "0.05"]) == 0
    found = [json.loads(line) for line in events.read_text().splitlines()]
    stages = [event["name"] for event in found if event["event"] == "stage"]
    tail = ["tidying", "simplifying", "writing", "trust", "intersections", "pictures"]
    assert stages == ["survey", "depth maps", "checks", "volume", "triangles", *tail]
    assert not [event for event in found if event["event"] == "progress" and event.get("seconds_left") == 0]


def test_a_collider_of_convex_parts(scene, tmp_path, capsys):
    out = tmp_path / "parts.glb"
    words = ["--voxel", "0.1", "--faces", "200", "--collider", "convex", "--backend", "cpu"]
    assert main(["mesh", str(scene), str(out), *words]) == 0
    said = capsys.readouterr().out
    number = int(re.search(r"parts.glb: (\d+) convex part", said)[1])
    outside = float(re.search(r"at most (\S+) world units outside", said)[1])
    filled, left = map(
        float, re.search(r"(\S+) % of their volume is empty .* leave out (\S+) %", said).groups()
    )
    assert filled < 15 and left < 5  # a ball: hulls of its pieces are hardly larger
    assert outside < 0.1  # a voxel
    written = out.read_bytes()
    assert all(b'"collider_%d"' % part in written for part in range(number))
    assert b'"collider_%d"' % number not in written
    radii = np.linalg.norm(read_mesh(out).vertices, axis=1)
    assert RADIUS - 0.1 < radii.max() < RADIUS + 0.1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["out.stl"], "unknown mesh format; known are .glb, .ply, .obj"),
        (["out.glb", "--voxel", "0"], "--voxel"),
        (["out.glb", "--faces", "3"], "--faces: is 3, but has to be at least 4"),
        (["out.obj", "--collider", "convex"], "--collider convex: out.obj cannot hold several parts"),
        (["out.glb", "--tau", "1"], "--tau: is for --truth"),
        (["out.glb", "--truth", "missing.ply"], "--truth: missing.ply does not exist"),
        (["out.glb", "--bounds", "0,0,0,1,0,1"], "--bounds: X1, Y1 and Z1 have to be larger"),
    ],
)
def test_bad_options_are_one_line(scene, words, said, capsys):
    assert main(["mesh", str(scene), *words]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and "\n" not in error


def test_a_missing_scene_and_a_bad_truth_leave_the_file_that_was_there(scene, tmp_path, capsys):
    out = tmp_path / "kept.ply"
    triangle = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    write_mesh(out, triangle)
    before = out.read_bytes()
    assert main(["mesh", str(tmp_path / "nothing"), str(out)]) == 2
    (tmp_path / "bad.ply").write_bytes(b"ply\nno more")
    assert main(["mesh", str(scene), str(out), "--truth", str(tmp_path / "bad.ply")]) == 2
    assert "bad.ply" in capsys.readouterr().err and out.read_bytes() == before


def test_the_options_know_every_format():
    assert tuple(found.suffix for found in MESH_FORMATS) == SUFFIXES
