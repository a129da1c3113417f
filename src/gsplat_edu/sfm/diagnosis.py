"""Why photos get no poses: the cause that measured numbers name, and what to do about it."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.photos.decoding import decode_grey

INLIERS = 15
"""Smallest number of matches with one geometry that connects two photos: COLMAP's own bound."""

FEW_FEATURES = 200
"""A photo with fewer features is weakly textured: photos of the textured box with 120 connect 9 of 91 pairs, with 480
they connect 35."""

WEAK_THRESHOLD = 0.001
"""Detection threshold (difference of Gaussians) for photos with few features; COLMAP's own is 0.0067. On photos of the
textured box with 6 % of its contrast, 0.0067 finds no feature; 0.001 finds 920, which connect 45 of 91 pairs. Another
octave helps no further: photos enlarged four times connect none, those in their own size 31."""

WEAK_SHARE = 0.25
"""Photos with few features are searched again if they are at least this fraction of all; fewer are just left out."""

COMPLETE = 0.5
"""If fewer than this fraction of the photos have a pose, the capture is written, but the command fails."""

PARTNERS = 2
"""A photo that matches fewer others than this, on average, overlaps too little."""

FLAT = 0.5
"""If more than this fraction of the matching pairs show no parallax, photos were taken from one spot, or of a plane."""

NO_PARALLAX = (4, 5, 6)
"""COLMAP's kinds of two-view geometry that a homography explains: of a plane, a rotation, or either."""

BLOCK = 16
"""Side of the blocks in which texture is measured, px."""

BLANK_LEVELS = 2.0
"""A block whose grey values have a smaller standard deviation is blank, of 255."""

BLANK = 0.5
"""Call the background blank if more than this fraction of a photo is."""

WIDE_EDGE = 2.5
"""Call photos blurred if their edges are wider than this, px (standard deviation). Photos of a phone have about 1."""

LOOKED_AT = 12
"""Most photos whose pixels are measured."""


@dataclass(frozen=True)
class Evidence:
    """What is measured of photos and their matches. Medians are over photos or pairs.

    Args:
        photos: Number of photos.
        connected: How many of them are connected by matches.
        features: Median number of features of a photo.
        tried: Number of pairs that were matched.
        matching: Number of pairs with at least `INLIERS` matches of one geometry.
        inliers: Median number of these matches in a matching pair.
        flat: Fraction of the matching pairs without parallax.
        blank: Median fraction of a photo without texture.
        edge: Median width of the edges, px (standard deviation of the blur); 0 if there are none.
    """

    photos: int
    connected: int
    features: int
    tried: int
    matching: int
    inliers: int
    flat: float
    blank: float
    edge: float

    @property
    def numbers(self) -> str:
        """The measured numbers, as a clause."""
        pairs = f"{self.matching:,} of {self.tried:,} pairs match"
        pairs += f" with {self.inliers} inliers" if self.matching else ""
        return f"{self.features} features a photo, {pairs} (medians)"


def diagnosis(found: Evidence) -> str:
    """Return the most likely cause and what to do, as clauses without a full stop.

    Too few features come first, because they also leave few matches; then too little overlap, then missing parallax.
    """
    if found.features < FEW_FEATURES:
        return f"{found.numbers}: {_few_features(found)}"
    if found.connected < found.photos / 2 or 2 * found.matching < PARTNERS * found.photos:
        return (
            f"{found.numbers}: the photos overlap too little; walk around the subject in small steps, each photo"
            " showing two thirds of the previous one"
        )
    if found.flat > FLAT:
        return (
            f"{found.numbers}, {100 * found.flat:.0f} % of them without parallax: photos from one spot, or of"
            " something flat, show no depth; walk around the subject in small steps"
        )
    return (
        f"{found.numbers}, but they yield no common poses: things that move, repeat or mirror contradict one another;"
        " mask them, or take more photos in smaller steps"
    )


def _few_features(found: Evidence) -> str:
    if found.edge > WIDE_EDGE:
        return f"the photos are blurred (edges are {found.edge:.1f} px wide); hold still, use more light, and focus"
    if found.blank > BLANK:
        return (
            f"{100 * found.blank:.0f} % of a photo is blank; show more of a textured surrounding, or put things with"
            " texture beside the subject, such as printed paper"
        )
    return (
        "the subject has little texture; photograph closer and in raking light, put things with texture beside it,"
        " and try --max-image-size with the photos' full size"
    )


def evidence(folder: Path, photos: Sequence[Path], connected: int) -> Evidence:
    """Measure photos and their matches.

    Args:
        folder: Work folder with COLMAP's database.db.
        photos: The copies of the photos.
        connected: How many are connected by matches.
    """
    with closing(
        sqlite3.connect(f"{(folder / 'database.db').absolute().as_uri()}?mode=ro", uri=True)
    ) as reader:
        counts = reader.execute(
            "SELECT COALESCE(k.rows, 0) FROM images i LEFT JOIN keypoints k ON k.image_id = i.image_id"
        ).fetchall()
        tried = reader.execute("SELECT COUNT(*) FROM matches").fetchone()[0]
        query = "SELECT rows, config FROM two_view_geometries WHERE rows >= ?"
        verified = np.array(reader.execute(query, (INLIERS,)).fetchall(), dtype=np.int64).reshape(-1, 2)
    looked_at = [photos[i * len(photos) // LOOKED_AT] for i in range(LOOKED_AT)] if photos else []
    greys = map(_grey, dict.fromkeys(looked_at))
    measured = [texture(grey) for grey in greys if grey is not None]
    blank, edge = np.median(measured, axis=0).tolist() if measured else (0.0, 0.0)
    return Evidence(
        photos=len(photos),
        connected=connected,
        features=_median([count for (count,) in counts]),
        tried=tried,
        matching=len(verified),
        inliers=_median(verified[:, 0].tolist()),
        flat=float(np.isin(verified[:, 1], NO_PARALLAX).mean()) if len(verified) else 0.0,
        blank=blank,
        edge=edge,
    )


def _grey(path: Path) -> Float32[np.ndarray, "H W"] | None:
    """Return the grey values of a photo, 0 to 255; None if it cannot be decoded."""
    try:
        return decode_grey(path).astype(np.float32)
    except DatasetError:
        return None


def texture(grey: Float32[np.ndarray, "H W"]) -> tuple[float, float]:
    """Return the fraction of a photo that is blank, and the width of its strongest edges.

    An edge blurred by a Gaussian of s px has |I'| = h exp(-x^2 / 2 s^2) / (s sqrt(2 pi)), so max |I''| / max |I'| is
    exp(-1/2) / s. The ratio of high quantiles of both gives s.

    Args:
        grey: (H, W) grey values, 0 to 255.

    Returns:
        The fraction of blocks whose standard deviation is below `BLANK_LEVELS`, and s in px; 0 without edges.
    """
    H, W = (side // BLOCK * BLOCK for side in grey.shape)
    if not H or not W:
        return 0.0, 0.0
    blocks = grey[:H, :W].reshape(H // BLOCK, BLOCK, W // BLOCK, BLOCK)
    blank = float((blocks.std(axis=(1, 3)) < BLANK_LEVELS).mean())
    first = np.abs(grey[:, 2:] - grey[:, :-2]) / 2
    second = np.abs(grey[:, 2:] - 2 * grey[:, 1:-1] + grey[:, :-2])
    slope, bend = (float(np.quantile(values, 0.99)) for values in (first, second))
    return blank, float(np.exp(-0.5)) * slope / bend if slope > BLANK_LEVELS and bend > 0 else 0.0


def _median(values: Sequence[int]) -> int:
    return int(np.median(values)) if len(values) else 0
