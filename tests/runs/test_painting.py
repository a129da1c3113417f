"""Photos paint a mesh, but not with what moved through them."""

import numpy as np
import pytest
from PIL import Image

from gsplat_edu import Camera
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.mesh.depths import DepthView
from gsplat_edu.mesh.faces import faces_of
from gsplat_edu.mesh.texture import TextureSettings
from gsplat_edu.parts.transients.files import mask_path
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.painting import painted
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.views import View

SIZE, GREY, RED = 64, (120, 120, 120), (255, 0, 0)
SMALL = TextureSettings(size=256)
WALL = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]), np.array([[0, 2, 1], [1, 2, 3]]))


@pytest.fixture
def taken(tmp_path):
    """Return a capture of a grey wall, with a red thing in the middle of its second photo, and its depth maps."""
    views, maps = [], []
    for number in range(3):
        camera = Camera(np.eye(3), (0.05 * number, 0, -2.5), 70, 70, 31.5, 31.5, SIZE, SIZE)
        image = np.full((SIZE, SIZE, 3), GREY, np.uint8)
        if number == 1:
            image[24:40, 24:40] = RED
        views.append(View(camera, image, name=f"{number}.png"))
    write_transforms(tmp_path / "capture", views, np.zeros((1, 3)), np.zeros((1, 3)))
    dataset = load_dataset(tmp_path / "capture", DataSettings(test_every=0))
    for view in dataset.train:
        depth = np.full((SIZE, SIZE), 2.5, np.float32)
        facing, clear = np.full((SIZE, SIZE), 255, np.uint8), np.zeros((SIZE, SIZE), dtype=bool)
        maps.append(DepthView(view.name, view.camera, depth, facing, view.read().image, clear, 0))
    return dataset, maps


def reddest(mesh):
    image = mesh.texture.image.astype(int)
    return int((image[..., 0] - image[..., 1]).max())


def test_masks_of_a_run_say_what_does_not_paint(taken, tmp_path):
    pytest.importorskip("xatlas")
    dataset, maps = taken
    run = RunFolder(tmp_path / "run")
    assert len(dataset.train) == 3
    assert reddest(painted(WALL, dataset, maps, settings=SMALL)) > 30
    assert reddest(painted(WALL, dataset, maps, run, SMALL)) > 30, "it looked for nothing that moves"
    counts = np.full((SIZE, SIZE), 255, np.uint8)
    counts[22:42, 22:42] = 0
    path = mask_path(run.path, next(view.name for view in dataset.train if view.name.endswith("1.png")))
    path.parent.mkdir(parents=True)
    Image.fromarray(counts).save(path)
    assert reddest(painted(WALL, dataset, maps, run, SMALL)) == 0
    assert reddest(painted(WALL, dataset, maps, settings=SMALL)) > 30


def test_photos_of_a_fisheye_paint_the_places_that_they_show(tmp_path):
    pytest.importorskip("xatlas")
    views, lens = [], Projection("fisheye", Distortion.of(k1=-0.02))
    for number in range(3):
        camera = Camera(np.eye(3), (0.3 * number, 0, -0.8), 24, 24, 31.5, 31.5, SIZE, SIZE).through(lens)
        rays = camera.rays()
        with np.errstate(all="ignore"):
            places = camera.eye + (-camera.eye[2] / rays[..., 2])[..., None] * rays
        on_wall = (rays[..., 2] > 0) & (np.abs(places[..., :2]) <= 1).all(axis=-1)
        shades = np.where(on_wall[..., None], 128 + 100 * places, 0)
        shades[..., 2] = 0
        views.append(View(camera, np.rint(shades).astype(np.uint8), name=f"{number}.png"))
    write_transforms(tmp_path / "capture", views, np.zeros((1, 3)), np.zeros((1, 3)))
    dataset = load_dataset(tmp_path / "capture", DataSettings(test_every=0, lens="native"))
    maps = []
    for view in dataset.train:
        for face in faces_of(view.camera):
            shape, rays = (face.H, face.W), face.rays()
            with np.errstate(all="ignore"):
                depth = -face.eye[2] / rays[..., 2]
            at = face.eye + depth[..., None] * rays
            depth = np.where((depth > 0) & (np.abs(at[..., :2]) <= 1.0).all(axis=-1), depth, 0)
            facing, clear = np.full(shape, 255, np.uint8), np.zeros(shape, dtype=bool)
            image = np.zeros((*shape, 3), np.uint8)
            maps.append(
                DepthView(
                    view.name, face, depth.astype(np.float32), facing, image, clear, 0, lens=view.camera
                )
            )
    assert len(maps) > 9  # the wall, at 0.8 from a fisheye, is on its side faces too
    mesh = painted(WALL, dataset, maps, settings=SMALL)
    texture, corners = mesh.texture.image.astype(float), mesh.texture.uvs * mesh.texture.image.shape[1::-1]
    off = []
    for face, uv in zip(WALL.corners, corners, strict=True):
        for weights in np.random.default_rng(3).dirichlet([2, 2, 2], 200):
            column, row = np.floor(weights @ uv).astype(int)
            off.append(texture[row, column] - [*(128 + 100 * (weights @ face)[:2]), 0])
    # a pixel of the lens is 1/24 of a radian, at 0.8: 3.3 shades in the middle, 8 at the corners of the wall;
    # linear between pixels, twice, so an error of a pixel's eighth of that is left, and texels have a size
    assert np.abs(off).mean() < 1.5 and np.quantile(np.abs(off), 0.98) < 6
