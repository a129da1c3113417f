"""Photos that a capture keeps but that nothing uses: the list left_out.txt in its folder, and those without a pose.

Each line names a photo: by its path below the folder, or as the capture names it. Lines that begin with # are
comments. A photo that is taken off the list is used again. Which views are held out does not change with the list.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import Record, Text, record_of
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import Frame, capture_folder, is_file
from gsplat_edu.data.changes import changing
from gsplat_edu.data.notes import UnusablePhotos

LEFT_OUT = "left_out.txt"
"""Name of the list."""

HEAD = "# Photos that are not used; gsplat-edu leave-out changes this list.\n"
"""First line of a list that is written."""


def read_left_out(capture: Path) -> tuple[str, ...]:
    """Return the photos that a capture leaves out, in the order of its list.

    Args:
        capture: The capture's folder, or its transforms.json.

    Raises:
        DatasetError: the list is not text in UTF-8, or cannot be read.
    """
    path = _list_of(capture)
    if not is_file(path):
        return ()
    try:
        lines = [line.strip() for line in read_text(path, "utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        reason = "is not text in UTF-8" if isinstance(error, UnicodeDecodeError) else error.strerror
        raise DatasetError(f"{path}: {reason}; write one photo in each line, or delete the file") from None
    return tuple(dict.fromkeys(line for line in lines if line and not line.startswith("#")))


def write_left_out(capture: Path, names: Iterable[str]) -> None:
    """Write the list of a capture, sorted; without names, the file is removed.

    Args:
        capture: The capture's folder, or its transforms.json.
        names: The photos.

    Raises:
        OSError: the folder cannot be written to.
    """
    path, chosen = _list_of(capture), sorted(set(names))
    if not chosen:
        path.unlink(missing_ok=True)
        return
    with written_aside(path) as aside:
        aside.write_text(HEAD + "".join(f"{name}\n" for name in chosen), encoding="utf-8")


def is_left_out(frame: Frame, capture: Path, names: Iterable[str]) -> bool:
    """Return whether a list of photos names the photo of a frame.

    Args:
        frame: The frame.
        capture: The capture's folder, or its transforms.json.
        names: The photos.
    """
    return not {frame.name, photo_path(frame, capture)}.isdisjoint(names)


def changed_left_out(
    capture: Path,
    frames: Sequence[Frame],
    photos: Sequence[str],
    back: bool = False,
    notes: Sequence[object] = (),
) -> tuple[str, ...]:
    """Return the list of a capture with further photos, or without them.

    Args:
        capture: The capture's folder, or its transforms.json.
        frames: Its frames.
        photos: The photos: their paths below the folder, their names, or their file names if only one photo has it.
        back: Take the photos off the list instead.
        notes: The capture's, which name the photos that are not among its frames because they are unusable.

    Raises:
        DatasetError: a photo is unknown or unusable, or several have its name; none is left; or as for `read_left_out`.
    """
    paths = {photo_path(frame, capture): frame.name for frame in frames}
    for photo in photos:
        _refuse_unusable(photo, paths, capture, notes)
    chosen = [_found(photo, paths, capture) for photo in photos]
    # lines that name no photo stay: it may come back
    kept = [name for name in read_left_out(capture) if name not in chosen and paths.get(name) not in chosen]
    kept = [name for name in kept if not any(paths[path] == name for path in chosen)]
    listed = tuple(kept) if back else (*kept, *chosen)
    if all(is_left_out(frame, capture, listed) for frame in frames):
        raise DatasetError(f"{capture}: none of its {len(paths)} photos would be left; keep some")
    return listed


def change_left_out(
    capture: Path,
    frames: Sequence[Frame],
    photos: Sequence[str] | None,
    back: bool = False,
    notes: Sequence[object] = (),
) -> tuple[str, ...]:
    """Change the list of a capture and return it; changes by other threads and processes are kept.

    Args:
        capture: The capture's folder, or its transforms.json.
        frames: Its frames.
        photos: The photos, as for `changed_left_out`; None empties the list.
        back: Take the photos off the list instead.
        notes: The capture's, as for `changed_left_out`.

    Raises:
        DatasetError: as for `changed_left_out` and `gsplat_edu.data.changes.changing`.
        OSError: the folder cannot be written to.
    """
    with changing(capture):
        listed = () if photos is None else changed_left_out(capture, frames, photos, back, notes)
        write_left_out(capture, listed)
    return listed


def photo_named(capture: Path, frames: Sequence[Frame], photo: str) -> str:
    """Return the path, as `photo_path` gives it, of the photo that a text means.

    Args:
        capture: The capture's folder, or its transforms.json.
        frames: Its frames.
        photo: The photo's path below the folder, its name, or its file name if only one photo has it.

    Raises:
        DatasetError: the photo is unknown, or several have its name.
    """
    return _found(photo, {photo_path(frame, capture): frame.name for frame in frames}, capture)


def photo_path(frame: Frame, capture: Path) -> str:
    """Return the path of a frame's photo below the capture's folder; its whole path if it lies elsewhere.

    Args:
        frame: The frame.
        capture: The capture's folder, or its transforms.json.
    """
    folder = capture_folder(capture)
    return (frame.image.relative_to(folder) if frame.image.is_relative_to(folder) else frame.image).as_posix()


def _refuse_unusable(photo: str, paths: dict[str, str], capture: Path, notes: Sequence[object]) -> None:
    """Say so if a text means no photo in use, but one that is left out because its pose or camera is unusable."""
    if any(photo in (path, name, path.rsplit("/", 1)[-1]) for path, name in paths.items()):
        return
    unusable = [problem for note in notes if isinstance(note, UnusablePhotos) for problem in note.problems]
    for name, reason in unusable:
        if photo.rsplit("/", 1)[-1] == name.rsplit("/", 1)[-1]:
            problem = (
                f"{legible(photo)} is left out already, because its pose or camera is unusable ({reason})"
            )
            raise DatasetError(f"{capture}: {problem}; repair it to use it again, or do not name it")


def _found(photo: str, paths: dict[str, str], capture: Path) -> str:
    """Return the path below the capture of the photo that a text means."""
    fitting = [path for path, name in paths.items() if photo in (path, name)]
    fitting = fitting or [path for path in paths if path.rsplit("/", 1)[-1] == photo]
    if len(fitting) != 1:
        problem = (
            f"{len(fitting)} photos are called {legible(photo)}; give the path of one, as {fitting[0]}"
            if fitting
            else f"has no photo {legible(photo)}; give its path below the folder, as {next(iter(paths))}"
        )
        raise DatasetError(f"{capture}: {problem}")
    return fitting[0]


def _list_of(capture: Path) -> Path:
    return capture_folder(capture) / LEFT_OUT


class WithoutPose(Record, frozen=True, forbid_unknown_fields=False):
    """Names of photos in the facts of the stage "capture", by the reason why they have no pose that counts."""

    left_out: tuple[Text, ...] = ()
    unclear: tuple[Text, ...] = ()
    doubtful: tuple[Text, ...] = ()


def without_pose(capture: Path) -> tuple[str, ...]:
    """Return the names of the photos for which the search that made a capture found no pose that counts.

    Args:
        capture: Its folder; without a record of a search, or with a damaged one, the result is empty.
    """
    try:
        facts = parse_json(read_text(capture / "sfm" / "stages.json"))["stages"]["capture"]["facts"]
        names = record_of("facts", facts, WithoutPose)
    except (OSError, ValueError, KeyError, TypeError, ArgumentError):
        return ()
    return (*names.left_out, *names.unclear, *names.doubtful)
