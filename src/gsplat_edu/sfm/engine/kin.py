"""Photos of other sizes: scaled or cropped photos of the main camera, or photos of another lens.

Photos of one size share a camera. A few photos of another size determine their focal length poorly: the mapper
compensates a wrong one by placing them nearer or farther, and every point still fits. They are therefore registered
again, against the photos of the main camera only, with each focal length that scaling or cropping would give them, and
with the one that fits them best.
"""

from __future__ import annotations

import copy
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from .database import is_wide, opened
from .judge import take_out
from .lenses import Kin, adjust
from .mappers import Options

OWN = 10
"""Trust a camera's own focal length if it has at least this number of photos."""

LEAST = 5
"""Compare the other photos with trusted cameras only if these have at least this number of photos."""

PLACED = 15
"""Smallest number of points that register a photo here; `judge` decides later whether its pose counts."""

INLIER = 4.0
"""Largest reprojection error of a point, px, as in `judge.REPROJECTED`."""

AS_GOOD = 0.95
"""Another focal length explains the photos equally well if its score is at least this fraction of the best score."""

NEARLY_AS_GOOD = 0.9
"""The fraction if the best focal length was fitted to the photos themselves, which always scores slightly higher."""

APART = 1.1
"""Two focal lengths are different if their ratio is at least this."""

ROUNDS = 3
"""Rounds of registration: photos that overlap only with other photos of this kind follow in a later round."""


class MatchedPoints(NamedTuple):
    """The points of the model that a photo sees by its verified matches: places (n, 2) px, points (n, 3)."""

    places: np.ndarray
    points: np.ndarray


def placed_anew(
    model: pycolmap.Reconstruction, database: str, photos: str, folder: Path, options: Options
) -> tuple[pycolmap.Reconstruction, dict[int, Kin], set[int]]:
    """Register the photos of cameras with few photos again, if possible with a focal length related to the main one.

    If two different focal lengths explain the photos of a camera equally well, these photos are removed.

    Args:
        model: A model in which all poses count; not changed.
        database: Features, matches, and whether EXIF gave a camera's focal length.
        photos: Folder of the photos.
        folder: Work folder.
        options: Threads and seed.

    Returns:
        The model, the cameras that are scaled or cropped versions of another one, and the photos removed because no
        single focal length explains them.
    """
    images = {
        camera: [i for i in sorted(model.reg_image_ids()) if model.image(i).camera_id == camera]
        for camera in sorted({model.image(i).camera_id for i in model.reg_image_ids()})
    }
    if not (images := {camera: rows for camera, rows in images.items() if not is_wide(model.camera(camera))}):
        return model, {}, set()
    with opened(database) as reader:
        known = {camera for camera in images if reader.read_camera(camera).has_prior_focal_length}
    few = {camera for camera in images if camera not in known and len(images[camera]) < OWN}
    main = max(images, key=lambda camera: (len(images[camera]), -camera))
    few -= {main}
    others = {image for camera in few for image in images[camera]}
    stay = model.num_reg_images() - len(others)
    if not few or stay < max(LEAST, model.num_reg_images() / 2):
        return model, {}, set()
    rest = copy.deepcopy(model)
    take_out(rest, others)
    if rest.num_reg_images() < LEAST or not rest.num_points3D():
        return model, {}, set()
    adjust(rest, options.threads)
    kin, left = dict[int, Kin](), {camera: list(images[camera]) for camera in few}
    for number in range(ROUNDS):
        found = _placed(rest, database, left, main, kin, options.seed)
        if not found:
            break
        work = folder / f"placed{number}"
        work.mkdir()
        rest = _triangulated(rest, database, photos, work, options)
        left = {camera: [i for i in rows if i not in found] for camera, rows in left.items()}
    return rest, kin, others - set(rest.reg_image_ids())


def _placed(
    rest: pycolmap.Reconstruction,
    database: str,
    left: dict[int, list[int]],
    main: int,
    kin: dict[int, Kin],
    seed: int,
) -> set[int]:
    """Register photos against the model; return those that were registered."""
    found = set[int]()
    for camera, images in sorted(left.items()):
        seen = {image: _seen(rest, database, image) for image in images}
        seen = {image: one for image, one in seen.items() if len(one.places) >= PLACED}
        if not seen:
            continue
        lens = rest.camera(camera)
        focal, fitting = _explained(lens, rest.camera(main), seen, kin.get(camera), seed)
        if focal is None or not fitting:
            continue
        factor = focal / rest.camera(main).mean_focal_length()
        if any(abs(factor / f - 1.0) < 1e-9 for f in _factors(lens, rest.camera(main))):
            kin[camera] = Kin(main, factor)
        _set_lens(lens, rest.camera(main), focal)
        for image in fitting:
            pose, inliers = _pose(lens, seen[image], seed)
            if pose is not None and inliers >= PLACED:
                frame = rest.frame(rest.image(image).frame_id)
                frame.set_cam_from_world(camera, pose)
                rest.register_frame(frame.frame_id)
                found.add(image)
    return found


def _factors(lens: pycolmap.Camera, main: pycolmap.Camera) -> list[float]:
    """List the distinct ratios of focal lengths that result from scaling, cropping, or both."""
    sides = [sorted((camera.width, camera.height)) for camera in (lens, main)]
    found = list[float]()
    for factor in (sides[0][1] / sides[1][1], sides[0][0] / sides[1][0], 1.0):
        if all(_apart(factor, other) for other in found):
            found.append(factor)
    return found


def _apart(a: float, b: float) -> bool:
    return max(a / b, b / a) >= APART


def _explained(
    lens: pycolmap.Camera,
    main: pycolmap.Camera,
    seen: dict[int, MatchedPoints],
    before: Kin | None,
    seed: int,
) -> tuple[float | None, list[int]]:
    """Return the focal length that explains the photos, px (None if several do), and the photos it explains."""
    related = [factor * main.mean_focal_length() for factor in _factors(lens, main)]
    own = [focal for one in seen.values() if (focal := _own_focal(lens, one, seed)) is not None]
    scores = {
        focal: np.array([_score(lens, main, focal, one, seed) for one in seen.values()])
        for focal in related + own
    }
    focal = before.factor * main.mean_focal_length() if before else _chosen(related, scores)
    if focal is None:
        return None, []
    if focal not in scores:
        scores[focal] = np.array([_score(lens, main, focal, one, seed) for one in seen.values()])
    if focal not in related:
        near = [
            [_score(lens, main, focal * by, one, seed) for one in seen.values()] for by in (APART, 1 / APART)
        ]
        if max(map(sum, near)) >= AS_GOOD * scores[focal].sum():
            return None, []
    fits = scores[focal] >= AS_GOOD * np.max([scores[f] for f in related], axis=0)
    fits &= scores[focal] >= NEARLY_AS_GOOD * np.max(list(scores.values()), axis=0)
    return focal, [image for image, fit in zip(seen, fits, strict=True) if fit]


def _chosen(related: list[float], scores: dict[float, np.ndarray]) -> float | None:
    """Choose by the total score of all photos; a focal length related to the main one is preferred."""
    total = {focal: float(score.sum()) for focal, score in scores.items()}
    best = max(total, key=lambda focal: total[focal])
    most = max(total[focal] for focal in related)
    if most < NEARLY_AS_GOOD * total[best]:
        return best
    good = [focal for focal in related if total[focal] >= AS_GOOD * most]
    return good[0] if len(good) == 1 else None


def _score(
    lens: pycolmap.Camera, main: pycolmap.Camera, focal: float, one: MatchedPoints, seed: int
) -> float:
    """Score how well a focal length explains a photo: about the number of points with a small reprojection error."""
    trial = copy.deepcopy(lens)
    _set_lens(trial, main, focal)
    pose, _ = _pose(trial, one, seed)
    return 0.0 if pose is None else float((1.0 / (1.0 + _errors(trial, pose, one) ** 2)).sum())


def _set_lens(lens: pycolmap.Camera, main: pycolmap.Camera, focal: float) -> None:
    """Set a camera's focal length, and copy the main one's distortion, which does not depend on the size."""
    params = np.array(lens.params)
    params[list(lens.focal_length_idxs())] = focal
    if lens.model == main.model:
        params[list(lens.extra_params_idxs())] = np.array(main.params)[list(main.extra_params_idxs())]
    lens.params = params.tolist()


def _estimation(seed: int) -> pycolmap.AbsolutePoseEstimationOptions:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = INLIER, seed
    return options


def _pose(lens: pycolmap.Camera, one: MatchedPoints, seed: int) -> tuple[pycolmap.Rigid3d | None, int]:
    """Register a photo with a known lens; return its pose and the number of inliers."""
    found = pycolmap.estimate_and_refine_absolute_pose(
        one.places, one.points, copy.deepcopy(lens), _estimation(seed)
    )
    if found is None:
        return None, 0
    return found["cam_from_world"], int((_errors(lens, found["cam_from_world"], one) < INLIER).sum())


def _own_focal(lens: pycolmap.Camera, one: MatchedPoints, seed: int) -> float | None:
    """Return the focal length that fits one photo best, px."""
    trial, estimation = copy.deepcopy(lens), _estimation(seed)
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    estimation.estimate_focal_length = refinement.refine_focal_length = True
    found = pycolmap.estimate_and_refine_absolute_pose(one.places, one.points, trial, estimation, refinement)
    return None if found is None or trial.has_bogus_params(0.1, 10.0, 1.0) else trial.mean_focal_length()


def _errors(lens: pycolmap.Camera, pose: pycolmap.Rigid3d, one: MatchedPoints) -> np.ndarray:
    """Return the reprojection errors, px; large for points behind the camera."""
    local = one.points @ pose.rotation.matrix().T + pose.translation
    ahead = local[:, 2] > 0
    found = np.array(lens.img_from_cam(np.where(ahead[:, None], local, [0.0, 0.0, 1.0])), dtype=np.float64)
    errors = np.linalg.norm(np.nan_to_num(found, nan=1e9) - one.places, axis=1)
    return np.asarray(np.where(ahead, errors, 1e9))


def _seen(model: pycolmap.Reconstruction, database: str, number: int) -> MatchedPoints:
    """Collect the points of the model that a photo's matches refer to; each feature gets its most frequent point."""
    votes = dict[int, Counter[int]]()
    with opened(database) as reader:
        keypoints = reader.read_keypoints(number)[:, :2].astype(np.float64)
        for pair, geometry in zip(*reader.read_two_view_geometries(), strict=True):
            ends = pycolmap.pair_id_to_image_pair(pair)
            if number not in ends:
                continue
            mine = ends.index(number)
            other = ends[1 - mine]
            if other not in model.images or not model.image(other).has_pose:
                continue
            features = model.image(other).points2D
            for match in geometry.inlier_matches:
                if (there := features[int(match[1 - mine])]).has_point3D():
                    votes.setdefault(int(match[mine]), Counter())[there.point3D_id] += 1
    chosen = {feature: max(sorted(count), key=lambda p: count[p]) for feature, count in sorted(votes.items())}
    points = np.array([model.point3D(point).xyz for point in chosen.values()]).reshape(-1, 3)
    return MatchedPoints(keypoints[list(chosen)].reshape(-1, 2), points)


def _triangulated(
    model: pycolmap.Reconstruction, database: str, photos: str, folder: Path, options: Options
) -> pycolmap.Reconstruction:
    """Triangulate the points of all photos again, with fixed poses and lenses."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads, pipeline.random_seed = options.threads, options.seed
    return pycolmap.triangulate_points(model, database, photos, str(folder), options=pipeline)
