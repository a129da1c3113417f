"""COLMAP's database: cameras, photos and matches, written so that numbers do not depend on threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pycolmap


@contextmanager
def opened(path: str) -> Iterator[pycolmap.Database]:
    """Open a database for the block."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def add_camera(database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    """Write a camera, and the rig of the same number that is this camera alone."""
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def add_photo(database: pycolmap.Database, name: str, number: int, camera: int) -> None:
    """Write an image, and the frame of the same number that is this image alone."""
    image = pycolmap.Image(name=name, camera_id=camera, image_id=number)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=camera)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


def with_cameras(source: str, target: str, model: str, per_photo: bool, shared: dict[int, int]) -> str:
    """Copy a database, without descriptors, and give its photos other cameras.

    Photos that share a camera with larger or smaller ones have their features scaled to that camera's size.

    Args:
        source: The database.
        target: The copy.
        model: The cameras' model.
        per_photo: Whether every photo gets a camera of its own.
        shared: Cameras that are replaced by a camera of the same aspect, by their numbers.

    Returns:
        The copy's path.
    """
    with opened(source) as old, opened(target) as new, pycolmap.DatabaseTransaction(new):
        made = set[int]()
        scales = dict[int, np.ndarray]()
        for image in old.read_all_images():
            own = old.read_camera(image.camera_id)
            before = own if per_photo else old.read_camera(shared.get(image.camera_id, image.camera_id))
            number = image.image_id if per_photo else before.camera_id
            if number not in made:
                made.add(number)
                camera = pycolmap.Camera.create_from_model_name(
                    number, model, before.mean_focal_length(), before.width, before.height
                )
                camera.has_prior_focal_length = before.has_prior_focal_length
                add_camera(new, camera)
            scale = np.array([before.width / own.width, before.height / own.height, 1.0])
            scales[image.image_id] = scale
            add_photo(new, image.name, image.image_id, number)
            keypoints = np.array(old.read_keypoints(image.image_id))
            keypoints[:, :2] *= scale[:2].astype(keypoints.dtype)
            new.write_keypoints(image.image_id, keypoints)
        for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            _scale(geometry, scales[first], scales[second])
            new.write_two_view_geometry(first, second, geometry)
            new.write_matches(first, second, old.read_matches(first, second))
    return target


def _scale(geometry: pycolmap.TwoViewGeometry, first: np.ndarray, second: np.ndarray) -> None:
    """Fit a pair's matrices to pixels x' = S x: F' = S2^-T F S1^-1, H' = S2 H S1^-1; E is about rays."""
    if (first == 1.0).all() and (second == 1.0).all():
        return
    if geometry.F is not None:
        geometry.F = geometry.F / second[:, None] / first
    if geometry.H is not None:
        geometry.H = geometry.H * second[:, None] / first
