"""COLMAP's database: cameras, photos and matches, written so that numbers do not depend on threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pycolmap

COUNT_EVERY = 0.25
"""Seconds between two counts of what a job has written."""


@contextmanager
def opened(path: str) -> Iterator[pycolmap.Database]:
    """Open a database for the block."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


@contextmanager
def counted(
    path: str, tell: Callable[[int], None], count: Callable[[pycolmap.Database], int]
) -> Iterator[pycolmap.Database]:
    """Open a database for the block, in which COLMAP writes to it, and report now and then how much has been written.

    The connection stays open, and belongs to this process, because COLMAP does not wait for locks: SQLite locks the
    whole file while a process opens it first or closes it last, and a COLMAP that opens it in that moment fails. A
    program that watches from outside must therefore not open the file.

    Args:
        path: The database; created if missing.
        tell: Called with each count, in a thread of its own, and once after the block.
        count: Counts what has been written.

    Yields:
        The open database, for use before and after COLMAP's own work.
    """
    ended = threading.Event()

    def watch(database: pycolmap.Database) -> None:
        while not ended.wait(COUNT_EVERY):
            tell(count(database))

    with opened(path) as database:
        watcher = threading.Thread(target=watch, args=(database,), daemon=True)
        watcher.start()
        try:
            yield database
        finally:
            ended.set()
            watcher.join()
        tell(count(database))


def add_camera(database: pycolmap.Database, camera: pycolmap.Camera) -> None:
    """Write a camera, and a rig of the same number that consists of this camera."""
    database.write_camera(camera, use_camera_id=True)
    rig = pycolmap.Rig(rig_id=camera.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def add_photo(database: pycolmap.Database, name: str, number: int, camera: int) -> None:
    """Write an image, and a frame of the same number that consists of this image."""
    image = pycolmap.Image(name=name, camera_id=camera, image_id=number)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=number, rig_id=camera)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)


def with_cameras(
    source: str,
    target: str,
    model: str,
    per_photo: bool,
    shared: dict[int, int],
    known: dict[str, pycolmap.Camera] | None = None,
) -> str:
    """Copy a database without descriptors, and assign new cameras to its photos.

    If photos of different sizes share a camera, their features are scaled to the camera's size. Fisheyes keep their
    model and intrinsics.

    Args:
        source: The database.
        target: The copy.
        model: The camera model.
        per_photo: Whether every photo gets its own camera.
        shared: For each replaced camera, the number of its replacement, which has the same aspect ratio.
        known: Cameras of photos whose lens is known, by the photos' names, of the photos' size, under numbers that
            no camera of the database has.

    Returns:
        The path of the copy.
    """
    known = known or {}
    with opened(source) as old, opened(target) as new, pycolmap.DatabaseTransaction(new):
        made = set[int]()
        scales = dict[int, np.ndarray]()
        for image in old.read_all_images():
            own = old.read_camera(image.camera_id)
            before = own if per_photo else old.read_camera(shared.get(image.camera_id, image.camera_id))
            number = image.image_id if per_photo else before.camera_id
            if image.name in known:
                before = known[image.name]
                number = before.camera_id
            if number not in made:
                made.add(number)
                add_camera(new, before if image.name in known else _started(before, number, model))
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


def _started(before: pycolmap.Camera, number: int, model: str) -> pycolmap.Camera:
    """Return the camera with which mapping starts, with another lens model unless it is a fisheye."""
    camera = pycolmap.Camera.create_from_model_name(
        number, model, before.mean_focal_length(), before.width, before.height
    )
    if is_wide(before):
        camera.model = before.model
        camera.params = list(before.params)
    camera.has_prior_focal_length = before.has_prior_focal_length
    return camera


def is_wide(camera: pycolmap.Camera) -> bool:
    """Return whether a camera's model is that of a fisheye."""
    return camera.model_name.endswith("FISHEYE")


def with_rig(source: str, target: str, rotations: Sequence[np.ndarray], panoramas: list[list[str]]) -> str:
    """Copy a database without descriptors, with the faces of each panorama as one frame of a rig.

    Camera k of the rig took the faces k. Its intrinsics are those that the database has for these photos.

    Args:
        source: The database, in which the faces with one number share a camera, the first one camera 1.
        target: The copy.
        rotations: For each face, the rotation from the panorama's axes to the face's.
        panoramas: For each panorama, the names of its faces.

    Returns:
        The path of the copy.
    """
    with opened(source) as old, opened(target) as new, pycolmap.DatabaseTransaction(new):
        images = {image.name: image for image in old.read_all_images()}
        cameras = [old.read_camera(images[name].camera_id) for name in panoramas[0]]
        rig = pycolmap.Rig(rig_id=1)
        for number, (camera, R) in enumerate(zip(cameras, rotations, strict=True)):
            pinhole = pycolmap.Camera.create_from_model_name(
                camera.camera_id, "PINHOLE", camera.mean_focal_length(), camera.width, camera.height
            )
            pinhole.has_prior_focal_length = True
            new.write_camera(pinhole, use_camera_id=True)
            if number:
                turn = pycolmap.Rigid3d(pycolmap.Rotation3d(R @ rotations[0].T), np.zeros(3))
                rig.add_sensor(pinhole.sensor_id, turn)
            else:
                rig.add_ref_sensor(pinhole.sensor_id)
        new.write_rig(rig, use_rig_id=True)
        for number, names in enumerate(panoramas, 1):
            frame = pycolmap.Frame(frame_id=number, rig_id=1)
            for name in names:
                image = images[name]
                written = pycolmap.Image(name=name, camera_id=image.camera_id, image_id=image.image_id)
                new.write_image(written, use_image_id=True)
                frame.add_data_id(written.data_id)
                new.write_keypoints(image.image_id, old.read_keypoints(image.image_id))
            new.write_frame(frame, use_frame_id=True)
        for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            new.write_two_view_geometry(first, second, geometry)
            new.write_matches(first, second, old.read_matches(first, second))
    return target


def _scale(geometry: pycolmap.TwoViewGeometry, first: np.ndarray, second: np.ndarray) -> None:
    """Convert a pair's matrices to pixels x' = S x: F' = S2^-T F S1^-1, H' = S2 H S1^-1; E does not change."""
    if (first == 1.0).all() and (second == 1.0).all():
        return
    if geometry.F is not None:
        geometry.F = geometry.F / second[:, None] / first
    if geometry.H is not None:
        geometry.H = geometry.H * second[:, None] / first
