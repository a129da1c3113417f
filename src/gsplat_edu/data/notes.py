"""What a reader notes about a capture: values with fields, whose text is the sentence for the user."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class MissingPhotos:
    """Photos that the capture lists and that have no file.

    Args:
        missing: How many there are.
        total: Photos that the capture lists.
        first: Name of the first one.
    """

    missing: int
    total: int
    first: str

    def __str__(self) -> str:
        """Return the sentence."""
        return f"{self.missing} of {self.total} photos have no file: skipped, first {self.first}"


@dataclass(frozen=True)
class FilesOutside:
    """Files that are read from outside the capture's folder because the capture names them.

    Args:
        first: The first of them.
        count: How many there are.
        folder: The capture's folder.
    """

    first: Path
    count: int
    folder: Path

    def __str__(self) -> str:
        """Return the sentence."""
        more = f" and {self.count - 1} more files" if self.count > 1 else ""
        verb = "lie" if more else "lies"
        return f"{self.first}{more} {verb} outside of {self.folder}; the capture names {'them' if more else 'it'}"


@dataclass(frozen=True)
class UnclearMasks:
    """Photos whose mask is not used: it has a bare name that several photos share.

    Args:
        photos: How many photos there are of that kind.
        total: Photos that the capture lists.
        first: Name of the first one.
    """

    photos: int
    total: int
    first: str

    def __str__(self) -> str:
        """Return the sentence."""
        return (
            f"{self.photos} of {self.total} photos have a mask only by a bare name that several share: not used, "
            f"first {self.first}; put masks into folders as the photos are"
        )


@dataclass(frozen=True)
class OtherModels:
    """COLMAP models beside the one that is read.

    Args:
        folder: The folder that holds them.
        read: Name of the one that is read.
        others: Names of the others; at least one.
    """

    folder: Path
    read: str
    others: tuple[str, ...]

    def __str__(self) -> str:
        """Return the sentence."""
        others = ", ".join(self.others)
        return f"{self.folder} holds {len(self.others) + 1} models: {self.read} is read, {others} not"


@dataclass(frozen=True)
class UnusedSplit:
    """A list of photos that is not read because another one is there to test with.

    Args:
        unused: Name of the file that is left out.
        used: Name of the file with the photos to test with.
    """

    unused: str
    used: str

    def __str__(self) -> str:
        """Return the sentence."""
        return f"{self.unused}: its photos are left out; {self.used} is there to test with"


@dataclass(frozen=True)
class TwoLayouts:
    """A folder that holds both a transforms.json and a COLMAP model.

    Args:
        folder: The folder.
    """

    folder: Path

    def __str__(self) -> str:
        """Return the sentence."""
        return (
            f"{self.folder} holds transforms.json and a COLMAP model: the poses are those of transforms.json"
        )


Note = MissingPhotos | FilesOutside | UnclearMasks | OtherModels | UnusedSplit | TwoLayouts
