"""The usual mistakes in the conventions of poses and lenses, each with the reading that undoes it.

C is a frame's camera-to-world rotation as read, and e its centre. World axes are not among the mistakes: turning the
whole world (y or z up) changes no photo, so that no photo can tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Capture, Frame
from gsplat_edu.data.lens import PINHOLE_LIKE, Lens
from gsplat_edu.data.lens_formulas import FORMULAS
from gsplat_edu.data.notes import OtherReading
from gsplat_edu.data.panorama import FaceLens

Rotation = Float64[np.ndarray, "3 3"]
Vector = Float64[np.ndarray, "3"]

OPENGL = np.diag([1.0, -1.0, -1.0])
"""OpenCV's camera axes in OpenGL's, and the reverse."""

HALF_TURNS = {
    "the cameras' y and z axes point the other way (OpenGL's axes)": OPENGL,
    "the cameras' x and y axes point the other way (PyTorch3D's axes)": np.diag([-1.0, -1.0, 1.0]),
    "the cameras' x and z axes point the other way": np.diag([-1.0, 1.0, -1.0]),
}
"""Camera axes that are taken for others, by what the photos say about them."""

SCALES = (2.0, 4.0, 8.0)
"""Factors between photos and smaller copies of them."""

HALF_PIXEL = 0.5
"""Difference between the two conventions for the first pixel's centre, px."""

Change = Callable[[Frame], Frame]
"""Makes a frame as read into the frame that was meant."""


def _posed(pose: Callable[[Rotation, Vector], tuple[Rotation, Vector]], frame: Frame) -> Frame:
    """Change a frame's pose by a function of C and e; a panorama's faces change with the panorama."""
    face = frame.lens.R if isinstance(frame.lens, FaceLens) else np.eye(3)
    C, e = pose((face.T @ frame.R).T, frame.eye)
    return replace(frame, R=face @ C.T, eye=e)


def _lens(change: Callable[[Lens], Lens], frame: Frame) -> Frame:
    return replace(frame, lens=change(frame.lens))


def _turned(turn: Rotation, C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    return C @ turn, e


def _inverted(a: Rotation, b: Rotation, C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    return a @ C.T @ b, -a @ C.T @ e


def _transposed(a: Rotation, b: Rotation, C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    return a @ C.T @ b, e


def _transposed_about(a: Rotation, b: Rotation, C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    """Transpose rotations of files whose translations were computed from them."""
    R = a @ C.T @ b
    return R, R @ C.T @ e


def _translated(C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    return C, -C.T @ e


def _centred(turn: Rotation, C: Rotation, e: Vector) -> tuple[Rotation, Vector]:
    return C, -C @ turn @ e


def _poses() -> Iterator[tuple[str, Change]]:
    """Yield the mistakes in poses. Where axes of files may differ too, a mistake has several readings."""
    for name, turn in HALF_TURNS.items():
        yield name, partial(_posed, partial(_turned, turn))
    sides = [(a, b) for a in (np.eye(3), OPENGL) for b in (np.eye(3), OPENGL)]
    for name, pose in (
        ("the matrices are inverted (world-to-camera and camera-to-world are exchanged)", _inverted),
        ("the rotations are transposed", _transposed),
        ("the rotations are transposed", _transposed_about),
    ):
        for a, b in sides:
            yield name, partial(_posed, partial(pose, a, b))
    exchanged = "centres and translations of the cameras are exchanged"
    yield exchanged, partial(_posed, _translated)
    yield exchanged, partial(_posed, partial(_centred, np.eye(3)))
    yield exchanged, partial(_posed, partial(_centred, OPENGL))


def _scaled_focal(scale: float, lens: Lens) -> Lens:
    return replace(lens, fx=lens.fx * scale, fy=lens.fy * scale)


def _other_size(scale: float, lens: Lens) -> Lens:
    """Scale all intrinsics, about the corner of the first pixel."""
    cx, cy = scale * (lens.cx + 0.5) - 0.5, scale * (lens.cy + 0.5) - 0.5
    return replace(lens, fx=lens.fx * scale, fy=lens.fy * scale, cx=cx, cy=cy)


def _sides_exchanged(wide: bool, lens: Lens) -> Lens:
    ratio = lens.W / lens.H
    return _scaled_focal(ratio if wide else 1.0 / ratio, lens)


def _shifted(by: float, lens: Lens) -> Lens:
    return replace(lens, cx=lens.cx + by, cy=lens.cy + by)


def _reordered(order: Sequence[str], signs: Sequence[float], lens: Lens) -> Lens:
    """Take each of the first coefficients from the place of another one."""
    names = FORMULAS[lens.model].names
    padded = (*lens.coefficients, *[0.0] * (len(names) - len(lens.coefficients)))
    moved = [sign * padded[names.index(name)] for name, sign in zip(order, signs, strict=True)]
    return replace(lens, coefficients=(*moved, *padded[len(order) :]))


def _negated(lens: Lens) -> Lens:
    return replace(lens, coefficients=tuple(-c for c in lens.coefficients))


def _without_distortion(lens: Lens) -> Lens:
    return replace(lens, coefficients=(), model=PINHOLE_LIKE)


def _lenses() -> Iterator[tuple[str, Callable[[Lens], Lens]]]:
    """Yield the mistakes in lenses."""
    for scale in SCALES:
        for factor in (scale, 1.0 / scale):
            much = f"{scale:g} times too {'short' if factor > 1 else 'long'}"
            yield f"the focal length is {much}", partial(_scaled_focal, factor)
            size = f"photos {scale:g} times {'smaller' if factor > 1 else 'larger'}"
            yield f"focal length and principal point are those of {size}", partial(_other_size, factor)
    yield "the focal length refers to the photo's height, not its width", partial(_sides_exchanged, True)
    yield "the focal length refers to the photo's width, not its height", partial(_sides_exchanged, False)
    yield (
        "column and row of the principal point are exchanged",
        lambda lens: replace(lens, cx=lens.cy, cy=lens.cx),
    )
    for by in (HALF_PIXEL, -HALF_PIXEL):
        end = "low" if by > 0 else "high"
        yield f"the principal point is half a pixel too {end}", partial(_shifted, by)
    yield "the distortion has the opposite sign", _negated
    yield "the photos are undistorted already", _without_distortion


def _orders() -> Iterator[tuple[str, Callable[[Lens], Lens]]]:
    """Yield the mistakes in the coefficients of a perspective lens."""
    radial = ("k1", "k2", "p1", "p2")
    yield "k1 and k2 are exchanged", partial(_reordered, ("k2", "k1", "p1", "p2"), (1, 1, 1, 1))
    yield "p1 and p2 are exchanged", partial(_reordered, ("k1", "k2", "p2", "p1"), (1, 1, 1, 1))
    yield "k1 and k2 have the opposite sign", partial(_reordered, radial, (-1, -1, 1, 1))
    yield "p1 and p2 have the opposite sign", partial(_reordered, radial, (1, 1, -1, -1))
    yield (
        "k3 is in the place of p1, and p1 and p2 follow it",
        partial(_reordered, ("k1", "k2", "p2", "k3", "p1"), (1, 1, 1, 1, 1)),
    )


POSES: tuple[tuple[str, Change], ...] = tuple(_poses())
LENSES: tuple[tuple[str, Change], ...] = tuple((name, partial(_lens, change)) for name, change in _lenses())
ORDERS: tuple[tuple[str, Change], ...] = tuple((name, partial(_lens, change)) for name, change in _orders())
ALL: tuple[tuple[str, Change], ...] = (*POSES, *LENSES, *ORDERS)


def _keys() -> tuple[str, ...]:
    """Number the readings of one mistake, so that each has a name of its own."""
    names = [name for name, _ in ALL]
    counts = [names[:at].count(name) for at, name in enumerate(names)]
    return tuple(
        name if not count else f"{name} #{count + 1}" for name, count in zip(names, counts, strict=True)
    )


READINGS: dict[str, Change] = dict(zip(_keys(), (change for _, change in ALL), strict=True))
"""All readings by name; those of one mistake that undo it in different files end in #2, #3 and so on."""


def mistake(reading: str) -> str:
    """Return what the photos say is wrong, for a name in `READINGS`."""
    return reading.partition(" #")[0]


def read_as(capture: Capture, reading: str) -> Capture:
    """Return a capture with its poses and lenses under another reading, and a note that says so.

    Args:
        capture: As its reader gives it.
        reading: A name in `READINGS`.

    Raises:
        DatasetError: there is no such reading, or a lens is out of range under it.
    """
    if reading not in READINGS:
        raise DatasetError(f"reading: {reading!r} is not known to this version; train again")
    frames = tuple(READINGS[reading](frame) for frame in capture.frames)
    scale = capture.scale
    if scale is not None and any(np.any(a.eye != b.eye) for a, b in zip(frames, capture.frames, strict=True)):
        scale = replace(scale, earth=None)  # the world is another one
    notes = (*capture.notes, OtherReading(mistake(reading)))
    return replace(capture, frames=frames, notes=notes, scale=scale)


def readings_for(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return the names of the readings that make sense for frames.

    A panorama has no lens to misread. A rolling shutter's motion is given along the pose, so that another pose would
    need another motion: poses of such photos are compared as they are.

    Args:
        frames: At least one.
    """
    found = [] if any(frame.shutter is not None for frame in frames) else [name for name, _ in POSES]
    lenses = [frame.lens for frame in frames]
    if not any(isinstance(lens, FaceLens) for lens in lenses):
        found += [name for name, _ in LENSES]
        if all(lens.model == PINHOLE_LIKE for lens in lenses) and any(lens.distorts for lens in lenses):
            found += [name for name, _ in ORDERS]
    wanted = set(found)
    return tuple(name for name in READINGS if mistake(name) in wanted)
