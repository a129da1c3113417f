"""RealityCapture's and RealityScan's poses: a table as CSV, or an XMP file beside each photo.

World axes have +z up. A table has a line with the names of its columns, in any order: `name`, `x`, `y`, `alt` or `z`,
and the rotation, degrees, as `heading`, `pitch` and `roll` or as `omega`, `phi` and `kappa`. With G = diag(1, -1, -1),
the world-to-camera rotations in OpenCV axes are

heading, pitch, roll:  G (Rz(-heading) Rx(pitch) Ry(roll))'
omega, phi, kappa:     G (Ry(kappa) Rx(phi) Rz(-omega))'

The second turns a table of 706 photos into the rotations of the XMP files of the same project, to 1e-13. An XMP has the
rotation world to camera by rows, OpenCV axes, and the camera's centre.

Focal lengths `f` and `FocalLength35mm` are those of a photo whose longer side is 36 mm. Principal points are relative
to the middle, and fractions of the longer side. k1 to k3 are OpenCV's; t1 and t2 are read as p1 and p2.

Source: RealityCapture's help, "XMP Camera Math"; nerfstudio's documentation of its exports.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.data.capture import entries, is_file
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    PoseProgram,
    Poses,
    Shot,
    head_of,
    no_lens,
    numbers_of,
    sized,
    text_of,
    xml_of,
)
from gsplat_edu.photos.decoding import image_size

FILM = 36.0
"""Longer side of the photo to which focal lengths refer, mm."""

OPENGL = np.diag([1.0, -1.0, -1.0])
"""From camera axes with y up that look along -z to OpenCV's."""

ANGLES = (("heading", "pitch", "roll"), ("omega", "phi", "kappa"))

COEFFICIENTS = {"k1": "k1", "k2": "k2", "k3": "k3", "t1": "p1", "t2": "p2"}
"""Our names of the columns with distortion; k4 has no model here."""

EXPORT = "export Internal/External camera parameters, or XMP files"

BROWN3 = "align with the distortion model Brown3, or export undistorted photos"

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"

MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
"""Distortion models of XMP files that are polynomials; those that use k4 are refused."""


def holds_table(path: Path, head: bytes) -> bool:
    """Return whether a file is a table of cameras."""
    return (
        path.suffix.lower() == ".csv" and _columns(head.decode("utf-8", "replace").splitlines()) is not None
    )


def read_table(path: Path) -> Poses:
    """Read a table of cameras.

    Raises:
        DatasetError: the file is damaged, or has no focal lengths.
    """
    poses = table_of(path)
    if not poses.shots:
        raise DatasetError(f"{path}: has no cameras; {EXPORT}")
    return poses


def table_of(path: Path) -> Poses:
    """Read the poses of a table; the lens of a photo raises an error if the table has no focal lengths.

    Raises:
        DatasetError: the file is damaged.
    """
    lines = text_of(path).splitlines()
    header = _columns(lines)
    if header is None:
        raise DatasetError(
            f"{path}: lacks the line with the columns name, x, y, alt, heading, pitch, roll; {EXPORT}"
        )
    at, columns = header
    shots = []
    try:
        for number, row in enumerate(csv.reader(lines[at + 1 :], strict=True), at + 2):
            if not row or row[0].startswith("#"):
                continue
            if len(row) != len(columns):
                raise DatasetError(
                    f"{path}, line {number}: has {len(row)} entries for {len(columns)} columns; {AGAIN}"
                )
            shots.append(_row(f"{path}, line {number}", dict(zip(columns, row, strict=True))))
    except csv.Error as error:
        raise DatasetError(f"{path}: is not a table ({error}); {AGAIN}") from None
    return Poses(path, shots)


def _columns(lines: list[str]) -> tuple[int, list[str]] | None:
    """Return the number of the line with the columns, counted from 0, and their names; None if there is none."""
    for number, line in enumerate(lines[:3]):
        names = [name.strip().lower() for name in line.lstrip("#").split(",")]
        known = {"name", "x", "y"} <= set(names) and {"alt", "z"} & set(names)
        if known and len(set(names)) == len(names) and any(set(angles) <= set(names) for angles in ANGLES):
            return number, names
    return None


def _row(where: str, row: Mapping[str, str]) -> Shot:
    def number(name: str) -> float:
        return float(numbers_of(f"{where}, column {name}", row[name], 1)[0])

    eye = np.array([number("x"), number("y"), number("alt" if "alt" in row else "z")])
    angles = next(names for names in ANGLES if set(names) <= row.keys())
    a, b, c = (math.radians(number(name)) for name in angles)
    if angles == ANGLES[0]:
        R = OPENGL @ (turn(2, -a) @ turn(0, b) @ turn(1, c)).T
    else:
        R = OPENGL @ (turn(1, c) @ turn(0, b) @ turn(2, -a)).T
    if not {"f", "px", "py"} <= row.keys():
        return Shot(row["name"], R, eye, no_lens(f"the table has no columns f, px and py; {EXPORT}"))
    lens = _lens({name: number(name) for name in ("f", "px", "py", *COEFFICIENTS, "k4") if name in row})
    return Shot(row["name"], R, eye, lens)


def turn(axis: int, angle: float) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation about an axis.

    Args:
        axis: 0 to 2 for x to z.
        angle: Radians, positive as seen against the axis.
    """
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = math.cos(angle)
    R[j, i], R[i, j] = math.sin(angle), -math.sin(angle)
    return R


def _lens(found: Mapping[str, float], aspect: float = 1.0) -> Callable[[Path], Lens]:
    if found.get("k4"):
        return no_lens(f"a lens with k4 has no model here; {BROWN3}")

    def lens(photo: Path) -> Lens:
        W, H = image_size(photo)
        longer = max(W, H)
        values = {ours: found.get(name, 0.0) for name, ours in COEFFICIENTS.items()}
        values |= {"fx": found["f"] / FILM * longer, "fy": found["f"] * aspect / FILM * longer}
        values |= {"cx": found["px"] * longer, "cy": found["py"] * longer}
        return sized(values, (W, H))(photo)

    return lens


def holds_xmp(path: Path, head: bytes) -> bool:
    """Return whether a file is an XMP with a pose; those of other programs have none."""
    return path.suffix.lower() == ".xmp" and XCR[1:-1].encode() in head and b"Rotation" in head


def read_xmp(path: Path) -> Poses:
    """Read the XMP files in the folder of one of them; each has the name of its photo.

    Raises:
        DatasetError: one of them is damaged.
    """
    files = [
        each for each in entries(path.parent) if each.suffix.lower() == path.suffix.lower() and is_file(each)
    ]
    return Poses(path.parent, [_xmp(each) for each in files if holds_xmp(each, head_of(each))])


def _xmp(path: Path) -> Shot:
    values = _values(xml_of(path))
    missing = [name for name in ("Rotation", "Position", "FocalLength35mm") if name not in values]
    if missing:
        raise DatasetError(f"{path}: lacks {missing[0]}; export XMP files with camera parameters")

    def numbers(name: str, count: int, default: str | None = None) -> Float64[np.ndarray, " n"]:
        return numbers_of(f"{path}, {name}", values.get(name, default), count)

    R, eye = numbers("Rotation", 9).reshape(3, 3), numbers("Position", 3)
    model = values.get("DistortionModel", MODELS[0])
    k1, k2, k3, k4, t1, t2 = numbers("DistortionCoeficients", 6, "0 0 0 0 0 0").tolist()
    if model not in MODELS:
        lens = no_lens(f"the distortion model {shortened(printable(model))!r} has no model here; {BROWN3}")
    elif numbers("Skew", 1, "0")[0]:
        lens = no_lens("a lens with skew has no model here; align without skew")
    else:
        found = {
            "f": numbers("FocalLength35mm", 1)[0],
            "k1": k1,
            "k2": k2,
            "k3": k3,
            "k4": k4,
            "t1": t1,
            "t2": t2,
        }
        found |= {"px": numbers("PrincipalPointU", 1, "0")[0], "py": numbers("PrincipalPointV", 1, "0")[0]}
        lens = _lens(
            {name: float(value) for name, value in found.items()}, float(numbers("AspectRatio", 1, "1")[0])
        )
    return Shot(path.stem, R, eye, lens)


def _values(xmp: Element) -> dict[str, str]:
    """Return the values of an XMP, which are attributes or elements."""
    found = dict[str, str]()
    for element in xmp.iter():
        found |= {key.removeprefix(XCR): text for key, text in element.attrib.items() if key.startswith(XCR)}
        if element.tag.startswith(XCR) and element.text:
            found[element.tag.removeprefix(XCR)] = element.text
    return found


TABLE = PoseProgram("RealityCapture", holds_table, read_table)
XMP = PoseProgram("RealityCapture", holds_xmp, read_xmp, together=True)
