"""Photos of a capture by the names that other programs give them."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path, PurePosixPath

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import PHOTO_ENDINGS, PHOTO_FOLDERS, entries, is_file, is_folder
from gsplat_edu.data.masks import MASKS

DEEPEST = 3
"""Folders within folders that are searched for photos."""

NOT_SEARCHED = {MASKS, "depth", "confidence", *PHOTO_FOLDERS[1:]}
"""Folders whose images are not the capture's photos in full size."""

DEPTH = ".depth.png"
"""End of the name of a depth map that lies beside its photo, as in 7-Scenes."""


class PhotoNames:
    """The photos in a capture's folder and the folders in it.

    A name in a file may be a path on another computer, and may lack its suffix. It is looked up by its whole path,
    then by its last part, then by that without its suffix; case does not count.

    Args:
        folder: The capture.

    Attributes:
        paths: The photos by their paths relative to the folder, with slashes.

    Raises:
        DatasetError: the folder cannot be listed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: dict[str, Path] = {}
        self._collect(folder, "", DEEPEST)
        self._keys: list[dict[str, list[str]]] = [defaultdict(list) for _ in range(3)]
        for name in self.paths:
            for table, key in zip(self._keys, _keys(name), strict=True):
                table[key].append(name)

    def find(self, where: str, name: str) -> str | None:
        """Return the photo's path relative to the folder; None if there is no such photo.

        Args:
            where: The file, for messages.
            name: Its name or path in the file.

        Raises:
            DatasetError: several photos fit.
        """
        whole, last, stem = _keys(name)
        wanted = [*((self._keys[0], f"{first}{whole}") for first in ("", "images/"))]
        wanted += [(self._keys[1], last), (self._keys[2], last), (self._keys[2], stem)]
        for table, key in wanted:
            found = table.get(key, [])
            if len(found) == 1:
                return found[0]
            if found:
                raise DatasetError(
                    f"{where}: names the photo {legible(name)}, but {legible(found[0])} and {legible(found[1])} in "
                    f"{self.folder} could be it; give photos different names and export again"
                )
        return None

    def _collect(self, place: Path, prefix: str, depth: int) -> None:
        for path in entries(place):
            name = f"{prefix}{path.name}"
            if path.name.lower().endswith(DEPTH):
                continue
            if path.suffix.lower() in PHOTO_ENDINGS and is_file(path):
                self.paths[name] = path
            elif depth and path.name[0] != "." and path.name not in NOT_SEARCHED and is_folder(path):
                self._collect(path, f"{name}/", depth - 1)


def _keys(name: str) -> tuple[str, str, str]:
    """Return a name's whole path, its last part, and that without the suffix of a photo, for comparison."""
    path = PurePosixPath(name.replace("\\", "/").casefold())
    stem = path.stem if path.suffix in PHOTO_ENDINGS else path.name
    return path.as_posix(), path.name, stem
