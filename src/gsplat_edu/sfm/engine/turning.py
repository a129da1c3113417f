"""How much of what panoramas share moves between them by more than a turn of the camera.

A camera that only turns shows the same picture, turned. What is far away, as the sky is, looks like that from
everywhere: such matches say how the camera was turned, but not where it stood.
"""

from __future__ import annotations

import numpy as np
import pycolmap

from .database import opened
from .judge import AGREED

FEWEST = 30
"""Pairs of panoramas with fewer matches do not count."""

DRAWS = 64
"""Number of turns that are tried for a pair, each from two matches. If a third of the matches are far away, the
probability that none of them is right is 5e-4."""

REFITTED = 3
"""Number of times that the best turn is fitted again to the matches that agree with it."""


def moving_share(model: pycolmap.Reconstruction, database: str) -> float:
    """Return the fraction of the matches between frames that no turn of the camera explains within `AGREED` px.

    Args:
        model: The model; its frames are panoramas, whose faces have one centre.
        database: The database with the verified matches.

    Returns:
        From 0 to 1, over all pairs with `FEWEST` matches; 1 if there is none.
    """
    moving = total = 0
    rng = np.random.default_rng(0)
    for (first, second), limit in _pairs(model, database):
        if len(first) >= FEWEST:
            moving += len(first) - int(_turned(first, second, limit, rng).sum())
            total += len(first)
    return moving / total if total else 1.0


def _pairs(
    model: pycolmap.Reconstruction, database: str
) -> list[tuple[tuple[np.ndarray, np.ndarray], float]]:
    """Return, for each pair of frames, the rays of its matches in the axes of both, and `AGREED` px in radians."""
    registered, rays = set(model.reg_image_ids()), dict[int, np.ndarray]()
    found = dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]]()
    with opened(database) as reader:
        for pair, geometry in zip(*reader.read_two_view_geometries(), strict=True):
            images = pycolmap.pair_id_to_image_pair(pair)
            if not len(geometry.inlier_matches) or not set(images) <= registered:
                continue
            frames = [model.image(image).frame_id for image in images]
            if frames[0] == frames[1]:
                continue
            for image in images:
                if image not in rays:
                    rays[image] = _rays(model, image, reader.read_keypoints(image))
            a, b = (rays[image][geometry.inlier_matches[:, k]] for k, image in enumerate(images))
            if frames[0] < frames[1]:
                found.setdefault((frames[0], frames[1]), []).append((a, b))
            else:
                found.setdefault((frames[1], frames[0]), []).append((b, a))
    limit = AGREED / min(camera.mean_focal_length() for camera in model.cameras.values())
    return [
        ((np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])), limit)
        for _, parts in sorted(found.items())
    ]


def _rays(model: pycolmap.Reconstruction, number: int, keypoints: np.ndarray) -> np.ndarray:
    """Return the rays of a face's keypoints, of length 1, in the axes of its frame."""
    image = model.image(number)
    plane = np.array(model.camera(image.camera_id).cam_from_img(keypoints[:, :2].astype(np.float64)))
    rays = np.column_stack([plane, np.ones(len(plane))])
    turn, pose = image.cam_from_world().rotation.matrix(), model.frame(image.frame_id).rig_from_world
    assert pose is not None, "the photo is registered"
    in_frame = turn @ pose.rotation.matrix().T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ in_frame)


def _turned(a: np.ndarray, b: np.ndarray, limit: float, rng: np.random.Generator) -> np.ndarray:
    """Return which rays a agree with the rays b after the turn that most of them agree with."""
    best = np.zeros(len(a), dtype=bool)
    for _ in range(DRAWS):
        drawn = rng.choice(len(a), 2, replace=False)
        agree = _agree(_fitted(a[drawn], b[drawn]), a, b, limit)
        best = agree if agree.sum() > best.sum() else best
    for _ in range(REFITTED):
        if best.sum() >= 2:
            best = _agree(_fitted(a[best], b[best]), a, b, limit)
    return best


def _fitted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the rotation R that makes R a nearest to b (Kabsch 1976)."""
    U, _, V = np.linalg.svd(b.T @ a)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V)


def _agree(R: np.ndarray, a: np.ndarray, b: np.ndarray, limit: float) -> np.ndarray:
    return np.asarray(np.linalg.norm(a @ R.T - b, axis=1) < limit)
