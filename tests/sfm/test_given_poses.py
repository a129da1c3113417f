"""A search starts from the poses that are there, completes them, and keeps their coordinates."""

import json
import shutil
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.capture import Frame
from gsplat_edu.data.colmap import read_cameras
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_model
from gsplat_edu.options.sfm import options_from
from gsplat_edu.photos.decoding import TURNS
from gsplat_edu.sfm.given import GivenPoses, colmap_camera, find_given, leave_unused, quarter_turns, turned
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box
from sfm.textured_box import LIMIT, MOVED, TURNED, cameras_of, check

COUNT, POSED = 16, 10

MISPLACED = 4, 12
"""A photo that is given the pose of another one."""

WORLD = Rotation.from_euler("xyz", (0.4, -1.1, 2.0)).as_matrix(), 3.0, np.array([1000.0, -50.0, 20.0])
"""The given coordinates: x' = s R x + t of the box's."""

EXTENT = 3.6
"""Extent of the cameras, units of the box."""

OFF = 0.02, 0.2
"""Standard deviations of the given poses: of a centre's coordinates, units of the box, and of a turn, degrees."""


def moved(camera):
    """Move a camera into the given coordinates."""
    R, s, t = WORLD
    return replace(camera, R=camera.R @ R.T, eye=s * R @ camera.eye + t)


def disturbed(camera, rng):
    """Disturb a pose by `OFF`."""
    turn = Rotation.from_rotvec(np.radians(OFF[1]) * rng.normal(size=3)).as_matrix()
    return replace(camera, R=turn @ camera.R, eye=camera.eye + OFF[0] * rng.normal(size=3))


def with_poses(folder, photos, poses):
    """Copy the photos, unless they are there, and write the model of given poses."""
    shutil.copytree(photos.folder / "images", folder / "images", dirs_exist_ok=True)
    write_model(folder, poses, np.zeros((1, 3)), np.zeros((1, 3)))


@pytest.fixture(scope="session")
def photos(tmp_path_factory):
    """Photos around the box, and their true cameras in the given coordinates."""
    folder, cameras = tmp_path_factory.mktemp("given") / "capture", box_orbit(COUNT)
    (folder / "images").mkdir(parents=True)
    for number, camera in enumerate(cameras):
        Image.fromarray(photograph_box(camera)).save(folder / "images" / f"{number:02d}.jpg", quality=95)
    truth = {f"{number:02d}.jpg": moved(camera) for number, camera in enumerate(cameras)}
    return SimpleNamespace(folder=folder, cameras=cameras, truth=truth)


@pytest.fixture(scope="session")
def completed(colmap, photos, tmp_path_factory):
    """The capture made from slightly wrong poses of some photos, and one that is another photo's."""
    rng = np.random.default_rng(0)
    whose = [MISPLACED[1] if number == MISPLACED[0] else number for number in range(POSED)]
    given = [(f"{n:02d}.jpg", moved(disturbed(photos.cameras[k], rng))) for n, k in enumerate(whose)]
    folder, out, said = tmp_path_factory.mktemp("posed"), tmp_path_factory.mktemp("completed") / "out", []
    with_poses(folder, photos, given)
    reconstruct(SfmOptions(folder, out, max_features=LIMIT), said.append)
    return SimpleNamespace(folder=folder, out=out, said=said, given=dict(given))


@pytest.mark.slow
def test_all_photos_are_placed_in_the_given_coordinates(completed, photos):
    found = cameras_of(completed.out)
    assert sorted(found) == sorted(photos.truth)
    check(found, photos.truth)  # their relative poses, which the given ones miss by more
    # The coordinates are fitted to the right poses: seven numbers to POSED - 1 of them, each three coordinates. Twice
    # the expected error is allowed, in addition to that of the search.
    away = MOVED * EXTENT + 2 * OFF[0] * np.sqrt(3 * 7 / (POSED - 1))
    angle = TURNED + 2 * OFF[1] * np.sqrt(3 / (POSED - 1))
    for name, camera in found.items():
        true = photos.truth[name]
        assert np.linalg.norm(camera.eye - true.eye) / WORLD[1] < away, name
        assert np.degrees(Rotation.from_matrix(camera.R @ true.R.T).magnitude()) < angle, name
    assert len(CaptureReader(completed.out).capture.cloud.points) > 500


@pytest.mark.slow
def test_the_run_says_whose_poses_it_starts_from_and_how_many_photos_it_added(completed):
    assert (
        completed.said[0] == "starting from the poses of COLMAP: 10 of 16 photos (--poses none ignores them)"
    )
    (line,) = [line for line in completed.said if line.startswith("mapping: ")]
    assert line.startswith("mapping: 16 of 16 photos have a pose (given poses, ")
    assert "6 more than those of COLMAP" in line


@pytest.mark.slow
def test_it_resumes_until_the_poses_change(completed, photos, tmp_path):
    folder, out = tmp_path / "capture", tmp_path / "out"
    shutil.copytree(completed.folder, folder)
    shutil.copytree(completed.out, out)
    said = []
    reconstruct(SfmOptions(folder, out, max_features=LIMIT), said.append)
    assert all(line.endswith("(done before)") for line in said[1:]), said
    with_poses(folder, photos, [(name, photos.truth[name]) for name in completed.given])
    reconstruct(SfmOptions(folder, out, max_features=LIMIT), said.append)
    assert "mapping: poses changed; repeating this stage and the later ones" in said


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
def test_poses_that_disagree_with_the_photos_are_not_used(photos, tmp_path):
    folder, said = tmp_path / "capture", []
    order = np.random.default_rng(1).permutation(COUNT)
    with_poses(folder, photos, [(f"{n:02d}.jpg", photos.truth[f"{order[n]:02d}.jpg"]) for n in range(COUNT)])
    reconstruct(SfmOptions(folder, tmp_path / "out", max_features=LIMIT), said.append)
    assert any("do not agree with the photos" in line and "searching without them" in line for line in said)
    found = cameras_of(tmp_path / "out")
    check(found, photos.truth)
    assert np.linalg.norm(np.mean([camera.eye for camera in found.values()], axis=0)) < 10, (
        "the origin is the search's own"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("colmap")
def test_poses_that_few_points_support_stay_as_they_are(photos, tmp_path):
    folder, said = tmp_path / "capture", []
    given = {f"{number:02d}.jpg": photos.truth[f"{number:02d}.jpg"] for number in range(12)}
    with_poses(folder, photos, list(given.items()))
    with suppress(DatasetError):  # fewer than COMPLETE of the photos: the capture is kept
        reconstruct(SfmOptions(folder, tmp_path / "out", max_features=100), said.append)
    assert "the photos match too little to refine the poses of COLMAP, which stay as they are" in said, said
    found = cameras_of(tmp_path / "out")
    assert set(given) <= set(found)
    for name, camera in given.items():
        assert np.allclose(found[name].eye, camera.eye, atol=1e-6), name
        assert np.allclose(found[name].R, camera.R, atol=1e-6), name


def given_of(folder, poses="auto"):
    """Return what `find_given` returns, and what it says."""
    said = []
    return find_given(folder, poses, sorted((folder / "images").iterdir()), said.append), said


def test_misread_poses_are_read_as_the_photos_show(photos, tmp_path):
    folder = tmp_path / "capture"
    shutil.copytree(photos.folder / "images", folder / "images")
    frames = []
    for name, camera in photos.truth.items():
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.R.T, camera.eye  # OpenCV axes, where the format has OpenGL's
        size = {"w": camera.W, "h": camera.H, "fl_x": camera.fx, "fl_y": camera.fy}
        middle = {"cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist(), **size, **middle})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    given, _ = given_of(folder)
    said = []
    proven = given.proven(said.append)
    assert len(said) == 1 and "only if" in said[0]
    eyes = np.stack([proven.frames[name].eye for name in photos.truth])
    true = np.stack([camera.eye for camera in photos.truth.values()])
    apart, really = (np.linalg.norm(e[:, None] - e[None], axis=2) for e in (eyes, true))
    assert np.allclose(apart, really)
    turns = [proven.frames[name].R @ proven.frames["00.jpg"].R.T for name in photos.truth]
    wanted = [camera.R @ photos.truth["00.jpg"].R.T for camera in photos.truth.values()]
    assert np.allclose(turns, wanted)


def test_a_folder_without_poses_and_none_start_from_nothing(photos, tmp_path):
    shutil.copytree(photos.folder / "images", tmp_path / "images")
    assert given_of(tmp_path) == (None, [])
    with_poses(tmp_path, photos, list(photos.truth.items()))
    assert given_of(tmp_path, "none") == (None, [])
    given, said = given_of(tmp_path)
    assert len(given.frames) == COUNT and len(said) == 1


def test_unusable_poses_are_named_and_are_an_error_if_chosen(photos, tmp_path):
    with_poses(tmp_path, photos, [("00.jpg", photos.truth["00.jpg"])])
    assert given_of(tmp_path) == (
        None,
        ["not starting from the poses of COLMAP: 1 of 16 photos have a usable one"],
    )
    (tmp_path / "reconstruction.json").write_text("[{")
    shutil.rmtree(tmp_path / "sparse")
    given, said = given_of(tmp_path)
    assert given is None and len(said) == 1
    assert (
        said[0].startswith("not starting from the poses that are there: ")
        and "reconstruction.json" in said[0]
    )
    with pytest.raises(DatasetError, match=r"reconstruction\.json"):
        given_of(tmp_path, tmp_path / "reconstruction.json")


def test_the_option_chooses_a_file_or_none(photos, tmp_path, capsys):
    def poses(*words):
        words = ["sfm", str(folder), str(tmp_path / "out"), *words]
        return options_from(build_parser(["sfm"]).parse_args(words)).poses

    folder = tmp_path / "capture"
    with_poses(folder, photos, [("00.jpg", photos.truth["00.jpg"])])
    (folder / "transforms.json").write_text("{}")
    assert (poses(), poses("--poses", "none")) == ("auto", "none")
    assert poses("--poses", "transforms.json") == folder / "transforms.json"
    assert main(["sfm", str(folder), str(tmp_path / "out"), "--poses", "other.xml"]) == 2
    assert "--poses: other.xml is no file in" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


BENT = Lens(320, 240, 300.0, 310.0, 150.0, 125.0, (0.1, -0.02, 0.003, -0.004))


@pytest.mark.parametrize("turns", range(-1, 4))
def test_a_turned_lens_sends_turned_rays_to_turned_pixels(turns):
    columns, rows = np.meshgrid(np.linspace(5, 310, 5), np.linspace(5, 230, 4))
    columns, rows, other, W, H = columns.ravel(), rows.ravel(), turned(BENT, turns), 320, 240
    x, y = BENT.rays(columns, rows)
    for _ in range(turns % 4):
        columns, rows, x, y, W, H = H - 1 - rows, columns, -y, x, H, W
    assert (other.W, other.H) == (W, H)
    assert np.allclose(other.rays(columns, rows), [x, y], atol=1e-6)


@pytest.mark.parametrize(("stored", "sensor"), [(6, 1), (1, 8), (3, 1), (1, 1), (2, 2), (7, 2)])
def test_the_pose_of_an_upright_photo_becomes_that_of_its_copy(tmp_path, stored, sensor):
    upright = box_orbit(3)[1]
    frame = Frame(
        "a.jpg", tmp_path / "a.jpg", lens_of_camera(upright), upright.R, upright.eye, orientation=stored
    )
    turns = (TURNS[stored] - TURNS[sensor]) % 4
    size = (240, 320) if turns % 2 else (320, 240)
    photo = PhotoFacts("a.jpg", "000000.jpg", *size, sensor=sensor)
    assert quarter_turns(frame, photo) == turns
    model = GivenPoses(CaptureReader(tmp_path), {"a.jpg": frame}).model(
        [photo], [{"names": ["000000.jpg"]}], 160
    )
    (camera,), (view,) = model["cameras"], model["views"]
    assert (camera["W"], camera["H"]) == tuple(side // 2 for side in size)
    point = np.array([0.3, -0.6, 0.2])
    u, v, _ = upright.project(upright.world_to_cam(point[None]))
    place, (W, H) = (u[0], v[0]), (320, 240)
    for _ in range(-turns % 4):
        place, W, H = (H - 1 - place[1], place[0]), H, W
    x, y, z = np.array(view["rotation"]) @ (point - np.array(view["eye"]))
    f, cx, cy, _ = camera["params"]
    expected = (np.array(place) + 0.5) / 2
    assert np.allclose([f * x / z + cx, f * y / z + cy], expected)


def test_a_mirrored_photo_with_a_pose_of_the_picture_as_stored_gets_none(tmp_path):
    frame = Frame("a.jpg", tmp_path / "a.jpg", BENT, np.eye(3), np.zeros(3))
    assert quarter_turns(frame, PhotoFacts("a.jpg", "000000.jpg", 320, 240, sensor=2)) is None


def lens_of_camera(camera):
    return Lens(camera.W, camera.H, camera.fx, camera.fy, camera.cx, camera.cy)


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        (Lens(320, 240, 300.0, 300.0, 150.0, 125.0), "SIMPLE_RADIAL"),
        (Lens(320, 240, 300.0, 300.0, 150.0, 125.0, (0.1, 0.01)), "RADIAL"),
        (Lens(320, 240, 300.0, 310.0, 150.0, 125.0), "OPENCV"),
        (BENT, "OPENCV"),
        (Lens(320, 240, 300.0, 300.0, 150.0, 125.0, (0.1, 0.0, 0.0, 0.0, 0.01)), "FULL_OPENCV"),
        (Lens(320, 240, 300.0, 300.0, 150.0, 125.0, (0.1,), "fisheye"), "SIMPLE_RADIAL_FISHEYE"),
        (Lens(320, 240, 300.0, 310.0, 150.0, 125.0, (0.1, 0.0, 0.2), "fisheye"), "OPENCV_FISHEYE"),
    ],
)
def test_a_lens_becomes_the_simplest_model_that_has_it(lens, model, tmp_path):
    name, params = colmap_camera(lens)
    assert name == model
    path = tmp_path / "cameras.txt"
    path.write_text(f"1 {name} 320 240 {' '.join(map(repr, params))}\n")
    read = read_cameras(path)[1]
    columns, rows = np.linspace(5, 310, 5), np.linspace(5, 230, 5)
    assert np.allclose(read.rays(columns, rows), lens.rays(columns, rows))


def test_photos_without_a_pose_get_the_usual_lens_of_their_camera(tmp_path):
    frames = {
        name: Frame(name, tmp_path / name, Lens(320, 240, f, f, 159.5, 119.5), np.eye(3), np.zeros(3))
        for name, f in (("a", 300.0), ("b", 320.0), ("c", 340.0), ("d", 320.0))
    }
    photos = [PhotoFacts(name, f"{name}.jpg", 320, 240) for name in "abcdef"]
    groups = [{"names": [f"{name}.jpg" for name in "abcde"]}, {"names": ["f.jpg"]}]
    model = GivenPoses(CaptureReader(tmp_path), frames).model(photos, groups, 1600)
    focal = {name: model["cameras"][camera]["params"][0] for name, camera in model["lens_of"].items()}
    assert focal == {"a.jpg": 300.0, "b.jpg": 320.0, "c.jpg": 340.0, "d.jpg": 320.0, "e.jpg": 320.0}
    assert [view["name"] for view in model["views"]] == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def test_the_digest_follows_every_number(photos, tmp_path):
    def digest(**changed):
        frame = Frame("a.jpg", tmp_path / "a.jpg", BENT, np.eye(3), np.zeros(3))
        return GivenPoses(CaptureReader(tmp_path), {"a.jpg": replace(frame, **changed)}).digest()

    with_poses(tmp_path, photos, [("00.jpg", photos.truth["00.jpg"])])
    same, nudged = digest(), np.array([0.0, 0.0, 1e-12])
    assert digest() == same
    others = {digest(eye=nudged), digest(lens=replace(BENT, fx=300.1)), digest(orientation=6)}
    assert len(others | {same}) == 4


def test_poses_of_panoramas_are_left_unused_and_that_is_said(photos, tmp_path):
    with_poses(tmp_path / "in", photos, list(photos.truth.items()))
    said = []
    leave_unused(tmp_path / "in", "auto", said.append)
    leave_unused(tmp_path / "in", "none", said.append)
    assert said == [
        "not starting from the poses of COLMAP: a search for the poses of panoramas starts from none"
    ]
    with pytest.raises(DatasetError, match="omit --poses"):
        leave_unused(tmp_path / "in", tmp_path / "in" / "cameras.xml", said.append)
