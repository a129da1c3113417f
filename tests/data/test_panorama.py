"""Faces of panoramas: the geometry of COLMAP's model, the seam, antialiasing, alpha and masks."""

import math

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import DatasetError, ShapeError
from gsplat_edu.data.colmap import read_cameras
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.images import PhotoFile
from gsplat_edu.data.panorama import (
    FACES,
    FaceLens,
    cut_face,
    face_pinhole,
    face_rotations,
    face_side,
    is_panorama_size,
)
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.cameras import check_sizes
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.photos import measure_photo


def directions(W, H):
    """Return the ray of each pixel of a panorama, (H, W, 3)."""
    longitude = ((np.arange(W) + 0.5) / W - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(H) + 0.5) / H) * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    flat = np.cos(latitude)
    return np.stack([flat * np.sin(longitude), -np.sin(latitude), flat * np.cos(longitude)], axis=2)


def face_rays(R, side):
    """Return the unit rays of a face's pixels in the panorama's axes."""
    camera = face_pinhole(side)
    x = (np.arange(side) - camera.cx) / camera.fx
    X, Y = np.meshgrid(x, x)
    rays = np.stack([X, Y, np.ones_like(X)], axis=2) @ R
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def painted(rays):
    """Return a smooth colour for each direction; no two are equal."""
    x, y, z = np.moveaxis(rays, -1, 0)
    waves = [np.sin(25 * x + 10 * y), np.cos(20 * y - 15 * z), np.sin(30 * z + x * y)]
    return np.round(127.5 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)


def test_directions_are_those_of_colmaps_model():
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    found = camera.img_from_cam(directions(64, 32).reshape(-1, 3)).reshape(32, 64, 2)
    y, x = np.mgrid[:32, :64]
    np.testing.assert_allclose(found, np.stack([x + 0.5, y + 0.5], axis=2), atol=1e-9)


def test_faces_are_rotations_that_cover_the_sphere():
    rotations = face_rotations()
    assert len(rotations) == FACES == 8
    rays = directions(90, 45).reshape(-1, 3)
    seen = np.zeros(len(rays), int)
    for R in rotations:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1) and R[0, 1] == pytest.approx(0)  # no roll
        assert R[1, 1] > 0.8  # its down is near the panorama's down
        x, y, z = (rays @ R.T).T
        seen += (z > 0) & (np.abs(x) <= z) & (np.abs(y) <= z)
    latitude = np.degrees(np.arcsin(-rays[:, 1]))
    assert (seen[np.abs(latitude) < 73] >= 1).all() and (seen[np.abs(latitude) > 81] == 0).all()
    assert (seen[np.abs(latitude) < 10] >= 2).mean() > 0.5  # the rings overlap along the horizon


@pytest.mark.parametrize("number", range(8))
def test_faces_show_what_their_rays_show(number):
    """A face cut from a painted sphere equals the face painted directly up to a few grey levels, also across the
    seam."""
    W, H, R = 1024, 512, face_rotations()[number]
    side = face_side(W)
    face, alpha, mask = cut_face(painted(directions(W, H)), None, None, R, side)
    assert alpha is None and mask is None and face.shape == (side, side, 3)
    wrong = np.abs(face.astype(int) - painted(face_rays(R, side)))
    assert wrong.max() <= 4 and wrong.mean() < 0.6


def test_a_quarter_of_a_pixel_would_be_noticed():
    """A panorama that is shifted by a quarter of a pixel exceeds the bound of the previous test."""
    W, H, R = 1024, 512, face_rotations()[0]
    shifted = painted(directions(2 * W, 2 * H)[::2, 1::2])  # pixel centres shifted by a quarter of a pixel
    side = face_side(W)
    wrong = np.abs(cut_face(shifted, None, None, R, side)[0].astype(int) - painted(face_rays(R, side)))
    assert wrong.max() > 4 and wrong.mean() > 0.6


def test_the_seam_leaves_no_line():
    """The panorama is noise. Rotating it by whole pixels, and the face with it, gives the same face."""
    rng = np.random.default_rng(0)
    W, H, side = 256, 128, 80
    noise = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    R = face_rotations()[0]
    turn = 2 * np.pi * 100 / W
    back = np.array([[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]])
    plain = cut_face(noise, None, None, R, side)[0].astype(int)
    for shift in (100, -100, 128):
        turn = 2 * np.pi * shift / W
        c, s = math.cos(turn), math.sin(turn)
        back = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        moved = cut_face(np.roll(noise, shift, axis=1), None, None, R @ back, side)[0]
        assert np.abs(moved - plain).max() <= 1


def test_downscaled_faces_are_averages():
    """A chequerboard of single pixels becomes grey at a quarter of its size, which point sampling would not give."""
    W, H = 1600, 800
    y, x = np.mgrid[:H, :W]
    board = np.repeat((255 * ((x + y) % 2)).astype(np.uint8)[..., None], 3, axis=2)
    face = cut_face(board, None, None, face_rotations()[0], face_side(W) // 4)[0].astype(float)
    assert abs(face.mean() - 127.5) < 2 and face.std() < 25
    assert face_side(W) == 509 and face_side(100_000) == 1600 and face_side(8000, 512) == 512


def test_alpha_and_masks_are_cut_with_the_colours():
    """Transparent pixels do not affect colours, and a pixel counts only if all of its samples count."""
    W, H, R, side = 512, 256, face_rotations()[4], 100
    rays = directions(W, H)
    clear = rays @ R[2] > 0.9  # a disc in the middle of the face
    image = np.where(clear[..., None], np.uint8(200), np.uint8(10)) * np.ones(3, np.uint8)
    alpha, mask = np.where(clear, 255, 0).astype(np.uint8), ~clear
    face, opacity, counts = cut_face(image, alpha, mask, R, side)
    inside = face_rays(R, side) @ R[2] > 0.91
    assert (opacity[inside] == 255).all() and (face[inside] == 200).all() and not counts[inside].any()
    outside = face_rays(R, side) @ R[2] < 0.88
    assert (opacity[outside] == 0).all() and counts[outside].all()
    edge = (opacity > 20) & (opacity < 235)
    assert edge.any() and np.abs(face[edge].astype(int) - 200).max() <= 6 and not counts[edge].all()


def test_only_whole_panoramas_are_cut(as_shipped):
    assert is_panorama_size(4000, 2000) and is_panorama_size(4001, 2000)
    assert not is_panorama_size(4000, 2100) and not is_panorama_size(40_000, 20_000)
    with pytest.raises(ShapeError, match="image: is 40x30, but a panorama has to be 2:1"):
        cut_face(np.zeros((30, 40, 3), np.uint8), None, None, np.eye(3), 10)


@pytest.mark.parametrize(("resolution", "side"), [(None, 163), (2.0, 82), (100, 100)])
def test_a_capture_of_colmaps_panoramas_is_read_as_faces(tmp_path, resolution, side):
    """An image of COLMAP's model EQUIRECTANGULAR becomes eight views from one centre, with masks, at any resolution."""
    W, H = 512, 256
    R = Rotation.from_euler("xyz", [0.2, 0.5, -0.1])
    eyes = np.array([[1.0, 2.0, 3.0], [4.0, 2.0, 0.0]])
    for folder in ("images", "masks", "sparse/0"):
        (tmp_path / folder).mkdir(parents=True)
    lines, x, y, z, w = [], *R.as_quat()
    for number, eye in enumerate(eyes, 1):
        rays = directions(W, H) @ R.as_matrix()  # in world axes
        Image.fromarray(painted(rays)).save(tmp_path / "images" / f"p{number}.png")
        Image.fromarray(np.where(rays[..., 1] < 0.3, 255, 0).astype(np.uint8)).save(
            tmp_path / f"masks/p{number}.png"
        )
        t = -R.as_matrix() @ eye
        lines.append(f"{number} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 p{number}.png\n\n")
    (tmp_path / "sparse/0/cameras.txt").write_text(f"1 EQUIRECTANGULAR {W} {H} {W} {H}\n")
    (tmp_path / "sparse/0/images.txt").write_text("".join(lines))
    dataset = load_dataset(tmp_path, DataSettings(resolution=resolution, test_every=2))
    assert [view.name for view in dataset.test] == [f"p1_{k}.png" for k in range(8)]
    assert len(dataset.train) == 8 and not any(
        "distortion" in note or "cropped" in note for note in map(str, dataset.notes)
    )
    assert "16 of 16 views are faces of panoramas, cut on loading" in map(str, dataset.notes)
    assert not check_sizes(prepare(CaptureReader(tmp_path)))
    for view in dataset.test:
        camera, photo = view.camera, view.read()
        assert (side, side) == (camera.W, camera.H) and camera.fx == pytest.approx(side / 2)
        np.testing.assert_allclose(camera.eye, eyes[0], atol=1e-9)
        c = (np.arange(side) - camera.cx) / camera.fx
        X, Y = np.meshgrid(c, c)
        rays = np.stack([X, Y, np.ones_like(X)], axis=2) @ camera.R
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        wrong = np.abs(photo.image.astype(int) - painted(rays))
        assert wrong.mean() < 2.0 and wrong.max() < 25  # of 240 grey levels; a wrong face differs by 80
        below = rays[..., 1]
        assert not photo.mask[below > 0.33].any() and photo.mask[below < 0.27].all()


def test_colmaps_panoramas_of_another_shape_are_refused(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 300 100 300 100\n")
    with pytest.raises(DatasetError, match="size 300x100 is not a panorama's"):
        read_cameras(tmp_path / "cameras.txt")


def test_the_doctor_reads_panoramas(tmp_path):
    """The doctor's thumbnails are those of the faces."""
    Image.fromarray(painted(directions(512, 256))).save(tmp_path / "a.png")
    lens = FaceLens.of(512, 256, 5)
    stats = measure_photo(PhotoFile(tmp_path / "a.png", None, lens, 163, 163, None))
    assert stats.thumbnail.shape == (128, 128, 3)
    wrong = np.abs(stats.thumbnail.astype(int) - painted(face_rays(face_rotations()[5], 128)))
    assert wrong.mean() < 2.0
