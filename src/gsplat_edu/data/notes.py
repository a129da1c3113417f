"""Notes about a capture: values with fields; `str` gives the sentence for the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

NAMED_PROBLEMS = 10
"""Number of unusable photos that a note names; the others are counted."""


@dataclass(frozen=True)
class SomePhotos:
    """Some of a capture's photos.

    Args:
        photos: Number of these photos.
        total: Number of photos that the capture lists.
    """

    photos: int
    total: int

    @property
    def counted(self) -> str:
        """How many they are, such as "3 of 40 photos"."""
        return f"{self.photos} of {self.total} photos"


@dataclass(frozen=True)
class NamedPhotos(SomePhotos):
    """Some of a capture's photos, of which the first is named.

    Args:
        first: Name of the first of these photos.
    """

    first: str


@dataclass(frozen=True)
class MissingPhotos(NamedPhotos):
    """Photos that the capture lists but that have no file."""

    def __str__(self) -> str:
        return f"{self.counted} have no file: skipped, first {self.first}"


@dataclass(frozen=True)
class FilesOutside:
    """Files outside the capture's folder that the capture refers to.

    Args:
        first: The first of them.
        count: Number of such files.
        folder: The capture's folder.
    """

    first: Path
    count: int
    folder: Path

    def __str__(self) -> str:
        more = f" and {self.count - 1} more files" if self.count > 1 else ""
        verb = "lie" if more else "lies"
        return f"{self.first}{more} {verb} outside of {self.folder}; the capture names {'them' if more else 'it'}"


@dataclass(frozen=True)
class UnclearMasks(NamedPhotos):
    """Photos whose mask is ignored, because several photos share its bare name."""

    def __str__(self) -> str:
        return (
            f"{self.counted} have a mask whose bare name several photos share: ignored, "
            f"first {self.first}; put masks into the same folders as the photos"
        )


@dataclass(frozen=True)
class PhotosWithoutMask(NamedPhotos):
    """Photos without a mask in a capture where others have one."""

    def __str__(self) -> str:
        return f"{self.counted} have no mask, first {self.first}: all their pixels count"


@dataclass(frozen=True)
class LossyMasks:
    """Masks in a lossy format, in which zeros are not exact.

    Args:
        masks: Number of such masks.
        total: Number of masks.
        first: File name of the first such mask.
    """

    masks: int
    total: int
    first: str

    def __str__(self) -> str:
        return (
            f"{self.masks} of {self.total} masks are stored with losses (JPEG or HEIC), first {self.first}: pixels of "
            "at least 128 count"
        )


@dataclass(frozen=True)
class OtherModels:
    """COLMAP models other than the one that is read.

    Args:
        folder: The folder that holds them.
        read: Name of the one that is read.
        photos: Number of photos that it lists.
        others: Names of the others, with the number of photos that each lists; None if it cannot be read. At least one.
    """

    folder: Path
    read: str
    photos: int | None
    others: tuple[tuple[str, int | None], ...]

    def __str__(self) -> str:
        others = ", ".join(f"{name} ({_photos(count)})" for name, count in self.others)
        read = f"{self.read} ({_photos(self.photos)})"
        return f"{self.folder} holds {len(self.others) + 1} models: {read} is read, {others} not"


def _photos(count: int | None) -> str:
    return "unreadable" if count is None else f"{count} photo{'' if count == 1 else 's'}"


@dataclass(frozen=True)
class UnusablePhotos:
    """Photos whose pose or camera cannot be used.

    Args:
        problems: Name of each such photo, and what is wrong with it.
        total: Number of photos listed by the capture that have a file.
    """

    problems: tuple[tuple[str, str], ...]
    total: int

    def __str__(self) -> str:
        count, shown = len(self.problems), self.problems[:NAMED_PROBLEMS]
        named = ", ".join(f"{name} ({reason})" for name, reason in shown)
        more = f" and {count - len(shown)} more" if count > len(shown) else ""
        has, is_ = ("has", "is") if count == 1 else ("have", "are")
        counted = f"{count} of {self.total} photos {has} an unusable pose or camera and {is_} left out"
        return f"{counted}: {named}{more}"


@dataclass(frozen=True)
class RepeatedPhotos(NamedPhotos):
    """Photos that the capture lists more than once with the same pose, and that are used once."""

    def __str__(self) -> str:
        if self.photos == 1:
            return f"1 of {self.total} photos is listed more than once: only its first entry counts ({self.first})"
        return f"{self.counted} are listed more than once: only their first entries count, first {self.first}"


@dataclass(frozen=True)
class UnusedSplit:
    """A list of photos that is ignored because another list provides the test views.

    Args:
        unused: Name of the ignored file.
        used: Name of the file with the test views.
    """

    unused: str
    used: str

    def __str__(self) -> str:
        return f"{self.unused}: its photos are ignored; {self.used} provides the test views"


@dataclass(frozen=True)
class TwoLayouts:
    """A folder that holds both a transforms.json and a COLMAP model.

    Args:
        folder: The folder.
    """

    folder: Path

    def __str__(self) -> str:
        return f"{self.folder} holds transforms.json and a COLMAP model: using the poses of transforms.json"


@dataclass(frozen=True)
class PosesOf(SomePhotos):
    """The capture's poses are those of another program.

    Args:
        program: Its name.
    """

    program: str

    def __str__(self) -> str:
        return f"poses of {self.program}: {self.counted}"


@dataclass(frozen=True)
class OtherPoses:
    """Pose files of other programs that are not read.

    Args:
        read: The file that is read.
        photos: Number of photos that it poses.
        others: The others, each with what it has instead.
    """

    read: Path
    photos: int
    others: tuple[tuple[Path, str], ...]

    def __str__(self) -> str:
        others = ", ".join(f"{path.name} ({what})" for path, what in self.others)
        return f"{self.read.name} ({_photos(self.photos)}) is read, as it poses the most photos; not read: {others}"


@dataclass(frozen=True)
class OtherReconstructions:
    """Reconstructions of a pose file other than the largest, which is read.

    Args:
        file: The pose file.
        photos: Number of photos of the largest.
        others: Numbers of photos of the others. At least one.
    """

    file: Path
    photos: int
    others: tuple[int, ...]

    def __str__(self) -> str:
        others = ", ".join(map(str, self.others))
        return (
            f"{self.file.name} holds {len(self.others) + 1} reconstructions: that of {_photos(self.photos)} is read, "
            f"those of {others} are not"
        )


@dataclass(frozen=True)
class UnreadColors(NamedPhotos):
    """Photos whose colours are taken as sRGB although their files declare others.

    Args:
        reason: Why its colours are not converted.
    """

    reason: str

    @classmethod
    def of(cls, problems: Sequence[tuple[str, str]]) -> list[UnreadColors]:
        """Return the note in a list; empty if no photo has a problem.

        Args:
            problems: Name of each photo and `gsplat_edu.photos.decoding.ImageHeader.problem`.
        """
        found = [(name, problem) for name, problem in problems if problem]
        return [cls(len(found), len(problems), *found[0])] if found else []

    def __str__(self) -> str:
        return f"{self.counted} are taken as sRGB, first {self.first}: {self.reason}"


@dataclass(frozen=True)
class Background(SomePhotos):
    """Photos with an alpha channel, and their background.

    Args:
        color: (r, g, b), 0 to 1, over which they are composited on loading; None if they keep their alpha.
        usually_white: Whether published scores of such captures are usually on white.
    """

    color: tuple[float, float, float] | None
    usually_white: bool

    def __str__(self) -> str:
        said = f"{self.counted} have an alpha channel"
        if self.color is not None:
            names = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}
            spelled = names.get(self.color, "RGB " + " ".join(f"{value:g}" for value in self.color))
            said += f": their background is {spelled}, which the scene learns as if it were there"
        else:
            said += ": what they cut out is trained over changing colours, and scored over black and white"
        if not self.usually_white or self.color == (1.0, 1.0, 1.0):
            return said
        return f"{said}; published scores of Blender scenes are on white, as with --white-background"


@dataclass(frozen=True)
class LeftOutPhotos(NamedPhotos):
    """Photos that are left out: by the capture's list, or by a training because their poses are certainly wrong."""

    def __str__(self) -> str:
        return f"{self.counted} are left out, first {self.first}"


@dataclass(frozen=True)
class OnlyInRegion:
    """The capture has a box, and only the pixels count that may show something in it."""

    def __str__(self) -> str:
        return (
            "only what the photos show of the box of region.json counts; --set region=none uses all of them"
        )


@dataclass(frozen=True)
class OtherReading:
    """Poses or lenses that are read otherwise than their format says, as the photos show.

    Args:
        mistake: What is wrong with them as the format has them.
    """

    mistake: str

    def __str__(self) -> str:
        return f"poses and lenses are read as the photos show: {self.mistake}"


Note = (
    Background
    | MissingPhotos
    | FilesOutside
    | UnclearMasks
    | PhotosWithoutMask
    | LossyMasks
    | OtherModels
    | UnusablePhotos
    | RepeatedPhotos
    | UnusedSplit
    | TwoLayouts
    | PosesOf
    | OtherPoses
    | OtherReading
    | OtherReconstructions
    | UnreadColors
    | LeftOutPhotos
    | OnlyInRegion
)
