"""Frames of a video that are worth being photos: sharp ones, a step of the camera apart."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from gsplat_edu.errors import DatasetError
from gsplat_edu.files import named_in_utf8, written_aside

VIDEO_ENDINGS = (
    ".mp4",
    ".mov",
    ".m4v",
    ".avi",
    ".mkv",
    ".webm",
    ".mts",
    ".m2ts",
    ".mpg",
    ".mpeg",
    ".3gp",
    ".wmv",
)
"""What names of videos end in, in any case."""

CANDIDATES = 24
"""Frames that are looked at for each that is taken, about; a longer video is looked at in larger steps."""

SHARPNESS_SIDE = 640
"""Longest side at which sharpness is measured, px: noise and compression are gone, motion blur is not."""

MOTION_SIDE = 160
"""Longest side at which motion is measured, px."""

STILL = 0.0002
"""Motion between two frames, as a share of the longest side, below which a camera stands still: noise moves, too."""

DIFFERENT = 0.005
"""Motion, as a share of the longest side, from which two frames are two photos."""

FRAME_QUALITY = 97
"""JPEG quality of frames that become photos."""

Progress = Callable[[str, int, int], None]
"""Told which stage, how much of it is done, and of how much."""


def is_video(path: Path) -> bool:
    """Say whether a file is named like a video."""
    return path.suffix.lower() in VIDEO_ENDINGS


def choose_frames(path: Path, count: int, progress: Progress) -> list[int]:
    """Choose frames: the video is cut into intervals of equal motion, and the sharpest frame of each is taken.

    Sharpness is the variance of the Laplacian, motion the mean length of the optical flow (DIS, Kroeger et al. 2016).

    Args:
        path: The video.
        count: How many intervals.
        progress: Told of the frames that were read.

    Returns:
        Numbers of frames, ascending; fewer than `count` where the video has fewer, or the camera stands still.

    Raises:
        DatasetError: the file cannot be decoded.
    """
    numbers, sharpness, motion = list[int](), list[float](), list[float]()
    flow, before = _Flow(), None
    with _opened(path) as video:
        total = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        step = max(1, total // (CANDIDATES * count))
        for number, frame in _every(video, step):
            grey = _grey(frame, SHARPNESS_SIDE)
            small = _grey(grey, MOTION_SIDE)
            moved = 0.0 if before is None else flow(before, small)
            before = small
            numbers.append(number)
            sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
            motion.append(moved if moved > STILL else 0.0)
            progress("choosing frames", number + 1, max(total, number + 1))
    if not numbers:
        raise DatasetError(
            f"{path}: holds no frame that can be decoded; convert it, for example to H.264 in mp4"
        )
    interval = _intervals(np.array(motion), count)
    best: dict[int, int] = {}
    for index, part in enumerate(interval.tolist()):
        if part not in best or sharpness[index] > sharpness[best[part]]:
            best[part] = index
    return sorted(numbers[index] for index in best.values())


def write_frames(path: Path, chosen: Sequence[int], folder: Path, progress: Progress) -> list[Path]:
    """Write frames as photos, upright, but for those that show the same as the one before.

    Args:
        path: The video.
        chosen: Numbers of frames, ascending.
        folder: Where to; made where it is missing. Frames are named frame_NUMBER.jpg.
        progress: Told of the frames that were written or left out.

    Returns:
        The photos.

    Raises:
        DatasetError: the file cannot be decoded.
        OSError: a photo cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted, written = set(chosen), list[Path]()
    flow, before = _Flow(), None
    with _opened(path) as video:
        for done, (number, frame) in enumerate(_every(video, 1, wanted), 1):
            small = _grey(frame, MOTION_SIDE)
            if before is None or flow(before, small) >= DIFFERENT:
                before = small
                target = folder / f"frame_{number:06d}.jpg"
                # not imwrite: it crashes on names that are not UTF-8, and does not say why it fails
                _, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, FRAME_QUALITY])
                with written_aside(target) as aside:
                    aside.write_bytes(data.tobytes())
                written.append(target)
            progress("writing frames", done, len(wanted))
            if done == len(wanted):
                break
    return written


class _Flow:
    """Measures motion between two small frames."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def __call__(self, before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
        """Return the mean length of the flow, as a share of the longer side."""
        if before.shape != after.shape:  # a video may change its size
            return 1.0
        field = self._flow.calc(before, after, np.zeros((*before.shape, 2), np.float32))
        lengths: Float32[np.ndarray, "h w"] = np.hypot(field[..., 0], field[..., 1])
        longest: int = max(before.shape)
        return float(lengths.mean()) / longest


def _intervals(motion: Float64[np.ndarray, " n"], count: int) -> Int64[np.ndarray, " n"]:
    """Return which interval of equal motion each frame lies in."""
    path = np.cumsum(motion)
    if path[-1] == 0.0:
        return np.zeros(len(motion), dtype=np.int64)
    parts: Int64[np.ndarray, " n"] = np.minimum((path / path[-1] * count).astype(np.int64), count - 1)
    return parts


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    # FFmpeg and OpenCV would print their complaints beside ours. FFmpeg's are looked at once, at the first video.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with named_in_utf8(path) as plain:
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        video = cv2.VideoCapture(str(plain), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(before)
        try:
            if not video.isOpened():
                raise DatasetError(
                    f"{path}: is no video that OpenCV can decode; convert it, for example to H.264 in mp4"
                )
            # Phones store how a video was held, not the turned frames.
            video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            yield video
        finally:
            video.release()


def _every(
    video: cv2.VideoCapture, step: int, wanted: set[int] | None = None
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Yield frames and their numbers: every `step`-th, or the wanted ones."""
    number = 0
    while video.grab():
        if number in wanted if wanted is not None else number % step == 0:
            ok, frame = video.retrieve()
            if ok:
                yield number, frame
        number += 1


def _grey(frame: np.ndarray, longest: int) -> UInt8[np.ndarray, "h w"]:
    factor = min(1.0, longest / max(frame.shape[:2]))
    if factor < 1.0:
        size = tuple(max(1, round(factor * side)) for side in frame.shape[1::-1])
        frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
    return np.asarray(frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))
