"""Scale and up from two marked points and from GPS, up to the scene."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.scale import Scale, read_scale, write_scale
from gsplat_edu.io.formats import read_scene
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.earth import Earth, geodetic
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.sfm.scale import Sight, in_given_world, placed
from gsplat_edu.sfm.scale_text import Mark, marks_of, points_of
from lab.captures.textured_box import align_cameras, box_orbit, photograph_box
from sfm.textured_box import LIMIT, cameras_of

A, B = np.array([-0.7, -1.0, -0.5]), np.array([0.7, -1.0, 0.5])
"""Two opposite corners of the top of the box, 1.720 units of its world apart."""

METRES = 2.5
"""Assumed length of one unit of the box's world, m."""


def marked(camera, point):
    """Return the pixel of a point in an upright photo, px from its left and upper edges, to a tenth of a pixel."""
    u, v, z = camera.project(camera.world_to_cam(point[None]))
    assert z[0] > 0 and 0 < u[0] < camera.W and 0 < v[0] < camera.H
    return f"{u[0] + 0.5:.1f},{v[0] + 0.5:.1f}"


def marks_in(truth, names, length):
    """Return the text of --scale with A and B marked in photos."""
    points = [";".join(f"{name}:{marked(truth[name], point)}" for name in names) for point in (A, B)]
    return f"{points[0]} {points[1]} {length}"


def test_marks_give_the_scale_end_to_end(done, tmp_path, capsys):
    """Marks in a landscape, in a portrait that EXIF rotates, and names with blanks give the distance to 0.5 %. The
    stages before the last one are reused, so this takes a second. The capture, the run and its scene have the scale,
    and `info` prints it.
    """
    names = list(done.truth)[:4]
    assert any(done.truth[name].W < done.truth[name].H for name in names)
    length = METRES * float(np.linalg.norm(A - B))
    said, capture, run = [], done.out, tmp_path / "run"
    options = SfmOptions(
        done.options.source,
        capture,
        max_features=LIMIT,
        threads=1,
        scale=marks_in(done.truth, names, f"{length:.4f}m"),
    )
    try:
        reconstruct(options, said.append)
        assert any(line.startswith("scale: 1 unit = 1 m, from a given distance (4.301") for line in said)
        move = align_cameras(
            cameras_of(capture), {name: at_scale(camera) for name, camera in done.truth.items()}
        )
        assert move.s == pytest.approx(1.0, abs=0.005)
        scale = read_scale(capture)
        assert scale.unit == "m" and scale.source == "a given distance"
        assert main(["info", str(capture)]) == 0
        assert "units      1 unit = 1 m, from a given distance" in capsys.readouterr().out
        brief = "--iterations 2 --strategy none --no-rescale --eval-every 0"
        assert main(["train", str(capture), "--out", str(run), *brief.split()]) == 0
        assert json.loads((run / "config.json").read_text())["scale"]["unit"] == "m"
        capsys.readouterr()
        assert main(["info", str(run)]) == 0
        assert "units      1 unit = 1 m, from a given distance" in capsys.readouterr().out
        assert main(["convert", str(run), str(tmp_path / "x.compressed.ply")]) == 0
        assert read_scene(tmp_path / "x.compressed.ply").unit == "m"
        # written files have the capture's coordinates, in metres
        eyes = np.array([one["position"] for one in json.loads((run / "cameras.json").read_text())])
        given = np.stack([camera.eye for camera in cameras_of(capture).values()])
        np.testing.assert_allclose(np.sort(eyes, axis=0), np.sort(given, axis=0), atol=1e-6)
    finally:
        reconstruct(done.options)  # other tests use this capture
    assert read_scale(capture) is None


def at_scale(camera):
    """Return a camera of the box's world in metres."""
    return Camera(
        camera.R, METRES * camera.eye, camera.fx, camera.fy, camera.cx, camera.cy, camera.H, camera.W
    )


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
def test_gps_gives_scale_and_up_end_to_end(tmp_path):
    """Photos with GPS, in a world that is tilted relative to the cameras' mean up, give scale to 0.5 % and up to a
    degree. EXIF has hundredths of arc seconds, 0.3 m. The box has 20 m per unit, so the positions spread over 80 m.
    """
    truth = {f"{i:02d}.jpg": camera for i, camera in enumerate(box_orbit(14))}
    metres, tilt = 20.0, np.radians(25.0)
    # world -> east, north, up, tilted about east, so that the cameras' mean up is wrong by 25 degrees
    level = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    ground = turn @ level
    (tmp_path / "photos").mkdir()
    for name, camera in truth.items():
        east, north, up = metres * ground @ camera.eye
        exif = Image.Exif()
        latitude, longitude = 48.0 + north / 111_194.0, 8.0 + east / 74_628.0
        exif.get_ifd(0x8825).update(
            {
                1: "N",
                2: sexagesimal(latitude),
                3: "E",
                4: sexagesimal(longitude),
                6: 300.0 + round(float(up), 2),
            }
        )
        Image.fromarray(photograph_box(camera)).save(tmp_path / "photos" / name, quality=95, exif=exif)
    said = []
    reconstruct(SfmOptions(tmp_path / "photos", tmp_path / "out", max_features=LIMIT, threads=1), said.append)
    (line,) = [line for line in said if line.startswith("scale: ")]
    assert re.search(r"1 unit = 1 m, from GPS \(1[234] of 14 positions agree", line)
    assert "up from GPS, +z is north" in line
    run = tmp_path / "run"
    brief = "--iterations 1 --strategy none --no-rescale --eval-every 0"
    assert main(["train", str(tmp_path / "out"), "--out", str(run), *brief.split()]) == 0
    scene = open_source(run).scene
    assert scene.up == (0.0, -1.0, 0.0) and scene.unit == "m"  # the cameras' mean up is 25 degrees off
    found = cameras_of(tmp_path / "out")
    for name, camera in found.items():
        latitude, longitude, height = geodetic(scene.earth.rows @ [*camera.eye, 1.0])
        east, north, up = metres * ground @ truth[name].eye
        np.testing.assert_allclose(
            [111_194.0 * (latitude - 48.0), 74_628.0 * (longitude - 8.0), height - 300.0],
            [north, east, up],
            atol=1.0,  # m; the seconds of the photos have two digits, 0.3 m
        )
    move = align_cameras(found, truth)  # from the capture to the box's world
    # One degree of latitude is 111.194 km on this ellipsoid, one of longitude 74.628 km, at most 0.05 % apart.
    assert 1 / move.s == pytest.approx(metres, rel=0.005)
    up = ground @ move.R @ [0.0, -1.0, 0.0]
    north = ground @ move.R @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up[2])) < 1.0 and np.degrees(np.arccos(north[1])) < 1.0

    said.clear()
    reconstruct(
        SfmOptions(tmp_path / "photos", tmp_path / "out", max_features=LIMIT, threads=1, scale="none"),
        said.append,
    )
    assert not any(line.startswith("scale:") for line in said) and read_scale(tmp_path / "out") is None


def sexagesimal(angle):
    degrees, minutes = int(angle), int(60 * (angle % 1))
    return float(degrees), float(minutes), round(3600 * (angle - degrees - minutes / 60), 2)


CAMERAS = [
    Camera(np.eye(3), np.array([x, 0.0, -4.0]), 100.0, 100.0, 79.5, 59.5, 120, 160)
    for x in (-1.0, 0.0, 1.0, 0.0001)
]
SIGHTS = [
    Sight(PhotoFacts(f"a/{i}.jpg", f"{i}", 160, 120), Lens(160, 120, 100.0, 100.0, 79.5, 59.5), c.R, c.eye)
    for i, c in enumerate(CAMERAS)
]
CLOUD = np.random.default_rng(0).uniform(-1, 1, (50, 3))


def pixel(number, point):
    u, v, _ = CAMERAS[number].project(CAMERAS[number].world_to_cam(np.array([point])))
    return f"{number}:{float(u[0]) + 0.5!r},{float(v[0]) + 0.5!r}"


def test_marks_are_triangulated_exactly():
    a, b = (0.3, 0.2, 0.1), (-0.2, 0.4, 0.8)
    marks = [";".join(pixel(number, point) for number in (0, 1, 2)) for point in (a, b)]
    move, scale = placed(CAMERAS, CLOUD, SIGHTS, f"{marks[0]} {marks[1]} 50cm", lambda line: None)
    assert move.s * np.linalg.norm(np.subtract(a, b)) == pytest.approx(50.0, rel=1e-6)
    assert scale.unit == "cm"
    arbitrary, none = placed(CAMERAS, CLOUD, SIGHTS, "none", print)
    assert none is None
    # the origin is the same point as before
    np.testing.assert_allclose(move.t / move.s, arbitrary.t / arbitrary.s, atol=1e-12)


def test_small_scenes_in_metres_are_warned_about():
    marks = [";".join(pixel(number, point) for number in (0, 2)) for point in ((0, 0, 0), (0.5, 0, 0))]
    said = []
    placed(CAMERAS, CLOUD, SIGHTS, f"{marks[0]} {marks[1]} 0.05m", said.append)
    assert "give the distance in cm, so that a unit is 1 cm" in said[0]
    placed(CAMERAS, CLOUD, SIGHTS, f"{marks[0]} {marks[1]} 50cm", said.append)
    assert len(said) == 1


@pytest.mark.parametrize(
    ("a", "complaint"),
    [
        ("1:80,60;3:80,60", "the rays to point A meet at 0.0 degrees"),
        ("0:105,60;2:55,20", "do not meet: in a/[02].jpg it is [0-9]+ px away from its mark"),
        ("0:30,60;2:130,60", "do not meet: in a/[02].jpg it is behind the camera"),
        ("0:80,60;9:80,60", "9: no photo of this name has a pose"),
        ("0:80,60;2:161,60", "2:161,60 lies outside of the photo, which is 160x120 upright"),
    ],
)
def test_marks_that_cannot_be_used_are_named(a, complaint):
    b = ";".join(pixel(number, (0.2, 0.1, 0.3)) for number in (0, 2))
    with pytest.raises(ArgumentError, match=f"--scale: .*{complaint}"):
        placed(CAMERAS, CLOUD, SIGHTS, f"{a} {b} 1m", print)


def test_the_same_name_in_two_folders_is_ambiguous():
    sights = [
        Sight(PhotoFacts(f"{folder}/0.jpg", "", 160, 120), SIGHTS[0].lens, np.eye(3), np.zeros(3))
        for folder in "ab"
    ]
    with pytest.raises(ArgumentError, match=r"--scale: 0\.jpg is the name of 2 photos; give its folder"):
        placed(CAMERAS, CLOUD, sights, "0.jpg:1,1;1.jpg:2,2 0.jpg:1,1;1.jpg:2,2 1m", print)


def test_texts_are_parsed():
    given = marks_of("walk 0 IMG.JPG:1,2.5;b/c d.png:-3,4e1 walk 0 IMG.JPG:5,6; x:7,8 120cm")
    assert given.a == (Mark("walk 0 IMG.JPG", 1, 2.5), Mark("b/c d.png", -3, 40))
    assert given.b == (Mark("walk 0 IMG.JPG", 5, 6), Mark("x", 7, 8)) and (given.length, given.unit) == (
        120,
        "cm",
    )
    given = points_of("-1,2,0.5 3,2,0.5 1.20m")
    assert (given.apart, given.length, given.unit) == (4.0, 1.2, "m")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1.2m",
        "a:1,2;b:3,4 1m",
        "a:1,2 b:3,4 1m",
        "a:1,2;b:3,4 a:1,2;b:3,4 1.2",
        "a:1,2;b:3,4 a:1,2;b:3,4 0m",
        "a:1,2;b:3,4 a:1;b:3,4 1m",
        "a:1,2;b:3,4 a:1,2;b:3,4 a:1,2;b:3,4 1m",
        "a:1,2;a:3,4 a:1,2;b:3,4 1m",
        "far",
    ],
)
def test_texts_that_cannot_be_read_end_in_one_line(text, tmp_path, capsys):
    assert main(["sfm", str(tmp_path), str(tmp_path / "out"), "--scale", text]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "--scale: " in line
    with pytest.raises(ArgumentError):
        points_of(text)


def test_a_scale_is_refused_if_poses_are_given(done, tmp_path, capsys):
    arguments = ["train", str(done.out), "--out", str(tmp_path / "run")]
    assert main([*arguments, "--scale", "none"]) == 2
    assert "--scale: has an effect only if DATA has no poses" in capsys.readouterr().err
    assert main([*arguments, "--panorama", "yes"]) == 2
    assert "--panorama: has an effect only if DATA has no poses" in capsys.readouterr().err


def test_the_place_on_earth_is_the_text_of_scene_files(tmp_path):
    scale = Scale("m", "GPS", "well", True, Earth.at_place(47.3769, 8.5417, 408.123))
    write_scale(tmp_path, scale)
    assert json.loads((tmp_path / "scale.json").read_text())["earth"] == str(scale.earth)
    assert read_scale(tmp_path) == Scale.parsed("", scale.json()) == scale
    write_scale(tmp_path, Scale("m", "GPS"))
    assert read_scale(tmp_path) == Scale("m", "GPS")


def test_a_damaged_scale_is_named(tmp_path):
    wrong = ("{", "[]", '{"unit": "m"}', '{"unit": 1, "source": "", "detail": ""}')
    elsewhere = ('"EPSG:4978 1 2"', '{"crs": "EPSG:4978", "matrix": []}')
    for text in (*wrong, *(f'{{"unit": "m", "source": "GPS", "earth": {place}}}' for place in elsewhere)):
        (tmp_path / "scale.json").write_text(text)
        with pytest.raises(DatasetError, match=r"scale\.json: is damaged"):
            read_scale(tmp_path)
    assert str(Scale("cm", "GPS")) == "1 unit = 1 cm, from GPS"
    assert re.match(r"1 unit = 1 m, from GPS \(well\)", str(Scale("m", "GPS", "well")))


def test_the_scale_of_a_dataset(done):
    assert load_dataset(done.out).scale is None


def test_given_poses_keep_their_world_and_marks_change_only_its_unit():
    a, b = (0.3, 0.2, 0.1), (-0.2, 0.4, 0.8)
    marks = [";".join(pixel(number, point) for number in (0, 1, 2)) for point in (a, b)]
    known = Scale("m", "GPS")
    for choice, scale in (("auto", known), ("none", None)):
        move, found = in_given_world(SIGHTS, choice, known)
        assert found == scale and move.s == 1.0 and not move.t.any() and np.array_equal(move.R, np.eye(3))
    move, found = in_given_world(SIGHTS, f"{marks[0]} {marks[1]} 50cm", known)
    assert move.s * np.linalg.norm(np.subtract(a, b)) == pytest.approx(50.0, rel=1e-6)
    assert found.unit == "cm" and not move.t.any() and np.array_equal(move.R, np.eye(3))
