"""Photos whose cameras are known, of something with enough texture for features: a box on a floor."""

import cv2
import numpy as np

from gsplat_edu.camera import Camera, look_at
from gsplat_edu.data.dataset import DataSettings, load_dataset

# A lens of 352 px sees a pixel as 1/352 rad, and moves by 4/352 of a unit at the distance of the box. Reprojection
# errors are a quarter of a pixel, but the lens's own parameters, which so few and so small photos fix badly, take
# up some of the poses: two pixels' worth is allowed.
TURNED = np.degrees(2 / 352)
"""Largest angle between a rotation and its truth, degrees."""

MOVED = 2 * 4 / 352 / 3.6
"""Largest distance of a centre from its truth, as a share of the cameras' extent of 3.6."""

FACES = np.array(
    [
        # corner, and the two edges that leave it; y points down, the floor is y = 0
        [(-4.0, 0.0, -4.0), (8.0, 0.0, 0.0), (0.0, 0.0, 8.0)],
        [(-0.7, -1.0, -0.5), (1.4, 0.0, 0.0), (0.0, 0.0, 1.0)],
        [(-0.7, -1.0, -0.5), (1.4, 0.0, 0.0), (0.0, 1.0, 0.0)],
        [(0.7, -1.0, 0.5), (-1.4, 0.0, 0.0), (0.0, 1.0, 0.0)],
        [(0.7, -1.0, -0.5), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)],
        [(-0.7, -1.0, 0.5), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)],
    ]
)
"""The floor, then the box's top and sides: what comes later hides what came before."""

INSIDE = np.array([0.0, -0.5, 0.0])
"""A point in the box."""

TARGET = np.array([0.1, -0.4, 0.0])
"""What the cameras look at."""

SHARPER = 2
"""Photos are drawn this much larger and made smaller, so that edges are smooth."""


def texture(seed, side):
    """Coloured noise of all sizes, so that features are found near and far."""
    rng, image = np.random.default_rng(seed), np.zeros((side, side, 3), np.float32)
    for cells in (4, 8, 16, 32, 64, 128):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        image += cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 30 * image, 0, 255).astype(np.uint8)


TEXTURES = [texture(i, 512 if i == 0 else 256) for i in range(len(FACES))]


def photograph(camera):
    """Render the scene, RGB; pixel centres are whole numbers."""
    s = SHARPER
    # resizing is about the image's corner, (-1/2, -1/2)
    middle = [(c + 0.5) * s - 0.5 for c in (camera.cx, camera.cy)]
    K = np.array([[camera.fx * s, 0, middle[0]], [0, camera.fy * s, middle[1]], [0, 0, 1]])
    size = (s * camera.W, s * camera.H)
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    for (corner, a, b), picture in zip(FACES, TEXTURES, strict=True):
        outward = np.cross(a, b)
        outward *= np.sign(outward @ (corner + (a + b) / 2 - INSIDE))
        if corner[1] == 0.0:
            outward = np.array([0.0, -1.0, 0.0])  # the floor is seen from above
        if outward @ (camera.eye - corner) <= 0:
            continue
        side = len(picture)
        first = corner + (a + b) / (2 * side)  # the centre of the texture's first pixel
        H = K @ camera.R @ np.stack([a / side, b / side, first - camera.eye], axis=1)
        drawn = cv2.warpPerspective(picture, H, size, flags=cv2.INTER_LINEAR)
        covered = cv2.warpPerspective(np.full((side, side), 255, np.uint8), H, size, flags=cv2.INTER_NEAREST)
        image[covered > 0] = drawn[covered > 0]
    return cv2.resize(image, (camera.W, camera.H), interpolation=cv2.INTER_AREA)


def camera_at(azimuth, elevation=0.45, size=(320, 240)):
    """A camera, 4 away from the box. Held upright or not, the focal length is 352 px."""
    W, H = size
    direction = np.array(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), -np.cos(elevation) * np.cos(azimuth)]
    )
    eye = TARGET + 4.0 * direction
    return Camera(look_at(eye, TARGET), eye, 352.0, 352.0, (W - 1) / 2, (H - 1) / 2, H, W)


def orbit(count, turn=2 * np.pi, size=(320, 240)):
    """Cameras around the box; the height swings, so that the poses fix the focal length."""
    angles = turn * np.arange(count) / count
    return [camera_at(angle, 0.45 + 0.15 * np.sin(3 * angle), size) for angle in angles]


def aligned_errors(found, truth):
    """Move cameras onto their truth by the similarity that brings their centres closest (Umeyama 1991).

    Returns:
        Distances of the centres as shares of the truth's extent; angles between the rotations in degrees; and the
        rotation R of x' = s R x + t.
    """
    names = sorted(found)
    a, b = (np.stack([cameras[name].eye for name in names]) for cameras in (found, truth))
    A, B = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(B.T @ A)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ sign @ Vt
    s = np.trace(np.diag(S) @ sign) / (A**2).sum()
    distances = np.linalg.norm(s * A @ R.T - B, axis=1) / np.linalg.norm(B, axis=1).max()
    traces = [np.trace(found[name].R @ R.T @ truth[name].R.T) for name in names]
    return distances, np.degrees(np.arccos(np.clip((np.array(traces) - 1) / 2, -1, 1))), R


def cameras_of(capture):
    """The cameras of a capture on disk, by the names of their photos."""
    dataset = load_dataset(capture, DataSettings(test_every=0))
    assert dataset.layout == "COLMAP"
    return {view.name: view.camera for view in dataset.train}


def check(found, truth):
    """Compare cameras with their truth; return the rotation between the two worlds."""
    moved, turned, R = aligned_errors(found, truth)
    assert moved.max() < MOVED
    assert turned.max() < TURNED
    return R
