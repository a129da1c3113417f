"""The validated contents of a SOG's meta.json.

Source: PlayCanvas' specification of SOG, section 2.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float32, Float64

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.reading import no_number, parse_json
from gsplat_edu.io.scene import extras, read_extras
from gsplat_edu.io.sog.palette import CODEBOOK, MOST_ENTRIES
from gsplat_edu.io.sog.values import LARGEST_LOG, Range
from gsplat_edu.scene.frame import ORIGIN, Vector

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
        up: Up direction, of length 1; None if unspecified.
        unit: Unit of the coordinates; None if unspecified.
        origin: Position of the coordinates' zero.
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
    up: Vector | None
    unit: str | None = None
    origin: Vector = ORIGIN
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

    Codebook values are written with the fewest digits that restore the same float32. Up, unit and origin are stored in
    asset.extras, which other readers ignore. Antialiasing is stored twice: as "antialias" from the specification, and
    as "model", which PlayCanvas' splat-transform reads and writes since 3.2 and omits for the default model.
    """
    asset: dict[str, object] = {"generator": GENERATOR}
    if frame := extras(meta.up, meta.unit, meta.origin):
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
        document = parse_json(data, no_number)
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise SceneFormatError(f"{path}: its metadata is not JSON ({reason}); get the file again") from None
    if not isinstance(document, dict):
        _refuse(path, "no object")
    version = document.get("version")
    if version is None and _at(document, "means.shape") is not None:
        version = 1  # version 1 has no such key
    if isinstance(version, bool) or version != VERSION:
        said = f"version {version}" if type(version) is int and 0 < version < 1000 else "no version"
        raise SceneFormatError(
            f"{path}: is SOG of {said}, but only version 2 is supported; export it as version 2"
        )
    return _checked(path, document)


def _checked(path: Path, document: dict[str, object]) -> Meta:
    antialiased = document.get("antialias")
    if not (antialiased is None or isinstance(antialiased, bool)):
        _refuse(path, "antialias, which is neither true nor false")
    if antialiased is None and document.get("model") in MODELS:
        antialiased = document["model"] == ANTIALIASED_MODEL
    keys = ("means.mins", "means.maxs")
    low, high = (_numbers(path, key, _at(document, key), 3, LARGEST_LOG) for key in keys)
    harmonics = None
    if document.get("shN") is not None:
        harmonics = Harmonics(
            entries=_whole(path, document, "shN.count", 1, MOST_ENTRIES),
            degree=_whole(path, document, "shN.bands", min(COEFFICIENTS), max(COEFFICIENTS)),
            codebook=_codebook(path, document, "shN.codebook"),
            files=_files(path, document, "shN.files", len(SHN)),
        )
    try:
        up, unit, origin = read_extras(_at(document, "asset.extras"))
    except ValueError:
        _refuse(path, "an origin that is not three numbers")
    return Meta(
        count=_whole(path, document, "count", 0, MOST_SPLATS),
        span=(low, high),
        scales=_codebook(path, document, "scales.codebook"),
        sh0=_codebook(path, document, "sh0.codebook"),
        harmonics=harmonics,
        antialiased=antialiased,
        up=up,
        unit=unit,
        origin=origin,
        means=_files(path, document, "means.files", len(MEANS)),
        quats=_files(path, document, "quats.files", len(QUATS)),
        log_scales=_files(path, document, "scales.files", len(SCALES)),
        colors=_files(path, document, "sh0.files", len(SH0)),
    )


def _refuse(path: Path, what: str) -> NoReturn:
    raise SceneFormatError(f"{path}: its metadata has {what}; it is damaged, get the file again")


def _at(document: object, key: str) -> object:
    """Return the value at a dotted key; None if there is none."""
    for part in key.split("."):
        document = document.get(part) if isinstance(document, dict) else None
    return document


def _is_number(value: object, largest: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= largest


def _numbers(
    path: Path, key: str, found: object, length: int, largest: float
) -> Float64[np.ndarray, " length"]:
    if not isinstance(found, list) or len(found) != length:
        _refuse(path, f"no {length} numbers in {key}")
    for index, value in enumerate(found):
        if not _is_number(value, largest):
            _refuse(path, f"a value in {key}[{index}] that is not a number or is out of range")
    return np.array(found, dtype=np.float64)


def _codebook(path: Path, document: dict[str, object], key: str) -> Float32[np.ndarray, "256"]:
    """Read a codebook. Those of scenes with infinite values start with null, which is extrapolated downwards."""
    found = _at(document, key)
    lacks_first = isinstance(found, list) and len(found) == CODEBOOK and found[0] is None
    if isinstance(found, list) and lacks_first:
        found = [found[1], *found[1:]]
    entries = _numbers(path, key, found, CODEBOOK, LARGEST_FLOAT)
    if lacks_first:
        step = (entries[-1] - entries[1]) / (CODEBOOK - 1)
        entries[0] = np.clip(entries[1] - step, -LARGEST_FLOAT, LARGEST_FLOAT)
    return entries.astype(np.float32)


def _whole(path: Path, document: dict[str, object], key: str, low: int, high: int) -> int:
    found = _at(document, key)
    if not isinstance(found, int) or isinstance(found, bool) or not low <= found <= high:
        _refuse(path, f"no whole number from {low} to {high} in {key}")
    return found


def _files(path: Path, document: dict[str, object], key: str, length: int) -> tuple[str, ...]:
    found = _at(document, key)
    if not isinstance(found, list) or len(found) != length:
        _refuse(path, f"no {length} file names in {key}")
    for name in found:
        if not isinstance(name, str) or not NAME.fullmatch(name):
            _refuse(path, f"an entry in {key} that is not a plain file name")
    return tuple(found)
