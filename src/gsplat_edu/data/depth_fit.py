"""Compare depth maps with the points that photos see: find unit and kind, or a scale and a shift for each photo.

A map holds camera depth z, the length of the ray, or a network's inverse depth, which is 1 / z (for a fisheye or a
panorama, 1 / distance) up to a scale and a shift that differ from photo to photo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import short_number

Z, RAY, INVERSE, AUTO_KIND = "z", "ray", "inverse", "auto"
KINDS = (AUTO_KIND, Z, RAY, INVERSE)
"""What the values of maps are; auto decides between z and ray."""

LEAST_POINTS = 30
"""Fewest points of all photos that tell unit and kind."""

LEAST_OF_PHOTO = 8
"""Fewest points by which the map of a photo is judged; twice as many for a scale and a shift."""

MOST_OF_PHOTO = 500
"""Points of a photo that are compared, evenly spaced in their order."""

SPREAD = 0.1
"""Largest median of |depth / point's depth - 1| of maps that agree with the points. A phone's sensor has 0.01 to 0.03,
monocular depth 0.02 to 0.08."""

UNIT_OFF = 0.1
"""Largest relative difference between a unit that the user names and the one that the points tell."""

CERTAIN = 0.2
"""Standard error of the slope up to which points tell z from ray."""

SCALE_RANGE = 5.0
"""Largest factor between the scale of a photo's inverse depth and the median of all photos."""

ROBUST = 1.5
"""Residuals beyond this multiple of the median absolute one, times 1.48, count less: Huber's weights."""

ROUNDS = 20
"""Rounds of reweighting."""


class DepthMisfitError(DatasetError):
    """Depth maps that do not fit the points of their photos.

    Args:
        where: The folder of maps, or the capture.
        reason: What does not fit.
        advice: What to do.
    """

    def __init__(self, where: str, reason: str, advice: str) -> None:
        super().__init__(f"{where}: {reason}; {advice}", reason)
        self.advice = advice


class Matches(NamedTuple):
    """Points in a photo, and what its map says there."""

    values: Float64[np.ndarray, " n"]  # of the map, in its unit
    depths: Float64[np.ndarray, " n"]  # z of the points (for inverse depth, the lens's depth), world units
    lengths: Float64[np.ndarray, " n"]  # length of the point's ray at z = 1


class PhotoFit(NamedTuple):
    """How a map becomes depth: z = scale value, distance = scale value, or depth = 1 / (scale value + shift)."""

    scale: float
    shift: float = 0.0
    farthest: float = math.inf
    """Inverse depth beyond this z is not used, world units: no point supports it."""


class Rejected(NamedTuple):
    """A photo whose map is not used."""

    name: str
    reason: str


@dataclass(frozen=True)
class DepthFit:
    """How the maps of a capture become depth, and how well they agree with its points.

    Args:
        kind: "z", "ray" or "inverse".
        unit: World units for a unit of the maps; 0 for inverse depth.
        points: Number of points that were compared; 0 if unit and kind are unchecked.
        spread: Median of |depth / point's depth - 1|.
        certain: Whether the points, or the user, tell z from ray.
        photos: By photo, how its map becomes depth; rejected photos are missing.
        rejected: Photos whose maps disagree with the points, in the order of their names.
    """

    kind: str
    unit: float
    points: int
    spread: float
    certain: bool
    photos: Mapping[str, PhotoFit]
    rejected: tuple[Rejected, ...]


class _Line(NamedTuple):
    scale: float
    shift: float
    error: float  # standard error of the scale


def fit_depths(
    matches: Mapping[str, Matches],
    kind: str = AUTO_KIND,
    unit: float = 0.0,
    where: str = "depth",
    usual: str = Z,
) -> DepthFit:
    """Find how maps become depth.

    Args:
        matches: By photo, its points and its map's values there.
        kind: One of `KINDS`.
        unit: World units for a unit of the maps; 0 to find it.
        where: Where the maps are, for messages.
        usual: "z" or "ray", which auto takes where the points do not tell.

    Raises:
        DatasetError: there are too few points to find what is not named, the maps agree with them in no unit, or the
            unit that is named does not fit.
    """
    matches = {name: _thinned(each) for name, each in matches.items()}
    count = sum(len(each.values) for each in matches.values())
    if kind == INVERSE:
        return _inverse(matches, where)
    if count < LEAST_POINTS:
        return _unchecked(
            matches, count, usual if kind == AUTO_KIND else kind, unit, where, kind != AUTO_KIND
        )
    every = Matches(*(np.concatenate(column) for column in zip(*matches.values(), strict=True)))
    ratio, length = np.log(every.depths / every.values), np.log(every.lengths)
    line = _robust_line(length, ratio)
    points_tell = line.error < CERTAIN
    kind_of_points = usual if not points_tell else RAY if line.scale < -0.5 else Z
    named = None if kind == AUTO_KIND else kind
    power = 1.0 if (named or kind_of_points) == RAY else 0.0
    level = float(np.median(ratio + power * length))
    found, spread = math.exp(level), _relative(ratio + power * length - level)
    if spread > SPREAD:
        raise DepthMisfitError(where, *_neither(matches, spread))
    if named is not None and points_tell and kind_of_points != named:
        names = {Z: "camera depth (z)", RAY: "lengths of rays"}
        raise DepthMisfitError(
            where,
            f"its values are {names[kind_of_points]}, not {names[named]}: {count:,} points agree",
            "leave depth_kind out",
        )
    if unit > 0 and abs(math.log(found / unit)) > UNIT_OFF:
        raise DepthMisfitError(where, *_other_unit(unit, found, count))
    used = unit if unit > 0 else found
    reasons = {
        name: _why_rejected(np.log(each.depths / each.values) + power * np.log(each.lengths) - math.log(used))
        for name, each in matches.items()
    }
    photos = {name: PhotoFit(used) for name, reason in reasons.items() if reason is None}
    rejected = tuple(Rejected(name, reason) for name, reason in reasons.items() if reason is not None)
    certain = points_tell or named is not None
    return DepthFit(named or kind_of_points, used, count, spread, certain, photos, rejected)


def _unchecked(
    matches: Mapping[str, Matches], count: int, kind: str, unit: float, where: str, certain: bool
) -> DepthFit:
    """Take unit and kind as they are named, because too few points tell them."""
    if unit <= 0:
        raise DepthMisfitError(
            where,
            f"{count} points lie where the maps have depth, too few to find its unit",
            "name it with `depth_unit=U`, the world units for a unit of the maps",
        )
    fits = dict.fromkeys(matches, PhotoFit(unit))
    return DepthFit(kind, unit, 0, 0.0, certain, fits, ())


def _other_unit(unit: float, found: float, count: int) -> tuple[str, str]:
    """Describe a named unit that the points contradict, and what to do."""
    times = short_number(max(found / unit, unit / found), 3)
    larger = "large" if unit > found else "small"
    reason = (
        f"with depth_unit={unit:g}, depth is {times} times too {larger} at {count:,} points of the photos"
    )
    return reason, f"leave depth_unit out, or give {short_number(found, 4)}"


def _why_rejected(off: Float64[np.ndarray, " n"]) -> str | None:
    """Return why a map is not used, from the logarithms of point's depth / depth; None if it is used."""
    if len(off) < LEAST_OF_PHOTO:
        return None
    middle = float(np.median(off))
    if abs(middle) > SPREAD:
        return f"depth is {short_number(math.exp(-middle), 3)} times that of the points"
    if (spread := _relative(off - middle)) > 2 * SPREAD:
        return f"depth differs from that of the points by {100 * spread:.0f} %"
    return None


def _neither(matches: Mapping[str, Matches], spread: float) -> tuple[str, str]:
    """Describe maps that have no unit, and what to do."""
    text = f"they are neither z nor ray length in any unit: depth differs from the points' by {100 * spread:.0f} %"
    try:
        spread = _inverse(matches, "").spread
    except DatasetError:
        return text, "check that the maps belong to these photos and poses"
    return f"{text}, while inverse depth fits to {100 * spread:.1f} %", "take `depth_kind=inverse`"


def _inverse(matches: Mapping[str, Matches], where: str) -> DepthFit:
    """Fit 1 / z = scale value + shift to every photo."""
    lines, spreads, rejected = dict[str, _Line](), dict[str, float](), list[Rejected]()
    for name, each in matches.items():
        if len(each.values) < 2 * LEAST_OF_PHOTO:
            rejected.append(Rejected(name, f"{len(each.values)} points are too few for a scale and a shift"))
            continue
        line = lines[name] = _robust_line(each.values, 1 / each.depths)
        spreads[name] = _relative((line.scale * each.values + line.shift) * each.depths - 1)
    usual = float(np.median([line.scale for line in lines.values()] or [0.0]))
    photos = dict[str, PhotoFit]()
    for name, line in lines.items():
        if usual > 0 and not usual / SCALE_RANGE < line.scale < usual * SCALE_RANGE:
            rejected.append(Rejected(name, f"its scale is {line.scale / usual:.2g} of the usual one"))
        elif spreads[name] > SPREAD:
            rejected.append(
                Rejected(name, f"depth differs from that of the points by {100 * spreads[name]:.0f} %")
            )
        else:
            farthest = 2.0 * float(np.max(matches[name].depths))
            photos[name] = PhotoFit(line.scale, line.shift, farthest)
    if usual <= 0 or not photos:
        raise DepthMisfitError(where, *_no_inverse(rejected, bool(lines), usual))
    spread = float(np.median([spreads[name] for name in photos]))
    count = sum(len(matches[name].values) for name in photos)
    return DepthFit(INVERSE, 0.0, count, spread, True, photos, tuple(sorted(rejected)))


def _no_inverse(rejected: Sequence[Rejected], enough: bool, usual: float) -> tuple[str, str]:
    """Say why no photo has inverse depth, and what to do."""
    if not enough:
        return (
            "no photo sees enough points to find a scale and a shift",
            "inverse depth needs a capture with points",
        )
    if usual <= 0:
        return "larger values are farther away, so the maps are no inverse depth", "leave depth_kind out"
    first = rejected[0]
    return (
        f"{first.name}: {first.reason}, and the others are no better",
        "check that the maps belong to these photos",
    )


def _robust_line(x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> _Line:
    """Fit y = scale x + shift by iteratively reweighted least squares with Huber's weights.

    Sums are NumPy's own: those of a BLAS depend on its number of threads.
    """
    weights = np.ones(len(x))
    scale = shift = 0.0
    error = math.inf
    for _ in range(ROUNDS):
        total = weights.sum()
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        along = x - mean_x
        squares = float((weights * along * along).sum())
        if squares <= 1e-12 * max(float((weights * x * x).sum()), 1e-300):
            return _Line(0.0, float(np.median(y)), math.inf)
        scale = float((weights * along * (y - mean_y)).sum()) / squares
        shift = float(mean_y - scale * mean_x)
        off = y - scale * x - shift
        sigma = 1.48 * float(np.median(np.abs(off)))
        error = sigma / math.sqrt(squares)
        if sigma <= 0:
            break
        weights = np.minimum(1.0, ROBUST * sigma / np.maximum(np.abs(off), 1e-300))
    return _Line(scale, shift, error)


def _relative(off: Float64[np.ndarray, " n"]) -> float:
    return float(np.median(np.abs(off)))


def _thinned(matches: Matches) -> Matches:
    count = len(matches.values)
    if count <= MOST_OF_PHOTO:
        return matches
    rows = np.linspace(0, count - 1, MOST_OF_PHOTO).round().astype(np.int64)
    return Matches(*(column[rows] for column in matches))


def no_jumps(depth: Float64[np.ndarray, "h w"], jump: float, wraps: bool = False) -> Bool[np.ndarray, "h w"]:
    """Return the pixels with depth that lie beside no jump from one surface to another.

    At the edge of an object, a sensor's pixel mixes two depths, and it lies beside the photo's edge. On a plane, the
    inverse depth w is linear in the pixels, however steep the plane is. A jump has both a difference of neighbours and
    a second difference larger than a fraction of w.

    Args:
        depth: NaN where there is none.
        jump: The fraction.
        wraps: Whether the first and the last column are neighbours.
    """
    held: Bool[np.ndarray, "h w"] = np.isfinite(depth)
    with np.errstate(invalid="ignore", divide="ignore"):
        for w, kept, closed in ((1 / depth, held, False), (1 / depth.T, held.T, wraps)):
            here, inner = (w, kept) if closed else (w[1:-1], kept[1:-1])
            before, after = (np.roll(w, 1, 0), np.roll(w, -1, 0)) if closed else (w[:-2], w[2:])
            step = np.maximum(np.abs(here - before), np.abs(after - here))
            bend = np.abs(before - 2 * here + after)
            inner[np.minimum(step, bend) > jump * here] = False  # NaN is no jump
    return held


def matched(names: Sequence[str], count: int = 3) -> str:
    """Name the first photos of a list, and count the others."""
    more = len(names) - count
    return ", ".join(names[:count]) + (f" and {more} more" if more > 0 else "")
