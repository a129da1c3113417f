"""KSPLAT of the GaussianSplats3D viewer: 24 to 44 bytes per splat, and SH up to degree 2.

A file is little-endian: a header of 4,096 bytes, a header of 1,024 bytes for each section, then the sections. A section
has its buckets, then its splats. Levels of compression:

    level  centre                       scales, rotation   SH coefficient
    0      float32                      float32            float32
    1      16 bits within its bucket    float16            float16
    2      16 bits within its bucket    float16            8 bits between bounds in the header, ±1.5 if they are 0

Scales are linear, rotations (w, x, y, z); colour and opacity are 8 bits each at every level, as in a .splat. SH are
stored channel by channel, first the 3 coefficients of degree 1 of each channel, then the 5 of degree 2. A bucket is a
cube with the splats' offsets from its centre in steps of its half side / 32767. Full buckets come first; the number of
splats in each of the others precedes the centres of the buckets.

Axes are those of the scene: nothing is flipped.

Source: SplatBuffer.js of mkkellogg's GaussianSplats3D (MIT licence), version 0.1 of the format. Its writer rounds
colours down; ours rounds to nearest.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.quantize import (
    MIN_SCALE,
    byte_to_logit,
    logit_to_byte,
    rounded_bytes,
    unit_quats,
)
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians

HEADER = np.dtype(
    {
        "names": [
            "major",
            "minor",
            "sections",
            "loaded_sections",
            "splats",
            "loaded",
            "level",
            "middle",
            "sh_range",
        ],
        "formats": ["u1", "u1", "<u4", "<u4", "<u4", "<u4", "<u2", ("<f4", 3), ("<f4", 2)],
        "offsets": [0, 1, 4, 8, 12, 16, 20, 24, 36],
        "itemsize": 4096,
    }
)
"""The file's header. A viewer counts in `loaded` what has arrived, which in a file is everything."""

SECTION_FIELDS = {
    "loaded": ("<u4", 0),
    "splats": ("<u4", 4),
    "in_bucket": ("<u4", 8),
    "buckets": ("<u4", 12),
    "side": ("<f4", 16),
    "bucket_bytes": ("<u2", 20),
    "half_steps": ("<u4", 24),
    "bytes": ("<u4", 28),
    "full": ("<u4", 32),
    "partial": ("<u4", 36),
    "sh": ("<u2", 40),
}
"""Type and offset of each field of a section's header."""

SECTION = np.dtype(
    {
        "names": list(SECTION_FIELDS),
        "formats": [kind for kind, _ in SECTION_FIELDS.values()],
        "offsets": [offset for _, offset in SECTION_FIELDS.values()],
        "itemsize": 1024,
    }
)
"""The header of a section."""

LEVELS = (0, 1, 2)
SH_DEGREE = 2
SH_VALUES = (0, 9, 24)
"""Numbers of SH values of a splat, by degree."""

IN_BUCKET = 256
HALF_STEPS = 32767
SH_BOUND = 1.5
STEPS_PER_SPLAT = 64
"""The side of the buckets that we write makes a step of a centre at most this fraction of the median splat's size."""


@dataclass(frozen=True)
class _Buckets:
    """Splats sorted into cubes.

    Args:
        order: The splats' indices, sorted by bucket.
        counts: Splats of each bucket; those with `IN_BUCKET` come first.
        centers: Middle of each bucket.
        side: Of every bucket.
    """

    order: Int64[np.ndarray, " N"]
    counts: Int64[np.ndarray, " B"]
    centers: Float32[np.ndarray, "B 3"]
    side: np.float32

    @staticmethod
    def of(means: Float32[np.ndarray, "N 3"], log_scales: Float32[np.ndarray, "N 3"]) -> _Buckets:
        """Sort splats into the cubes of a grid; a cube with more than `IN_BUCKET` splats becomes several buckets."""
        side = _side(means, log_scales)
        low = means.min(axis=0, initial=np.inf).astype(np.float64) if len(means) else np.zeros(3)
        cubes = np.floor((means - low) / side)
        order = np.lexsort(cubes.T)
        edges = np.flatnonzero(np.any(np.diff(cubes[order], axis=0, prepend=-1), axis=1))
        lengths = np.diff(edges, append=len(means))
        full, left = lengths // IN_BUCKET, lengths % IN_BUCKET
        within = np.arange(len(means)) - np.repeat(edges, lengths)
        in_full = within < np.repeat(full * IN_BUCKET, lengths)
        middles = low + (cubes[order][edges] + 0.5) * side
        return _Buckets(
            order=np.concatenate([order[in_full], order[~in_full]]),
            counts=np.concatenate([np.full(full.sum(), IN_BUCKET), left[left > 0]]).astype(np.int64),
            centers=np.concatenate([np.repeat(middles, full, axis=0), middles[left > 0]]).astype(np.float32),
            side=np.float32(side),
        )

    def steps(self, means: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Return the sorted means as steps from their buckets' corners, 0 to 2 `HALF_STEPS`."""
        offsets = means.astype(np.float64) - np.repeat(self.centers.astype(np.float64), self.counts, axis=0)
        steps = np.floor(offsets * (HALF_STEPS / (float(self.side) / 2.0)) + 0.5) + HALF_STEPS
        clamped: Float64[np.ndarray, "N 3"] = np.clip(steps, 0, 2 * HALF_STEPS)
        return clamped

    def describe(self, section: np.ndarray) -> None:
        """Set what a section's header says of the buckets."""
        full = int((self.counts == IN_BUCKET).sum())
        section["in_bucket"], section["buckets"], section["bucket_bytes"] = IN_BUCKET, len(self.counts), 12
        section["side"], section["half_steps"] = self.side, HALF_STEPS
        section["full"], section["partial"] = full, len(self.counts) - full

    def stored(self) -> bytes:
        """Return the numbers of splats of the buckets that are not full, and the centres of all."""
        partial = self.counts[self.counts < IN_BUCKET]
        return partial.astype("<u4").tobytes() + self.centers.astype("<f4").tobytes()


@dataclass(frozen=True)
class _Section:
    """A section's header, and where its parts are.

    Args:
        header: One `SECTION`.
        splat: Layout of a splat.
        start: Offset of the section in the file.
    """

    header: np.void
    splat: np.dtype
    start: int

    @property
    def count(self) -> int:
        return int(self.header["splats"])

    @property
    def centers_at(self) -> int:
        return self.start + 4 * int(self.header["partial"])

    @property
    def splats_at(self) -> int:
        return self.centers_at + int(self.header["bucket_bytes"]) * int(self.header["buckets"])

    @property
    def end(self) -> int:
        return self.splats_at + self.count * self.splat.itemsize


def read(path: Path) -> Scene:
    """Read a .ksplat of any level and any number of sections.

    Args:
        path: The file.

    Returns:
        The scene, float32, in file order, with the highest SH degree of its sections. Scales, opacities and rotations
        of zero are read as from a .splat.

    Raises:
        SceneFormatError: the file is not a .ksplat, of another version, or damaged.
        OSError: the file cannot be read.
    """
    stored = read_bytes(path)
    header, sections = _sections(path, stored)
    low, high = (
        float(bound) or default
        for bound, default in zip(header["sh_range"], (-SH_BOUND, SH_BOUND), strict=True)
    )
    degree = max(int(section.header["sh"]) for section in sections)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are named
        parts = [
            _tensors(path, stored, section, int(header["level"]), (low, high), degree) for section in sections
        ]
    return Scene(Gaussians(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]}))


def write(path: Path, scene: Scene, level: int = 1) -> None:
    """Write a .ksplat with one section; SH coefficients above degree 2 are dropped.

    Splats are sorted by bucket, and within a bucket keep their order.

    Args:
        path: Output file; parent folders are created.
        scene: Quaternions are normalised, colours clamped to 0..1, and scales to what the level can store.
        level: Of `LEVELS`.

    Raises:
        ArgumentError: a parameter is NaN or infinite in float32, a quaternion has zero length, or there is no such
            level.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    if level not in LEVELS:
        raise ArgumentError(f"level: {level!r}, must be 0, 1 or 2")
    gaussians = scene.gaussians.map(torch.Tensor.float)
    gaussians.check_finite()
    degree = min(gaussians.sh_degree, SH_DEGREE)
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    buckets = _Buckets.of(tensors["means"], tensors["log_scales"]) if level else None
    order = slice(None) if buckets is None else buckets.order
    tensors = {name: values[order] for name, values in tensors.items()}
    sh = _sh_by_channel(tensors["sh_rest"], degree)
    sh_range = (float(sh.min()), float(sh.max())) if sh.size else (-SH_BOUND, SH_BOUND)

    splats = np.zeros(len(gaussians), dtype=_layout(level, degree))
    splats["center"] = tensors["means"] if buckets is None else buckets.steps(tensors["means"])
    splats["scales"] = _scales(tensors["log_scales"], splats["scales"].dtype)
    splats["quat"] = unit_quats(tensors["quats"])
    splats["rgba"][:, :3] = rounded_bytes((tensors["sh0"][:, 0].astype(np.float64) * C0 + SH_OFFSET) * 255.0)
    splats["rgba"][:, 3] = logit_to_byte(tensors["logit_opacities"])
    splats["sh"] = (
        rounded_bytes(_share(sh, sh_range) * 255.0) if level == 2 else _in_range(sh, splats["sh"].dtype)
    )
    body = (b"" if buckets is None else buckets.stored()) + splats.tobytes()

    header, section = np.zeros((), HEADER), np.zeros((), SECTION)
    header["minor"], header["level"] = 1, level
    header["sections"] = header["loaded_sections"] = 1
    header["splats"] = header["loaded"] = section["splats"] = section["loaded"] = len(splats)
    header["sh_range"] = sh_range
    if len(splats):
        header["middle"] = tensors["means"].astype(np.float64).mean(axis=0)
    section["sh"], section["bytes"] = degree, len(body)
    if buckets is not None:
        buckets.describe(section)
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write(header.tobytes() + section.tobytes())
        file.write(body)


def _layout(level: int, degree: int) -> np.dtype:
    """Return the layout of a splat."""
    center, number, sh = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    return np.dtype(
        [
            ("center", center, 3),
            ("scales", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("sh", sh, (SH_VALUES[degree],)),
        ]
    )


def _sections(path: Path, stored: bytes) -> tuple[np.void, list[_Section]]:
    """Return the headers, checked against each other and against the file's size."""
    damaged = SceneFormatError(f"{path}: is truncated, damaged or not a .ksplat; get it again")
    refuse_lfs_pointer(path, stored)
    if len(stored) < HEADER.itemsize + SECTION.itemsize:
        raise damaged
    header = np.frombuffer(stored, HEADER, count=1)[0]
    if (
        (header["major"], header["minor"]) != (0, 1)
        or header["level"] not in LEVELS
        or not header["sections"]
    ):
        raise SceneFormatError(
            f"{path}: is not a .ksplat of version 0.1 and level 0, 1 or 2; export the scene again as .ksplat or .ply"
        )
    start = HEADER.itemsize + int(header["sections"]) * SECTION.itemsize
    if len(stored) < start or not np.isfinite(header["sh_range"]).all():
        raise damaged
    sections = []
    for found in np.frombuffer(stored, SECTION, count=int(header["sections"]), offset=HEADER.itemsize):
        if found["sh"] > SH_DEGREE:
            raise damaged
        sections.append(_Section(found, _layout(int(header["level"]), int(found["sh"])), start))
        start = sections[-1].end
    # splat-transform's tests have a file that counts its splats as loaded only
    if start != len(stored) or sum(section.count for section in sections) != max(
        header["splats"], header["loaded"]
    ):
        raise damaged
    return header, sections


def _tensors(
    path: Path, stored: bytes, section: _Section, level: int, sh_range: tuple[float, float], degree: int
) -> dict[str, torch.Tensor]:
    """Return the parameters of a section, by their names in `Gaussians`, with SH of a degree."""
    splats = np.frombuffer(stored, section.splat, count=section.count, offset=section.splats_at)
    means = splats["center"].astype(np.float64)
    if level:
        half = float(section.header["side"]) / 2.0
        steps = int(section.header["half_steps"]) or HALF_STEPS
        means = (means - steps) * (half / steps) + _centers(path, stored, section)
    scales, quats = splats["scales"].astype(np.float64), splats["quat"].astype(np.float32)
    sh = splats["sh"].astype(np.float64)
    if level == 2:
        sh = sh / 255.0 * (sh_range[1] - sh_range[0]) + sh_range[0]
    for what, good in (
        ("position that is NaN or infinite", np.isfinite(means)),
        ("scale that is NaN, infinite or negative", np.isfinite(scales) & (scales >= 0.0)),
        ("rotation or a colour that is NaN or infinite", np.isfinite(np.concatenate([quats, sh], axis=1))),
    ):
        if not good.all():
            bad = np.flatnonzero(~good.all(axis=1))
            raise SceneFormatError(
                f"{path}: splat {bad[0]} of a section has a {what} ({len(bad)} such splats); get it again"
            )
    quats[~quats.any(axis=1)] = (1.0, 0.0, 0.0, 0.0)
    return {
        "means": torch.from_numpy(means.astype(np.float32)),
        "quats": torch.from_numpy(quats),
        "log_scales": torch.from_numpy(np.log(np.maximum(scales, MIN_SCALE)).astype(np.float32)),
        "sh0": torch.from_numpy(((splats["rgba"][:, None, :3] / 255.0 - SH_OFFSET) / C0).astype(np.float32)),
        "sh_rest": torch.from_numpy(_sh_by_coefficient(sh, degree).astype(np.float32)),
        "logit_opacities": torch.from_numpy(byte_to_logit(splats["rgba"][:, 3])),
    }


def _centers(path: Path, stored: bytes, section: _Section) -> Float64[np.ndarray, "N 3"]:
    """Return the middle of each splat's bucket."""
    header = section.header
    full, partial = int(header["full"]), int(header["partial"])
    lengths = np.frombuffer(stored, "<u4", count=partial, offset=section.start).astype(np.int64)
    if (
        header["bucket_bytes"] != 12
        or header["buckets"] != full + partial
        or full * int(header["in_bucket"]) + lengths.sum() != section.count
    ):
        raise SceneFormatError(f"{path}: the buckets do not hold the splats; it is damaged, get it again")
    centers = np.frombuffer(stored, "<f4", count=3 * (full + partial), offset=section.centers_at).reshape(
        -1, 3
    )
    lengths = np.concatenate([np.full(full, int(header["in_bucket"])), lengths])
    return np.repeat(centers.astype(np.float64), lengths, axis=0)


def _side(means: Float32[np.ndarray, "N 3"], log_scales: Float32[np.ndarray, "N 3"]) -> float:
    """Return the side of the buckets for `STEPS_PER_SPLAT`; all fits into float32 and its cubes into int64."""
    if not len(means):
        return 1.0
    size = float(np.exp(np.clip(np.median(log_scales.astype(np.float64).mean(axis=1)), -80.0, 80.0)))
    extent = float((means.max(axis=0).astype(np.float64) - means.min(axis=0)).max())
    side = 2 * HALF_STEPS * size / STEPS_PER_SPLAT
    return float(np.float32(min(max(side, extent / 2**20, 2.0**-100), 2.0**100)))


def _scales(log_scales: Float32[np.ndarray, "N 3"], kind: np.dtype) -> Float64[np.ndarray, "N 3"]:
    """Return scales that a float of this kind can hold."""
    limits = np.finfo(kind)
    low, high = float(limits.smallest_subnormal), float(limits.max)
    scales = np.exp(np.clip(log_scales.astype(np.float64), np.log(low), np.log(high)))
    clamped: Float64[np.ndarray, "N 3"] = np.clip(scales, low, high)
    return clamped


def _in_range(values: Float32[np.ndarray, "N C"], kind: np.dtype) -> Float32[np.ndarray, "N C"]:
    """Clamp values to what a float of this kind can hold."""
    most = float(np.finfo(kind).max)
    clamped: Float32[np.ndarray, "N C"] = np.clip(values, -most, most)
    return clamped


def _share(values: Float32[np.ndarray, "N C"], bounds: tuple[float, float]) -> Float64[np.ndarray, "N C"]:
    """Return where values lie between two bounds, 0 to 1."""
    low, high = (
        float(np.float32(bound)) or default
        for bound, default in zip(bounds, (-SH_BOUND, SH_BOUND), strict=True)
    )
    return (values.astype(np.float64) - low) / max(high - low, float(np.finfo(np.float32).tiny))


def _sh_by_channel(sh_rest: Float32[np.ndarray, "N K 3"], degree: int) -> Float32[np.ndarray, "N C"]:
    """Return the coefficients of degree 1 of each channel, then those of degree 2."""
    bands = (sh_rest[:, :3], sh_rest[:, 3:8])[:degree]
    flat = [band.transpose(0, 2, 1).reshape(len(band), 3 * band.shape[1]) for band in bands]
    return np.concatenate([np.zeros((len(sh_rest), 0), np.float32), *flat], axis=1)


def _sh_by_coefficient(sh: Float64[np.ndarray, "N C"], degree: int) -> Float64[np.ndarray, "N K 3"]:
    """Undo `_sh_by_channel`; coefficients up to the degree that are not there are 0."""
    full = np.zeros((len(sh), SH_VALUES[degree]))
    full[:, : sh.shape[1]] = sh
    bands = (full[:, :9], full[:, 9:])
    by_channel = [band.reshape(len(sh), 3, band.shape[1] // 3) for band in bands]
    return np.concatenate([band.transpose(0, 2, 1) for band in by_channel], axis=1)
