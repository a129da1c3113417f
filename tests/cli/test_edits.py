"""`convert --edits`, `render --edits`, and the arguments of `view --edit`."""

import json

import numpy as np
import pytest
import torch

from gsplat_edu.cli.main import main
from gsplat_edu.cli.view import edits_file
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.runs.source import open_source
from gsplat_edu.viewer import page
from gsplat_edu.viewer.export import read_back
from scene_files import make_run, random_scene, suffixes

SUFFIXES = [*suffixes(), ".html"]
EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
BALL = {"op": "select", "how": "replace", "by": "sphere", "center": [0, 0, 0], "radius": 0.6}
DELETE = [BALL, {"op": "delete"}]
TILT = [
    {"op": "upright", "points": [[0, 0, 0], [1, 0.2, 0], [0, 0.1, 1]]},
    {"op": "scale", "points": [[0, 0, 0], [0, 2, 0]], "length": 50, "unit": "cm"},
]
VIEW = {"position": [0.0, 0.0, -3.0], "rotation": EYE, "fov": 60.0}


@pytest.fixture
def edits(tmp_path):
    """Write an edits file for a scene or run."""

    def make(path, *operations):
        source = open_source(path)
        scene = identity_of(source.scene).document()
        content = {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": operations}
        (tmp_path / "edits.json").write_text(json.dumps(content))
        return tmp_path / "edits.json"

    return make


@pytest.fixture
def run(capsys):
    def call(*words, code=0):
        try:
            assert main([*map(str, words)]) == code
        except SystemExit as stop:  # argparse exits by itself
            assert stop.code == code
        printed = capsys.readouterr()
        if code:
            assert printed.err.count("\n") == 1 and "Traceback" not in printed.err
        return printed.err if code else printed.out

    return call


@pytest.fixture
def plain(tmp_path):
    write_scene(tmp_path / "in.ply", random_scene(300))
    return tmp_path / "in.ply"


def outside(gaussians):
    """Return the splats that the operations DELETE keep."""
    stays = gaussians.means.double().pow(2).sum(dim=1) > 0.36
    assert 0 < int(stays.sum()) < len(gaussians)
    return gaussians.map(lambda tensor: tensor[stays])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_holds_the_remaining_splats(run, edits, plain, tmp_path, suffix):
    """The bytes are those of converting a scene that never had the deleted splats."""
    said = run("convert", plain, "--edits", edits(plain, *DELETE), tmp_path / f"out{suffix}")
    scene = read_scene(plain)
    left = outside(scene.gaussians)
    assert f"{len(left):,} splats" in said
    write_scene(tmp_path / "left.ply", type(scene)(left, scene.antialiased, scene.up))
    run("convert", tmp_path / "left.ply", tmp_path / "b" / f"out{suffix}")
    assert (tmp_path / f"out{suffix}").read_bytes() == (tmp_path / "b" / f"out{suffix}").read_bytes()


def test_no_operations_change_no_byte(run, edits, plain, tmp_path):
    run("convert", plain, "--edits", edits(plain), tmp_path / "a.spz")
    run("convert", plain, tmp_path / "b.spz")
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_edits_come_before_filters_and_transforms(run, edits, plain, tmp_path):
    words = ["--edits", edits(plain, *DELETE, *TILT), "--transform", "move=1,2,3", "--sh-degree", 1]
    run("convert", plain, *words, tmp_path / "at once.ply")
    run("convert", plain, *words[:2], tmp_path / "first.ply")
    run("convert", tmp_path / "first.ply", *words[2:], tmp_path / "after.ply")
    first, after = (read_scene(tmp_path / f"{name}.ply") for name in ("at once", "after"))
    assert first.gaussians.sh_degree == 1
    for name, tensor in first.gaussians.tensors().items():
        # the intermediate file rounds to float32 once more
        torch.testing.assert_close(tensor, after.gaussians.tensors()[name], rtol=1e-6, atol=1e-6)
    assert read_scene(tmp_path / "first.ply").unit == "cm"


def facts_of(path):
    return page.read_facts(path, path.read_bytes())


def test_a_page_opens_in_the_start_view_with_named_views_and_the_path(run, edits, tmp_path):
    """The run has an origin, and its scene is rotated and scaled; views, path and pivot move with the scene."""
    folder, *_ = make_run(tmp_path / "run", origin=(500.0, 0.0, -20.0))
    path = KeyframePath(
        (Keyframe(np.zeros(3), np.eye(3), 50.0), Keyframe(np.ones(3), np.eye(3), 50.0)), False
    )
    views = [
        {"op": "start", **VIEW, "pivot": [0.0, 1.0, 2.0]},
        {"op": "view", "name": "<b> & door", **VIEW},
        {"op": "path", "path": path.document()},
        {"op": "measure", "points": [[0, 0, 0], [0, 0, 4]], "note": "door"},
    ]
    run("convert", folder.path, "--edits", edits(folder.path, *views), tmp_path / "plain.html")
    said = run("convert", folder.path, "--edits", edits(folder.path, *views, *TILT), tmp_path / "tilted.html")
    assert "measured 100 cm: door" in said, "2 units are 50 cm, so 4 are 100 cm"
    before, after = facts_of(tmp_path / "plain.html"), facts_of(tmp_path / "tilted.html")
    assert before["origin"] == [500.0, 0.0, -20.0] and after["origin"] == [0.0, 0.0, 0.0]
    assert before["start"]["pivot"] == [0.0, 1.0, 2.0] and before["start"]["index"] == -1
    assert before["start"]["camera"]["eye"] == VIEW["position"] and before["path"] == path.document()
    assert after["cameras"][0]["name"] == "<b> & door"
    assert [entry.get("saved") for entry in after["cameras"]] == [True, *[None] * (len(after["cameras"]) - 1)]
    assert after["start"]["up"] == after["up"] == [0.0, -1.0, 0.0]
    R = np.array(after["start"]["camera"]["R"]).T  # the start view had the axes of the world
    normal = np.cross([1, 0.2, 0], [0, 0.1, 1])
    np.testing.assert_allclose(
        R @ normal / np.linalg.norm(normal), [0, -1 if normal[1] < 0 else 1, 0], atol=1e-9
    )
    s = 25.0
    for place in (
        lambda f: f["start"]["pivot"],
        lambda f: f["cameras"][0]["eye"],
        lambda f: f["cameras"][-1]["eye"],
    ):
        np.testing.assert_allclose(place(after), s * R @ place(before), atol=1e-9)
    np.testing.assert_allclose(after["path"]["keyframes"][1]["position"], s * R @ np.ones(3), atol=1e-9)


def test_a_page_without_edits_has_no_part_of_the_editor(run, plain, tmp_path):
    run("convert", plain, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text().lower()
    for word in ("startedit", "edithistory", "editing", "edit_", "#edit"):
        assert word not in text, word


def test_another_scene_and_an_empty_result_are_one_line(run, edits, plain, tmp_path):
    write_scene(tmp_path / "other.ply", random_scene(200))
    file, out = edits(plain, *DELETE), tmp_path / "out.ply"
    assert "was made for another scene (of 300 splats, this one has 200)" in run(
        "convert", tmp_path / "other.ply", "--edits", file, out, code=2
    )
    run("convert", tmp_path / "other.ply", "--edits", file, "--edits-anyway", out)
    expected = outside(read_scene(tmp_path / "other.ply").gaussians)
    assert torch.equal(read_scene(out).gaussians.means, expected.means)
    file = edits(plain, {"op": "select", "how": "replace", "by": "size", "high": 0}, {"op": "delete"})
    words = ["convert", tmp_path / "other.ply", "--edits", file, "--edits-anyway", tmp_path / "no.ply"]
    assert "selects by size" in run(*words, code=2)
    everything = edits(plain, {"op": "invert"}, {"op": "delete"})
    assert "leaves none of 300 splats" in run(
        "convert", plain, "--edits", everything, tmp_path / "no.ply", code=2
    )
    assert not (tmp_path / "no.ply").exists()
    assert "--edits: is for one scene" in run(
        "convert", plain, plain, out, "--merge", "--edits", file, code=2
    )
    assert "add --edits FILE" in run("convert", plain, "--edits-anyway", out, code=2)
    assert "none.json: no such file" in run("convert", plain, "--edits", tmp_path / "none.json", out, code=2)


def test_render_follows_the_path_of_the_edits(run, edits, plain, tmp_path):
    """The frames equal renders of the scene and path that convert writes."""
    path = {
        "format": "gsplat_edu path", "version": 1, "loop": False,
        "keyframes": [VIEW, {**VIEW, "position": [0.5, 0.0, -2.0]}],
    }  # fmt: skip
    file = edits(plain, *DELETE, {"op": "path", "path": path})
    words = ["--frames", 2, "--size", 40]
    run("render", plain, "--edits", file, *words, "--out", tmp_path / "a")
    run("convert", plain, "--edits", file, tmp_path / "left.ply")
    (tmp_path / "path.json").write_text(json.dumps(path))
    run("render", tmp_path / "left.ply", "--path", tmp_path / "path.json", *words, "--out", tmp_path / "b")
    names = sorted(image.name for image in (tmp_path / "a").iterdir())
    assert len(names) == 2
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    said = run("render", plain, "--edits", file, "--save-path", tmp_path / "p.json", code=2)
    assert "--edits: cannot be combined with --save-path" in said


def test_the_file_of_the_editor_is_beside_the_scene(tmp_path, plain):
    from gsplat_edu.cli.main import build_parser

    folder, *_ = make_run(tmp_path / "run")
    for words, file in (
        ([folder.path, "--edit"], folder.path / "edits.json"),
        ([plain, "--edit"], tmp_path / "in.ply.edits.json"),
        ([plain, "--edit", "x.json"], "x.json"),
    ):
        given = ["view", *map(str, words)]
        assert str(edits_file(build_parser(given).parse_args(given))) == str(file)


def test_sources_that_cannot_be_edited_are_refused_in_one_line(run, plain, tmp_path):
    (tmp_path / "bad.json").write_text('{"format": "gsplat_edu edits", "version": 7}')
    words = ["view", plain, "--port", 0, "--no-open", "--edit", tmp_path / "bad.json"]
    assert "bad.json: version: is 7, but 1 is supported" in run(*words, code=2)
    run("convert", plain, tmp_path / "levels" / "lod-meta.json", "--lod-smallest", 100)
    said = run("view", tmp_path / "levels", "--port", 0, "--no-open", "--edit", code=2)
    assert "--edit: levels of detail cannot be edited" in said


def test_a_page_of_edits_has_the_remaining_splats(run, edits, plain, tmp_path):
    run("convert", plain, "--edits", edits(plain, *DELETE, *TILT), tmp_path / "out.html")
    assert len(read_back(tmp_path / "out.html").gaussians) == len(outside(read_scene(plain).gaussians))
