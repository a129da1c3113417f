"""Videos that browsers play: VP9 in an MP4 file with its index before the frames.

docs/decisions/0009-vp9-in-mp4.md explains why not H.264.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import named_in_utf8
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.evaluate.spherical import as_sphere

FOURCC = "vp09"

BT709, BT601 = 1, 6
"""Codes of ISO/IEC 23091-2 for colour primaries, transfer function and matrix. sRGB has the primaries of BT.709;
swscale, which OpenCV uses to convert to YUV, has the matrix of BT.601."""

MOST_BITS = (2**31 - 1) // 2
"""Largest bit rate that OpenCV sets, bits per second; below it, OpenCV sets 64 bits per pixel and frame."""

BITS_PER_PIXEL = 0.5
"""Largest average number of bits per pixel of a frame. Frames of traced boxes then have 37.0 dB; without a limit, 38.8
dB at 4.5 times the size (docs/decisions/0009-vp9-in-mp4.md)."""

FASTEST = 7_000
"""Largest frame rate that the encoder is told: frames below 640 x 480 px get as many bits as frames of 640 x 480 px."""

TICKS = 1_000
"""Duration of a frame in the track's units."""

CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts")
"""Container boxes that lead to the tables in an MP4 file's index."""

VISUAL_ENTRY = 8 + 8 + 78
"""Bytes before the codec's boxes in a sample description table: version and count, the header of its one entry, and the
fields common to all visual entries."""


def encode_video(
    path: Path, shown: Path, frames: Iterable[ArrayLike], fps: float, sphere: bool = False
) -> None:
    """Write frames as VP9, yuv420p, in an MP4 file. Equal frames give equal bytes.

    An odd width or height is padded with a copy of the last column or row because chroma has half the resolution.

    Args:
        path: The file to write; it exists and may be empty.
        shown: Its name in messages.
        frames: (H, W, 3) each, of equal size, uint8 or float from 0 to 1; taken one at a time.
        fps: Frames per second.
        sphere: Whether the frames are equirectangular and show the whole sphere; the file then says so.

    Raises:
        ArgumentError: there are no frames, their sizes differ, or OpenCV cannot encode VP9 here.
        OSError: the file cannot be written.
    """
    with named_in_utf8(path) as plain:
        _encode(plain, shown, frames, fps)
    path.write_bytes(streamable(path.read_bytes(), fps, sphere))


def _encode(path: Path, shown: Path, frames: Iterable[ArrayLike], fps: float) -> None:
    writer: cv2.VideoWriter | None = None
    size = (0, 0)
    try:
        for index, frame in enumerate(frames):
            picture = to_bytes(frame)
            if writer is None:
                size = picture.shape[:2]
                writer = _writer(path, shown, size, fps)
            if picture.shape[:2] != size:
                raise ArgumentError(
                    f"{shown}: frame {index} is {picture.shape[1]}x{picture.shape[0]}, but the first is"
                    f" {size[1]}x{size[0]}; write a folder instead"
                )
            padding = ((0, size[0] % 2), (0, size[1] % 2), (0, 0))
            bgr = np.pad(picture, padding, mode="edge")[..., ::-1]  # OpenCV's order
            writer.write(np.ascontiguousarray(bgr))
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise ArgumentError("frames: is empty; give at least one")


def _writer(path: Path, shown: Path, size: tuple[int, int], fps: float) -> cv2.VideoWriter:
    height, width = (side + side % 2 for side in size)
    # OpenCV has no option for the quality. A fast video gets few bits per frame; `streamable` slows it down.
    fast = max(min(round(MOST_BITS / (BITS_PER_PIXEL * width * height)), FASTEST), 1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*FOURCC), fast, (width, height))
    if not writer.isOpened():
        raise ArgumentError(
            f"{shown}: OpenCV cannot encode VP9 at {width}x{height}, {fps:g} fps here; write a folder of PNGs"
        )
    return writer


def streamable(data: bytes, fps: float | None = None, sphere: bool = False) -> bytes:
    """Move an MP4 file's index before its frames, and set the colour codes of its VP9 track and its frame rate.

    With the index at the end, a player has to fetch the whole file first. Without colour codes, browsers assume the
    matrix of BT.709, which turns (30, 220, 30) into (15, 190, 23).

    Args:
        data: The file.
        fps: Frames per second; None keeps those of the file.
        sphere: Whether to add the boxes of a 360-degree video (`gsplat_edu.evaluate.spherical`).

    Returns:
        The file; without added boxes, its length is unchanged.

    Raises:
        ArgumentError: it is not an MP4 file with an index, or too large for the index's 32-bit offsets.
    """
    boxes = {kind: (start, end) for kind, start, _, end in _boxes(data, 0, len(data))}
    if not {b"ftyp", b"moov", b"mdat"} <= set(boxes):
        raise ArgumentError(
            "video: is not an MP4 file with an index; OpenCV's encoder failed: write a folder instead"
        )
    (_, front), (start, end) = boxes[b"ftyp"], boxes[b"moov"]
    index = bytearray(data[start:end])
    _name_colours(index)
    if fps is not None:
        _set_rate(index, fps)
    if sphere:
        index = as_sphere(index)
    # the frames lie behind the index: it comes before them, or grows
    if shift := len(index) - (end - start if start < boxes[b"mdat"][0] else 0):
        _shift_offsets(index, shift)
    return data[:front] + index + data[front:start] + data[end:]


def _boxes(data: bytes | bytearray, start: int, end: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield kind, start, start of the content, and end of each box in a part of an MP4 file."""
    while start + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, start)
        header = 8
        if length == 1:  # the length needs 64 bits
            (length,), header = struct.unpack_from(">Q", data, start + 8), 16
        if length < header or start + length > end:
            return
        yield kind, start, start + header, start + length
        start += length


def _tables(index: bytearray, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start of the content, and end of each box of an index that contains no other boxes."""
    for kind, _, content, stop in _boxes(index, start, end):
        if kind in CONTAINERS:
            yield from _tables(index, content, stop)
        elif kind == b"stsd":
            yield from _tables(index, content + VISUAL_ENTRY, stop)
        else:
            yield kind, content, stop


def _shift_offsets(index: bytearray, shift: int) -> None:
    """Add `shift` to the file offsets of the frames in the index."""
    for kind, content, _ in list(_tables(index, 0, len(index))):
        if kind in (b"stco", b"co64"):
            (count,) = struct.unpack_from(">I", index, content + 4)
            form = f">{count}{'I' if kind == b'stco' else 'Q'}"
            offsets = [offset + shift for offset in struct.unpack_from(form, index, content + 8)]
            if kind == b"stco" and max(offsets, default=0) >= 2**32:
                raise ArgumentError("video: is larger than 4 GiB; write a folder, or fewer or smaller frames")
            struct.pack_into(form, index, content + 8, *offsets)


def _set_rate(index: bytearray, fps: float) -> None:
    """Give every frame the duration 1 / fps, and the headers of movie, track, edit and media the sum of them."""
    tables = {kind: content for kind, content, _ in _tables(index, 0, len(index))}
    times = tables[b"stts"]
    (entries,) = struct.unpack_from(">I", index, times + 4)
    frames = 0
    for number in range(entries):
        (count,) = struct.unpack_from(">I", index, times + 8 + 8 * number)
        struct.pack_into(">I", index, times + 12 + 8 * number, TICKS)
        frames += count
    struct.pack_into(">II", index, tables[b"mdhd"] + 12, max(round(TICKS * fps), 1), TICKS * frames)
    (units,) = struct.unpack_from(">I", index, tables[b"mvhd"] + 12)
    whole = round(units * frames / fps)
    for kind, at in ((b"mvhd", 16), (b"tkhd", 20), (b"elst", 8)):
        if kind in tables:
            struct.pack_into(">I", index, tables[kind] + at, whole)


def _name_colours(index: bytearray) -> None:
    """Set the bytes of vpcC for primaries, transfer function and matrix, after 4 bytes of version and 3 of format."""
    for kind, content, _ in list(_tables(index, 0, len(index))):
        if kind == b"vpcC":
            index[content + 7 : content + 10] = bytes((BT709, BT709, BT601))
