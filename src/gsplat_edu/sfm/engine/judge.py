"""Which poses of a model count: those that enough points fix, and that the photos' matches do not contradict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pycolmap

from .database import opened

SUPPORT = 30
"""Points that fix a pose: COLMAP's own bound for placing a photo in a model."""

STEADY = 15
"""Of these, points that two photos with a counting pose see as well. A point that only one other photo sees says
nothing about how far apart the two photos stand: half the support may be of that kind."""

SPREAD = 0.02
"""Least standard deviation of the support in the photo, along any direction, as a share of the longer side. Points on a
line or in one spot leave the pose open; an object that takes up a tenth of the photo's width has 0.03."""

REPROJECTED = 4.0
"""Largest reprojection error of a point that supports a pose, px: COLMAP's own bound when it filters points."""

AGREED = 4.0
"""Distance from the epipolar line up to which a match agrees with two poses, px: the bound of its verification."""

CONTRADICTED = 0.3
"""Least share of a photo's matches that have to agree with its pose."""

PARALLAX = 1.5
"""Least angle between the rays to a point, degrees: COLMAP's own bound when it filters points."""

SCATTERED = 2.0
"""Largest ratio of the 90th to the 10th percentile of the focal lengths where every photo has a camera of its own. For
one lens it is about 1.1. Cameras in wrong places absorb that in their focal lengths: 2.7 on a capture of a box with
four equal sides. In between is a zoom that was used within its range."""


class Agreement(NamedTuple):
    """How many verified matches agree with the poses, by photo."""

    agree: dict[int, int]
    total: dict[int, int]

    @property
    def share(self) -> float:
        """Share of all matches that agree."""
        return sum(self.agree.values()) / max(1, sum(self.total.values()))

    @property
    def contradictory(self) -> set[int]:
        """Photos most of whose matches do not fit their poses."""
        return {image for image in self.total if self.agree[image] < CONTRADICTED * self.total[image]}


def unsupported(model: pycolmap.Reconstruction) -> dict[int, int]:
    """Find the photos whose poses do not count.

    A pose counts if `SUPPORT` points, spread over the photo, fix it to photos whose poses count; `STEADY` of them have
    to be seen by two such photos. The first two are those that share the most points.

    Args:
        model: The model.

    Returns:
        How many points fix the pose to the others, by the numbers of the photos.
    """
    seen = {image: _observations(model, image) for image in sorted(model.reg_image_ids())}
    size = 1 + max((int(points.max()) for points, _ in seen.values() if len(points)), default=0)
    best = set[int]()
    left = set(seen)
    while len(left) > len(best):
        grown = _grown(seen, left, size, model)
        if len(grown) > len(best):
            best = grown
        if not grown:
            break
        left -= grown
    count = _counts(seen, best, size)
    return {image: int((count[seen[image][0]] > 0).sum()) for image in sorted(set(seen) - best)}


def _grown(
    seen: dict[int, tuple[np.ndarray, np.ndarray]], left: set[int], size: int, model: pycolmap.Reconstruction
) -> set[int]:
    """Start with the two photos that share the most points, and add what they and the added ones support."""
    first = max(sorted(left), key=lambda image: len(seen[image][0]))
    count = _counts(seen, {first}, size)
    shared = {image: int(count[seen[image][0]].sum()) for image in sorted(left - {first})}
    second = max(shared, key=lambda image: shared[image], default=first)
    if second == first or shared[second] < SUPPORT:
        return {first}
    grown = {first, second}
    while True:
        count = _counts(seen, grown, size)
        added = {
            image
            for image in sorted(left - grown)
            if _supported(count[seen[image][0]], seen[image][1], _longest(model, image))
        }
        if not added:
            return grown
        grown |= added


def _supported(count: np.ndarray, places: np.ndarray, longest: int) -> bool:
    """Say whether points fix a pose, given how many counting photos see each."""
    if (count > 0).sum() < SUPPORT or (count > 1).sum() < STEADY:
        return False
    covariance = np.cov(places[count > 0].T)
    return bool(np.sqrt(max(float(np.linalg.eigvalsh(covariance)[0]), 0.0)) >= SPREAD * longest)


def _counts(seen: dict[int, tuple[np.ndarray, np.ndarray]], images: set[int], size: int) -> np.ndarray:
    """Count, for each point, the photos of a set that see it."""
    count = np.zeros(size, np.int64)
    for image in images:
        count[seen[image][0]] += 1
    return count


def _longest(model: pycolmap.Reconstruction, image: int) -> int:
    camera = model.camera(model.image(image).camera_id)
    return max(camera.width, camera.height)


def _observations(model: pycolmap.Reconstruction, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that a photo sees where they are, and where: numbers (n,) and places (n, 2) in px."""
    points, places, errors = residuals(model, number)
    good = errors < REPROJECTED
    return points[good], places[good]


def residuals(model: pycolmap.Reconstruction, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a photo sees of the model, each point once.

    Args:
        model: The model.
        number: Of the photo.

    Returns:
        numbers of the points (n,), places in the photo (n, 2) px, and reprojection errors (n,) px; infinite for points
        behind the camera.
    """
    image = model.image(number)
    seen = {p.point3D_id: p.xy for p in image.points2D if p.has_point3D()}
    numbers = np.array(list(seen), dtype=np.int64)
    places = np.array(list(seen.values()), dtype=np.float64).reshape(-1, 2)
    if not len(numbers):
        return numbers, places, np.zeros(0)
    xyz = np.stack([model.point3D(int(point)).xyz for point in numbers])
    local = xyz @ image.cam_from_world().rotation.matrix().T + image.cam_from_world().translation
    ahead = local[:, 2] > 0
    safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
    found = np.array(model.camera(image.camera_id).img_from_cam(safe), dtype=np.float64)
    errors = np.linalg.norm(np.nan_to_num(found, nan=1e9) - places, axis=1)
    return numbers, places, np.where(ahead, errors, np.inf)


def agreement(model: pycolmap.Reconstruction, database: str) -> Agreement:
    """Compare the matches of every two photos with their poses, by the Sampson distance.

    Args:
        model: The model.
        database: Holds the verified matches.
    """
    found = Agreement({}, {})
    registered = set(model.reg_image_ids())
    rays = dict[int, np.ndarray]()
    with opened(database) as reader:
        for pair, geometry in zip(*reader.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            if not len(geometry.inlier_matches) or not {first, second} <= registered:
                continue
            for image in (first, second):
                if image not in rays:
                    keypoints = reader.read_keypoints(image)[:, :2].astype(np.float64)
                    camera = model.camera(model.image(image).camera_id)
                    plane: np.ndarray = camera.cam_from_img(keypoints)  # type: ignore[assignment]
                    rays[image] = np.column_stack([plane, np.ones(len(plane))])
            a, b = (rays[i][geometry.inlier_matches[:, k]] for k, i in enumerate((first, second)))
            relative = model.image(second).cam_from_world() * model.image(first).cam_from_world().inverse()
            focal = model.camera(model.image(first).camera_id).mean_focal_length()
            good = int((_sampson(relative, a, b) * focal < AGREED).sum())
            for image in (first, second):
                found.agree[image] = found.agree.get(image, 0) + good
                found.total[image] = found.total.get(image, 0) + len(a)
    return found


def _sampson(relative: pycolmap.Rigid3d, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return distances from the epipolar lines, to first order, on the plane at depth 1."""
    E = pycolmap.essential_matrix_from_pose(relative)
    Ea, Eb = a @ E.T, b @ E
    slopes = (Ea[:, :2] ** 2).sum(axis=1) + (Eb[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * Ea).sum(axis=1)) / np.sqrt(np.maximum(slopes, 1e-30)))


def take_out(model: pycolmap.Reconstruction, images: set[int]) -> None:
    """Take photos out of a model, and the points that lose what held them.

    Args:
        model: Changed.
        images: Numbers of the photos.
    """
    for image in sorted(images):
        model.deregister_frame(model.image(image).frame_id)
    if images and model.num_points3D():
        pycolmap.ObservationManager(model).filter_all_points3D(REPROJECTED, PARALLAX)


def steady_points(model: pycolmap.Reconstruction) -> int:
    """Count the points that three photos and more see."""
    return sum(model.point3D(point).track.length() >= 3 for point in model.point3D_ids())


def scattered(model: pycolmap.Reconstruction) -> bool:
    """Say whether the focal lengths of a model's photos, as shares of their longer sides, are all over the place."""
    cameras = [model.camera(model.image(image).camera_id) for image in sorted(model.reg_image_ids())]
    shares = [camera.mean_focal_length() / max(camera.width, camera.height) for camera in cameras]
    low, high = np.quantile(shares, (0.1, 0.9))
    return bool(high > SCATTERED * low)
