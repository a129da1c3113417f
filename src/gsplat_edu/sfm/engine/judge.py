"""Decide which poses count: enough points must determine a pose, and the photo's matches must not contradict it."""

from __future__ import annotations

from collections.abc import Container
from typing import NamedTuple

import numpy as np
import pycolmap

from .database import is_wide, opened

SUPPORT = 30
"""Smallest number of points that determine a pose: COLMAP's own bound for registering a photo."""

STEADY = 15
"""Smallest number of the supporting points that two other photos with a counting pose see. A point seen by only one
other photo does not determine the distance between the two photos; up to half of the points may be of this kind."""

LEAST_POINT_SPREAD = 0.02
"""Smallest standard deviation of the supporting points in the photo, along any direction, as a fraction of the longer
side. Points on a line or in one spot do not determine the pose. An object as wide as a tenth of the photo has 0.03."""

REPROJECTED = 4.0
"""Largest reprojection error of a point that supports a pose, px: COLMAP's own bound when it filters points."""

AGREED = 4.0
"""A match agrees with two poses if its distance from the epipolar line is at most this, px, as in COLMAP's
verification."""

CONTRADICTED = 0.3
"""Smallest fraction of a photo's matches that have to agree with its pose."""

PARALLAX = 1.5
"""Smallest angle between the rays to a point, degrees: COLMAP's own bound when it filters points."""

SCATTERED = 2.0
"""Largest ratio of the 90th to the 10th percentile of the focal lengths if every photo has its own camera. For one lens
it is about 1.1. Misplaced cameras compensate with their focal lengths: 2.7 on a capture of a box with four equal sides.
A zoom lens lies in between."""


class Agreement(NamedTuple):
    """Number of verified matches, and number of matches that agree with the poses, by photo."""

    agree: dict[int, int]
    total: dict[int, int]

    @property
    def share(self) -> float:
        """Fraction of all matches that agree."""
        return sum(self.agree.values()) / max(1, sum(self.total.values()))

    def contradictory(self, model: pycolmap.Reconstruction) -> set[int]:
        """Return the photos with too few matches that fit their poses. Photos of one frame have one pose."""
        found = set[int]()
        for images in frames(model).values():
            agree, total = (
                sum(count.get(image, 0) for image in images) for count in (self.agree, self.total)
            )
            if agree < CONTRADICTED * total:
                found |= set(images)
        return found


def frames(model: pycolmap.Reconstruction) -> dict[int, list[int]]:
    """Return the registered photos of each frame, sorted: one, or the faces of a panorama."""
    found = dict[int, list[int]]()
    for image in sorted(model.reg_image_ids()):
        found.setdefault(model.image(image).frame_id, []).append(image)
    return found


def unsupported(model: pycolmap.Reconstruction, trusted: Container[str] = ()) -> dict[int, int]:
    """Find the photos whose poses do not count.

    Photos of one frame have one pose and count as one photo. A pose counts if the photo shares `SUPPORT` points, spread
    over the photo, with photos whose poses count; two such photos have to see `STEADY` of them. The search starts with
    the two photos that share the most points, or with the photos whose poses count in any case.

    Args:
        model: The model.
        trusted: Names of the photos whose poses count in any case.

    Returns:
        By number of each such photo, the number of points that it shares with photos whose poses count.
    """
    photos = frames(model)
    seen = {frame: _together(model, images) for frame, images in photos.items()}
    longest = {frame: _longest(model, images[0]) for frame, images in photos.items()}
    size = 1 + max((int(points.max()) for points, _ in seen.values() if len(points)), default=0)
    best = {frame for frame, images in photos.items() if any(model.image(i).name in trusted for i in images)}
    left = set(seen)
    if best:
        best = left = _extended(seen, left, best, size, longest)
    while len(left) > len(best):
        grown = _grown(seen, left, size, longest)
        if len(grown) > len(best):
            best = grown
        if not grown:
            break
        left -= grown
    count = _counts(seen, best, size)
    return {
        image: int((count[seen[frame][0]] > 0).sum())
        for frame in sorted(set(seen) - best)
        for image in photos[frame]
    }


def _grown(
    seen: dict[int, tuple[np.ndarray, np.ndarray]], left: set[int], size: int, longest: dict[int, int]
) -> set[int]:
    """Start with the two frames that share the most points, and repeatedly add the photos that they support."""
    first = max(sorted(left), key=lambda image: len(seen[image][0]))
    count = _counts(seen, {first}, size)
    shared = {image: int(count[seen[image][0]].sum()) for image in sorted(left - {first})}
    second = max(shared, key=lambda image: shared[image], default=first)
    if second == first or shared[second] < SUPPORT:
        return {first}
    return _extended(seen, left, {first, second}, size, longest)


def _extended(
    seen: dict[int, tuple[np.ndarray, np.ndarray]],
    left: set[int],
    start: set[int],
    size: int,
    longest: dict[int, int],
) -> set[int]:
    """Add the frames that the first ones support, those that these support, and so on."""
    grown = set(start)
    while True:
        count = _counts(seen, grown, size)
        added = {
            image
            for image in sorted(left - grown)
            if _supported(count[seen[image][0]], seen[image][1], longest[image])
        }
        if not added:
            return grown
        grown |= added


def _supported(count: np.ndarray, places: np.ndarray, longest: int) -> bool:
    """Return whether points determine a pose, given how many photos whose pose counts see each."""
    if (count > 0).sum() < SUPPORT or (count > 1).sum() < STEADY:
        return False
    covariance = np.cov(places[count > 0].T)
    return bool(np.sqrt(max(float(np.linalg.eigvalsh(covariance)[0]), 0.0)) >= LEAST_POINT_SPREAD * longest)


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
    """Return the points with a small reprojection error in a photo: numbers (n,) and places (n, 2) in px."""
    points, places, errors = residuals(model, number)
    good = errors < REPROJECTED
    return points[good], places[good]


def _together(model: pycolmap.Reconstruction, images: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the observations of a frame, each point once; the photos of a frame lie side by side, in px."""
    found = [_observations(model, image) for image in images]
    if len(found) == 1:
        return found[0]
    points, first = np.unique(np.concatenate([points for points, _ in found]), return_index=True)
    shifts = np.arange(len(found))[:, None] * [1.0, 0.0] * _longest(model, images[0])
    places = np.concatenate([places + shift for (_, places), shift in zip(found, shifts, strict=True)])
    return points, places[first]


def residuals(model: pycolmap.Reconstruction, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that a photo sees, each once.

    Args:
        model: The model.
        number: Number of the photo.

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
    """Compare the matches of all pairs of photos with their poses, by the Sampson distance.

    Args:
        model: The model.
        database: The database with the verified matches.
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
            cameras = [model.camera(model.image(i).camera_id) for i in (first, second)]
            apart = _angles if any(map(is_wide, cameras)) else _sampson
            good = int((apart(relative, a, b) * cameras[0].mean_focal_length() < AGREED).sum())
            for image in (first, second):
                found.agree[image] = found.agree.get(image, 0) + good
                found.total[image] = found.total.get(image, 0) + len(a)
    return found


def _sampson(relative: pycolmap.Rigid3d, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return first-order distances from the epipolar lines, on the plane at depth 1."""
    E = pycolmap.essential_matrix_from_pose(relative)
    Ea, Eb = a @ E.T, b @ E
    slopes = (Ea[:, :2] ** 2).sum(axis=1) + (Eb[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((b * Ea).sum(axis=1)) / np.sqrt(np.maximum(slopes, 1e-30)))


def _angles(relative: pycolmap.Rigid3d, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return first-order angles from the epipolar planes, radians, for rays far from the optical axis."""
    E = pycolmap.essential_matrix_from_pose(relative)
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    Ea, Eb = a @ E.T, b @ E
    slopes = (Ea**2).sum(axis=1) + (Eb**2).sum(axis=1)
    return np.asarray(np.abs((b * Ea).sum(axis=1)) / np.sqrt(np.maximum(slopes, 1e-30)))


def take_out(model: pycolmap.Reconstruction, images: set[int]) -> None:
    """Remove photos, the other photos of their frames, and points without support from a model.

    Args:
        model: The model; changed in place.
        images: Numbers of the photos.
    """
    for frame in sorted({model.image(image).frame_id for image in images}):
        model.deregister_frame(frame)
    if images and model.num_points3D():
        pycolmap.ObservationManager(model).filter_all_points3D(REPROJECTED, PARALLAX)


def steady_points(model: pycolmap.Reconstruction) -> int:
    """Count the points seen by at least three photos."""
    return sum(model.point3D(point).track.length() >= 3 for point in model.point3D_ids())


def scattered(model: pycolmap.Reconstruction) -> bool:
    """Return whether the focal lengths of a model's photos, relative to their longer sides, vary too much."""
    cameras = [model.camera(model.image(image).camera_id) for image in sorted(model.reg_image_ids())]
    shares = [camera.mean_focal_length() / max(camera.width, camera.height) for camera in cameras]
    low, high = np.quantile(shares, (0.1, 0.9))
    return bool(high > SCATTERED * low)
