"""Convert photos to sRGB from the colours that their files declare: an ICC profile, or the primaries of a HEIC."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image, ImageCms

SAME = 2
"""Largest change of a value, of 255, by a profile that counts as sRGB's. Its versions differ by 1 from rounding."""

RELATIVE = ImageCms.Intent.RELATIVE_COLORIMETRIC
"""Rendering intent: white becomes white, and colours outside of sRGB are clipped."""

D50 = (0.9642, 1.0, 0.8249)
"""White of the space in which ICC profiles are connected, XYZ (ICC.1:2022, 7.2.16)."""

D65 = (0.3127, 0.3290)
"""White of sRGB, Display P3 and BT.2020, xy (IEC 61966-2-1)."""

BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""XYZ to cone responses, for the change of white (ICC.1:2022, annex E)."""

PRIMARIES = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
"""xy of red, green and blue by their number in ITU-T H.273: BT.2020 and Display P3."""

PLAIN_PRIMARIES = (1, 2)
"""Numbers in H.273 of sRGB's primaries, and of unspecified ones."""

HDR_CURVES = {16: "PQ", 18: "HLG"}
"""Curves of high dynamic range in H.273. All other curves are taken as sRGB's, which they resemble and which phones
mean."""

DAMAGED = "its colour profile is damaged"

SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
"""sRGB's curve as parameters g, a, b, c, d: (a v + b)^g from v = d on, c v below (IEC 61966-2-1)."""


Info = Mapping[str | tuple[int, int], Any]
"""The information that Pillow reads from a header: `Image.info`."""


@dataclass(frozen=True, eq=False)
class Conversion:
    """The conversion of pixels by a profile.

    Args:
        rgb: Converts RGB in place; None keeps the pixels.
        rgba: The same for RGBA, keeping alpha.
        problem: Why the pixels are taken as sRGB although the file declares other colours; empty if they are converted.
    """

    rgb: ImageCms.ImageCmsTransform | None = None
    rgba: ImageCms.ImageCmsTransform | None = None
    problem: str = ""


AS_IT_IS = Conversion()


def conversion_of(info: Info) -> Conversion:
    """Return how to convert an image to sRGB.

    Args:
        info: What Pillow read from the header. An ICC profile takes precedence over the numbers of H.273 (nclx).
    """
    profile, numbers = info.get("icc_profile"), info.get("nclx_profile")
    if isinstance(profile, bytes) and profile:
        return _from_profile(profile)
    if isinstance(numbers, Mapping):
        return _from_numbers(
            int(numbers.get("color_primaries", 2)), int(numbers.get("transfer_characteristics", 2))
        )
    return AS_IT_IS


def to_srgb(image: Image.Image, info: Info) -> None:
    """Convert an image to sRGB in place, relative colorimetric; without a profile, or with sRGB's, no bit changes.

    Args:
        image: In mode RGB or RGBA.
        info: As for `conversion_of`.
    """
    conversion = conversion_of(info)
    transform = conversion.rgba if image.mode == "RGBA" else conversion.rgb
    if transform is not None:
        transform.apply_in_place(image)


def make_profile(primaries: Sequence[tuple[float, float]]) -> bytes:
    """Write an ICC profile with given primaries, sRGB's white and sRGB's curve.

    Args:
        primaries: xy of red, green and blue.

    Returns:
        A version 4 profile for displays.

    Source: ICC.1:2022, 7.2 (header), 10.18 (parametricCurveType), 10.31 (XYZType).
    """
    columns = _primaries_xyz(primaries)
    curve = struct.pack(">4s4xHH5i", b"para", 3, 0, *(round(65536 * value) for value in SRGB_CURVE))
    text = "RGB, sRGB curve".encode("utf-16-be")
    words = struct.pack(">4s4xII2s2sII", b"mluc", 1, 12, b"en", b"US", len(text), 28) + text
    tags = [(b"desc", words), (b"cprt", words), (b"wtpt", _xyz(D50))]
    tags += [
        (name, _xyz(column)) for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T, strict=True)
    ]
    tags += [(name, curve) for name in (b"rTRC", b"gTRC", b"bTRC")]
    table, data, start = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for name, content in tags:
        table += struct.pack(">4sII", name, start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    header = struct.pack(
        ">I4xI4s4s4s12x4s4x4x4x4x8xI12s48x",
        start + len(data),
        0x04400000,
        *(b"mntr", b"RGB ", b"XYZ ", b"acsp"),
        0,
        _xyz(D50)[8:],
    )
    return header + table + data


def _xyz(color: Sequence[float] | Float64[np.ndarray, "3"]) -> bytes:
    return struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * float(value)) for value in color))


def _primaries_xyz(primaries: Sequence[tuple[float, float]]) -> Float64[np.ndarray, "3 3"]:
    """Return XYZ of red, green and blue as columns, adapted from D65 to D50; their sum is white."""
    directions = np.array([_direction(x, y) for x, y in primaries]).T
    white = _direction(*D65)
    columns = directions * np.linalg.solve(directions, white)
    gains = (BRADFORD @ np.array(D50)) / (BRADFORD @ white)
    return np.asarray(np.linalg.solve(BRADFORD, gains[:, None] * (BRADFORD @ columns)))


def _direction(x: float, y: float) -> Float64[np.ndarray, "3"]:
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


@lru_cache(maxsize=16)
def _from_profile(profile: bytes) -> Conversion:
    """Read an ICC profile, with a cache, because all photos of a camera have the same."""
    try:
        given = ImageCms.ImageCmsProfile(BytesIO(profile))
        space = given.profile.xcolor_space.strip()
        if not (space.isascii() and space.isalnum()):
            return Conversion(problem=DAMAGED)
        if space != "RGB":
            return Conversion(problem=f"its colour profile is for {space}, not for RGB")
        target = ImageCms.createProfile("sRGB")
        rgb, rgba = (ImageCms.buildTransform(given, target, mode, mode, RELATIVE) for mode in ("RGB", "RGBA"))
    except ImportError:
        return Conversion(problem="this Pillow was built without LittleCMS, which reads colour profiles")
    except (OSError, ValueError, TypeError, ImageCms.PyCMSError):
        return Conversion(problem=DAMAGED)
    steps = np.arange(0, 256, 17, dtype=np.uint8)  # 0 and 255 are among them
    colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
    converted = rgb.apply(Image.fromarray(colors))
    if np.abs(np.asarray(converted).astype(int) - colors).max() <= SAME:
        return AS_IT_IS
    return Conversion(rgb, rgba)


@lru_cache(maxsize=16)
def _from_numbers(primaries: int, curve: int) -> Conversion:
    """Read the colours of a HEIC without an ICC profile."""
    if curve in HDR_CURVES:
        return Conversion(problem=f"its brightness is coded as {HDR_CURVES[curve]}, for high dynamic range")
    if primaries in PRIMARIES:
        return _from_profile(make_profile(PRIMARIES[primaries]))
    if primaries in PLAIN_PRIMARIES:
        return AS_IT_IS
    return Conversion(problem=f"its primaries, number {primaries} of ITU-T H.273, are not supported")
