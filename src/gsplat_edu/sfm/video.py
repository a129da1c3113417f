"""Select video frames that are useful as photos: sharp, with camera motion between them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import named_in_utf8, written_aside
from gsplat_edu.scene.photo import shrunk

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
"""Suffixes of videos, in any case."""

CANDIDATES = 24
"""Approximate number of frames examined per selected frame; longer videos are sampled more coarsely."""

SHARPNESS_SIDE = 640
"""Longest side for measuring sharpness, px: it removes noise and compression artefacts but not motion blur."""

MOTION_SIDE = 160
"""Longest side for measuring motion, px."""

STILL = 0.0002
"""The camera is still if the motion between frames is below this, relative to the longest side; noise causes some."""

DIFFERENT = 0.005
"""Two frames are different photos if the motion between them is at least this, relative to the longest side."""

FRAME_QUALITY = 97
"""JPEG quality of the selected frames."""

Progress = Callable[[str, int, int], None]
"""Called with the stage, the amount done and the total."""


def is_video(path: Path) -> bool:
    """Return whether a file has the suffix of a video."""
    return path.suffix.lower() in VIDEO_ENDINGS


def choose_frames(path: Path, count: int, progress: Progress) -> list[int]:
    """Select frames: divide the video into intervals of equal motion and take the sharpest frame of each.

    Sharpness is the variance of the Laplacian, motion the mean length of the optical flow (DIS, Kroeger et al. 2016).

    Args:
        path: The video.
        count: Number of intervals.
        progress: Called as frames are read.

    Returns:
        Frame numbers, ascending; fewer than `count` if the video has fewer frames or the camera is still.

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
    """Write frames as upright photos; skip frames that equal the previous one.

    Args:
        path: The video.
        chosen: Frame numbers, ascending.
        folder: Output folder; created if missing. Files are named frame_NUMBER.jpg.
        progress: Called as frames are written or skipped.

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
                # not imwrite: it crashes on names that are not UTF-8, and does not report the cause of a failure
                _, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, FRAME_QUALITY])
                with written_aside(target) as aside:
                    aside.write_bytes(data.tobytes())
                written.append(target)
            progress("writing frames", done, len(wanted))
            if done == len(wanted):
                break
    return written


class _Flow:
    """Measures the motion between two small frames."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def __call__(self, before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
        """Return the mean length of the optical flow, relative to the longer side."""
        if before.shape != after.shape:  # the frame size may change within a video
            return 1.0
        field = self._flow.calc(before, after, np.zeros((*before.shape, 2), np.float32))
        lengths: Float32[np.ndarray, "h w"] = np.hypot(field[..., 0], field[..., 1])
        longest: int = max(before.shape)
        return float(lengths.mean()) / longest


def _intervals(motion: Float64[np.ndarray, " n"], count: int) -> Int64[np.ndarray, " n"]:
    """Return the index of each frame's interval of equal motion."""
    path = np.cumsum(motion)
    if path[-1] == 0.0:
        return np.zeros(len(motion), dtype=np.int64)
    parts: Int64[np.ndarray, " n"] = np.minimum((path / path[-1] * count).astype(np.int64), count - 1)
    return parts


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    # Keep messages of FFmpeg and OpenCV off the terminal. FFmpeg reads its setting once, at the first video.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with named_in_utf8(path) as plain:
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        video = cv2.VideoCapture(str(plain), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(before)
        try:
            if not video.isOpened():
                raise DatasetError(
                    f"{path}: is not a video that OpenCV can decode; convert it, for example to H.264 in mp4"
                )
            # Phones store the orientation of a video separately, without rotating its frames.
            video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            yield video
        finally:
            video.release()


def _every(
    video: cv2.VideoCapture, step: int, wanted: set[int] | None = None
) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"]]]:
    """Yield frames and their numbers: every `step`-th frame, or the wanted ones."""
    number = 0
    while video.grab():
        if number in wanted if wanted is not None else number % step == 0:
            ok, frame = video.retrieve()
            if ok:
                yield number, frame
        number += 1


def _grey(frame: np.ndarray, longest: int) -> UInt8[np.ndarray, "h w"]:
    frame = shrunk(frame, longest)
    return np.asarray(frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))
