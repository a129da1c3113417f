"""The pairs of photos that a matcher tries: all, likely, consecutive, similar, or taken nearby."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from gsplat_edu.sfm import likely, pairs
from gsplat_edu.sfm.colmap import COLMAP_SEED
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.sequence import PhotoSequence, find_sequence, natural_order

FEW = 59
"""Up to this number of photos every pair is matched, because that makes poses a little better. With 2,000 features per
photo, likely pairs of fox (50 photos) take a quarter of the time, 16 instead of 66 s of processor time, but poses
differ from those of another program by 0.235 % and 0.208 degrees instead of 0.209 % and 0.181 degrees."""

EXHAUSTIVE = 150
"""Up to this number of photos, those that chosen pairs do not connect, or that get no pose from likely pairs, are
matched with all others. Up to this number of faces of panoramas, every pair is matched: 11,175 pairs, ten minutes on
two cores."""

COMPARED = 400
"""Largest number of photos of which all pairs are compared by their largest features: 79,800 pairs, a minute."""

PARTNERS, ENOUGH = 10, 40
"""Each photo is matched with this number of photos, those with the most matches of large features; and with all that
have this number of such matches. Of snowmiku97 these are 16 % of all pairs, 97 % of them hold, and they have 83 % of
the verified matches of all pairs."""

SEQUENCE = 60
"""Smallest number of photos for which a sequence is sought. It takes seconds, and matching all 1,770 pairs minutes on
two cores."""

OVERLAP = {"video": 10, "photos": 4}
"""Each photo is matched with this number of following photos; photos found to be in sequence are matched like a
video."""

ALIKE = {"video": 5, "photos": 25}
"""Each photo is matched with this number of similar photos; in a video, these close loops."""

CLOSE_BY = 15
"""Each photo is matched with this number of photos taken nearby, if EXIF gives the positions of all photos."""


@dataclass(frozen=True)
class Candidates:
    """Chooses the pairs to match.

    Args:
        photos: The photos, in the order of their indices.
        database: COLMAP's database, with their features.
        video: Whether they are the frames of a video.
        unit: Photos with one pose: a panorama's faces, which follow one another in the list.
        progress: Called with the number of pairs compared by their largest features, and their total.
    """

    photos: Sequence[PhotoFacts]
    database: Path
    video: bool = False
    unit: int = 1
    progress: Callable[[int, int], None] = lambda done, total: None

    @cached_property
    def sequence(self) -> PhotoSequence | None:
        """The sequence in which the photos were taken, or None; always None for frames, panoramas, and few photos."""
        if self.video or self.unit > 1 or len(self.photos) < SEQUENCE:
            return None
        names, times = [photo.name for photo in self.photos], [photo.taken for photo in self.photos]
        return find_sequence(names, times, self._described)

    def automatic(self) -> str:
        """Return the matcher that fits the photos."""
        count = len(self.photos)
        if self.video:
            return "nearest"
        if self.sequence is not None:
            return "sequence"
        if self.unit == 1 and FEW < count <= COMPARED:
            return "likely"
        return "exhaustive" if count <= EXHAUSTIVE else "nearest"

    def reason(self, kind: str) -> str:
        """Return why a matcher tries fewer than all pairs of photos; empty for frames, or if it tries all.

        Args:
            kind: The matcher, as `automatic` returns it.
        """
        if kind == "sequence":
            return str(self.sequence)
        if kind == "exhaustive" or self.video:
            return ""
        if kind == "likely":
            return "each photo is matched with those that share most of its largest features"
        nearby = " or were taken nearby" if all(photo.place is not None for photo in self.photos) else ""
        return f"each photo is matched with those that follow it or look alike{nearby}"

    def farther(self, kind: str, part: Collection[int]) -> set[pairs.Pair]:
        """Return more pairs, for photos that the automatic matcher `kind` did not connect, or that got no pose.

        Args:
            kind: The matcher.
            part: The other photos; no more pairs among these are returned.
        """
        inside = set(part)
        wider = self.of("exhaustive") if len(self.photos) <= EXHAUSTIVE else self.of(kind, 3)
        return {(a, b) for a, b in wider if a not in inside or b not in inside}

    def of(self, kind: str, farther: int = 1) -> set[pairs.Pair]:
        """Return the pairs; never two faces of one panorama, which show no depth.

        Args:
            kind: "exhaustive"; "likely": photos that share large features; "sequential"; "nearest": also similar photos
                and those taken nearby; or "sequence": also these, but as few as for a video.
            farther: Factor for the number of similar photos and those taken nearby.
        """
        chosen = self._pairs(kind, farther)
        return chosen if self.unit == 1 else {(a, b) for a, b in chosen if a // self.unit != b // self.unit}

    def _pairs(self, kind: str, farther: int) -> set[pairs.Pair]:
        count = len(self.photos)
        if kind == "exhaustive":
            return pairs.all_pairs(count)
        if kind == "likely":
            return likely.likely_pairs(self._votes, farther * PARTNERS, ENOUGH)
        like = "video" if self.video or kind == "sequence" else "photos"
        overlap, unit = OVERLAP["video"] if kind == "sequential" else OVERLAP[like], range(self.unit)
        chosen = {
            (self.unit * a + i, self.unit * b + j)
            for a, b in pairs.sequential_pairs(count // self.unit, overlap)
            for i in unit
            for j in unit
        }
        order = self._order
        if kind != "sequential":
            chosen |= pairs.nearest_pairs(self._described[order], farther * ALIKE[like], overlap + 1)
            places = [photo.place for photo in (self.photos[i] for i in order) if photo.place is not None]
            if len(places) == count:
                chosen |= pairs.nearest_pairs(pairs.on_the_ground(places), farther * CLOSE_BY)
        return {(min(order[a], order[b]), max(order[a], order[b])) for a, b in chosen}

    @cached_property
    def _order(self) -> list[int]:
        """The photos in sequence: as found, or else by name."""
        if self.sequence is not None:
            return self.sequence.order
        groups = natural_order([photo.name for photo in self.photos[:: self.unit]])
        return [self.unit * group + face for group in groups for face in range(self.unit)]

    @cached_property
    def _described(self) -> Float32[np.ndarray, "n d"]:
        return pairs.photo_descriptors(self.database, [photo.copy for photo in self.photos], COLMAP_SEED)

    @cached_property
    def _votes(self) -> Int64[np.ndarray, "n n"]:
        features = likely.largest_features(self.database, [photo.copy for photo in self.photos])
        total = math.comb(len(features), 2)
        return likely.votes(features, lambda done: self.progress(done, total))
