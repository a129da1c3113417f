"""Write renders to files: a PNG, two images side by side, a folder of frames, a video."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import remove_leftovers, written_aside
from gsplat_edu.base.validation import ArrayLike, check_shape, in_range
from gsplat_edu.evaluate.comparison import SEPARATOR_GREY, SEPARATOR_WIDTH
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.evaluate.spherical import XMP_KEY, photo_sphere
from gsplat_edu.evaluate.video import encode_video

PICTURE_SIDE = 640
"""Pictures of a report are shrunk until their longer side has this many px."""

JPEG_QUALITY = 88

VIDEO_SUFFIX = ".mp4"

NOT_WRITTEN = frozenset(
    "." + name
    for name in (
        "3gp",
        "apng",
        "avi",
        "avif",
        "bmp",
        "flv",
        "gif",
        "jpeg",
        "jpg",
        "m4v",
        "mkv",
        "mov",
        "mpeg",
        "mpg",
        "ogv",
        "png",
        "tif",
        "tiff",
        "webm",
        "webp",
        "wmv",
    )
)
"""Suffixes of image and video formats that are not supported; a folder is unlikely to be meant by them."""

RgbBytes = UInt8[np.ndarray, "H W 3"]


def save_png(path: Path, image: ArrayLike, sphere: bool = False) -> None:
    """Write an image as 8-bit PNG.

    Args:
        path: Output file; parent folders are created.
        image: (H, W, 3) uint8, or float from 0 to 1, clamped and rounded.
        sphere: Whether it is equirectangular and shows the whole sphere; the file then says so
            (`gsplat_edu.evaluate.spherical`).

    Raises:
        ShapeError: not (H, W, 3).
        ArgumentError: a value is NaN or infinite.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    picture = Image.fromarray(to_bytes(image))
    facts = PngInfo()
    if sphere:
        facts.add_itxt(XMP_KEY, photo_sphere(*picture.size))
    with written_aside(path) as aside:
        picture.save(aside, format="PNG", pnginfo=facts)


def small_jpeg(image: RgbBytes) -> bytes:
    """Return an image as a JPEG for a report, shrunk to `PICTURE_SIDE`.

    Args:
        image: (H, W, 3) uint8.
    """
    picture = Image.fromarray(image)
    picture.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def side_by_side(images: Sequence[ArrayLike]) -> RgbBytes:
    """Put images of equal height side by side, with a thin grey line between them.

    Args:
        images: (H, W, 3) each, uint8 or float from 0 to 1; at least one.

    Returns:
        (H, sum of W + separators, 3) uint8.

    Raises:
        ShapeError: an image is not (H, W, 3), or its height differs.
        ArgumentError: `images` is empty.
    """
    if not images:
        raise ArgumentError("images: is empty; give at least one")
    pictures = [to_bytes(image) for image in images]
    height = pictures[0].shape[0]
    line = np.full((height, SEPARATOR_WIDTH, 3), SEPARATOR_GREY, dtype=np.uint8)
    row: list[RgbBytes] = []
    for picture in pictures:
        check_shape("images", picture.shape, (height, "W", 3), {})
        row += [line, picture] if row else [picture]
    return np.concatenate(row, axis=1)


def check_output(out: Path) -> None:
    """Reject an unsupported output name before any frame is rendered.

    Args:
        out: As for `write_frames`.

    Raises:
        ArgumentError: the suffix belongs to another format, the name of a video is a folder, or the reverse.
    """
    formats = f"give a video ({VIDEO_SUFFIX}) or a folder of PNGs"
    suffix = out.suffix.lower()
    if suffix in NOT_WRITTEN and not out.is_dir():
        raise ArgumentError(f"{out}: {suffix[1:].upper()} is not supported; {formats}")
    if suffix == VIDEO_SUFFIX and out.is_dir():
        raise ArgumentError(f"{out}: is a folder; {formats} under another name")
    if suffix != VIDEO_SUFFIX and out.exists() and not out.is_dir():
        raise ArgumentError(f"{out}: is a file; {formats}")


def write_frames(
    out: Path,
    frames: Iterable[ArrayLike],
    fps: float = 30.0,
    names: Sequence[str] | None = None,
    sphere: bool = False,
) -> list[Path]:
    """Write frames as a video, or as PNGs in a folder.

    Temporary files left by a killed process are removed.

    Args:
        out: A file that ends in .mp4 (VP9, see `gsplat_edu.evaluate.video`), or a folder; it is created.
        frames: (H, W, 3) each, uint8 or float from 0 to 1; taken one at a time. The frames of a video have equal size;
            an odd width or height is padded with a copy of the last column or row.
        fps: Frames per second of a video.
        names: File names in a folder, one per frame; None means frame_0000.png and so on.
        sphere: Whether the frames are equirectangular and show the whole sphere; the files then say so.

    Returns:
        The written files.

    Raises:
        ArgumentError: there are no frames, their sizes differ, the name belongs to another format (see `check_output`),
            or OpenCV cannot encode the video here.
        OSError: a file cannot be written.
    """
    check_output(out)
    if out.suffix.lower() == VIDEO_SUFFIX:
        remove_leftovers(out.parent, below=False)
        with written_aside(out) as aside:
            encode_video(aside, out, frames, in_range("fps", fps, 0.0, open_low=True), sphere)
        return [out]
    remove_leftovers(out, below=False)
    written = []
    for index, frame in enumerate(frames):
        written.append(out / (f"frame_{index:04d}.png" if names is None else names[index]))
        save_png(written[-1], frame, sphere)
    if not written:
        raise ArgumentError("frames: is empty; give at least one")
    return written
