"""A search starts from the poses that are there, completes them, and keeps their coordinates."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.capture import Frame
from gsplat_edu.data.colmap import read_cameras
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_model
from gsplat_edu.options.sfm import options_from
from gsplat_edu.scene.camera import Camera
from gsplat_edu.sfm.given import GivenPoses, colmap_camera, find_given, quarter_turns, turned
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from lab.captures.textured_box import box_orbit, photograph_box
from sfm.textured_box import LIMIT, MOVED, TURNED, cameras_of

COUNT, POSED = 16, 9

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


def with_poses(folder, poses):
    """Write the model of given poses."""
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
    """The capture made from slightly wrong poses of some photos."""
    rng = np.random.default_rng(0)
    given = [(f"{number:02d}.jpg", moved(disturbed(photos.cameras[number], rng))) for number in range(POSED)]
    with_poses(photos.folder, given)
    out, said = tmp_path_factory.mktemp("completed") / "out", []
    reconstruct(SfmOptions(photos.folder, out, max_features=LIMIT), said.append)
    return SimpleNamespace(out=out, said=said, given=dict(given))


@pytest.mark.slow
def test_all_photos_are_placed_in_the_given_coordinates(completed, photos):
    found = cameras_of(completed.out)
    assert sorted(found) == sorted(photos.truth)
    for name, camera in found.items():
        away = np.linalg.norm(camera.eye - photos.truth[name].eye) / WORLD[1]
        angle = np.degrees(Rotation.from_matrix(camera.R @ photos.truth[name].R.T).magnitude())
        print(name, away, angle, name in completed.given)
    print(completed.said)
