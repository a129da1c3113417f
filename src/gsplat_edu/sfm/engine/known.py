"""Models that begin with known poses: triangulate, adjust, register the other photos, and keep the coordinates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .database import opened
from .judge import SUPPORT, unsupported
from .kin import OWN
from .lenses import LENS_LADDER, adjust, refined
from .mappers import Options, Tell, incremental, without_doubtful

BOUNDS = (16.0, 4.0)
"""Largest reprojection errors of the points, px, in the rounds of triangulation: first that of poses which the photos
prove only roughly (`gsplat_edu.survey.proof.AGREES`, at the size of the copies), then COLMAP's own."""

SURVIVING = 0.5
"""Smallest fraction of the given poses that matches must not contradict; otherwise they are no start."""

DETERMINED = 0.5
"""Smallest fraction of the given poses that points have to determine for the poses to be adjusted."""

FITS = 30
"""Rounds of the fit to the given poses; with one wrong pose of ten, 10 rounds suffice."""

NEGLIGIBLE = 1e-9
"""Distances below this, in the spread of the given centres, count as this."""

SHIFTS = 16
"""The scale of a model is that of the distances from each photo to this many others."""


def cameras_of(given: dict[str, Any], first: int) -> dict[str, pycolmap.Camera]:
    """Return the given cameras by the names of their photos.

    Args:
        given: As for `from_known_poses`.
        first: Number of the first camera.
    """
    made = [
        pycolmap.Camera(
            model=one["model"],
            width=one["W"],
            height=one["H"],
            params=one["params"],
            camera_id=first + number,
        )
        for number, one in enumerate(given["cameras"])
    ]
    for camera in made:
        camera.has_prior_focal_length = True
    return {name: made[number] for name, number in given["lens_of"].items()}


def add_posed(
    model: pycolmap.Reconstruction, database: pycolmap.Database, number: int, pose: pycolmap.Rigid3d
) -> None:
    """Add a photo of a database, with its camera and keypoints, to a model.

    Args:
        model: The model; changed.
        database: The database.
        number: The photo's number.
        pose: From the world to the camera.
    """
    image = database.read_image(number)
    if not model.exists_camera(image.camera_id):
        model.add_camera_with_trivial_rig(database.read_camera(image.camera_id))
    seen = np.zeros((0, 2))
    if database.exists_keypoints(number):
        seen = np.array(database.read_keypoints(number))[:, :2].astype(np.float64)
    posed = pycolmap.Image(name=image.name, keypoints=seen, camera_id=image.camera_id, image_id=number)
    model.add_image_with_trivial_frame(posed, pose)


def from_known_poses(
    tell: Tell, database: str, photos: str, folder: Path, options: Options, given: dict[str, Any]
) -> tuple[pycolmap.Reconstruction, dict[int, str], bool] | None:
    """Refine known poses, and register the other photos.

    If the points determine fewer than `DETERMINED` of the given poses (`judge.unsupported`), all of these and their
    intrinsics stay as given. Otherwise all poses are adjusted, the model is moved back to the given coordinates, and
    photos whose pose no points determine get the given one. Intrinsics of cameras with fewer than `kin.OWN` photos stay
    as given.

    Args:
        tell: Called with the number of registered photos.
        database: Features and matches, with the given cameras.
        photos: Folder of the photos.
        folder: Work folder.
        options: Thresholds, threads and seed.
        given: "cameras": the given "model", size "W" and "H", and "params"; "lens_of": the number of the camera of each
            photo, by name; "views": the posed photos' "name", "rotation" from the world to the camera, and "eye".

    Returns:
        The model in the given coordinates, the refined parameters of each camera, and whether the given poses stayed as
        they were; None if the matches contradict too many of the poses.
    """
    model, trusted = _posed(database, given), {view["name"] for view in given["views"]}
    known, fixed = set(model.cameras), _with_few_photos(database, set(model.cameras))
    model = _triangulated(model, database, photos, folder, options, BOUNDS[0])
    holds = len(unsupported(model)) > (1.0 - DETERMINED) * len(trusted)
    if not holds:
        adjust(model, options.threads, fixed=known)
        model = _triangulated(model, database, photos, folder, options, BOUNDS[1])
        adjust(model, options.threads, fixed=fixed)
    without_doubtful(model, database, trusted)
    if model.num_reg_images() < SURVIVING * len(trusted) or model.num_points3D() < SUPPORT:
        return None
    trusted &= {model.image(image).name for image in model.reg_image_ids()}
    common = options._replace(fixed=known if holds else fixed, holds=holds, unmatched=True)
    for loose in (False, True):
        model = _extended(tell, model, (database, photos), folder, common._replace(loose=loose), trusted)
    normal = _normal(given)
    if holds:
        lenses = {number: camera.model_name for number, camera in model.cameras.items()}
    else:
        free = set(model.cameras) - fixed
        climb = all(model.camera(number).model_name == LENS_LADDER[0].model for number in free)
        model, lenses = refined(model, climb, options.threads, fixed=fixed)
        without_doubtful(model, database)
        model.transform(_to_given(model, given))
        _put_back(model, database, given, trusted)
    without_doubtful(model, database, trusted)
    model.transform(normal.inverse())
    return model, lenses, holds


def _put_back(
    model: pycolmap.Reconstruction, database: str, given: dict[str, Any], trusted: set[str]
) -> None:
    """Give the photos without a pose their given one, in the coordinates of `_normal`."""
    placed = {model.image(image).name for image in model.reg_image_ids()}
    with opened(database) as db:
        for number, name, pose in _poses(db, given):
            if name in placed or name not in trusted:
                continue
            if not model.exists_image(number):
                add_posed(model, db, number, pose)
                continue
            frame = model.image(number).frame_id
            model.frame(frame).rig_from_world = pose
            model.register_frame(frame)


def _posed(database: str, given: dict[str, Any]) -> pycolmap.Reconstruction:
    """Return the model of the given poses without points, in the coordinates of `_normal`."""
    model = pycolmap.Reconstruction()
    with opened(database) as db:
        for number, _, pose in _poses(db, given):
            add_posed(model, db, number, pose)
    return model


def _poses(database: pycolmap.Database, given: dict[str, Any]) -> Iterator[tuple[int, str, pycolmap.Rigid3d]]:
    """Yield number, name and pose of each posed photo, in the coordinates of `_normal`."""
    numbers, normal = {image.name: image.image_id for image in database.read_all_images()}, _normal(given)
    for view in given["views"]:
        R = np.array(view["rotation"])
        pose = np.column_stack([R, -R @ (normal * np.array(view["eye"]))])
        yield numbers[view["name"]], view["name"], pycolmap.Rigid3d(pose)


def _normal(given: dict[str, Any]) -> pycolmap.Sim3d:
    """Return the similarity that brings the given centres around the origin, to a spread of 1."""
    eyes = np.array([view["eye"] for view in given["views"]])
    scale = 1.0 / (_spread(eyes) or 1.0)
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(), -scale * eyes.mean(axis=0))


def _spread(eyes: np.ndarray) -> float:
    """Return the root mean square distance of centres (n, 3) from their mean."""
    return float(np.sqrt(np.mean(np.sum((eyes - eyes.mean(axis=0)) ** 2, axis=1))))


def _with_few_photos(database: str, known: set[int]) -> set[int]:
    """Return the given cameras that have too few photos to refine their intrinsics."""
    with opened(database) as db:
        photos = Counter(image.camera_id for image in db.read_all_images())
    return {camera for camera in known if photos[camera] < OWN}


def _triangulated(
    model: pycolmap.Reconstruction, database: str, photos: str, folder: Path, options: Options, bound: float
) -> pycolmap.Reconstruction:
    """Triangulate all matches anew; poses stay. Points with a larger reprojection error, px, are left out."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = options.threads, options.seed
    pipeline.extract_colors = False
    pipeline.triangulation.ignore_two_view_tracks = (
        False  # photos of a sequence may match only their neighbours
    )
    pipeline.mapper.filter_max_reproj_error = bound
    pipeline.triangulation.complete_max_reproj_error = bound
    pipeline.triangulation.merge_max_reproj_error = bound
    out = folder / f"within{bound:.0f}"
    out.mkdir()
    return pycolmap.triangulate_points(model, database, photos, str(out), options=pipeline)


def _extended(
    tell: Tell,
    model: pycolmap.Reconstruction,
    place: tuple[str, str],
    folder: Path,
    options: Options,
    trusted: set[str],
) -> pycolmap.Reconstruction:
    """Register the photos that have no pose yet, and leave out those whose pose does not count.

    Args:
        tell: Called with the number of registered photos.
        model: The model.
        place: The database, and the folder of the photos.
        folder: Work folder.
        options: As for `incremental`.
        trusted: As for `without_doubtful`.
    """
    database, photos = place
    with opened(database) as db:
        if model.num_reg_images() == db.num_images():
            return model
    work = folder / ("loose" if options.loose else "strict")
    begin = work / "begin"
    begin.mkdir(parents=True)
    model.write_binary(begin)
    before = model.num_reg_images()
    found = incremental(lambda added: tell(before + added), database, photos, str(work), options, str(begin))
    more = max(found.values(), key=lambda other: other.num_reg_images(), default=model)
    without_doubtful(more, database, trusted)
    return more if more.num_reg_images() >= before else pycolmap.Reconstruction(begin)


def _to_given(model: pycolmap.Reconstruction, given: dict[str, Any]) -> pycolmap.Sim3d:
    """Return the similarity from a model to the given poses, in the coordinates of `_normal`.

    Each pose is compared as four points: the camera's centre, and the ends of its axes, which are as long as the given
    centres are spread. Centres alone would not determine the turn about the line on which a camera moved. The sum of
    the distances is minimised, by reweighted squares, so that a few wrong poses have little effect.
    """
    normal = _normal(given)
    images = {model.image(image).name: model.image(image) for image in sorted(model.reg_image_ids())}
    views = [view for view in given["views"] if view["name"] in images]
    if len(views) < 2:
        return pycolmap.Sim3d()
    poses = [images[view["name"]].cam_from_world() for view in views]
    eyes = np.array([pose.inverse().translation for pose in poses])
    given_eyes = np.array([normal * np.array(view["eye"]) for view in views])
    scale = _scale(eyes, given_eyes)
    found = _corners(eyes, np.array([pose.rotation.matrix() for pose in poses]) / scale)
    wanted = _corners(given_eyes, np.array([view["rotation"] for view in views]))
    weights, fit = np.ones(len(views)), pycolmap.Sim3d()
    for _ in range(FITS):
        fit = _similarity(found, wanted, weights)
        moved = fit.scale * found @ fit.rotation.matrix().T + fit.translation
        away = np.sqrt(np.mean(np.sum((moved - wanted) ** 2, axis=2), axis=1))
        weights = 1.0 / np.maximum(away, NEGLIGIBLE)
    return fit


def _similarity(found: np.ndarray, wanted: np.ndarray, weights: np.ndarray) -> pycolmap.Sim3d:
    """Return the similarity that minimises the weighted squared distances of points (Umeyama 1991).

    Args:
        found: (n, 4, 3) points.
        wanted: (n, 4, 3) where they should be.
        weights: (n,) weights.
    """
    w = (np.repeat(weights, 4) / (4.0 * weights.sum()))[:, None]
    x, y = found.reshape(-1, 3), wanted.reshape(-1, 3)
    x_mean, y_mean = (w * x).sum(axis=0), (w * y).sum(axis=0)
    x, y = x - x_mean, y - y_mean
    U, D, V = np.linalg.svd((w * y).T @ x)
    sign = np.array([1.0, 1.0, np.linalg.det(U @ V)])
    R = U @ np.diag(sign) @ V
    s = float((D * sign).sum() / (w * x**2).sum())
    return pycolmap.Sim3d(s, pycolmap.Rotation3d(R), y_mean - s * R @ x_mean)


def _scale(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the median ratio of the distances between centres (n, 3), which a few wrong ones hardly change."""
    ratios = list[np.ndarray]()
    for shift in range(1, min(len(found), SHIFTS + 1)):
        apart = [np.linalg.norm(eyes - np.roll(eyes, shift, axis=0), axis=1) for eyes in (wanted, found)]
        ratios.append(apart[0] / np.maximum(apart[1], NEGLIGIBLE))
    return max(float(np.median(np.concatenate(ratios))), NEGLIGIBLE)


def _corners(eyes: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the centre of each camera and the ends of its axes, right, down and forward (n, 4, 3)."""
    return np.concatenate([eyes[:, None], eyes[:, None] + axes], axis=1)
