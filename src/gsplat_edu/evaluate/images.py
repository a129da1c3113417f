"""Renders as files: a PNG, two pictures side by side, a folder of frames, a video."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.errors import ArgumentError
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.files import written_aside
from gsplat_edu.validation import ArrayLike, check_shape, in_range

SEPARATOR_WIDTH = 4
"""px between two pictures side by side."""

SEPARATOR_GREY = 128

VIDEO_SUFFIX = ".mp4"

Frame = UInt8[np.ndarray, "H W 3"]


def save_png(path: Path, image: ArrayLike) -> None:
    """Write an image as PNG of 8 bits.

    Args:
        path: The file; parent folders are made.
        image: (H, W, 3) uint8, or float from 0 to 1, clamped and rounded.

    Raises:
        ShapeError: not (H, W, 3).
        ArgumentError: a value is NaN or infinite.
        OSError: the file cannot be written. What stood there before is untouched.
    """
    picture = Image.fromarray(to_bytes(image))
    with written_aside(path) as aside:
        picture.save(aside, format="PNG")


def side_by_side(images: Sequence[ArrayLike]) -> Frame:
    """Put images of one height beside each other, a thin grey line between them.

    Args:
        images: (H, W, 3) each, uint8 or float from 0 to 1; at least one.

    Returns:
        (H, sum of W + separators, 3) uint8.

    Raises:
        ShapeError: an image is not (H, W, 3), or of another height.
        ArgumentError: there is none.
    """
    if not images:
        raise ArgumentError("images: is empty; give at least one")
    pictures = [to_bytes(image) for image in images]
    height = pictures[0].shape[0]
    line = np.full((height, SEPARATOR_WIDTH, 3), SEPARATOR_GREY, dtype=np.uint8)
    row: list[Frame] = []
    for picture in pictures:
        check_shape("images", picture.shape, (height, "W", 3), {})
        row += [line, picture] if row else [picture]
    return np.concatenate(row, axis=1)


def write_frames(
    out: Path, frames: Iterable[ArrayLike], fps: float = 30.0, names: Sequence[str] | None = None
) -> list[Path]:
    """Write frames as a video, or as PNGs in a folder.

    Args:
        out: A file that ends in .mp4 (video, mp4v), or a folder; it is made.
        frames: (H, W, 3) each, uint8 or float from 0 to 1. They are taken one at a time. A video's are of one
            size; an odd last row or column is cut off, which video formats ask for.
        fps: Frames per second of a video.
        names: File names in a folder, one per frame; frame_0000.png and so on where None.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: there are no frames, the sizes differ, the folder's name is a file, or the video cannot be
            encoded here.
        OSError: a file cannot be written.
    """
    if out.suffix.lower() == VIDEO_SUFFIX:
        with written_aside(out) as aside:
            _encode(aside, out, frames, in_range("fps", fps, 0.0, open_low=True))
        return [out]
    if out.exists() and not out.is_dir():
        raise ArgumentError(f"{out}: is a file; give a folder, or a name that ends in {VIDEO_SUFFIX}")
    written = []
    for index, frame in enumerate(frames):
        written.append(out / (f"frame_{index:04d}.png" if names is None else names[index]))
        save_png(written[-1], frame)
    if not written:
        raise ArgumentError("frames: is empty; give at least one")
    return written


def _encode(aside: Path, out: Path, frames: Iterable[ArrayLike], fps: float) -> None:
    writer: cv2.VideoWriter | None = None
    size = (0, 0)
    try:
        for index, frame in enumerate(frames):
            picture = to_bytes(frame)
            if writer is None:
                size = picture.shape[:2]
                writer = _writer(aside, out, size, fps)
            if picture.shape[:2] != size:
                raise ArgumentError(
                    f"{out}: frame {index} is {picture.shape[1]}x{picture.shape[0]}, but the first is"
                    f" {size[1]}x{size[0]}; write a folder instead"
                )
            height, width = size[0] // 2 * 2, size[1] // 2 * 2
            writer.write(np.ascontiguousarray(picture[:height, :width, ::-1]))  # OpenCV's order is BGR
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise ArgumentError("frames: is empty; give at least one")


def _writer(aside: Path, out: Path, size: tuple[int, int], fps: float) -> cv2.VideoWriter:
    height, width = size[0] // 2 * 2, size[1] // 2 * 2
    if not height or not width:
        raise ArgumentError(f"{out}: frames of {size[1]}x{size[0]} are too small for a video; write a folder")
    fourcc = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(aside), fourcc, fps, (width, height))
    if not writer.isOpened():
        raise ArgumentError(
            f"{out}: OpenCV cannot encode mp4 at {width}x{height}, {fps:g} fps, here; write a folder of PNGs"
        )
    return writer
