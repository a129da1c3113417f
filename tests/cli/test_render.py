import json
import signal

import cv2
import numpy as np
import pytest
from PIL import Image

import gsplat_edu.cli.main as command_line
from far_run import BLUE, write_far_run
from gsplat_edu.io.ply import load_ply, save_ply
from gsplat_edu.render.api import render
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from processes import Program
from waiting import until


@pytest.fixture
def cli(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_far_run(tmp_path_factory.mktemp("made"))


def pixels(path):
    return np.array(Image.open(path))


def test_a_run_is_rendered_as_an_orbit_into_its_folder(made, cli, capsys):
    folder, *_ = made
    assert cli(["render", str(folder.path), "--frames", "3"]) == 0
    printed = capsys.readouterr().out
    path = folder.renders / "orbit.mp4"
    assert printed.splitlines()[-1].startswith(f"wrote {path}: 3 images of ") and "32x24" in printed
    assert printed.startswith("the cameras surround the scene: using a full circle\n")
    video = cv2.VideoCapture(str(path))
    frames = [video.read() for _ in range(4)]
    assert [read for read, _ in frames] == [True] * 3 + [False]
    assert frames[0][1][0, 0].argmax() == 0, "the background is blue, the first BGR channel"


def test_the_runs_cameras_render_the_same_images_as_in_training(made, cli, capsys, tmp_path):
    folder, _, bare, views = made
    assert cli(["render", str(folder.path), "--dataset", "--out", str(tmp_path / "seen")]) == 0
    assert f"wrote {tmp_path / 'seen'}/: 6 images" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "seen").iterdir()) == [f"view_{i:03d}.png" for i in range(6)]
    settings = RenderSettings(background=BLUE)
    for i in (0, 5):
        direct = render(load_ply(bare), views[i].camera, settings=settings).image.clamp(0, 1).numpy()
        # The scene was stored at coordinates near 512, where float32 steps are 6e-5 world units. That is less than
        # 0.01 px, over which a colour changes by less than one 8-bit step.
        difference = pixels(tmp_path / "seen" / f"view_{i:03d}.png") - 255.0 * direct
        assert np.abs(difference).max() < 2


def test_a_datasets_cameras_a_size_and_a_background_can_be_chosen(made, cli, tmp_path):
    _, capture, bare, _ = made
    words = [
        "render",
        str(bare),
        "--dataset",
        str(capture),
        "--size",
        "64",
        "--white-background",
        "--out",
        "big",
    ]
    assert cli(words) == 0
    image = pixels(tmp_path / "big" / "view_002.png")
    assert image.shape == (48, 64, 3) and (image[0, 0] == 255).all()


def test_an_orbit_of_a_scene_file_is_centred(made, cli, tmp_path, capsys):
    bare = made[2]
    assert cli(["render", str(bare), "--frames", "2", "--size", "40", "--out", "frames"]) == 0
    assert "has no cameras: using a full circle" in capsys.readouterr().out
    image = pixels(tmp_path / "frames" / "frame_0001.png").astype(int).sum(axis=2)
    assert image.shape == (40, 40) and image[15:25, 15:25].min() > 0
    assert cli(["render", str(bare), "--frames", "2", "--size", "40"]) == 0
    assert (tmp_path / "out" / "bare_orbit.mp4").is_file()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["gone"], "gone: does not exist; give a run folder or a scene file"),
        (["."], "is not a run (config.json is missing)"),
        (["BARE", "--dataset"], "--dataset: a scene file has no cameras"),
        (["BARE", "--frames", "0"], "--frames: is 0"),
        (["BARE", "--size", "0"], "--size: is 0"),
        (["BARE", "--fps", "-1"], "--fps: is -1"),
        (["BARE", "--backend", "abacus"], "backend 'abacus'"),
        (["BARE", "--dataset", "."], "is not a capture"),
        (
            ["BARE", "--out", "x.gif"],
            "x.gif: GIF is not supported; give a video (.mp4) or a folder of PNGs",
        ),
    ],
)
def test_mistakes_are_one_line(made, cli, capsys, tmp_path, arguments, says):
    words = [str(made[2]) if word == "BARE" else word for word in arguments]
    assert cli(["render", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and says in error
    assert list(tmp_path.iterdir()) == []


def test_cameras_on_one_side_get_no_full_circle(made, cli, capsys, tmp_path):
    """Only three of six cameras, 60 degrees apart, exist, so half of a full circle would show what no photo shows."""
    folder, _, bare, views = made
    run = RunFolder(tmp_path / "run")
    run.write_config(folder.read_config() | {"origin": [0.0, 0.0, 0.0]})
    save_ply(run.scene(1), load_ply(bare))
    run.write_cameras(views[:3], [])
    assert cli(["render", str(run.path), "--frames", "4", "--out", "frames"]) == 0
    assert "the cameras cover 1" in (said := capsys.readouterr().out), said
    assert "degrees: the path stays within them\n" in said


def test_help_shows_an_example(cli, capsys):
    with pytest.raises(SystemExit):
        cli(["render", "--help"])
    assert "example: gsplat-edu render " in capsys.readouterr().out


@pytest.mark.own_process
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_render_leaves_no_temporary_file(made, cli, tmp_path, number):
    """SIGTERM used to leave one. A file that SIGKILL leaves is removed by the next render."""
    folder, program = (
        tmp_path / "videos",
        "import sys; from gsplat_edu.cli.main import main; sys.exit(main())",
    )
    folder.mkdir()
    (folder / ".mine.original.mp4").write_text("a user's own hidden file")
    words = ["render", str(made[2]), "--size", "64", "--out", str(folder / "x.mp4")]
    rendering = Program(program, [*words, "--frames", "3000"], tmp_path)
    until(lambda: not rendering.runs or list(folder.glob(".x.*.mp4")))
    rendering.send(number)
    code, _, said = rendering.ended()
    left = {path.name for path in folder.iterdir()} - {".mine.original.mp4"}
    if number == signal.SIGKILL:
        assert code == -number and len(left) == 1
        assert cli([*words, "--frames", "2"]) == 0
        left = {path.name for path in folder.iterdir()} - {".mine.original.mp4", "x.mp4"}
    else:
        assert code == 130 and said.count("\n") == 1, said
    assert left == set()


def test_maps_are_written_beside_the_images(made, cli, capsys, tmp_path):
    """The TIFF has the values, the PNG has them scaled as maps.json says, and the preview is not uniform."""
    _, capture, bare, views = made
    words = [
        "--dataset",
        str(capture),
        "--out",
        str(tmp_path / "seen"),
        "--maps",
        "depth, normal,alpha,depth,distortion",
    ]
    assert cli(["render", str(bare), *words]) == 0
    assert "6 images and their maps (depth, normal, alpha, distortion) of " in capsys.readouterr().out
    listed = json.loads((tmp_path / "seen" / "maps.json").read_text())
    assert len(listed) == 24 and len(list((tmp_path / "seen").iterdir())) == 6 * (1 + 3 * 4) + 1
    settings = RenderSettings(background=BLUE)
    maps, _ = render_maps(
        load_ply(bare), views[2].camera, ["depth", "normal", "alpha", "distortion"], settings
    )
    for name, tensor in maps.items():
        stem, truth = tmp_path / "seen" / f"view_002.{name}", tensor.numpy()
        values = cv2.imread(f"{stem}.tiff", cv2.IMREAD_UNCHANGED)
        stored = cv2.imread(f"{stem}.png", cv2.IMREAD_UNCHANGED)
        assert values.dtype == np.float32 and stored.dtype == np.uint16
        if name == "normal":
            values, stored = values[..., ::-1], stored[..., ::-1]
        np.testing.assert_array_equal(values, truth)
        scale = listed[f"view_002.{name}.png"]
        # half a step, plus the float32 rounding of the product
        np.testing.assert_allclose(
            scale["scale"] * stored + scale["offset"], truth, rtol=0, atol=0.51 * scale["scale"]
        )
        shown = pixels(f"{stem}.preview.png")
        assert shown.shape == (24, 32, 3) and shown.std() > 10


def test_an_orbit_with_maps_is_a_folder(made, cli, tmp_path):
    _, _, bare, _ = made
    assert cli(["render", str(bare), "--maps", "median-depth", "--frames", "2", "--size", "20"]) == 0
    names = sorted(path.name for path in (tmp_path / "out" / "bare_orbit").iterdir())
    frame = [
        "frame_0000.median-depth.png",
        "frame_0000.median-depth.preview.png",
        "frame_0000.median-depth.tiff",
    ]
    assert names[:4] == [*frame, "frame_0000.png"] and "maps.json" in names


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--maps", "depth,height"], "--maps: does not know 'height'; use alpha, depth, expected-depth"),
        (["--maps", ""], "--maps: does not know ''; use alpha"),
        (["--maps", "depth", "--out", "x.mp4"], "--maps: x.mp4 is a video; give a folder with --out DIR"),
    ],
)
def test_maps_that_cannot_be_written_are_refused(made, cli, capsys, words, message):
    _, _, bare, _ = made
    assert cli(["render", str(bare), *words]) == 2
    assert message in capsys.readouterr().err
