import base64
import gzip
import json
import re

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.data.point_files import read_points
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.mesh_files import write_mesh
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath, write_path
from gsplat_edu.render.api import render
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.viewer.export import read_back
from scene_files import make_run, random_scene, suffixes

SUFFIXES = [*suffixes(), ".html"]


@pytest.fixture
def plain(tmp_path):
    write_scene(tmp_path / "in.ply", random_scene(300))
    return tmp_path / "in.ply"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_is_written_and_verified_from_the_runs_cameras(convert, tmp_path, suffix):
    folder, *_ = make_run(tmp_path / "run")
    out = tmp_path / f"new/out{suffix}"
    said = convert(folder.path, out, "--verify")
    kept = {".splat": 0, ".ksplat": 2}.get(suffix, 3)
    assert f"wrote {out}: 30 splats, SH degree {kept}" in said
    figures = re.search(r"PSNR ([\d.]+) dB over 5 views, worst ([\d.]+) \((.*)\.jpg\); ([\d,]+) bytes", said)
    assert int(figures[4].replace(",", "")) == out.stat().st_size

    # The test renders both scenes itself to check the printed figures.
    source, written = open_source(folder.path), read_back(out)
    with torch.no_grad():
        scores = [
            psnr(
                *(
                    render(scene.gaussians, camera, settings=source.settings).image.clamp(0, 1)
                    for scene in (written, source.scene)
                )
            )
            for _, camera in source.cameras
        ]
    assert float(figures[1]) == pytest.approx(np.mean(scores), abs=0.006)
    assert float(figures[2]) == pytest.approx(min(scores), abs=0.006)
    assert np.mean(scores) > (15 if suffix == ".splat" else 35), (
        "with a wrong axis or sign, PSNR is far lower"
    )
    if suffix == ".ply":
        assert float(figures[1]) == 100.0


def test_values_that_a_format_cannot_store_are_reported(convert, tmp_path):
    folder, *_ = make_run(tmp_path / "run")
    said = convert(folder.path, tmp_path / "a.splat")
    assert "30 splats, SH degree 0" in said
    assert "stores SH up to degree 0; degrees up to 3 are dropped" in said
    assert "cannot store that the scene needs antialiased rendering" in said
    assert "left out" not in convert(folder.path, tmp_path / "a.ply")


def test_filters_and_transforms_are_applied_in_order(convert, plain, tmp_path):
    before = read_scene(plain).gaussians
    matrix = tmp_path / "m.txt"
    matrix.write_text("1 0 0 0\n0 0 -1 0\n0 1 0 0.5\n")
    convert(
        *(plain, tmp_path / "out.ply", "--crop=-0.5,-1,-1,1,1,1", "--min-opacity", 0.3, "--sh-degree", 1),
        *("--transform", "scale=2", "--transform", f"matrix={matrix}", "--transform", "move=1,0,0"),
    )
    after = read_scene(tmp_path / "out.ply").gaussians
    means = before.means.double().numpy()
    kept = (
        (means >= (-0.5, -1, -1)).all(axis=1) & (means <= 1).all(axis=1) & (before.opacities >= 0.3).numpy()
    )
    x, y, z = 2 * means[kept].T
    np.testing.assert_allclose(after.means, np.stack([x + 1, -z, y + 0.5], axis=1), atol=1e-6)
    assert after.sh_degree == 1 and 0 < kept.sum() < 300
    convert(plain, tmp_path / "turned.ply", "--transform", "rotate=x:180")
    np.testing.assert_allclose(
        read_scene(tmp_path / "turned.ply").gaussians.means, means * (1, -1, -1), atol=1e-6
    )


def test_a_known_distance_sets_the_unit(convert, plain, tmp_path):
    """Two points that are 2.1 units apart after the transform become 1.2 m apart, and Gaussians scale accordingly."""
    out, before = tmp_path / "metres.ply", read_scene(plain).gaussians
    said = convert(plain, out, "--transform", "move=1,0,0", "--scale", "-0.5,1,2 -0.5,1,4.1 1.20m")
    assert "1 unit of metres.ply = 1 m; it was 1.75 units before" in said
    assert read_scene(out).unit == "m" and read_scene(plain).unit is None
    convert(out, tmp_path / "twice.ply", "--transform", "scale=2")
    convert(out, tmp_path / "moved.ply", "--transform", "move=1,2,3")
    assert [read_scene(tmp_path / f"{name}.ply").unit for name in ("twice", "moved")] == [None, "m"]
    assert "comment gsplat_edu unit m" in out.read_bytes()[:1000].decode("latin-1")
    after = read_scene(out).gaussians
    factor = 1.2 / 2.1
    shift = torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(after.means, (before.means + shift) * factor)
    torch.testing.assert_close(after.scales, before.scales * factor)
    assert "does not end with a distance" in convert(plain, out, "--scale", "0,0,0 1,0,0 12 yards", code=2)


def test_scenes_are_joined_on_request(convert, plain, tmp_path):
    assert "add --merge" in convert(plain, plain, tmp_path / "out.ply", code=2)
    convert(plain, plain, tmp_path / "out.ply", "--merge")
    assert len(read_scene(tmp_path / "out.ply").gaussians) == 600


def test_a_page_gets_a_path_that_moves_with_the_scene(convert, tmp_path):
    """The file has the run's coordinates. The page has those of its scene relative to its origin, which moves along."""
    origin = (40000.0, 300.0, 7.0)
    folder, _, cameras = make_run(tmp_path / "run", origin)
    path = KeyframePath(tuple(map(Keyframe.of_camera, cameras[:3])), True, 4.0)
    write_path(tmp_path / "path.json", path, origin)
    for moves, at in (
        ([], origin),
        (["--transform", "scale=2", "--transform", "rotate=y:90"], (14.0, 600.0, -80000.0)),
    ):
        convert(folder.path, tmp_path / "a.html", "--path", tmp_path / "path.json", *moves)
        facts = json.loads(re.search(r'id="facts">(.*?)</script>', (tmp_path / "a.html").read_text())[1])
        np.testing.assert_allclose(facts["origin"], at, atol=1e-9)
        assert (facts["path"]["loop"], facts["path"]["duration"]) == (True, 4.0)
        eyes = np.array([camera["eye"] for camera in facts["cameras"]])
        for keyframe in facts["path"]["keyframes"]:
            here = facts["cameras"][np.linalg.norm(eyes - keyframe["position"], axis=1).argmin()]
            np.testing.assert_allclose(keyframe["position"], here["eye"], atol=1e-9)
            np.testing.assert_allclose(np.transpose(keyframe["rotation"]), here["R"], atol=1e-9)
    convert(folder.path, tmp_path / "a.html")
    assert '"path":null' in (tmp_path / "a.html").read_text()


def test_a_page_carries_a_mesh_that_moves_with_the_scene(convert, tmp_path):
    """The file has the capture's coordinates, the page those of its scene; the size of the page is printed."""
    origin = (512.0, -64.0, 8.0)
    folder, *_ = make_run(tmp_path / "run", origin)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = Mesh(corners + origin, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    write_mesh(tmp_path / "a.ply", mesh)
    out = tmp_path / "a.html"
    for moves, expected, at in (
        ([], corners, origin),
        (["--transform", "scale=2", "--transform", "move=1,0,0"], 2 * corners, (1025.0, -128.0, 16.0)),
    ):
        said = convert(folder.path, out, "--surface", tmp_path / "a.ply", *moves)
        assert f"mesh of 4 triangles; {out.stat().st_size:,} bytes" in said
        text = out.read_text()
        facts = json.loads(re.search(r'id="facts">(.*?)</script>', text)[1])
        assert facts["origin"] == list(at)
        assert facts["meshes"] == [
            {"name": "surface", "vertices": 4, "faces": 4, "coloring": "none", "image": 0}
        ]
        data = gzip.decompress(base64.b64decode(re.search(r'class="meshes">(.*?)</script>', text)[1]))
        np.testing.assert_allclose(np.frombuffer(data, "<f4", 12).reshape(4, 3), expected, atol=1e-6)
        assert (np.frombuffer(data, "<u4", 12, 48).reshape(4, 3) == mesh.faces).all()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["gone.ply", "out.ply"], "gone.ply: does not exist"),
        (
            ["IN", "out.obj"],
            "known are .compressed.ply, .ply, .splat, .ksplat, .spz, .sog, .glb, .usda, .usdc, .usdz, .rad, .csv,"
            " .las, .laz, .html,",
        ),
        (["IN", "."], "unknown scene format"),
        (["IN", "IN/out.ply"], "is a file; give a folder"),
        (["IN", "out.ply", "--crop", "1,2,3"], "is not 6 numbers"),
        (["IN", "out.ply", "--crop", "0,0,0,1,1,nan"], "is not 6 numbers"),
        (["IN", "out.ply", "--crop", "0,0,0,1,1,-1"], "must be below"),
        (["IN", "out.ply", "--crop", "90,90,90,91,91,91"], "no splat is left (300 before)"),
        (["IN", "out.ply", "--min-opacity", "2"], "--min-opacity: "),
        (["IN", "out.ply", "--sh-degree", "4"], "--sh-degree: "),
        (["IN", "out.ply", "--transform", "shear=2"], "'shear=2' cannot be read"),
        (["IN", "out.ply", "--transform", "scale=-1"], "mirrors"),
        (["IN", "out.ply", "--transform", "scale=0"], "singular"),
        (["IN", "out.ply", "--transform", "rotate=w:90"], "cannot be read"),
        (["IN", "out.ply", "--transform", "move=1,2"], "cannot be read"),
        (["IN", "out.ply", "--transform", "matrix=gone.txt"], "gone.txt"),
        (["IN", "out.laz", "--verify"], "--verify: out.laz is a point cloud"),
        (["IN", "out.glb", "--verify", "--backend", "abacus"], "abacus"),
        (
            ["IN", "out.ply", "--path", "IN"],
            "--path: only a page can play a camera path; out.ply is not a page, use .html",
        ),
        (["IN", "out.html", "--path", "IN"], "in.ply: is not JSON"),
        (["IN", "out.html", "--path", "gone.json"], "gone.json"),
        (
            ["IN", "out.spz", "--surface", "a.glb"],
            "--surface: only a page can show a mesh; out.spz is not a page, use .html",
        ),
        (["IN", "out.html", "--surface", "gone.glb"], "gone.glb"),
        (
            ["IN", "out.html", "--collider", "a.glb"],
            "--collider: is shown with a surface; add --surface FILE",
        ),
        (["IN", "out.html", "--surface", "IN.stl"], "unknown mesh format; known are .glb, .ply, .obj"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(convert, plain, tmp_path, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    assert says in convert(*(word.replace("IN", "in.ply") for word in words), code=2)
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


def test_a_scene_may_replace_itself(convert, plain):
    convert(plain, plain, "--sh-degree", 0)
    assert read_scene(plain).gaussians.sh_degree == 0


def test_levels_of_detail_are_written_verified_and_described(convert, tmp_path, capsys):
    write_scene(tmp_path / "in.ply", random_scene(300, 3))
    out = tmp_path / "scene-lod" / "lod-meta.json"
    said = convert(
        tmp_path / "in.ply", out, "--lod-smallest", 80, "--lod-leaf", 100, "--lod-chunk", 150, "--verify"
    )
    assert f"wrote {out}: 300 splats, SH degree 1" in said
    assert "levels of 300, 152, 76 splats; errors up to 0, 0." in said and "4 leaves, 5 files, " in said
    assert float(re.search(r"PSNR ([\d.]+) dB over 8 views", said)[1]) > 40
    size = sum(file.stat().st_size for file in out.parent.rglob("*.*"))
    assert f"{size:,} bytes" in said
    assert main(["info", str(out.parent)]) == 0
    told = capsys.readouterr().out
    assert "PlayCanvas streamed SOG" in told
    assert "3 of 300, 152, 76 splats, 4 leaves in 5 files; the finest one is described here" in told
    convert(out.parent, tmp_path / "again.ply")
    assert len(read_scene(tmp_path / "again.ply").gaussians) == 300


def test_options_of_levels_need_levels(convert, plain, tmp_path):
    said = convert(plain, tmp_path / "out.ply", "--lod-leaf", 5, code=2)
    assert "--lod-leaf:" in said and "has no levels of detail" in said
    assert "smallest: " in convert(plain, tmp_path / "lod-meta.json", "--lod-smallest", 0, code=2)


def test_tiles_are_written_and_verified(convert, plain, tmp_path):
    out = tmp_path / "tiles" / "tileset.json"
    said = convert(plain, out, "--lod-leaf", 100)
    assert "7 tiles, " in said
    assert "not placed on the globe: the scene does not say where on earth it is" in said
    assert "PSNR" in convert(plain, out, "--verify")
    assert "a tile is a file" in convert(plain, out, "--lod-chunk", 5, code=2)


def test_a_point_cloud_is_written_and_says_what_it_is_for(convert, tmp_path, capsys):
    folder, *_ = make_run(tmp_path / "run", origin=(5e6, 4e5, 0.0))
    out = tmp_path / "out.laz"
    said = convert(folder.path, out)
    assert f"wrote {out}: the centres of the splats as points" in said
    assert "coordinates are the scene's own" in said and "relative to the origin" not in said
    assert np.abs(np.median(read_points(out).points, axis=0) - (5e6, 4e5, 0.0)).max() < 10.0
    for words in (["info", out], ["convert", out, tmp_path / "a.ply"], ["view", out]):
        assert main(list(map(str, words))) == 2
        error = capsys.readouterr().err
        assert "out.laz: is a point cloud, not a scene; give it to a training as points" in error
        assert error.count("\n") == 1
