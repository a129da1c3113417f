"""Fisheyes are recognised, mapped from their circle, and kept whole, with a lens that holds beyond 90 degrees."""

import math
import sqlite3
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.lens import FISHEYE, Lens
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.sfm.circle import Circle
from gsplat_edu.sfm.options import SfmOptions, lens_choice
from gsplat_edu.sfm.photos import copy_photos
from gsplat_edu.sfm.reconstruct import reconstruct
from gsplat_edu.sfm.wide_lenses import angle_of_radius, camera_groups, lens_lines, rim_line
from lab.captures.textured_box import align_cameras
from panorama_room import SHARPER, averaged, colours_of, walk

COUNT, W, H = 16, 360, 340
SEES = math.radians(95.0)
CIRCLE = Circle(185.0, 167.0, 165.0)
PROJECTION = Projection("fisheye", Distortion.of(k1=-0.02, k2=0.003))
FOCAL = CIRCLE.radius / (SEES * (1 - 0.02 * SEES**2 + 0.003 * SEES**4))
TURNED = (3, 8)
"""Photos that the camera took on its side, with EXIF's orientation."""


def photograph(camera):
    """Return a photo of the room, black beyond 95 degrees: averages of two by two rays per pixel."""
    dense = Camera.posed(camera.R, camera.eye, fine(camera)).through(PROJECTION)
    rays = dense.rays()
    own = rays @ camera.R.T
    angle = np.arctan2(np.hypot(own[..., 0], own[..., 1]), own[..., 2])
    return averaged(np.where((angle <= SEES)[..., None], colours_of(camera.eye, rays), 0.0))


def fine(camera):
    """Return the intrinsics of a camera with `SHARPER` times as many pixels along each axis."""
    given = Intrinsics(camera.W, camera.H, camera.fx, camera.fy, camera.cx, camera.cy)
    return given.scaled(SHARPER * camera.W, SHARPER * camera.H)


def heading(i):
    """Return the rotation of photo `i`: it looks to the right and left of +z in turn, and a little down."""
    yaw, pitch = 0.5 * math.sin(1.3 * i), 0.15
    c, s, q, r = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    turn = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return np.array([[1.0, 0.0, 0.0], [0.0, q, -r], [0.0, r, q]]) @ turn


@pytest.fixture(scope="module")
def round_photos(colmap, tmp_path_factory):
    """Ray-traced photos of 190 degrees with black corners and the capture that sfm makes of them."""
    folder = tmp_path_factory.mktemp("fisheyes")
    (folder / "photos").mkdir()
    truth = {}
    for i, eye in enumerate(walk(COUNT)):
        sensor = Camera(heading(i), eye, FOCAL, FOCAL, CIRCLE.x, CIRCLE.y, H, W).through(PROJECTION)
        name, exif, truth[f"f{i:02d}.jpg"] = f"f{i:02d}.jpg", Image.Exif(), sensor
        if i in TURNED:
            exif[0x0112] = 6  # a clockwise quarter turn brings it upright: right becomes down
            turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
            truth[name] = Camera(turn @ sensor.R, sensor.eye, FOCAL, FOCAL, 0, 0, W, H)
        Image.fromarray(photograph(sensor)).save(folder / "photos" / name, quality=95, exif=exif)
    said = []
    options = SfmOptions(folder / "photos", folder / "capture", max_features=2000, threads=1)
    reconstruct(options, said.append)
    return SimpleNamespace(folder=folder, capture=options.out, said=said, truth=truth, options=options)


@pytest.mark.slow
def test_poses_and_lens_are_found_beyond_ninety_degrees(round_photos):
    (line,) = [line for line in round_photos.said if "taken for" in line]
    assert line.startswith(
        "16 photos taken for circular fisheyes: their corners are black outside of a circle"
    )
    assert "180 degrees across it" in line and "beyond 80 degrees from the axis are left out" in line
    dataset = load_dataset(round_photos.capture, DataSettings(test_every=0, lens="native"))
    cameras = {view.name: view.camera for view in dataset.train}
    assert len(cameras) == COUNT
    found = align_cameras(cameras, round_photos.truth)
    assert found.moved.max() < 0.01 and found.turned.max() < 0.2, found
    camera = cameras["f00.jpg"]
    for degrees, limit in ((45, 0.3), (75, 0.3), (90, 0.7), (95, 1.2)):
        theta = np.array([math.radians(degrees)])
        ray = np.array([[math.sin(theta[0]), 0.0, math.cos(theta[0])]])
        radius = _radius(camera.projection, camera.fx, ray)
        assert radius == pytest.approx(_radius(PROJECTION, FOCAL, ray), abs=limit), degrees
    assert (camera.cx, camera.cy) == pytest.approx((CIRCLE.x, CIRCLE.y), abs=1.0)


def _radius(projection, focal, ray):
    camera = Camera(np.eye(3), np.zeros(3), focal, focal, 0.0, 0.0, H, W).through(projection)
    u, v, _ = camera.project(ray)
    return float(np.hypot(u[0], v[0]))


@pytest.mark.slow
def test_photos_are_copied_whole_and_masked_outside_of_the_circle(round_photos):
    for name in ("f00.jpg", "f05.jpg"):
        copied = (round_photos.capture / "images" / name).read_bytes()
        assert copied == (round_photos.folder / "photos" / name).read_bytes()
    with Image.open(round_photos.capture / "images" / "f03.jpg") as upright:
        assert upright.size == (H, W) and upright.getexif().get(0x0112, 1) == 1
    mask = np.asarray(Image.open(round_photos.capture / "masks" / "f00.jpg.png")) != 0
    inside = CIRCLE.inside(W, H)
    assert not (mask & ~inside).any()
    assert mask[CIRCLE.inside(W, H, 3.0)].all()
    turned = np.asarray(Image.open(round_photos.capture / "masks" / "f03.jpg.png")) != 0
    np.testing.assert_array_equal(turned, np.rot90(mask, -1))
    dataset = load_dataset(round_photos.capture, DataSettings(test_every=0, lens="native"))
    for view in dataset.train:
        assert view.read().mask.mean() == pytest.approx(mask.mean(), abs=0.01), view.name


@pytest.mark.slow
def test_the_rim_is_reported(round_photos):
    (line,) = {line for line in round_photos.said if line.startswith("the lens")}
    degrees = float(line.partition("sees ")[2].partition(" ")[0])
    assert degrees == pytest.approx(190, abs=4) and "--lens native uses all of it" in line


@pytest.mark.slow
def test_features_lie_within_eighty_degrees(round_photos):
    with sqlite3.connect(round_photos.capture / "sfm" / "database.db") as reader:
        rows = reader.execute("SELECT rows, cols, data FROM keypoints").fetchall()
    places = np.concatenate([np.frombuffer(d, np.float32).reshape(r, c)[:, :2] for r, c, d in rows])
    radii = np.hypot(places[:, 0] - 0.5 - CIRCLE.x, places[:, 1] - 0.5 - CIRCLE.y)
    assert 0.7 * CIRCLE.radius < radii.max() < 80 / 90 * CIRCLE.radius + 1.5


@pytest.mark.slow
def test_the_users_model_overrides(round_photos, tmp_path):
    """A pinhole's model makes no fisheyes; a fisheye's may name its field of view."""
    files = sorted((round_photos.folder / "photos").iterdir())
    photos, _ = copy_photos(files, files[0].parent, tmp_path / "photos", 1600)
    for choice, model, focal in (
        ("RADIAL", None, None),
        ("OPENCV_FISHEYE:200", "OPENCV_FISHEYE", CIRCLE.radius / math.radians(100)),
        ("auto", "SIMPLE_RADIAL_FISHEYE", CIRCLE.radius / math.radians(90)),
    ):
        (group,) = camera_groups(photos, tmp_path / "photos", 1600, choice)
        assert (group.lens.model if group.lens else None) == model
        assert focal is None or group.lens.focal == pytest.approx(focal, rel=0.01)


def test_wrong_choices_are_refused():
    assert lens_choice("OPENCV_FISHEYE:200") == ("OPENCV_FISHEYE", 200.0)
    for text, said in (("OPENCV:90", "has no field of view"), ("OPENCV_FISHEYE:x", "not a number"),
                       ("OPENCV_FISHEYE:20", "at least 60"), ("FOV", "camera_model")):  # fmt: skip
        with pytest.raises(ArgumentError, match=said):
            lens_choice(text)


@pytest.mark.slow
def test_round_photos_among_others_of_their_size_are_another_camera(round_photos, tmp_path):
    rng = np.random.default_rng(0)
    files = sorted((round_photos.folder / "photos").iterdir())[:3]
    for path in files:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for i in range(4):
        Image.fromarray(rng.integers(40, 255, (H, W, 3), dtype=np.uint8)).save(tmp_path / f"plain{i}.jpg")
    photos, _ = copy_photos(sorted(tmp_path.glob("*.jpg")), tmp_path, tmp_path / "c" / "photos", 1600)
    groups = camera_groups(photos, tmp_path / "c" / "photos", 1600)
    assert [(len(group.photos), group.lens is not None) for group in groups] == [(3, True), (4, False)]
    (line,) = lens_lines(groups)
    assert line.startswith("3 photos taken for circular fisheyes")


def test_exif_names_a_fisheye_that_fills_the_photo(tmp_path):
    """The focal length is EXIF's if it is known, else that of 180 degrees across the diagonal."""
    rng = np.random.default_rng(0)
    for name, focal in (("a.jpg", 16), ("b.jpg", None)):
        exif = Image.Exif()
        details = exif.get_ifd(0x8769)
        details[0xA434] = "EF8-15mm f/4L FISHEYE USM"
        if focal:
            details[0xA405] = focal
        pixels = rng.integers(0, 256, (200, 300, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / name, exif=exif)
    photos, _ = copy_photos(
        [tmp_path / "a.jpg", tmp_path / "b.jpg"], tmp_path, tmp_path / "c" / "photos", 150
    )
    known, unknown = camera_groups(photos, tmp_path / "c" / "photos", 150)
    diagonal = math.hypot(150, 100)
    assert known.lens.circle is None and known.lens.focal == pytest.approx(16 / math.hypot(36, 24) * diagonal)
    assert unknown.lens.focal == pytest.approx(diagonal / math.pi)
    assert "EXIF names the lens so; the lens starts from the focal length in EXIF" in known.why
    plain = [replace(photo, fisheye=False) for photo in photos]
    assert all(group.lens is None for group in camera_groups(plain, tmp_path / "c" / "photos", 150))


def test_a_polynomial_that_turns_back_is_reported():
    """theta - 0.2 theta^3 turns back at 1.29 radians, where its radius is 0.86 focal lengths."""
    lens = Lens(400, 400, 120.0, 120.0, 199.5, 199.5, (-0.2,), FISHEYE)
    turn = 120.0 * (math.sqrt(1 / 0.6) * (1 - 0.2 / 0.6))
    assert angle_of_radius(lens, turn + 0.5) is None and angle_of_radius(lens, turn - 0.5) is not None
    line = rim_line(lens, Circle(199.5, 199.5, 190.0))
    assert f"turns back {turn:.0f} px from its middle, before the rim at 190 px" in line
    straight = replace(lens, coefficients=())
    assert angle_of_radius(straight, 120.0 * math.radians(100)) == pytest.approx(100.0)
    assert "the lens sees 181 degrees across" in rim_line(straight, Circle(199.5, 199.5, 190.0))
