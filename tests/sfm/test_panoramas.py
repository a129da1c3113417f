"""360-degree panoramas are recognised, cut, mapped as a rig, and trained like pinhole photos."""

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.panorama import FACES, face_pinhole, face_rotations
from gsplat_edu.data.textured_box import align_cameras
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
from panorama_room import held_out, panorama, photo, walk

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


@pytest.mark.sliced(1, group="captures from photos", together=True)
def test_panoramas_become_faces_with_one_centre_each(room):
    """All faces get poses, those of one panorama share a centre, and both agree with the truth."""
    assert any("7 panoramas cut into 8 faces each of 163x163 px" in line for line in room.said)
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


@pytest.mark.sliced(1, group="captures from photos", together=True)
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


@pytest.mark.sliced(1, group="captures from photos", together=True)
def test_whole_panoramas_are_held_out(room):
    """A face is never held out from a training on other faces from the same place."""
    dataset = load_dataset(room.capture, DataSettings(test_every=3))
    places = [{view.name.partition("_")[0] for view in part} for part in (dataset.train, dataset.test)]
    assert places == [{"p1", "p2", "p4", "p5"}, {"p0", "p3", "p6"}]
    assert len(dataset.test) == 3 * FACES
    assert any("56 photos have 7 centres" in note for note in map(str, dataset.notes))


@pytest.mark.slow
@pytest.mark.sliced(1, group="captures from photos", together=True)
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
    """A photo cropped to 2:1 is treated as a photo, and a note names the option."""
    said = []
    assert not are_panoramas(files((64, 32), (64, 32)), "auto", said.append)
    assert "if they are 360-degree panoramas, give --panorama yes" in said[0]
    said.clear()
    assert not are_panoramas(files((64, 48), (64, 32)), "auto", said.append) and not said
    assert are_panoramas(files((64, 32), (64, 32)), "yes", said.append) and not said


def test_xmp_decides(files):
    said = []
    assert are_panoramas(files((64, 32), (80, 40), xmp=(0, 1)), "auto", said.append) and not said
    assert not are_panoramas(files((64, 32), xmp=(0,)), "no", said.append) and not said
    assert not are_panoramas(files((64, 32), (64, 48), xmp=(0,)), "auto", said.append)
    assert (
        "1 of 2 photos are 360-degree panoramas according to their XMP, first 0.jpg: used as plain" in said[0]
    )
    said.clear()
    # parts of the sphere
    assert not are_panoramas(files((64, 20), (64, 20), xmp=(0, 1)), "auto", said.append)


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


@pytest.mark.sliced(1, group="captures from photos", together=True)
def test_the_work_folder_lists_the_cut_panoramas(room):
    facts = json.loads((room.capture / "sfm" / "stages.json").read_text())["stages"]["faces"]["facts"]
    assert [one["name"] for one in facts["panoramas"]] == [f"p{i}.jpg" for i in range(COUNT)]
    data = (room.capture / "images" / "p0_0.jpg").read_bytes()
    assert data == (room.capture / "sfm" / "faces" / "p0_0.jpg").read_bytes()  # no second lossy copy
    assert Image.open(io.BytesIO(data)).size == (SIDE, SIDE)
