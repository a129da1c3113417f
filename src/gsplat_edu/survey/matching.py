"""Matches between two photos that are found without poses: SIFT features, and a consistent epipolar geometry.

Source: Lowe 2004 for the features and the ratio test; Fischler and Bolles 1981 for random samples; Hartley 1997 for the
eight-point algorithm. All random choices have a fixed seed, and no sum depends on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from gsplat_edu.data.capture import Frame
from gsplat_edu.data.lens import PINHOLE_LIKE, Lens
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.photos.decoding import decode, decode_mask
from gsplat_edu.scene.photo import Photo, resized_mask

SIDE = 1000
"""Distances are px of a photo whose longest side has this length."""

PANORAMA_SIDE = 1600
"""The same for a panorama, whose longest side spans a full turn."""

DETECTED = 0.7
"""Features are detected in photos of this multiple of `SIDE`, in about 0.1 s per photo: OpenCV doubles them first. That
takes half the time of whole ones. As many pairs match (`snowmiku97` 33 and 34, `fox` 36 and 36, 23 photos of weak
texture 10 and 10), with median errors of 0.61 and 0.59, 0.57 and 0.68, 3.7 and 4.2 px. At 0.5, the weak texture has 6
pairs."""

FEATURES = 1200
"""Largest number of features of a photo, the most contrasting first."""

CONTRAST = 0.01
"""Contrast of the weakest features, a quarter of OpenCV's default: plain walls have few others."""

DISTINCT = 0.8
"""A match is kept if its descriptors' distance is below this multiple of the second-best one (Lowe 2004)."""

LEVELS = 512
"""Length of a descriptor, whose entries are whole numbers: their products stay below 2^24, where float32 is exact."""

SAMPLES = 400
"""Samples of eight matches: one of them has no false match with 0.99 if 56 % of the matches are true."""

LOOSE = 4.0
"""Largest distance of a consistent match from its epipolar line, px at `SIDE`. Distortion bends lines by a few px."""

FEWEST = 20
"""Fewer consistent matches of a pair are chance: eight always fit, and some more lie near some line."""

MOST = 60
"""Matches of a pair that are compared, evenly spaced in the list: no pair outweighs others."""

SOLVED = 0.1
"""Largest error of an inverted lens, px."""

CONVERGED = 1e-9
"""Largest error at which the iteration ends early, in units of the focal length."""

STEPS = 60
"""Steps of the fixed-point iteration that inverts a lens."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one photo.

    Args:
        at: (n, 2) columns and rows, px of the photo's lens; pixel centres have integer coordinates.
        descriptors: (n, 128) SIFT descriptors as square roots of unit sums (Arandjelovic and Zisserman 2012), times
            `LEVELS` and rounded.
    """

    at: Float64[np.ndarray, "n 2"]
    descriptors: Float32[np.ndarray, "n 128"]


def features_of(frame: Frame) -> Features:
    """Detect features where the photo is opaque and inside its mask.

    Args:
        frame: A photo, or a whole panorama.

    Raises:
        DatasetError: the photo or its mask cannot be decoded.
    """
    side = round(DETECTED * (PANORAMA_SIDE if isinstance(frame.lens, FaceLens) else SIDE))
    image, alpha = decode(frame.image, frame.orientation, side)
    rgb = image if alpha is None else np.asarray(Photo(image, alpha).over((0.0, 0.0, 0.0)))
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    factor = side / max(grey.shape)
    h, w = (max(1, round(factor * length)) if factor < 1.0 else length for length in grey.shape)
    grey = cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA) if factor < 1.0 else grey
    counts = np.ones((h, w), np.bool_)
    if alpha is not None:
        counts &= resized_mask(alpha >= 128, h, w)
    if frame.mask is not None:
        counts &= resized_mask(decode_mask(frame.mask), h, w)
    return features_in(grey, frame.lens, counts)


def features_in(grey: UInt8[np.ndarray, "h w"], lens: Lens, counts: Bool[np.ndarray, "h w"]) -> Features:
    """Detect features in an image.

    Args:
        grey: (h, w) the image.
        lens: The camera's intrinsics, of any size.
        counts: (h, w) the pixels to look at.
    """
    h, w = grey.shape
    detector = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=CONTRAST)
    found, descriptors = detector.detectAndCompute(grey, counts.astype(np.uint8) * 255)
    at = np.array([point.pt for point in found], np.float64).reshape(-1, 2)
    if not found:
        return Features(at, np.zeros((0, 128), np.float32))
    at, first = np.unique(at, axis=0, return_index=True)  # a place with two directions gives two features
    scale = np.array([lens.W / w, lens.H / h])
    sums = np.maximum(descriptors[first].sum(axis=1, keepdims=True), 1e-9)
    roots = np.sqrt(descriptors[first] / sums)
    return Features((at + 0.5) * scale - 0.5, np.rint(LEVELS * roots))


def rays_through(lens: Lens, at: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Return unit rays through pixels, in the camera's axes; NaN where the lens has none.

    Args:
        lens: A lens, or that of a panorama, whose rays are in the panorama's axes.
        at: (n, 2) px of the lens.
    """
    if isinstance(lens, FaceLens):
        across, down = (at[:, 0] - lens.cx) / lens.fx, (at[:, 1] - lens.cy) / lens.fy
        return np.stack([np.sin(across) * np.cos(down), np.sin(down), np.cos(across) * np.cos(down)], axis=1)
    wanted = np.stack([(at[:, 0] - lens.cx) / lens.fx, (at[:, 1] - lens.cy) / lens.fy])
    rays = np.stack([*_inverted(lens, wanted), np.ones(len(at))], axis=1)
    return np.asarray(rays / np.sqrt(np.sum(rays * rays, axis=1, keepdims=True)))


def _inverted(lens: Lens, wanted: Float64[np.ndarray, "2 n"]) -> Float64[np.ndarray, "2 n"]:
    """Solve for x / z and y / z by steps that undo the remaining error; of wide lenses in angles."""
    if not lens.distorts:
        return wanted
    formula, wide = FORMULAS[lens.model], lens.wide
    coefficients = np.zeros(len(formula.names))
    coefficients[: len(lens.coefficients)] = lens.coefficients

    def slopes(q: Float64[np.ndarray, "2 n"]) -> Float64[np.ndarray, "2 n"]:
        angle = np.hypot(*q)
        return q * np.where(angle > 1e-9, np.tan(angle) / np.maximum(angle, 1e-9), 1.0) if wide else q

    q = wanted.copy()
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            x, y = slopes(q)
            error = wanted - np.stack(formula.image(x, y, coefficients))
            q = q + error
            if np.nanmax(np.abs(error), initial=0.0) < CONVERGED:
                break
        good = (np.hypot(*error) * max(lens.fx, lens.fy) < SOLVED) & (np.hypot(*q) < 1.5 if wide else True)
        return np.asarray(np.where(good, slopes(q), np.nan))


def matches_of(
    one: Features, other: Features, lenses: tuple[Lens, Lens]
) -> tuple[Float64[np.ndarray, "m 2"], Float64[np.ndarray, "m 2"]] | None:
    """Match two photos; None if too few matches are consistent.

    The photos' poses are not used. Neither is the distortion of a perspective lens, which may be misread.

    Args:
        one: Features of a photo.
        other: Features of another one.
        lenses: Their lenses.

    Returns:
        Positions in both photos, at most `MOST` of them.
    """
    rows, columns = _mutual(one.descriptors, other.descriptors)
    if len(rows) < FEWEST:
        return None
    a, b = one.at[rows], other.at[columns]
    rays = [rays_through(_undistorting(lens), at) for lens, at in zip(lenses, (a, b), strict=True)]
    slack = sum(LOOSE * _step(lens) for lens in lenses) / 2.0
    good = np.flatnonzero(_consistent(rays[0], rays[1], slack))
    if len(good) < FEWEST:
        return None
    chosen = good[np.linspace(0, len(good) - 1, min(MOST, len(good))).astype(np.int64)]
    return a[chosen], b[chosen]


def _undistorting(lens: Lens) -> Lens:
    return lens if lens.wide else replace(lens, coefficients=(), model=PINHOLE_LIKE)


def _step(lens: Lens) -> float:
    """Return the angle of a pixel at the size at which features are detected, radians."""
    side = PANORAMA_SIDE if isinstance(lens, FaceLens) else SIDE
    return max(1.0, max(lens.W, lens.H) / side) / max(lens.fx, lens.fy)


def _mutual(
    one: Float32[np.ndarray, "n 128"], other: Float32[np.ndarray, "m 128"]
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Return pairs of features that are nearest to each other and distinct from the second nearest.

    All numbers are whole and below 2^24, hence exact, and the same on every machine.
    """
    if min(len(one), len(other)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    squares = [np.square(descriptors).sum(axis=1) for descriptors in (one, other)]
    distances = squares[0][:, None] + squares[1] - 2.0 * (one @ other.T)
    rows, nearest = np.arange(len(one)), distances.argmin(axis=1)
    first, mutual = distances[rows, nearest], distances.argmin(axis=0)[nearest] == rows
    distances[rows, nearest] = np.inf
    kept = mutual & (first < DISTINCT**2 * distances.min(axis=1))
    return rows[kept], nearest[kept]


def _consistent(
    one: Float64[np.ndarray, "n 3"], other: Float64[np.ndarray, "n 3"], slack: float
) -> Bool[np.ndarray, " n"]:
    """Return which matches fit the epipolar geometry that most of them fit.

    The angle between a ray and the epipolar plane of the other one is at most `slack`, radians, in both photos.
    """
    finite = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)
    rows = np.flatnonzero(finite)
    if len(rows) < FEWEST:
        return np.zeros(len(one), np.bool_)
    a, b = one[rows], other[rows]
    rng = np.random.default_rng(0)
    samples = np.argsort(rng.random((SAMPLES, len(rows))), axis=1, kind="stable")[:, :8]
    equations = (b[samples][..., :, None] * a[samples][..., None, :]).reshape(SAMPLES, 8, 9)
    E = np.linalg.svd(equations)[2][:, 8].reshape(SAMPLES, 3, 3)
    planes, back = np.einsum("sij,nj->sni", E, a), np.einsum("sji,nj->sni", E, b)
    products = np.abs(np.einsum("sni,ni->sn", planes, b))
    lengths = np.minimum(np.linalg.norm(planes, axis=2), np.linalg.norm(back, axis=2))
    fits = products <= np.sin(slack) * np.maximum(lengths, 1e-12)
    found = np.zeros(len(one), np.bool_)
    found[rows[fits[int(np.argmax(fits.sum(axis=1)))]]] = True
    return found
