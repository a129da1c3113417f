"""Keyframes of a camera path, and the JSON file that holds them.

    {"format": "gsplat_edu path", "version": 1, "loop": false, "duration": 8.0,
     "keyframes": [{"position": [x, y, z], "rotation": [[...], [...], [...]], "fov": 50.0, "time": 0.0}, ...]}

A keyframe with a time may have a "hold", seconds that the camera rests there, and the path an "ease".

`position` and `rotation` are those of a run's cameras.json: the camera's centre in the coordinates of the scene's file,
and the rotation from camera to world. `docs/FORMATS.md` describes every key. The page's script `keyframes.js` writes
the same file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import ABSENT, Absent, Number, Record, as_json, present, record_of
from gsplat_edu.base.validation import ArrayLike, float64_array
from gsplat_edu.scene.camera import ROTATION_TOLERANCE, Camera

FORMAT = "gsplat_edu path"
VERSION = 1

FEWEST = 2
"""Keyframes of the shortest path."""

FARTHEST = 1e30
"""World units: positions lie within this distance along each axis, so that squares of distances stay finite."""

NARROWEST, WIDEST = 0.01, 179.0
"""Degrees: limits of the vertical field of view."""

LEAST_STEP = 1e-3
"""Seconds: the times of consecutive keyframes differ by at least this."""

LONGEST = 1e6
"""Seconds: limit of times and durations, 11 days."""

Ease = Literal["ends", "views"]
EASES = ENDS, VIEWS = get_args(Ease)
"""Where the camera slows down to a stop: at both ends of the path, or at every keyframe."""

SEGMENT_SECONDS = 2.0
"""Seconds from one keyframe to the next, on average, if a path states neither times nor a duration."""

Place: TypeAlias = tuple[Number, Number, Number]

NO_SHIFT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A camera that a path passes through.

    Args:
        eye: (3,) camera centre, world units.
        R: (3, 3) world-to-camera rotation, rows (right, down, forward).
        fov: Vertical field of view, degrees.
        time: When the path is here, seconds; None if the path chooses.
        hold: How long the camera then rests here, seconds; 0 for no rest. Needs a time.
    """

    eye: Float64[np.ndarray, "3"]
    R: Float64[np.ndarray, "3 3"]
    fov: float
    time: float | None = None
    hold: float = 0.0

    @classmethod
    def of_camera(cls, camera: Camera) -> Keyframe:
        """Return the keyframe with a camera's pose and vertical field of view."""
        return cls(camera.eye, camera.R, math.degrees(2.0 * math.atan(0.5 * camera.H / camera.fy)))


@dataclass(frozen=True, eq=False)
class KeyframePath:
    """The keyframes of a path.

    Args:
        keyframes: At least two; all have times, or none has.
        loop: Whether the path returns from the last keyframe to the first.
        duration: Seconds from the first keyframe to the end; None takes the last keyframe's time, or
            `SEGMENT_SECONDS` per segment without times.
        ease: One of `EASES`, or None for a camera that slows down nowhere.

    Raises:
        ArgumentError: a value is out of range; times and duration contradict each other.
    """

    keyframes: tuple[Keyframe, ...]
    loop: bool
    duration: float | None = None
    ease: str | None = None

    def __post_init__(self) -> None:
        """Check all values."""
        if len(self.keyframes) < FEWEST:
            raise ArgumentError(
                f"keyframes: has {len(self.keyframes)}, but a path needs at least {FEWEST} keyframes"
            )
        for index, keyframe in enumerate(self.keyframes):
            try:
                check_keyframe(keyframe)
            except ArgumentError as error:
                raise type(error)(f"keyframes[{index}].{error}") from None
        if self.ease is not None and self.ease not in EASES:
            raise ArgumentError(f'ease: is {as_json(self.ease)}, but has to be "{ENDS}" or "{VIEWS}"')
        self._check_times()

    @property
    def timed(self) -> bool:
        """Whether the keyframes have times."""
        return self.keyframes[0].time is not None

    @property
    def seconds(self) -> float:
        """Length of the path in time."""
        if self.duration is not None:
            return self.duration
        first, last = self.keyframes[0].time, self.keyframes[-1].time
        if first is not None and last is not None:
            return last + self.keyframes[-1].hold - first
        return SEGMENT_SECONDS * (len(self.keyframes) - (0 if self.loop else 1))

    def placed(self, R: ArrayLike, scale: float, shift: ArrayLike) -> KeyframePath:
        """Return the path that sees the scene x' = scale R x + shift as this one sees x.

        Args:
            R: (3, 3) rotation.
            scale: Above 0.
            shift: (3,) world units of the result.
        """
        turn, by = float64_array("R", R, (3, 3)), float64_array("shift", shift, (3,))
        moved = (replace(k, eye=scale * turn @ k.eye + by, R=k.R @ turn.T) for k in self.keyframes)
        return replace(self, keyframes=tuple(moved))

    def shifted(self, shift: ArrayLike) -> KeyframePath:
        """Return the path with (3,) `shift` added to all positions."""
        by = float64_array("shift", shift, (3,))
        return replace(self, keyframes=tuple(replace(k, eye=k.eye + by) for k in self.keyframes))

    def document(self) -> dict[str, Any]:
        """Return the content of the path's file."""
        duration = {} if self.duration is None else {"duration": self.duration}
        ease = {} if self.ease is None else {"ease": self.ease}
        entries = [_entry(keyframe) for keyframe in self.keyframes]
        head = {"format": FORMAT, "version": VERSION, "loop": self.loop}
        return {**head, **ease, **duration, "keyframes": entries}

    def _check_times(self) -> None:
        if self.duration is not None and not LEAST_STEP <= self.duration <= LONGEST:
            raise ArgumentError(
                f"duration: is {self.duration}, but has to be between {LEAST_STEP} and {LONGEST:g} seconds"
            )
        times = [keyframe.time for keyframe in self.keyframes if keyframe.time is not None]
        if not times:
            return
        if len(times) < len(self.keyframes):
            raise ArgumentError("keyframes: some have a time and some have none; give it for all or for none")
        ends = [time + keyframe.hold for time, keyframe in zip(times, self.keyframes, strict=True)]
        for index, (before, end, after) in enumerate(zip(times, ends, times[1:], strict=False), 1):
            if after - end < LEAST_STEP:
                until = f", which holds until {end}" if end > before else ""
                raise ArgumentError(
                    f"keyframes[{index}].time: is {after}, but has to be at least {LEAST_STEP} s after the"
                    f" keyframe before, at {before}{until}"
                )
        if not self.loop and self.duration is not None:
            raise ArgumentError("duration: follows from the keyframes' times; remove it, or the times")
        if self.loop and (self.duration is None or self.duration - (ends[-1] - times[0]) < LEAST_STEP):
            raise ArgumentError(
                f"duration: is {self.duration}, but a loop with times needs one that is longer than its keyframes,"
                f" {ends[-1] - times[0]} s, for the way back to the first"
            )


class ViewRecord(Record, frozen=True):
    """A pose and a field of view in a file: the camera's centre, the rotation from camera to world, degrees."""

    position: Place
    rotation: tuple[Place, Place, Place]
    fov: Number

    def __post_init__(self) -> None:
        """Check the values."""
        check_keyframe(self.view)

    @property
    def view(self) -> Keyframe:
        """The keyframe, without a time."""
        return Keyframe(np.array(self.position), np.array(self.rotation).T, self.fov)


class KeyframeRecord(ViewRecord, frozen=True):
    """A keyframe of a path's file; see `Keyframe`."""

    time: Number | Absent = ABSENT
    hold: Annotated[float, Meta(ge=LEAST_STEP, le=LONGEST)] | Absent = ABSENT

    @property
    def keyframe(self) -> Keyframe:
        """The keyframe."""
        return replace(self.view, time=present(self.time), hold=present(self.hold) or 0.0)


class PathRecord(Record, frozen=True):
    """The file of a path; see `KeyframePath`."""

    format: Literal["gsplat_edu path"]
    version: Literal[1]
    loop: bool
    keyframes: tuple[KeyframeRecord, ...]
    ease: Ease | Absent = ABSENT
    duration: Number | Absent = ABSENT

    def __post_init__(self) -> None:
        """Check what the values have to be together."""
        _ = self.path

    @property
    def path(self) -> KeyframePath:
        """The path."""
        keyframes = tuple(record.keyframe for record in self.keyframes)
        return KeyframePath(keyframes, self.loop, present(self.duration), present(self.ease))


def read_path(file: Path, origin: ArrayLike = NO_SHIFT) -> KeyframePath:
    """Read a path.

    Args:
        file: The JSON file.
        origin: (3,) subtracted from the positions: the origin that was subtracted from the scene.

    Raises:
        ArgumentError: the file is not a path of this version; the message names the file and the key.
        OSError: the file cannot be read.
    """
    shift = float64_array("origin", origin, (3,))
    try:
        found = parse_json(read_text(file), strict=True)
    except ValueError as error:  # a UnicodeDecodeError is one, too
        raise ArgumentError(f"{file}: is not JSON ({str(error)[:80]}); give a path file") from None
    try:
        return parsed_path(found).shifted(-shift)
    except ArgumentError as error:
        raise ArgumentError(f"{file}: {error}") from None


def write_path(file: Path, path: KeyframePath, origin: ArrayLike = NO_SHIFT) -> None:
    """Write a path.

    Args:
        file: Output file; parent folders are created.
        path: The path.
        origin: (3,) added to the positions.

    Raises:
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    document = path.shifted(origin).document()
    text = json.dumps(document, indent=2, allow_nan=False)
    with written_aside(file) as aside:
        aside.write_text(text + "\n", encoding="utf-8")


def evenly_chosen(cameras: Sequence[Camera], most: int) -> list[Camera]:
    """Choose at most `most` cameras, evenly over the list, from the first to the last.

    Args:
        cameras: At least one.
        most: At least 2.
    """
    if len(cameras) <= most:
        return list(cameras)
    return [cameras[i] for i in np.linspace(0, len(cameras) - 1, most).round().astype(int)]


def check_keyframe(keyframe: Keyframe) -> None:
    """Check the values of a keyframe.

    Raises:
        ArgumentError: one is out of range.
    """
    eye = float64_array("position", keyframe.eye, (3,))
    if np.abs(eye).max() > FARTHEST:
        raise ArgumentError(f"position: is beyond {FARTHEST:g}; move the scene closer to zero")
    R = float64_array("rotation", keyframe.R, (3, 3))
    # the first test also keeps the product finite
    off = np.abs(R).max() > 1.0 + ROTATION_TOLERANCE or np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE
    if off or np.linalg.det(R) < 0:
        raise ArgumentError("rotation: is not a rotation; its columns must be right, down and forward")
    if not NARROWEST <= keyframe.fov <= WIDEST:
        raise ArgumentError(
            f"fov: is {keyframe.fov}, but has to be between {NARROWEST} and {WIDEST:g} degrees"
        )
    if keyframe.time is not None and not abs(keyframe.time) <= LONGEST:
        raise ArgumentError(f"time: is {keyframe.time}, but has to be within {LONGEST:g} seconds of 0")
    if keyframe.hold and keyframe.time is None:
        raise ArgumentError("hold: needs a time of the keyframe")
    if keyframe.hold and not LEAST_STEP <= keyframe.hold <= LONGEST:
        raise ArgumentError(
            f"hold: is {keyframe.hold}, but has to be between {LEAST_STEP} and {LONGEST:g} seconds"
        )


def _entry(keyframe: Keyframe) -> dict[str, Any]:
    time = {} if keyframe.time is None else {"time": keyframe.time}
    hold = {"hold": keyframe.hold} if keyframe.hold else {}
    return {
        "position": keyframe.eye.tolist(),
        "rotation": keyframe.R.T.tolist(),
        "fov": keyframe.fov,
        **time,
        **hold,
    }


def parsed_path(found: object) -> KeyframePath:
    """Return the path that a document describes; positions are as they stand there.

    Args:
        found: The parsed JSON.

    Raises:
        ArgumentError: it is not a path of this version; the message names the key.
    """
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ArgumentError(f'is not a camera path: its "format" has to be "{FORMAT}"')
    record: PathRecord = record_of("", found, PathRecord)
    return record.path
