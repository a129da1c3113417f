"""`render --camera-model`: fisheyes, panoramas, orthographic views and floor plans, in files that say what they are."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

import gsplat_edu.cli.main as command_line
from far_run import BLUE, write_far_run
from gsplat_edu.cli.shot import median_depth
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.ply import load_ply
from gsplat_edu.paths.lenses import circle, fisheye, orthographic, panorama
from gsplat_edu.render import backends
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import scene_up


@pytest.fixture
def cli(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return command_line.main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_far_run(tmp_path_factory.mktemp("made"))


def pixels(path):
    return np.array(Image.open(path)).astype(float)


def size_of(path):
    return pixels(path).shape[1::-1]


def test_a_fisheye_is_drawn_from_the_runs_cameras_within_its_circle(made, cli, tmp_path, capsys):
    folder, _, bare, views = made
    words = [
        "--dataset",
        "--camera-model",
        "fisheye:12",
        "--size",
        "40",
        "--maps",
        "alpha,depth,planar-depth",
    ]
    assert cli(["render", str(folder.path), *words, "--out", "seen"]) == 0
    assert "6 images and their maps (alpha, depth, planar-depth)" in capsys.readouterr().out
    camera = fisheye(views[2].camera, 12, 40)
    direct = (
        render(load_ply(bare), camera, settings=RenderSettings(background=BLUE)).image.clamp(0, 1).numpy()
    )
    image = pixels(tmp_path / "seen" / "view_002.png")
    inside = circle(40)
    assert np.abs(direct[~inside] - BLUE).max() > 0.1, "without the circle, the corners would show the scene"
    assert np.abs(image - 255 * direct)[inside].max() < 2
    assert (image[~inside] == np.round(255 * np.array(BLUE))).all()
    for name in ("alpha", "depth", "planar-depth"):
        values = cv2.imread(str(tmp_path / "seen" / f"view_002.{name}.tiff"), cv2.IMREAD_UNCHANGED)
        assert np.isfinite(values).all() and (values[~inside] == 0).all() and (values[inside] > 0).any()


def test_panoramas_are_level_and_say_that_they_are_spheres(made, cli, tmp_path):
    folder, _, bare, views = made
    words = ["render", str(folder.path), "--camera-model", "equirectangular", "--size", "64"]
    assert cli([*words, "--dataset", "--out", "seen"]) == 0
    picture = Image.open(tmp_path / "seen" / "view_004.png")
    assert (
        picture.size == (64, 32)
        and 'GPano:ProjectionType="equirectangular"' in picture.text["XML:com.adobe.xmp"]
    )
    camera = panorama(views[4].camera, scene_up([view.camera for view in views]), 64)
    direct = (
        render(load_ply(bare), camera, settings=RenderSettings(background=BLUE)).image.clamp(0, 1).numpy()
    )
    assert np.abs(np.array(picture) - 255.0 * direct).max() < 2
    assert cli([*words, "--frames", "3"]) == 0
    path = folder.renders / "orbit.mp4"
    data = path.read_bytes()
    assert b"st3d" in data and data.index(b"sv3d") < data.index(b"mdat")
    video = cv2.VideoCapture(str(path))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (64, 32)
    assert [video.read()[0] for _ in range(4)] == [True] * 3 + [False]
    assert cli(["render", str(folder.path), "--camera-model", "fisheye", "--frames", "2"]) == 0
    assert b"st3d" not in path.read_bytes()


def test_the_default_width_of_a_panorama_is_a_multiple_of_four(made, cli, tmp_path):
    assert (
        cli(["render", str(made[0].path), "--camera-model", "equirectangular", "--dataset", "--out", "seen"])
        == 0
    )
    width = max(made[3][0].camera.W, made[3][0].camera.H) // 4 * 4
    assert size_of(tmp_path / "seen" / "view_000.png") == (width, width // 2)


def test_an_orthographic_path_is_drawn_with_parallel_rays(made, cli, tmp_path):
    folder, _, bare, views = made
    words = ["--dataset", "--camera-model", "orthographic", "--out", "o"]
    assert cli(["render", str(folder.path), *words]) == 0
    gaussians, first = load_ply(bare), views[0].camera
    names = [name for name, _, _ in folder.read_cameras(folder.read_config()["origin"])]
    depth = median_depth(gaussians, views[int(names[0].split("_")[1].split(".")[0])].camera)
    settings = RenderSettings(background=BLUE)
    direct = render(gaussians, orthographic(first, depth), settings=settings).image.clamp(0, 1).numpy()
    image = pixels(tmp_path / "o" / "view_000.png")
    assert image.shape == (first.H, first.W, 3) and np.abs(image - 255 * direct).max() < 2


def test_a_floor_plan_of_a_file_is_one_image_in_its_unit(made, cli, tmp_path, capsys):
    scene = read_scene(made[2])
    write_scene(tmp_path / "flat.ply", replace(scene, unit="m", up=(0.0, -1.0, 0.0)))
    words = [
        "render",
        "flat.ply",
        "--camera-model",
        "orthographic",
        "--size",
        "80",
        "--maps",
        "depth,normal,alpha",
    ]
    assert cli(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (
        lines[0].startswith("floor plan: ")
        and " px per m, " in lines[0]
        and " m with +z at the top" in lines[0]
    )
    assert lines[1].startswith("wrote out/flat_plan/: 1 images and their maps")
    scale, (width, height) = float(lines[0].split()[2]), (float(lines[0].split()[k]) for k in (6, 8))
    size = size_of(tmp_path / "out" / "flat_plan" / "plan.png")
    assert max(size) == 80
    assert size == pytest.approx((width * scale, height * scale), abs=0.1)
    depth, normal, alpha = (
        cv2.imread(str(tmp_path / "out" / "flat_plan" / f"plan.{name}.tiff"), cv2.IMREAD_UNCHANGED)
        for name in ("depth", "normal", "alpha")
    )
    assert alpha.max() > 0.5 and depth.shape == normal.shape[:2] == size[::-1]
    sure = alpha > 0.9
    assert (normal[..., 1][sure] <= 0).all(), "green, the second channel of three, is y: normals look up"


def test_a_floor_plan_of_a_run_may_be_cut(made, cli, capsys):
    folder = made[0]
    config = folder.read_config()
    assert cli(["render", str(folder.path), "--camera-model", "orthographic"]) == 0
    whole = capsys.readouterr().out
    assert " px per world unit, " in whole and "drawn up to" not in whole
    assert (folder.renders / "plan" / "plan.png").is_file()
    before = pixels(folder.renders / "plan" / "plan.png")
    high = float(whole.split("the scene is ")[1].split()[0])
    assert cli(["render", str(folder.path), "--camera-model", f"orthographic:{high / 2:g}"]) == 0
    assert f"drawn up to {high / 2:.4g}" in capsys.readouterr().out
    assert not np.array_equal(before, pixels(folder.renders / "plan" / "plan.png"))
    copy = RunFolder(folder.path)
    copy.write_config(config | {"scale": {"unit": "cm", "source": "a given distance", "detail": ""}})
    assert cli(["render", str(folder.path), "--camera-model", "orthographic"]) == 0
    assert " px per cm, " in capsys.readouterr().out
    copy.write_config(config)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("fish", "--camera-model: does not know 'fish'; use pinhole, fisheye, equirectangular, orthographic"),
        (
            "fisheye:",
            "--camera-model: 'fisheye:' has no degrees; write fisheye:N with a positive N of at most 340",
        ),
        ("fisheye:341", "'fisheye:341' has no degrees"),
        ("fisheye:nan", "'fisheye:nan' has no degrees"),
        ("orthographic:-1", "'orthographic:-1' has no height; write orthographic:N with a positive N"),
        ("orthographic:inf", "'orthographic:inf' has no height"),
        ("equirectangular:2", "equirectangular takes no number; leave out ':2'"),
        ("pinhole:2", "pinhole takes no number"),
        ("equirectangular --size 62", "--size: is 62, but an equirectangular image is twice as wide as high"),
        ("orthographic --maps planar-depth", "--maps: planar-depth needs rays from one point"),
        ("orthographic:2 --orbit", "--camera-model: a height is only for a plan"),
        ("orthographic --frames 3", "--frames: a plan is one image"),
        ("orthographic --out x.mp4", "--out: a plan is one image; give a folder instead of x.mp4"),
        ("fisheye --save-path x.json", "--save-path: renders nothing; remove --camera-model"),
    ],
)
def test_mistakes_are_one_line(made, cli, capsys, tmp_path, words, says):
    assert cli(["render", str(made[2]), "--camera-model", *words.split()]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and says in error
    assert list(tmp_path.iterdir()) == []


def test_a_backend_without_lenses_is_refused_by_name_and_not_chosen_by_auto(
    made, cli, capsys, tmp_path, monkeypatch
):
    words = [
        "render",
        str(made[2]),
        "--camera-model",
        "fisheye",
        "--frames",
        "1",
        "--size",
        "16",
        "--out",
        "f",
    ]
    cpu = backends.load_backend("cpu")
    lacking = replace(cpu, lacks=cpu.lacks | {"lens"}, name="other")
    monkeypatch.setattr("gsplat_edu.cli.render.load_backend", lambda name: lacking)
    assert cli([*words, "--backend", "cpu"]) == 2
    error = capsys.readouterr().err
    assert (
        error.count("\n") == 1
        and "--camera-model: fisheye needs a backend" in error
        and "use the backend cpu" in error
    )
    assert not (tmp_path / "f").exists()
    assert cli(words) == 0 and (tmp_path / "f" / "frame_0000.png").is_file()


def test_keyframes_are_drawn_through_a_lens(made, cli, tmp_path):
    assert cli(["render", str(made[2]), "--save-path", "p.json", "--keyframes", "3"]) == 0
    assert len(json.loads((tmp_path / "p.json").read_text())["keyframes"]) == 3
    words = ["--path", "p.json", "--frames", "2", "--size", "32", "--out", "k"]
    assert cli(["render", str(made[2]), "--camera-model", "equirectangular", *words]) == 0
    assert [size_of(p) for p in sorted((tmp_path / "k").iterdir())] == [(32, 16)] * 2
    assert cli(["render", str(made[2]), "--camera-model", "orthographic", *words]) == 0
    assert math.prod(size_of(tmp_path / "k" / "frame_0000.png")) == 32 * 32
