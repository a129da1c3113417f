"""360-degree panoramas are recognised, cut, mapped as a rig, and trained like pinhole photos."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.colmap import read_images
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.depths import DepthSource, judged_depths
from gsplat_edu.data.panorama import FACES, face_pinhole, face_rotations
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.io.formats import read_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.views import View
from gsplat_edu.sfm.panoramas import are_panoramas, cut_panoramas
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import align_cameras
from panorama_room import held_out, panorama, photo, walk
from sfm.engine_check import printed

COUNT, WIDTH, TURN = 7, 512, 0.3
SIDE = 163

SETTINGS = RenderSettings(jacobian_limit=1.3)
"""As in training."""

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


def face_cameras(side=SIDE):
    """Return the true camera of every face, by the name that it gets."""
    found = {}
    for i, eye in enumerate(walk(COUNT)):
        c, s = np.cos(TURN * i), np.sin(TURN * i)
        heading = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        for number, R in enumerate(face_rotations()):
            found[f"p{i}_{number}.jpg"] = Camera.posed(R @ heading, eye, face_pinhole(side))
    return found


@pytest.fixture(scope="module")
def room(colmap, tmp_path_factory):
    """The capture made from panoramas that XMP declares as such."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "photos" / "masks").mkdir(parents=True)
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[WIDTH * 5 // 12 :] = 0  # masks exclude more than 60 degrees below the horizon, such as a tripod
    for i, eye in enumerate(walk(COUNT)):
        Image.fromarray(mask).save(folder / "photos" / "masks" / f"p{i}.png")
        picture = Image.fromarray(panorama(eye, TURN * i, WIDTH))
        picture.save(folder / "photos" / f"p{i}.jpg", quality=95, subsampling=0, xmp=XMP)
    said = []
    reconstruct(SfmOptions(folder / "photos", folder / "capture", max_features=500, threads=1), said.append)
    return SimpleNamespace(folder=folder, capture=folder / "capture", said=said)


@pytest.mark.slow
def test_panoramas_become_faces_with_one_centre_each(room):
    """All faces get poses, those of one panorama share a centre, and both agree with the truth."""
    assert any("7 panoramas cut into 8 faces each of 163x163 px" in line for line in room.said)
    assert not any("not used" in line for line in room.said)
    assert any(
        "7 of 7 panoramas have a pose (incremental mapper, a rig of 8 faces)" in line for line in room.said
    )
    dataset = load_dataset(room.capture, DataSettings(test_every=0))
    cameras, truth = {view.name: view.camera for view in dataset.train}, face_cameras()
    assert cameras.keys() == truth.keys()
    for i in range(COUNT):
        eyes = np.stack([cameras[f"p{i}_{face}.jpg"].eye for face in range(FACES)])
        assert np.abs(eyes - eyes[0]).max() < 1e-9
    found = align_cameras(cameras, truth)
    assert found.moved.max() < 0.005 and found.turned.max() < 0.1
    for name, camera in cameras.items():
        assert (camera.W, camera.H) == (SIDE, SIDE)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (
            SIDE / 2,
            SIDE / 2,
            (SIDE - 1) / 2,
            (SIDE - 1) / 2,
        ), name


@pytest.mark.slow
def test_masks_of_panoramas_become_masks_of_faces(room):
    """A pixel of a face counts if its ray is less than 60 degrees below the horizon."""
    views = {view.name: view for view in load_dataset(room.capture, DataSettings(test_every=0)).train}
    for number, R in enumerate(face_rotations()):
        pinhole = face_pinhole(SIDE)
        x = (np.arange(SIDE) - pinhole.cx) / pinhole.fx
        X, Y = np.meshgrid(x, x)
        rays = np.stack([X, Y, np.ones_like(X)], axis=2) @ R
        below = np.degrees(np.arcsin(rays[..., 1] / np.linalg.norm(rays, axis=2)))
        counts = views[f"p2_{number}.jpg"].read().mask
        assert counts[below < 59].all() and not counts[below > 61].any()
        assert (below > 61).any() == (number >= 4)  # only faces of the lower ring see so far down


@pytest.mark.slow
def test_whole_panoramas_are_held_out(room):
    """A face is never held out from a training on other faces from the same place."""
    dataset = load_dataset(room.capture, DataSettings(test_every=3))
    places = [{view.name.partition("_")[0] for view in part} for part in (dataset.train, dataset.test)]
    assert places == [{"p1", "p2", "p4", "p5"}, {"p0", "p3", "p6"}]
    assert len(dataset.test) == 3 * FACES
    assert any("56 photos have 7 centres" in note for note in map(str, dataset.notes))


@pytest.mark.slow
def test_panoramas_train_as_well_as_pinhole_photos(room, tmp_path):
    """Trainings on cut panoramas, and on photos drawn ray by ray with true poses, have the same places, directions
    and start points. Both scenes are compared with pinhole photos of other places and directions. Their PSNR may
    differ by 0.3 dB.
    """
    dataset = load_dataset(room.capture, DataSettings(test_every=0))
    truth = face_cameras()
    move = align_cameras({view.name: view.camera for view in dataset.train}, truth)
    views = [View(moved(camera, move), photo(camera), name=name) for name, camera in truth.items()]
    write_colmap(tmp_path / "pinhole", views, dataset.points, dataset.colors)
    scores = []
    for capture in (room.capture, tmp_path / "pinhole"):
        run = tmp_path / f"run{len(scores)}"
        options = "--iterations 400 --eval-every 0 --save-every 0 --test-every 0"
        assert main(["train", str(capture), "--out", str(run), *options.split()]) == 0
        (scene,) = run.glob("point_cloud/*/point_cloud.ply")
        gaussians = read_scene(scene).gaussians
        scores.append(float(np.mean([score(gaussians, camera, move) for camera in held_out()])))
    assert scores[0] > scores[1] - 0.3, scores
    assert min(scores) > 20.0, scores


def moved(camera, move):
    """Move a camera from the true world to that of the capture."""
    pinhole = Intrinsics(camera.W, camera.H, camera.fx, camera.fy, camera.cx, camera.cy)
    return Camera.posed(camera.R @ move.R, move.R.T @ (camera.eye - move.t) / move.s, pinhole)


def score(gaussians, camera, move):
    """Return the PSNR of a photo that was not trained on."""
    with torch.no_grad():
        image = render(gaussians, moved(camera, move), settings=SETTINGS).image.clamp(0, 1)
    return psnr(image, torch.from_numpy(photo(camera).astype(np.float32) / 255))


@pytest.fixture
def files(tmp_path):
    """Write images of given sizes; XMP declares those with `xmp` to be panoramas."""

    def write(*sizes, xmp=()):
        found = []
        for number, size in enumerate(sizes):
            found.append(tmp_path / f"{number}.jpg")
            options = {"xmp": XMP} if number in xmp else {}
            Image.new("RGB", size, (90, 60, 30)).save(found[-1], **options)
        return found

    return write


def test_the_shape_alone_makes_no_panorama(files):
    """Photos of 2:1 whose edges tell nothing are treated as photos, and a note names the option."""
    said = []
    assert not are_panoramas(files((64, 32), (64, 32)), "auto", said.append)
    assert "if they are 360-degree panoramas, give --panorama yes" in said[0]
    said.clear()
    assert not are_panoramas(files((64, 48), (64, 32)), "auto", said.append) and not said
    assert are_panoramas(files((64, 32), (64, 32)), "yes", said.append) and not said


def test_xmp_decides(files):
    said = []
    assert are_panoramas(files((64, 32), (80, 40), xmp=(0, 1)), "auto", said.append)
    assert said == [
        "2 photos taken for 360-degree panoramas: their XMP says so; otherwise give --panorama no"
    ]
    said.clear()
    assert not are_panoramas(files((64, 32), xmp=(0,)), "no", said.append) and not said
    assert not said
    with pytest.raises(
        DatasetError, match=r"1 of 2 photos are 360-degree panoramas, first 0\.jpg, and others are not"
    ):
        are_panoramas(files((64, 32), (64, 48), xmp=(0,)), "auto", said.append)
    assert not are_panoramas(files((64, 32), (64, 48), xmp=(0,)), "no", said.append)
    # parts of the sphere
    assert not are_panoramas(files((64, 20), (64, 20), xmp=(0, 1)), "auto", said.append)


def test_the_picture_decides(tmp_path):
    """Panoramas without XMP are known by their edges; plain photos of the same room and crops to 2:1 are none."""
    plain, spheres = [tmp_path / f"a{i}.jpg" for i in range(3)], [tmp_path / f"b{i}.jpg" for i in range(3)]
    for i, eye in enumerate(walk(3)):
        whole = panorama(eye, 0.4 * i, 256)
        Image.fromarray(whole).save(spheres[i], quality=92)
        crop = whole[32:96, 32:160]  # 2:1, but only half of the horizon
        Image.fromarray(crop).resize((256, 128)).save(plain[i], quality=92)
    said = []
    assert are_panoramas(spheres, "auto", said.append) and "their left and right edges fit" in said[0]
    assert not are_panoramas(spheres, "no", said.append)
    assert not are_panoramas(plain, "auto", said.append)
    assert "3 photos taken for plain photos, although they are twice as wide as high" in said[1]
    Image.new("RGB", (64, 48)).save(tmp_path / "c.jpg")
    with pytest.raises(DatasetError, match="put the panoramas into a folder of their own"):
        are_panoramas([*spheres, tmp_path / "c.jpg"], "auto", said.append)


@pytest.mark.parametrize("kind", ["sky", "sky over grass", "stripes"])
def test_crops_with_alike_edges_are_no_panoramas(kind, tmp_path):
    """Left and right edges that look alike are not enough: the first and last rows have to be of one direction."""
    rng = np.random.default_rng(1)
    image = np.full((128, 256, 3), (120, 160, 220), np.float64)
    if kind == "sky over grass":
        image[64:] = rng.uniform(30, 160, (64, 256, 1))
    if kind == "stripes":
        image[:] = (128 + 100 * np.sin(np.arange(256) * 2 * np.pi / 64))[:, None]
    Image.fromarray(image.astype(np.uint8)).save(tmp_path / "a.png")
    assert not are_panoramas([tmp_path / "a.png"], "auto", lambda sentence: None)


def test_photos_of_another_shape_are_refused(files, capsys, tmp_path):
    with pytest.raises(
        DatasetError, match=r"1\.jpg: is 64x48, but a 360-degree panorama is twice as wide as high"
    ):
        are_panoramas(files((64, 32), (64, 48)), "yes", print)
    assert main(["sfm", str(tmp_path), str(tmp_path / "out"), "--panorama", "maybe"]) == 2
    assert "panorama" in capsys.readouterr().err


def test_orientation_alpha_masks_and_names(tmp_path):
    """EXIF rotates a panorama before it is cut, masks are found, and two files with one stem give distinct faces."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (32, 64, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(image).save(tmp_path / "a.png")
    Image.fromarray(image[::-1, ::-1]).save(tmp_path / "a.webp", exif=exif, lossless=True)
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((32, 64), 255, np.uint8)
    mask[:, :32] = 0
    Image.fromarray(mask).save(masks / "a.png.png")
    (tmp_path / "b.jpg").write_bytes(b"no image")
    out = tmp_path / "faces"
    found, side, unreadable = cut_panoramas(sorted(tmp_path.glob("?.*")), out, 20, lambda *step: None)
    assert side == 20 and [one.name for one in found] == ["a.png", "a.webp"]
    assert len(unreadable) == 1 and unreadable[0].startswith("b.jpg: ")
    assert found[0].faces[3] == "a_3.png" and found[1].faces[3] == "a_webp_3.png"
    for one, other in zip(found[0].faces, found[1].faces, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(out / one)), np.asarray(Image.open(out / other)))
    counts = [np.asarray(Image.open(out / "masks" / f"{name}.png")) != 0 for name in found[0].faces]
    assert not counts[3].any() and counts[1].all()  # 90 degrees to the left and to the right
    half = counts[0]
    assert not half[:, :10].any() and half[:, 11:].all()


def test_gps_reaches_the_faces(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 30.0, 0.0), 3: "W", 4: (8.0, 15.0, 0.0), 6: 120.5})
    Image.new("RGB", (64, 32)).save(tmp_path / "a.jpg", exif=exif)
    (one,), _, _ = cut_panoramas([tmp_path / "a.jpg"], tmp_path / "faces", 8, lambda *step: None)
    assert one.place == (48.5, -8.25, 120.5)


@pytest.mark.slow
def test_the_work_folder_lists_the_cut_panoramas(room):
    facts = json.loads((room.capture / "sfm" / "stages.json").read_text())["stages"]["faces"]["facts"]
    assert [one["name"] for one in facts["panoramas"]] == [f"p{i}.jpg" for i in range(COUNT)]


@pytest.mark.slow
def test_the_capture_has_the_panoramas_themselves(room):
    """One photo and one pose each, without a second lossy copy: `--lens native` trains through them."""
    for i in range(COUNT):
        data = (room.capture / "images" / f"p{i}.jpg").read_bytes()
        assert data == (room.folder / "photos" / f"p{i}.jpg").read_bytes()
    assert len(list((room.capture / "images").iterdir())) == COUNT
    truth = {}
    for i, eye in enumerate(walk(COUNT)):
        c, s = np.cos(TURN * i), np.sin(TURN * i)
        truth[f"p{i}.jpg"] = Camera.panorama(
            np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), eye, WIDTH // 2, WIDTH
        )
    dataset = load_dataset(room.capture, DataSettings(test_every=0, lens="native"))
    cameras = {view.name: view.camera for view in dataset.train}
    assert cameras.keys() == truth.keys()
    assert all(camera.projection.kind == "equirectangular" for camera in cameras.values())
    found = align_cameras(cameras, truth)
    assert found.moved.max() < 0.005 and found.turned.max() < 0.1
    below = np.arange(WIDTH // 2) >= WIDTH * 5 // 12
    mask = next(view for view in dataset.train if view.name == "p2.jpg").read().mask
    assert not mask[below].any() and mask[~below].all()


@pytest.mark.slow
def test_points_are_seen_where_the_panoramas_show_them(room):
    """The tracks of the model are in pixels of the panoramas."""
    model = room.capture / "sparse" / "0"
    poses = {pose.name: pose for pose in read_images(model / "images.bin")}
    assert set(poses) == {f"p{i}.jpg" for i in range(COUNT)}
    assert any("7 panoramas, whole" in line for line in room.said)
    (line,) = [line for line in room.said if line.startswith("capture:")]
    assert float(line.partition("mean reprojection error ")[2].partition(" ")[0]) < 1.0


@pytest.mark.slow
def test_faces_have_the_depth_of_their_panoramas_points(room):
    """`--depth points` finds a face's points in the tracks of the whole panorama."""
    views = load_dataset(room.capture, DataSettings(test_every=0)).train
    cameras = [(view.name, view.camera) for view in views]
    found = judged_depths(CaptureReader(room.capture), cameras, DepthSource(Path("points")))
    assert set(found.views) <= {name for name, _ in cameras}
    assert found.report.photos == FACES * COUNT and found.report.used > 0.8 * FACES * COUNT


@pytest.mark.slow
def test_panoramas_of_what_is_far_away_are_warned_of(room):
    """In a room, matches move; if they had not, the next call with the same work folder would say so."""
    path = room.capture / "sfm" / "stages.json"
    stages = json.loads(path.read_text())
    facts = stages["stages"]["mapping"]["facts"]
    assert facts["moving"] > 0.6 and not any("by more than a turn" in line for line in room.said)
    facts["moving"], said = 0.1, []
    path.write_text(json.dumps(stages))
    reconstruct(SfmOptions(room.folder / "photos", room.capture, max_features=500, threads=1), said.append)
    assert (
        sum("only 10 % of the matches move between the panoramas by more than a turn" in s for s in said) == 1
    )


@pytest.mark.usefixtures("colmap")
def test_the_share_of_matches_that_a_turn_does_not_explain():
    lines = printed(
        """
from engine.turning import _turned
rng = np.random.default_rng(1)
for moving in (0.05, 0.3, 0.6):
    a = rng.normal(size=(400, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    R = pycolmap.Rotation3d(rng.normal(size=3)).matrix()
    b = a @ R.T
    near = np.arange(400) < 400 * moving
    b[near] += 0.2 * rng.normal(size=(near.sum(), 3)) + [0.3, 0, 0]
    b += 1e-3 * rng.normal(size=b.shape)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    agree = _turned(a, b, 0.01, rng)
    print(agree[near].mean(), agree[~near].mean())
"""
    )
    for line in lines:
        near, far = map(float, line.split())
        assert near < 0.03 and far > 0.99
