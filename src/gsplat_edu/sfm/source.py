"""Classify the input: photos, a video, or something without usable photos."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import check_folder
from gsplat_edu.base.links import check_links
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.text import spelled_seconds
from gsplat_edu.data.capture import entries, is_file, is_folder
from gsplat_edu.data.reader import layout_of
from gsplat_edu.photos.decoding import image_size
from gsplat_edu.sfm.photos import is_photo, is_run, photo_files
from gsplat_edu.sfm.result import PARTS, published
from gsplat_edu.sfm.video import is_video

FEWEST = 3
"""Fewest photos of a useful model: the poses of only two photos cannot be verified."""

NAMED = 12
"""Most photos named in a message; the others are counted."""

CORE_SECONDS, MEASURED_PIXELS = 4.5, 2.07e6
"""Processor time of `sfm` for a photo of so many pixels, s: 50 photos of `fox` took 112 s on two quiet cores. 97 photos
of 0.31 megapixels took 3.3 s each on busy cores, where `expected_seconds` says 1.7: it may be off twofold."""

WANTED = "give a folder of photos, or a video"
OR_CAPTURE = "give a capture, a folder of photos, or a video"


def needs_poses(path: str | Path) -> bool:
    """Return whether a path is a video, or a folder of photos without poses in any supported layout.

    Args:
        path: The path given by the user.

    Raises:
        DatasetError: the path is a run folder, an empty folder, or a file of another kind; or its photos lie in several
            folders.
    """
    path = Path(path)
    if is_file(path):
        if path.suffix.lower() == ".json" or layout_of(path) is not None:
            return False
        _check_file(path, OR_CAPTURE)
        return True
    if not is_folder(path) or layout_of(path) is not None:
        return False
    _check_run(path)
    if not any(place.name[0] != "." for place in entries(path)):
        raise DatasetError(f"{path}: holds no photos, the folder is empty; {OR_CAPTURE}")
    return bool(photo_files(path))


def expected_seconds(source: Path) -> float | None:
    """Forecast roughly how long finding the poses of photos takes on this machine, s.

    Args:
        source: Folder of photos.

    Returns:
        CORE_SECONDS * photos * sqrt(pixels / MEASURED_PIXELS) / cores, with the first photo's pixels and a root of at
        most one, because large photos are reduced; None for a video, or if the first photo cannot be read.
    """
    if is_file(source) or not (files := photo_files(source)):
        return None
    try:
        W, H = image_size(files[0])
    except DatasetError:
        return None  # finding the poses reports it
    return CORE_SECONDS * len(files) * min(1.0, math.sqrt(W * H / MEASURED_PIXELS)) / (os.cpu_count() or 1)


def check_time_for_poses(photos: Path, limit: float, say: Callable[[str], None]) -> None:
    """Refuse a time limit that even half of the forecast of finding poses exceeds; warn if all of it does.

    Args:
        photos: The folder of photos, or a video, which has no forecast.
        limit: Seconds of the whole command.
        say: Receives the warning.

    Raises:
        ArgumentError: the limit cannot hold the search for poses.
    """
    expected = expected_seconds(photos)
    if expected is None or expected <= limit:
        return
    takes = f"finding the poses of its photos takes about {spelled_seconds(expected)} here"
    if expected > 2.0 * limit:
        least = spelled_seconds(2.0 * expected)
        raise ArgumentError(f"--time-limit: {photos}: {takes}, before the training; give at least {least}")
    say(f"{photos}: {takes}; the time limit may leave nothing for the training")


def check_source(source: Path, out: Path) -> list[Path]:
    """Check, before any work, that the input has photos and the output folder can be used.

    Args:
        source: Folder of the photos, or a video.
        out: Folder of the result.

    Returns:
        The photos; empty if the source is a video.

    Raises:
        ArgumentError: the output folder cannot be used.
        DatasetError: the source cannot be used.
    """
    check_folder("OUT", out)
    check_links("OUT", out, ("sfm",))
    here, there = source.resolve(), out.resolve()
    if here == there or any(here.is_relative_to(there / part) for part in (*PARTS, "sfm")):
        raise ArgumentError(f"OUT: {out} is the folder of the photos; choose another folder")
    if _holds_others(out):
        raise ArgumentError(f"OUT: {out} already holds photos or poses; choose another folder")
    if is_file(source):
        _check_file(source, WANTED)
        return []
    if not is_folder(source):
        raise DatasetError(f"{source}: does not exist; {WANTED}")
    _check_run(source)
    files = photo_files(source, there)
    if len(files) < FEWEST:
        raise DatasetError(too_few(source, len(files), []))
    return files


def too_few(source: Path, count: int, unreadable: Sequence[str]) -> str:
    """Explain why the photos are insufficient.

    Args:
        source: The path given by the user.
        count: Number of photos that can be decoded.
        unreadable: Names of the other photos.
    """
    if count:
        held = "one photo" if count == 1 else f"{count} photos"
        besides = f" that can be decoded (not {listed(unreadable)})" if unreadable else ""
        return f"{source}: holds {held}{besides}; poses need at least {FEWEST}, from different places"
    if unreadable:
        return f"{source}: holds no photo that can be decoded: {listed(unreadable)}; {remedy(unreadable)}"
    video = next((path.name for path in sorted(source.iterdir()) if is_video(path)), None)
    return f"{source}: holds no photos; " + (
        f"it holds a video; give that: {source / video}" if video else WANTED
    )


def remedy(names: Sequence[str]) -> str:
    """Say what to do with photos that cannot be decoded: a JPEG is damaged, another format may be unknown.

    Args:
        names: Their names, at least one.
    """
    if all(Path(name).suffix.lower() in (".jpg", ".jpeg") for name in names):
        return "they are damaged, or no JPEG in spite of their name; copy them from the camera again"
    return "export them as JPEG"


def listed(names: Sequence[str]) -> str:
    """Join the first names of a list, and count the others."""
    more = f", and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _check_file(path: Path, wanted: str) -> None:
    """Reject a file that is not a video."""
    if not is_video(path):
        what = "a single photo" if is_photo(path) else "neither a photo nor a video"
        raise DatasetError(f"{path}: is {what}; {wanted}")


def _check_run(folder: Path) -> None:
    """Reject a run folder, whose images are renders."""
    if not is_run(folder):
        return
    try:
        said = parse_json(read_text(folder / "config.json"))
        capture = said["data"]["path"] if isinstance(said["data"]["path"], str) else None
    except (OSError, ValueError, KeyError, TypeError):
        capture = None
    instead = f", {capture}" if capture else ""
    raise DatasetError(
        f"{folder}: is a run, whose pictures are renders, not photos; give the capture it was trained on{instead}"
    )


def _holds_others(out: Path) -> bool:
    """Return whether the output folder holds files that no run wrote and that a run would move away.

    Masks next to a run's capture do not count, because they stay.
    """
    work = out / "sfm"
    if not (work / "stages.json").is_file():
        in_use = is_folder(work) and any(path.name[0] != "." for path in entries(work))
        return in_use or layout_of(out) is not None or any((out / part).exists() for part in PARTS)
    others = {"images", "sparse"}.difference(published(work))
    return any((out / part).exists() for part in others)
