"""Find the depth maps of photos by their names, and the maps of a sensor's confidence beside them.

The map of the photo left/A.JPG is left/A.png, left/A.JPG.png or, if no other photo is called A, A.png; with any suffix
of `gsplat_edu.data.depth_files.ENDINGS`. Its confidence has the same name in a folder `confidence` beside the folder of
maps, as in Polycam's export.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import PHOTO_ENDINGS, PHOTO_FOLDERS, entries, is_file, is_folder
from gsplat_edu.data.depth_files import ENDINGS, PHOTOMETRIC, read_depth
from gsplat_edu.photos.image_files import UNDECODABLE, opened_image, require_room

CONFIDENCE = "confidence"
"""Name of the folder beside that of the maps."""

GEOMETRIC_MAPS = "stereo/depth_maps"
"""Where COLMAP writes its maps in a capture."""

DEEPEST = 6
"""Folders below folders that are searched."""

LEVELS = 2
"""Highest level of a phone's confidence; maps with larger values have up to 255."""


class DepthFile(NamedTuple):
    """The depth map of a photo."""

    path: Path
    confidence: Path | None = None


def depth_files(folder: Path, names: Sequence[str]) -> dict[str, DepthFile]:
    """Find the maps of photos.

    Args:
        folder: The folder of maps, or a capture with COLMAP's maps in stereo/depth_maps.
        names: Names of all photos in the capture, with slashes.

    Returns:
        The maps by the photos' names; photos without a map are missing.

    Raises:
        DatasetError: there is no such folder, two maps fit one photo, or no map fits any.
    """
    if not is_folder(folder):
        raise DatasetError(f"{folder}: is no folder; give the one with a depth map for each photo")
    if is_folder(folder / GEOMETRIC_MAPS):
        folder = folder / GEOMETRIC_MAPS
    maps: dict[str, list[Path]] = {}
    for path in _below(folder, DEEPEST):
        if (stem := _stem(path.relative_to(folder).as_posix())) is not None:
            maps.setdefault(stem, []).append(path)
    bare = Counter(PurePosixPath(_photo_stem(name)).name for name in names)
    found = dict[str, DepthFile]()
    for name in names:
        spellings = [_photo_stem(name), _within(_photo_stem(name))]
        if bare[last := PurePosixPath(_photo_stem(name)).name] == 1:
            spellings.append(last)
        fitting = next((_single(name, maps[stem]) for stem in spellings if stem in maps), None)
        if fitting is not None:
            found[name] = DepthFile(fitting, confidence_of(fitting))
    if not found:
        first = next((paths[0].name for paths in maps.values()), None)
        holds = "holds no depth map" if first is None else f"the first of its maps is {first}"
        raise DatasetError(
            f"{folder}: {holds}, and none is named like a photo such as {legible(names[0])}; rename them to the photos'"
            f" names, with one of the suffixes {', '.join(ENDINGS)}"
        )
    return found


def confidence_of(path: Path) -> Path | None:
    """Return the map of confidence that belongs to a depth map; None if there is none."""
    beside = path.parent.parent / CONFIDENCE / f"{path.stem}.png"
    return beside if is_file(beside) else None


def read_map(file: DepthFile) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Read a depth map and its weights: the confidence from 0 to 1, 1 without one, and 0 where there is no depth.

    Raises:
        DatasetError: a file is damaged, or the two have different sizes.
    """
    values = read_depth(file.path)
    weights = np.isfinite(values).astype(np.float32)
    if file.confidence is None:
        return values, weights
    try:
        with opened_image(file.confidence, ("PNG",)) as image:
            require_room(file.confidence, image)
            levels = np.asarray(image.convert("L"), np.float32)
    except UNDECODABLE as error:
        raise DatasetError(f"{file.confidence}: is no map of confidence: {error}; export it again") from None
    if levels.shape != values.shape:
        sizes = [f"{shape[1]}x{shape[0]}" for shape in (levels.shape, values.shape)]
        raise DatasetError(
            f"{file.confidence}: is {sizes[0]} but its depth map {sizes[1]}; export both again, or move it away"
        )
    return values, weights * levels / (LEVELS if levels.max() <= LEVELS else 255)


def _below(folder: Path, levels: int) -> Iterator[Path]:
    for path in entries(folder):
        if is_folder(path):
            if levels > 0 and path.name != CONFIDENCE:
                yield from _below(path, levels - 1)
        else:
            yield path


def _stem(name: str) -> str | None:
    """Return the photo's name without suffix to which a map's name belongs; None for other files."""
    lower = name.lower()
    if lower.endswith(PHOTOMETRIC):
        return None
    ending = next((ending for ending in ENDINGS if lower.endswith(ending)), None)
    return None if ending is None else _photo_stem(name[: -len(ending)])


def _photo_stem(name: str) -> str:
    """Return a photo's name without its suffix."""
    ending = next((ending for ending in PHOTO_ENDINGS if name.lower().endswith(ending)), "")
    return name[: len(name) - len(ending)]


def _within(stem: str) -> str:
    """Return a name without the folder of photos."""
    first, _, rest = stem.partition("/")
    return rest if rest and first in PHOTO_FOLDERS else stem


def _single(name: str, paths: Sequence[Path]) -> Path:
    if len(paths) > 1:
        first, second = (path.name for path in paths[:2])
        raise DatasetError(
            f"{paths[0].parent}: {first} and {second} are both named like depth maps of the photo {legible(name)};"
            " remove one of them"
        )
    return paths[0]
