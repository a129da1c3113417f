"""`gsplat-edu render --path` and `--save-path`."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from PIL import Image

import gsplat_edu.cli.main as command_line
from far_run import BLUE, ORIGIN, write_far_run
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import load_ply, save_ply
from gsplat_edu.paths.curve import PathCurve
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath, read_path, write_path
from gsplat_edu.paths.orbits import orbit_of_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import file_settings

SETTINGS = RenderSettings(background=BLUE)


@pytest.fixture
def cli(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_far_run(tmp_path_factory.mktemp("made"))


@pytest.fixture
def path(made):
    """A path of two seconds through three of the views, near zero."""
    frames = (dataclasses.replace(Keyframe.of_camera(made[3][i].camera), time=float(i)) for i in range(3))
    return KeyframePath(tuple(frames), False)


def pixels(path):
    return np.array(Image.open(path)).astype(float)


def picture(scene, camera, settings=SETTINGS):
    image = render(load_ply(scene), camera, settings=settings).image
    return 255.0 * image.clamp(0, 1).numpy()


def test_a_run_is_rendered_along_a_path_in_the_captures_coordinates(made, path, cli, tmp_path, capsys):
    folder, _, _, views = made
    write_path(tmp_path / "path.json", path, ORIGIN)
    words = ["--path", "path.json", "--out", "frames", "--fps", "2"]
    assert cli(["render", str(folder.path), *words]) == 0
    assert "wrote frames/: 5 images of " in capsys.readouterr().out, "two seconds, including both ends"
    curve = PathCurve(path)
    first = views[0].camera
    for i, camera in enumerate(curve.cameras(5, first.W, first.H)):
        off = pixels(tmp_path / "frames" / f"frame_{i:04d}.png") - picture(folder.scene(30), camera)
        assert np.abs(off).max() <= 0.51
    np.testing.assert_allclose(curve.cameras(5, 8, 8)[2].eye, views[1].camera.eye, atol=1e-9)


def test_a_video_eases_and_rests_as_the_path_says(made, path, cli, tmp_path, capsys):
    _, _, bare, _ = made
    held = dataclasses.replace(path.keyframes[2], hold=1.0)
    eased = KeyframePath((*path.keyframes[:2], held), False, None, "views")
    write_path(tmp_path / "path.json", eased)
    assert (
        cli(["render", str(bare), "--path", "path.json", "--out", "frames", "--fps", "4", "--size", "40"])
        == 0
    )
    assert "wrote frames/: 13 images of " in capsys.readouterr().out, "two seconds and a rest of one"
    cameras = PathCurve(eased).cameras(13, 40, 40)
    assert all(np.array_equal(camera.eye, cameras[8].eye) for camera in cameras[8:])
    assert not np.allclose(cameras[1].eye, PathCurve(path).cameras(9, 40, 40)[1].eye)
    for i in (1, 6, 8, 12):
        found = pixels(tmp_path / "frames" / f"frame_{i:04d}.png")
        assert np.abs(found - picture(bare, cameras[i], file_settings(read_scene(bare)))).max() <= 0.51


def test_a_scene_file_becomes_a_square_video_and_maps_a_folder(made, path, cli, tmp_path, capsys):
    folder, _, bare, _ = made
    write_path(tmp_path / "path.json", path)
    assert cli(["render", str(bare), "--path", "path.json", "--frames", "3", "--size", "40"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("wrote out/bare_path.mp4: 3 images")
    video = cv2.VideoCapture("out/bare_path.mp4")
    assert [video.read()[0] for _ in range(4)] == [True] * 3 + [False]
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == video.get(cv2.CAP_PROP_FRAME_HEIGHT) == 40
    write_path(tmp_path / "path.json", path, ORIGIN)
    words = ["--path", "path.json", "--frames", "1", "--size", "20", "--maps", "depth"]
    assert cli(["render", str(folder.path), *words]) == 0
    names = {p.name for p in (folder.renders / "path").iterdir()}
    assert {"frame_0000.png", "frame_0000.depth.tiff"} <= names


@pytest.mark.parametrize("source", ["run", "capture"])
def test_the_cameras_become_keyframes(made, cli, tmp_path, capsys, source):
    folder, capture, bare, views = made
    at, dataset, origin = {
        "run": (folder.path, [], ORIGIN),
        "capture": (bare, [str(capture)], (0, 0, 0)),
    }[source]
    assert cli(["render", str(at), "--dataset", *dataset, "--save-path", "new/p.json"]) == 0
    assert capsys.readouterr().out == "wrote new/p.json: 6 keyframes, a path of 10 s\n"
    found = read_path(tmp_path / "new" / "p.json", origin)
    assert not found.loop and not found.timed
    for keyframe, view in zip(found.keyframes, views, strict=True):
        np.testing.assert_allclose(keyframe.eye, view.camera.eye, atol=1e-6)
        np.testing.assert_allclose(keyframe.R, view.camera.R, atol=1e-6)
    assert cli(["render", str(at), "--dataset", *dataset, "--save-path", "few.json", "--keyframes", "3"]) == 0
    few = read_path(tmp_path / "few.json", origin).keyframes
    for keyframe, i in zip(few, (0, 2, 5), strict=True):
        np.testing.assert_allclose(keyframe.eye, views[i].camera.eye, atol=1e-6)
    assert {p.name for p in tmp_path.iterdir()} == {"new", "few.json"}, "nothing was rendered"


def test_a_saved_orbit_is_rendered_as_the_orbit(made, cli, tmp_path, capsys):
    """The path meets the orbit at its keyframes, and the loop lasts as long as the orbit's video."""
    bare = made[2]
    words = ["--frames", "12", "--fps", "6", "--size", "40"]
    assert cli(["render", str(bare), "--save-path", "orbit.json", "--keyframes", "6", *words]) == 0
    assert "wrote orbit.json: 6 keyframes, a loop of 2 s" in capsys.readouterr().out
    assert cli(["render", str(bare), *words, "--out", "orbit"]) == 0
    assert cli(["render", str(bare), "--path", "orbit.json", *words[2:], "--out", "path"]) == 0
    assert len(list((tmp_path / "path").iterdir())) == 12
    cameras = PathCurve(read_path(tmp_path / "orbit.json")).cameras(12, 40, 40)
    scene = read_scene(bare)
    for i, orbiting in enumerate(orbit_of_scene(scene.gaussians, 12, 40)):
        # The keyframes are 60 degrees apart. Between them, the curve is off the circle by 3 h⁴ / 128, 3 % of the
        # radius; see
        # tests/paths/test_curve.py.
        atol = 1e-9 if i % 2 == 0 else 0.03 * np.linalg.norm(orbiting.eye)
        np.testing.assert_allclose(cameras[i].eye, orbiting.eye, atol=atol)
        off = pixels(tmp_path / "path" / f"frame_{i:04d}.png") - picture(
            bare, cameras[i], file_settings(scene)
        )
        assert np.abs(off).max() <= 0.51


def without(key):
    return json.dumps({"format": "gsplat_edu path", "version": 1, "loop": True, key: []})


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--path", "gone.json"], "gone.json"),
        (["--path", "."], "is a folder"),
        (["--path", "bad.json"], "bad.json: is not JSON"),
        (["--path", "less.json"], "less.json: duration: is [], but has to be a number"),
        (["--path", "few.json"], "few.json: keyframes: has 0, but a path needs at least 2 keyframes"),
        (["--path", "long.json"], "long.json: lasts 1e+06 s, which is 30,000,001 frames; give --frames"),
        (["--path", "p.json", "--orbit"], "--path: cannot be combined with --orbit; give one of them"),
        (["--path", "p.json", "--dataset"], "--path: cannot be combined with --dataset"),
        (["--path", "p.json", "--dataset", "x"], "--path: cannot be combined with --dataset"),
        (["--path", "p.json", "--save-path", "q.json"], "--path: cannot be combined with --save-path"),
        (["--save-path", "q.json", "--out", "x.mp4"], "--save-path: renders nothing; remove --out"),
        (["--save-path", "q.json", "--maps", "depth"], "--save-path: renders nothing; remove --maps"),
        (["--save-path", "q.json", "--keyframes", "1"], "--keyframes: is 1"),
        (["--save-path", "."], "--save-path: "),
        (["--keyframes", "5"], "--keyframes: is only for --save-path"),
        (["--path", "p.json", "--frames", "0"], "--frames: is 0"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(made, path, cli, capsys, tmp_path, words, says):
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "less.json").write_text(without("duration"))
    (tmp_path / "few.json").write_text(without("keyframes"))
    write_path(tmp_path / "p.json", path)
    far = dataclasses.replace(path.keyframes[1], time=1e6)
    write_path(tmp_path / "long.json", KeyframePath((path.keyframes[0], far), False))
    before = sorted(p.name for p in tmp_path.iterdir())
    assert cli(["render", str(made[2]), *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and says in error
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_one_camera_is_no_path(made, cli, capsys, tmp_path):
    folder, _, bare, views = made
    run = RunFolder(tmp_path / "run")
    run.write_config(folder.read_config() | {"origin": [0.0, 0.0, 0.0]})
    save_ply(run.scene(1), load_ply(bare))
    run.write_cameras(views[:1], [])
    assert cli(["render", str(run.path), "--dataset", "--save-path", "p.json"]) == 2
    assert "--save-path: there is 1 camera, but a path needs at least 2" in capsys.readouterr().err
