"""What the readers of other programs' poses share: posed photos, lenses, and files that are checked when read.

Other programs place the centre of the first pixel at (0.5, 0.5), as `gsplat_edu.data.lens.lens_of` expects. Their files
may have keys that nobody here knows; what is read of them is checked.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import msgspec
import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import unreadable
from gsplat_edu.base.reading import open_file, parse_json, read_text
from gsplat_edu.base.records import Number, record_of
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.data.capture import Cloud, unit_colors
from gsplat_edu.data.lens import MAX_SIDE, PINHOLE_LIKE, Lens, lens_of
from gsplat_edu.data.notes import Note
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.photos.decoding import image_size
from gsplat_edu.scene.earth import Earth

HEAD = 4096
"""Bytes at the start of a file by which its program is recognized."""

MOST_XML = 1 << 28
"""Bytes of the largest XML file that is read; its elements need about fifty times as much memory."""

AGAIN = "export it again"
"""Advice for a damaged file."""

Size = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
"""A side of a photo, px."""

Triple = tuple[Number, Number, Number]

Triples = Sequence[Sequence[float] | Float64[np.ndarray, "3"]]


class Foreign(msgspec.Struct, frozen=True):
    """Base of records in files of other programs; unknown keys are ignored."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A posed photo of another program's file.

    Args:
        name: The photo's name or path in the file.
        R: (3, 3) world-to-camera rotation, OpenCV axes.
        eye: (3,) camera centre, world units.
        lens: Returns the lens for the photo's file, whose size counts if the program's file has none; it raises a
            DatasetError if the lens has no model here or is none.
    """

    name: str
    R: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]
    lens: Callable[[Path], Lens]


@dataclass(frozen=True, eq=False)
class Poses:
    """The contents of a pose file.

    Args:
        path: The file.
        shots: Its posed photos.
        cloud: Its points; None if it has none.
        notes: What the user should know about the file.
        without: Names of photos that cannot be posed, with the reason.
        earth: Where on earth the world is, in metres; None if the file does not say.
    """

    path: Path
    shots: Sequence[Shot]
    cloud: Cloud | None = None
    notes: tuple[Note, ...] = ()
    without: tuple[tuple[str, str], ...] = field(default=())
    earth: Earth | None = None


@dataclass(frozen=True)
class PoseProgram:
    """A program whose poses are read.

    Args:
        name: Its name.
        holds: Returns whether a file is one of them, by its name and its first `HEAD` bytes.
        read: Reads such a file. It raises a DatasetError if the file is damaged.
        together: Whether each photo has its own file; `read` then reads all in the folder of the given one.
    """

    name: str
    holds: Callable[[Path, bytes], bool]
    read: Callable[[Path], Poses]
    together: bool = False


def head_of(path: Path) -> bytes:
    """Return the first `HEAD` bytes of a file; none if it cannot be read."""
    try:
        with open_file(path) as file:
            return file.read(HEAD)
    except OSError:
        return b""


def text_of(path: Path) -> str:
    """Read a text file in UTF-8.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        return read_text(path, "utf-8-sig")
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: is not UTF-8 text; {AGAIN}") from None


def json_of(path: Path, kind: Any) -> Any:  # noqa: ANN401
    """Read a JSON file of a known shape.

    Args:
        path: The file.
        kind: The type of its contents, as for `gsplat_edu.base.records.record_of`.

    Raises:
        DatasetError: it is not JSON, or of another shape.
    """
    text = text_of(path)
    try:
        return record_of("", parse_json(text, strict=True), kind)
    except json.JSONDecodeError as error:
        place = f"{path}, line {error.lineno} column {error.colno}"
        raise DatasetError(f"{place}: is not JSON ({error.msg}); {AGAIN}") from None
    except (ArgumentError, ValueError) as error:
        raise DatasetError(f"{path}: {error}; {AGAIN}") from None


def each_of(path: Path, what: str, values: Mapping[str, Any], kind: Any) -> dict[str, Any]:  # noqa: ANN401
    """Convert the values of a JSON object, each of one type.

    Args:
        path: The file, for messages.
        what: What they are, for messages.
        values: The object.
        kind: The type, as for `gsplat_edu.base.records.record_of`.

    Raises:
        DatasetError: one is not of this type; the message has its key.
    """
    found = {}
    for key, value in values.items():
        try:
            found[key] = record_of("", value, kind)
        except ArgumentError as error:
            raise DatasetError(f"{path}, {what} {shortened(printable(key))}: {error}; {AGAIN}") from None
    return found


def xml_of(path: Path) -> ElementTree.Element:
    """Read an XML file. One with a document type is refused: its entities could expand without end.

    Raises:
        DatasetError: it is not XML, has a document type or is huge.
    """
    text = text_of(path)
    if len(text) > MOST_XML:
        raise DatasetError(
            f"{path}: has {len(text):,} characters, at most {MOST_XML:,} are read; export less"
        )
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DatasetError(f"{path}: has a document type, which is refused; {AGAIN} without it")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise DatasetError(f"{path}: is not XML ({error}); {AGAIN}") from None


def numbers_of(where: str, text: str | None, count: int | None = None) -> Float64[np.ndarray, " n"]:
    """Return the numbers of a text, separated by white space.

    Args:
        where: File and place, for messages.
        text: The text; None if it is missing.
        count: How many there have to be; None for any number.

    Raises:
        DatasetError: there are others, or one is no finite number.
    """
    words = (text or "").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.full(1, np.nan)
    if not np.all(np.isfinite(values)) or count not in (None, len(words)):
        wanted = "numbers" if count is None else f"{count} numbers"
        raise DatasetError(f"{where}: is {' '.join(words)[:40]!r}, but has to be {wanted}; {AGAIN}")
    return values


def quaternion(where: str, values: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a quaternion.

    Args:
        where: File and place, for messages.
        values: x, y, z, w, of any length above 0.

    Raises:
        DatasetError: its length is 0.
    """
    length = float(np.linalg.norm(values))
    if not 0 < length < np.inf:
        raise DatasetError(f"{where}: its quaternion has the length {length:g}; {AGAIN}")
    x, y, z, w = (value / length for value in values)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def sized(
    values: Mapping[str, float], size: tuple[int, int] | None, model: str = PINHOLE_LIKE
) -> Callable[[Path], Lens]:
    """Return the lens of a shot from intrinsics in px, whose principal point is relative to the middle of the image.

    Args:
        values: fx, fy, cx, cy in px, and any of the model's coefficients.
        size: Width and height, px; None for those of the photo.
        model: A name in `gsplat_edu.data.lens_formulas.FORMULAS`.
    """

    def lens(photo: Path) -> Lens:
        W, H = size if size is not None else image_size(photo)
        return _lens(tuple(sorted(values.items())), W, H, model)

    return lens


@functools.lru_cache(maxsize=4096)
def _lens(values: tuple[tuple[str, float], ...], W: int, H: int, model: str) -> Lens:
    named = dict(values)
    middle = {"cx": named["cx"] + W / 2, "cy": named["cy"] + H / 2}
    return lens_of({**named, **middle}, W, H, model)


def panorama(size: tuple[int, int]) -> Callable[[Path], Lens]:
    """Return the lens of a shot that is an equirectangular panorama.

    Args:
        size: Width and height, px.
    """
    W, H = size
    return lambda photo: FaceLens.of(W, H, 0)


def no_lens(reason: str) -> Callable[[Path], Lens]:
    """Return the lens of a shot whose lens has no model here: it raises an error with the reason."""

    def lens(photo: Path) -> Lens:
        raise DatasetError(reason)

    return lens


def cloud_of(points: Triples, colors: Triples) -> Cloud | None:
    """Return points with colours of 0 to 255; None if there are none."""
    if not len(points):
        return None
    where, seen = np.array(points, dtype=np.float64), np.array(colors, dtype=np.float64)
    return Cloud(where, unit_colors(seen / 255.0))
