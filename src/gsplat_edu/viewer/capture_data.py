"""What the page of a capture shows: its cameras as outlines, its points, and where photos are missing.

A camera's outline consists of lines in the camera's axes; its longest parts have length 1, and the page chooses their
size in the scene. A perspective lens is a pyramid, a fisheye a cone to the border of its image, or to the
circle in it, and a panorama a sphere.

The points are one little-endian array after another, each with all points in a shuffled order, so that the first n of
them are spread over the whole capture:

    positions   3 float32   world units
    colors      3 uint8     sRGB
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import Cloud, Frame, whole_panoramas
from gsplat_edu.data.left_out import is_left_out, photo_path, read_left_out
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.native_lens import native_intrinsics
from gsplat_edu.data.panorama import PANORAMIC
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.region import document_of
from gsplat_edu.doctor.cameras import SUPPORT, SUPPORT_SHARE
from gsplat_edu.doctor.gap import gap_sentence, widest_gap
from gsplat_edu.doctor.subject import subject_region
from gsplat_edu.paths.orbits import common_up
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.rig import stand_in
from gsplat_edu.survey.finding import Finding
from gsplat_edu.survey.geometry import Geometry
from gsplat_edu.survey.support import observed_points
from gsplat_edu.viewer.capture_matches import matches_of

MOST_POINTS = 200_000
"""More points of a capture are thinned evenly."""

FEW = "few matches"
"""Mark of a photo that far fewer points were matched in than in the others."""

RIM = 24
"""Points on the border of a fisheye's image, and of each ring of a panorama's sphere."""

WIDE = np.radians(80.0)
"""If the border of a fisheye's image sees farther from the optical axis, radians, its outline is the circle inside the
image: the corners of a circular fisheye are black, and drawn behind the camera they would confuse."""

SPHERE = 0.5
"""Radius of a panorama's sphere."""

TICK = 0.2
"""Height of the mark above the upper edge of an image, as a fraction of that edge's distance from the optical axis."""

TO_NEIGHBOUR = 0.8
"""Size of a camera's outline in distances between neighbouring cameras (their median)."""

SMALLEST, LARGEST = 0.05, 0.25
"""Bounds of that size, as fractions of the cameras' spread."""

START_SIZE = (1600, 1000)
"""Width and height of the start view, px."""

START_FOCAL = 1250.0
"""Its focal length, px."""

START_ELEVATION = np.radians(35.0)
"""From the horizon; the start view looks down on the cameras."""

SHOWN = 0.98
"""Fraction of the cameras that the start view shows; a few lost ones far away would make the others tiny."""

FILLED = 0.8
"""Fraction of the start view's width or height that they fill."""

MARGIN = 0.03
"""What a narrow window shows at least around the cameras' places in the start view, as a fraction of its width."""

Vector = Float64[np.ndarray, "3"]
Lines = list[tuple[Vector, Vector]]


@dataclass(frozen=True, eq=False)
class CaptureFacts:
    """What a page of a capture shows.

    Args:
        facts: Its metadata, for JSON.
        points: Its points, packed.
        matches: The matched points of its photos, packed (`gsplat_edu.viewer.capture_matches`); empty if unknown.
        frames: The frame of each camera of the metadata, in its order; a panorama has one.
    """

    facts: dict[str, Any]
    points: bytes
    matches: bytes
    frames: tuple[Frame, ...]


def capture_facts(
    reader: CaptureReader, title: str, findings: Mapping[str, Sequence[str]] | None = None
) -> CaptureFacts:
    """Return the data of a capture's page.

    Args:
        reader: The capture.
        title: Heading of the page.
        findings: What the doctor found about each photo, by the photos' names (`marks_of`); None if it was not asked.

    Raises:
        DatasetError: the capture cannot be read.
    """
    placed = reader.placed()
    frames = tuple(sorted(whole_panoramas(placed.frames), key=lambda frame: frame.name))
    listed = read_left_out(reader.path)
    out = [is_left_out(frame, reader.path, listed) for frame in frames]
    pinholes = [pinhole_of(frame) for frame in frames]
    used = [i for i, gone in enumerate(out) if not gone] or list(range(len(frames)))
    cloud = placed.cloud or Cloud(np.zeros((0, 3)), np.zeros((0, 3)))
    geometry = Geometry([pinholes[i] for i in used], cloud.points)
    gap = widest_gap(geometry)
    names = [legible(frame.name) for frame in frames]
    shapes = _Shapes()
    observed = observed_points(reader.path)
    few = _few(observed, [names[i] for i in used])
    cameras = []
    for i, (frame, camera) in enumerate(zip(frames, pinholes, strict=True)):
        marks = [*([FEW] if names[i] in few else []), *((findings or {}).get(names[i], ()))]
        cameras.append(
            {
                "name": names[i],
                "photo": legible(photo_path(frame, reader.path)),
                "shape": shapes.number(frame.lens),
                "points": observed.get(names[i]) if observed else None,
                "left_out": out[i],
                "marks": marks,
                **_numbers(camera),
            }
        )
    points = chosen_points(cloud)
    matches, numbers = (observed and matches_of(reader.path, frames)) or (None, b"")
    facts = {
        "title": title,
        "count": len(points.points),
        "all_points": len(cloud.points),
        "matches": matches,
        "cameras": cameras,
        "shapes": shapes.found,
        "size": _size(geometry.eyes),
        "start": _start(geometry),
        "near": 1e-3 * _spread(geometry.eyes),
        "gap": None if gap is None else np.round(gap.arc, 6).tolist(),
        "origin": placed.origin.tolist(),
        "subject": document_of(subject_region(geometry)),
        "gap_sentence": gap_sentence(geometry, gap, [names[i] for i in used]),
    }
    return CaptureFacts(facts, packed(points), numbers, frames)


def marks_of(findings: Sequence[Finding]) -> dict[str, list[str]]:
    """Return the names of the doctor's findings by the photos that they concern.

    Args:
        findings: The findings; those about the whole capture, or about pairs of photos, concern none.
    """
    marks: dict[str, list[str]] = {}
    for finding in findings:
        for name in finding.images:
            marks.setdefault(legible(name), []).append(finding.name)
    return marks


def pinhole_of(frame: Frame) -> Camera:
    """Return the pinhole that looks where a photo's camera looked, of at most 90 degrees for a wide lens.

    Args:
        frame: The photo. The distortion of a perspective lens is ignored.
    """
    lens = frame.lens
    native = native_intrinsics(lens) if lens.wide else None
    if native is not None:
        return stand_in(Camera.posed(frame.R, frame.eye, native))
    return Camera(frame.R, frame.eye, lens.fx, lens.fy, lens.cx, lens.cy, lens.H, lens.W)


def outline_of(lens: Lens) -> Float64[np.ndarray, "n 3"]:
    """Return the directions of a photo's border in the camera's axes, of length 1.

    Args:
        lens: The lens.

    Returns:
        The four corners of a perspective photo, clockwise from the top left; `RIM` points on the border of a fisheye's
        image or on the circle in it, clockwise from the right; none for a panorama.
    """
    if lens.model == PANORAMIC:
        return np.zeros((0, 3))
    native = native_intrinsics(lens) if lens.wide else None
    if native is not None:
        return _rim(Camera.posed(np.eye(3), np.zeros(3), native))
    columns = np.array([0.0, lens.W, lens.W, 0.0]) - 0.5
    rows = np.array([0.0, 0.0, lens.H, lens.H]) - 0.5
    plain = np.stack([(columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy])
    found = plain if lens.wide else lens.rays(columns, rows)
    x, y = np.where(np.isfinite(found), found, plain)
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def lines_of(lens: Lens) -> Lines:
    """Return the lines that draw a camera, in its axes: pairs of points."""
    rim = outline_of(lens)
    if not len(rim):
        turn = np.linspace(0.0, 2.0 * np.pi, RIM + 1)
        one, other, none = np.cos(turn), np.sin(turn), 0.0 * turn
        rings = [
            np.stack(parts, axis=1) for parts in ((one, other, none), (none, one, other), (other, none, one))
        ]
        lines = [(SPHERE * a, SPHERE * b) for ring in rings for a, b in pairwise(ring)]
        return [*lines, (np.array([0.0, 0.0, SPHERE]), np.array([0.0, 0.0, 1.0]))]  # where its middle looks
    lines = list(zip(rim, np.roll(rim, -1, axis=0), strict=True))
    lines += [(np.zeros(3), corner) for corner in rim[:: max(1, len(rim) // 4)]]
    top = rim[0] + rim[1] if len(rim) == 4 else 2.0 * rim[np.argmin(rim[:, 1])]
    base = (
        rim[:2] if len(rim) == 4 else rim[[np.argmin(rim[:, 1]) - 1, (np.argmin(rim[:, 1]) + 1) % len(rim)]]
    )
    tip = top / 2.0 + TICK * np.array([0.0, top[1] / 2.0, 0.0])
    return [*lines, *(((0.75 * top / 2.0 + 0.25 * end), tip) for end in base)]


def chosen_points(cloud: Cloud, most: int = MOST_POINTS) -> Cloud:
    """Return at most `most` points of a cloud, spread evenly over its list and then shuffled, always in the same way.

    Args:
        cloud: The points.
        most: Largest number of points.
    """
    count = len(cloud.points)
    rows = np.arange(count)
    if count > most:
        rows = np.linspace(0, count - 1, most).round().astype(np.int64)
    rows = np.random.default_rng(0).permutation(rows)
    return Cloud(cloud.points[rows], cloud.colors[rows])


def packed(cloud: Cloud) -> bytes:
    """Return the points as bytes: positions as float32, then colours as uint8."""
    colors = np.rint(255.0 * np.clip(cloud.colors, 0.0, 1.0)).astype(np.uint8)
    return b"".join([cloud.points.astype("<f4").tobytes(), colors.tobytes()])


class _Shapes:
    """Shapes of cameras, each once."""

    def __init__(self) -> None:
        self.found: list[dict[str, Any]] = []
        self._known: dict[Lens, int] = {}

    def number(self, lens: Lens) -> int:
        """Return the index of a lens's shape."""
        if lens not in self._known:
            self._known[lens] = len(self.found)
            lines = [np.round(np.concatenate(line), 6).tolist() for line in lines_of(lens)]
            self.found.append(
                {
                    "outline": np.round(outline_of(lens), 6).tolist(),
                    "lines": lines,
                    "flat": not lens.wide,
                }
            )
        return self._known[lens]


def _rim(camera: Camera) -> Float64[np.ndarray, "n 3"]:
    """Return rays at the border of a wide image in `RIM` directions, or on its circle if the border sees too far."""
    turn = 2.0 * np.pi * np.arange(RIM) / RIM
    reach = np.stack([np.cos(turn), np.sin(turn)])
    half = np.array([[camera.W / 2.0], [camera.H / 2.0]])
    border = _farthest(camera, reach * np.min(half / np.maximum(np.abs(reach), 1e-9), axis=0))
    return border if border[:, 2].min() > np.cos(WIDE) else _farthest(camera, reach * half.min())


def _farthest(camera: Camera, edge: Float64[np.ndarray, "2 n"]) -> Float64[np.ndarray, "n 3"]:
    """Return the farthest ray on the way from the middle of the image to each place, px from there, of length 1."""
    share = np.linspace(1.0, 0.02, 50)[:, None]
    a = (share * edge[0] + (camera.W - 1) / 2.0 - camera.cx) / camera.fx
    b = (share * edge[1] + (camera.H - 1) / 2.0 - camera.cy) / camera.fy
    rays = camera.projection.directions(a, b, camera.widest)
    first = np.argmax(np.isfinite(rays).all(axis=2), axis=0)
    found = np.nan_to_num(rays[first, np.arange(edge.shape[1])], nan=0.0) + np.array([0.0, 0.0, 1e-9])
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _few(observed: Mapping[str, int], names: Sequence[str]) -> set[str]:
    """Return the photos with far fewer matched points than the others, by the doctor's rule; none if unknown."""
    counts = {name: observed.get(name, 0) for name in names}
    if not observed or not any(counts.values()):
        return set()
    median = float(np.median(list(counts.values())))
    return {name for name, count in counts.items() if count < SUPPORT and count < SUPPORT_SHARE * median}


def _numbers(camera: Camera) -> dict[str, Any]:
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "H", "W")}
    return {"R": np.round(camera.R, 9).tolist(), "eye": camera.eye.tolist(), **numbers}


def _spread(eyes: Float64[np.ndarray, "C 3"]) -> float:
    """Return the distance from the median position that 95 % of the cameras keep; 1 if all are at one place."""
    distances = np.linalg.norm(eyes - np.median(eyes, axis=0), axis=1)
    return float(np.quantile(distances, 0.95)) or 1.0


def _size(eyes: Float64[np.ndarray, "C 3"]) -> float:
    """Return the length of the cameras' outlines, world units."""
    spread = _spread(eyes)
    if len(eyes) < 2:
        return LARGEST * spread
    nearest = cKDTree(eyes).query(eyes, k=[2])[0][:, 0]
    return float(np.clip(TO_NEIGHBOUR * np.median(nearest), SMALLEST * spread, LARGEST * spread))


def _start(geometry: Geometry) -> dict[str, Any]:
    """Return a view from above and behind the cameras that shows all of them and their subject."""
    eyes, up = geometry.eyes, common_up(geometry.cameras)
    middle = np.median(eyes, axis=0)
    subject = middle if geometry.centre is None else geometry.centre
    pivot = (middle + subject) / 2.0
    shown = np.concatenate([eyes, subject[None]])
    ahead = np.median(geometry.axes, axis=0)
    level = ahead - (ahead @ up) * up
    if np.linalg.norm(level) < 0.1:  # cameras all around
        level = geometry.axes[0] - (geometry.axes[0] @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = geometry.cameras[0].R[0] - (geometry.cameras[0].R[0] @ up) * up
    level = level / np.linalg.norm(level)
    away = -np.cos(START_ELEVATION) * level + np.sin(START_ELEVATION) * up
    width, height = START_SIZE
    x, y, z = ((shown - pivot) @ look_at(pivot + away, pivot, up).T).T
    needed = START_FOCAL / FILLED * np.maximum(np.abs(x) / (width / 2.0), np.abs(y) / (height / 2.0)) - z
    distance = max(float(np.quantile(needed, SHOWN)), _spread(eyes))
    camera = Camera.looking_at(pivot + distance * away, pivot, START_FOCAL, START_FOCAL, height, width, up)
    u, v, _ = camera.project(camera.world_to_cam(shown))
    places = np.stack([u, v])[:, np.isfinite(u)]
    (left, top), (right, bottom) = np.quantile(places, (1.0 - SHOWN, SHOWN), axis=1)
    margin = MARGIN * width
    subject_box = [left - margin, top - margin, right + margin, bottom + margin]
    return {
        "camera": _numbers(camera) | {"subject": np.round(subject_box, 2).tolist()},
        "pivot": pivot.tolist(),
        "up": up.tolist(),
    }
