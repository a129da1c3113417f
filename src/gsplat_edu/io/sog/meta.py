"""The validated contents of a SOG's meta.json.

Source: PlayCanvas' specification of SOG, section 2.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Float32

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.records import Record, record_of
from gsplat_edu.io.scene import SceneFrame, extras, read_extras
from gsplat_edu.io.sog.palette import CODEBOOK, MOST_ENTRIES
from gsplat_edu.io.sog.values import LARGEST_LOG, Range

VERSION = 2

MOST_SPLATS = 1 << 26
"""Most splats that are read and written: 67 million, in images of 8192 x 8192 pixels."""

COEFFICIENTS = {1: 3, 2: 8, 3: 15}
"""Coefficients per channel above degree 0, by degree; the specification calls degrees bands."""

GENERATOR = "gsplat-edu"

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,99}", re.ASCII)
"""A file name that stays inside the folder: no slash, no drive, no leading dot."""

ANTIALIASED_MODEL = "antialiased"

MODELS = ("default", ANTIALIASED_MODEL)
"""Splat models, which specify whether to render with antialiasing."""

LARGEST_FLOAT = float(str(np.finfo(np.float32).max))
"""The shortest decimal form of the largest float32: slightly larger, but parsed as the same float32."""

MEANS, QUATS = ("means_l.webp", "means_u.webp"), ("quats.webp",)
SCALES, SH0 = ("scales.webp",), ("sh0.webp",)
SHN = ("shN_centroids.webp", "shN_labels.webp")
"""Names of written images; other names may be read."""


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Description of the palette of harmonics.

    Args:
        entries: Number of entries in the palette.
        degree: Highest degree, 1 to 3.
        codebook: (256,) values that the palette's bytes select.
        files: Names of the images with entries and labels.
    """

    entries: int
    degree: int
    codebook: Float32[np.ndarray, "256"]
    files: tuple[str, ...] = SHN

    @property
    def coefficients(self) -> int:
        """Coefficients per channel."""
        return COEFFICIENTS[self.degree]


@dataclass(frozen=True, eq=False)
class Meta:
    """The contents of a meta.json.

    Args:
        count: Number of splats.
        span: Lowest and highest logarithm of each coordinate.
        scales: (256,) logarithms of scales that bytes select.
        sh0: (256,) coefficients of degree 0 that bytes select.
        harmonics: The palette; None for a scene of degree 0.
        antialiased: Whether the scene was trained with antialiasing; None if unspecified.
        frame: What is known of the coordinates.
        means: Names of the images with low and high bytes.
        quats: Name of the image of rotations.
        log_scales: Name of the image of scales.
        colors: Name of the image of coefficients of degree 0 and opacities.
    """

    count: int
    span: Range
    scales: Float32[np.ndarray, "256"]
    sh0: Float32[np.ndarray, "256"]
    harmonics: Harmonics | None
    antialiased: bool | None
    frame: SceneFrame
    means: tuple[str, ...] = MEANS
    quats: tuple[str, ...] = QUATS
    log_scales: tuple[str, ...] = SCALES
    colors: tuple[str, ...] = SH0

    @property
    def splat_images(self) -> tuple[str, ...]:
        """Names of the images with a pixel per splat; labels of harmonics come last."""
        labels = self.harmonics.files[1:] if self.harmonics else ()
        return (*self.means, *self.quats, *self.log_scales, *self.colors, *labels)

    @property
    def images(self) -> tuple[str, ...]:
        """Names of all images."""
        return (*self.splat_images, *(self.harmonics.files[:1] if self.harmonics else ()))

    def scene_bytes(self) -> int:
        """Return the size of the scene in float32, in bytes."""
        coefficients = self.harmonics.coefficients if self.harmonics else 0
        return 4 * self.count * (14 + 3 * coefficients)


def to_json(meta: Meta) -> bytes:
    """Write a meta.json; equal scenes give equal bytes.

    Codebook values are written with the fewest digits that restore the same float32. The frame is stored in
    asset.extras, which other readers ignore. Antialiasing is stored twice: as "antialias" from the specification, and
    as "model", which PlayCanvas' splat-transform reads and writes since 3.2 and omits for the default model.
    """
    asset: dict[str, object] = {"generator": GENERATOR}
    if frame := extras(meta.frame):
        asset["extras"] = frame
    document: dict[str, object] = {"version": VERSION, "asset": asset, "count": meta.count}
    if meta.antialiased is not None:
        document["antialias"] = meta.antialiased
        if meta.antialiased:
            document["model"] = ANTIALIASED_MODEL
    low, high = meta.span
    document["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": meta.means}
    document["scales"] = {"codebook": _short(meta.scales), "files": meta.log_scales}
    document["quats"] = {"files": meta.quats}
    document["sh0"] = {"codebook": _short(meta.sh0), "files": meta.colors}
    if meta.harmonics:
        document["shN"] = {
            "count": meta.harmonics.entries,
            "bands": meta.harmonics.degree,
            "codebook": _short(meta.harmonics.codebook),
            "files": meta.harmonics.files,
        }
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")


def _short(codebook: Float32[np.ndarray, "256"]) -> list[float]:
    return [float(str(entry)) for entry in codebook]


def from_json(path: Path, data: bytes) -> Meta:
    """Read a meta.json.

    Args:
        path: Name of the scene, for messages.
        data: The file's bytes.

    Raises:
        SceneFormatError: not a meta.json of version 2, or with impossible values.
    """
    try:
        document = parse_json(data, strict=True)
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise SceneFormatError(f"{path}: its metadata is not JSON ({reason}); get the file again") from None
    version = _at(document, "version")
    if version is None and _at(document, "means.shape") is not None:
        version = 1  # version 1 has no such key
    if isinstance(version, bool) or version != VERSION:
        said = f"version {version}" if type(version) is int and 0 < version < 1000 else "no version"
        raise SceneFormatError(
            f"{path}: is SOG of {said}, but only version 2 is supported; export it as version 2"
        )
    try:
        return _read(record_of("", document, _Document), read_extras(_at(document, "asset.extras")))
    except ValueError as error:
        raise SceneFormatError(f"{path}: its metadata is damaged ({error}); get the file again") from None


def _read(document: _Document, frame: SceneFrame) -> Meta:
    antialiased, means, palette = document.antialias, document.means, document.harmonics
    if antialiased is None and document.model in MODELS:
        antialiased = document.model == ANTIALIASED_MODEL
    return Meta(
        count=document.count,
        span=(np.array(means.mins), np.array(means.maxs)),
        scales=document.scales.entries(),
        sh0=document.sh0.entries(),
        harmonics=Harmonics(palette.count, palette.bands, palette.entries(), palette.files)
        if palette
        else None,
        antialiased=antialiased,
        frame=frame,
        means=means.files,
        quats=document.quats.files,
        log_scales=document.scales.files,
        colors=document.sh0.files,
    )


_File = Annotated[str, msgspec.Meta(pattern=rf"^{NAME.pattern}\Z(?#a plain file name)")]
_Log = Annotated[float, msgspec.Meta(ge=-LARGEST_LOG, le=LARGEST_LOG)]
_Entry = Annotated[float, msgspec.Meta(ge=-LARGEST_FLOAT, le=LARGEST_FLOAT)]


class _Part(Record, frozen=True, forbid_unknown_fields=False):
    """A part of a meta.json, in which other programs may store more."""


class _Means(_Part, frozen=True):
    mins: tuple[_Log, _Log, _Log]
    maxs: tuple[_Log, _Log, _Log]
    files: tuple[_File, _File]


class _Quats(_Part, frozen=True):
    files: tuple[_File]


class _Codebook(_Part, frozen=True):
    """A codebook. Those of scenes with infinite values start with null, which is extrapolated downwards."""

    codebook: Annotated[tuple[_Entry | None, ...], msgspec.Meta(min_length=CODEBOOK, max_length=CODEBOOK)]

    def __post_init__(self) -> None:
        """Check that only the first entry is null."""
        if None in self.codebook[1:]:
            raise ArgumentError(f"codebook[{self.codebook.index(None, 1)}]: is null, but has to be a number")

    def entries(self) -> Float32[np.ndarray, "256"]:
        """Return the codebook's entries."""
        entries = np.array(self.codebook, np.float64)
        if self.codebook[0] is None:
            step = (entries[-1] - entries[1]) / (CODEBOOK - 1)
            entries[0] = np.clip(entries[1] - step, -LARGEST_FLOAT, LARGEST_FLOAT)
        return entries.astype(np.float32)


class _Coded(_Codebook, frozen=True):
    files: tuple[_File]


class _Palette(_Codebook, frozen=True):
    count: Annotated[int, msgspec.Meta(ge=1, le=MOST_ENTRIES)]
    bands: Annotated[int, msgspec.Meta(ge=min(COEFFICIENTS), le=max(COEFFICIENTS))]
    files: tuple[_File, _File]


class _Document(_Part, frozen=True):
    count: Annotated[int, msgspec.Meta(ge=0, le=MOST_SPLATS)]
    means: _Means
    scales: _Coded
    quats: _Quats
    sh0: _Coded
    harmonics: _Palette | None = msgspec.field(name="shN", default=None)
    antialias: bool | None = None
    model: Any = None


def _at(document: object, key: str) -> object:
    """Return the value at a dotted key; None if there is none."""
    for part in key.split("."):
        document = document.get(part) if isinstance(document, dict) else None
    return document
