"""A folder of photos, captures, runs and scenes, each an entry with a name of its own.

    photos/NAME      photos, in folders or not, or a video
    captures/NAME    photos with poses, in any layout that `train` reads
    runs/NAME        what `train` writes
    scenes/NAME      a folder with one scene file
    .studio/         jobs/, trash/, uploads/ (parts of files), cache/ (thumbnails, pages)

An adopted entry is a link to a folder elsewhere (for a scene and a video: a folder with a link to the file).
Removing it removes the link. A link that was not adopted by this user on this computer is not followed
(`gsplat_edu.studio.adopted`): somebody else may have made the library.
"""

from __future__ import annotations

import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any

from gsplat_edu.base.constants import SCENE_SUFFIXES
from gsplat_edu.base.files import unreadable, written_aside
from gsplat_edu.base.links import is_inside, links_in, resolved
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import as_file_name, legible, shortened, whole_of
from gsplat_edu.data.capture import is_folder
from gsplat_edu.server.refusal import RefusedError, conflict, not_found
from gsplat_edu.sfm.video import VIDEO_ENDINGS
from gsplat_edu.studio.adopted import adopted, note_adopted
from gsplat_edu.studio.names import LONGEST, LONGEST_FILE, below, checked_name, name_after

KINDS = ("photos", "captures", "runs", "scenes")
"""Kinds of entries, and their folders."""

HIDDEN = ".studio"
"""Folder of the studio's own files."""

JOBS = "jobs"
"""Folder in `HIDDEN` with the folders of the jobs."""

PARTS = (JOBS, "trash", "uploads", "cache")
"""Folders in `HIDDEN`."""

EXPORTS = "exports"
"""Folder of an entry with the files that were exported from it."""

SCENE_ENDINGS = tuple(suffix for suffix in SCENE_SUFFIXES if suffix.count(".") == 1)
"""Endings of scene files that can be taken in."""


class Library:
    """A folder of entries. It may be used from any thread.

    Args:
        root: The folder; its parts are created if missing.
        in_use: Called with an absolute path; returns the reason why it may not be moved, or None.
        changed: Called after an entry was made, renamed, removed or restored.

    Raises:
        RefusedError: one of the library's own folders is a link or a file.
    """

    def __init__(
        self,
        root: Path,
        in_use: Callable[[Path], str | None] = lambda path: None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.root = root.resolve()
        self.in_use, self.changed = in_use, changed
        self._promised: set[Path] = set()
        self.lock = threading.RLock()
        check_own_folders(self.root)
        self._adopted = adopted(self.root)
        for kind in KINDS:
            (self.root / kind).mkdir(parents=True, exist_ok=True)
        for part in PARTS:
            self.hidden(part).mkdir(parents=True, exist_ok=True)
        # cached pages may be from an older version
        pages = [self.hidden("cache") / part for part in ("pages", "live")]
        for left in (*self.hidden("uploads").iterdir(), *pages, *links_in(self.hidden("cache"))):
            _delete(left)

    def hidden(self, part: str) -> Path:
        """Return one of the folders of the studio's own files."""
        return self.root / HIDDEN / part

    def name(self, path: Path) -> str:
        """Return how jobs name a path of the library: "runs/toy", "runs/toy/exports/toy.ply"."""
        return legible(path.relative_to(self.root).as_posix())

    def identity(self, name: str) -> object:
        """Return equal values for two names of one place, which differ by links or by the case of letters."""
        path = self.root / as_file_name(name)
        try:
            facts = path.stat()
        except OSError:
            return str(resolved(path) or path)
        return facts.st_dev, facts.st_ino

    def entries(self, kind: str) -> list[Path]:
        """Return the entries of a kind, by name; links that cannot be followed are none."""
        found = (self.root / kind).iterdir()
        return sorted(
            path for path in found if path.name[0] != "." and is_folder(path) and self.is_within(path)
        )

    def strange_links(self) -> list[str]:
        """Return a line for each entry that is a link which was not adopted here, or leads nowhere."""
        links = [path for kind in KINDS for path in (self.root / kind).iterdir() if path.is_symlink()]
        lines = []
        for path in sorted(links):
            try:
                path.stat()
            except OSError as error:
                name = legible(shortened(self.name(path), 300))
                reason = (error.strerror or "it cannot be followed").lower()
                lines.append(
                    f"{name}: is a link that leads nowhere ({reason}); remove it, or restore its place"
                )
                continue
            if not self.is_within(path):
                lines.append(self._strange(path))
        return lines

    def is_within(self, path: Path) -> bool:
        """Return whether a path, with all its links followed, lies in the library or in what it has adopted."""
        return is_inside(path, [self.root, *self._adopted])

    def check_within(self, path: Path) -> None:
        """Check that a path lies in the library or in what it has adopted.

        Raises:
            RefusedError: it does not.
        """
        if not self.is_within(path):
            raise conflict(self._strange(path))

    def check_tree(self, folder: Path) -> None:
        """Check that no link in a folder, at any depth, leads out of the library.

        Raises:
            RefusedError: one does.
        """
        for link in links_in(folder):
            self.check_within(link)

    def _strange(self, path: Path) -> str:
        name = path.relative_to(self.root) if path.is_relative_to(self.root) else path
        return (
            f"{legible(shortened(str(name), 300))}: leads out of the library by a link that was not adopted here;"
            " remove the link, or adopt the place that it leads to under the same name"
        )

    def entry(self, kind: str, name: object) -> Path:
        """Return an existing entry.

        Raises:
            RefusedError: there is none of this kind and name, or it is a link that was not adopted here.
        """
        path = self.place(kind, name)
        if not is_folder(path):
            raise not_found(f"{kind}/{path.name}")
        self.check_within(path)
        return path

    def named(self, subject: object) -> tuple[str, Path]:
        """Return kind and path of an entry named like "runs/toy".

        Raises:
            RefusedError: there is none.
        """
        kind, _, name = subject.partition("/") if isinstance(subject, str) else ("", "", "")
        return kind, self.entry(kind, name)

    def place(self, kind: str, name: object) -> Path:
        """Return where an entry is or would be.

        Raises:
            RefusedError: kind or name is not allowed.
        """
        if kind not in KINDS:
            raise RefusedError(
                f"{shortened(str(kind))!r}: is not a kind of entry; the kinds are {', '.join(KINDS)}"
            )
        return self.root / kind / checked_name(kind, name)

    def fresh(self, kind: str, name: object) -> Path:
        """Return the place of a new entry.

        Raises:
            RefusedError: the name is not allowed or taken.
        """
        path = self.place(kind, name)
        if os.path.lexists(path):
            raise conflict(f"{kind}/{path.name}: exists already; choose another name")
        return path

    def free_name(self, kind: str, name: str, word: str = "", others: tuple[str, ...] = ()) -> str:
        """Return the name, or the name with a number appended if it is taken or a waiting job will take it.

        Args:
            kind: Kind of the new entry.
            name: The name.
            word: Goes before the number: "walk-run-2" is no second set of photos. Without one, it is "walk (2)".
            others: Further kinds in which the name must be free.
        """
        chosen, copy = name, 2
        with self.lock:
            while any(self._is_taken(self.place(one, chosen)) for one in (kind, *others)):
                chosen, copy = f"{name}-{word}-{copy}" if word else f"{name} ({copy})", copy + 1
        return chosen

    def promise(self, kind: str, wish: str) -> str:
        """Return a free name for a new entry, which nobody else gets until `release`.

        No entry of any kind has it: entries of one name belong together.

        Args:
            kind: Its kind.
            wish: The name of a file or folder to name it after; characters that a name may not have are replaced.
        """
        with self.lock:
            name = self.free_name(kind, name_after(wish, kind), others=KINDS)
            self._promised.add(self.place(kind, name))
        return name

    def release(self, kind: str, name: str) -> None:
        """Give up a promised name."""
        with self.lock:
            self._promised.discard(self.place(kind, name))

    def _name_of(self, kind: str, source: Path) -> str:
        """Return a free name after a source, or that of the link to it that was not adopted here."""
        name = name_after(source.stem if source.is_file() else source.name, kind)
        link = self.place(kind, name)
        link = link / source.name if source.is_file() else link
        strange = link.is_symlink() and not self.is_within(link) and resolved(link) == source
        return name if strange else self.free_name(kind, name, others=KINDS)

    def _is_taken(self, path: Path) -> bool:
        return os.path.lexists(path) or path in self._promised or self.in_use(path) is not None

    def part(self, suffix: str = "") -> Path:
        """Return a new path for a file or folder that is not complete yet."""
        return self.hidden("uploads") / f"{secrets.token_hex(8)}{suffix}"

    def publish(self, part: Path, kind: str, name: str) -> Path:
        """Rename a complete folder to a new entry.

        Raises:
            RefusedError: the name is taken by now.
        """
        with self.lock:
            path = self.fresh(kind, name)
            part.rename(path)
        self.changed()
        return path

    def adopt(self, kind: str, source: Path, name: str | None = None) -> Path:
        """Make an entry of a folder or file elsewhere on this computer, without copying it.

        Args:
            kind: Its kind.
            source: The folder or file.
            name: Its name; None for a free one after the source.

        Raises:
            RefusedError: the source does not exist, cannot be read, is not of that kind, or lies in the library; or the
                name is taken.
        """
        if not source.is_absolute():
            raise RefusedError(f"path: {source} is relative; give the whole path, from the root")
        source = _existing(source)
        if source.is_relative_to(self.root) or self.root.is_relative_to(source):
            raise RefusedError(f"path: {source} overlaps the library; give a place outside of it")
        endings = {"scenes": SCENE_ENDINGS, "photos": VIDEO_ENDINGS}.get(kind, ())
        if source.is_file() and source.suffix.lower() not in endings:
            wanted = f"a folder, or a file ending in {', '.join(endings)}" if endings else "a folder"
            raise RefusedError(f"path: {source} is a file; give {wanted}")
        with self.lock:
            name = self._name_of(kind, source) if name is None else name
            path = self.place(kind, name)
            link = path / source.name if source.is_file() else path
            if (
                self.is_within(link) or resolved(link) != source
            ):  # else the link was made by hand, or elsewhere
                self.fresh(kind, name)
                link.parent.mkdir(exist_ok=True)
                link.symlink_to(source, target_is_directory=source.is_dir())
            note_adopted(self.root, source)
            self._adopted.append(source)
        self.changed()
        return path

    def rename(self, kind: str, name: str, to: object) -> Path:
        """Give an entry another name.

        Raises:
            RefusedError: there is none, a job uses it, or the name is taken.
        """
        with self.lock:
            path = self.entry(kind, name)
            self._check_free(path)
            target = self.fresh(kind, to)
            path.rename(target)
            for one in self.trash():
                if one["entry"] == self.name(path):
                    self._note_source(self.hidden("trash") / one["id"], target / EXPORTS)
        self.changed()
        return target

    def move(self, name: str, kind: str, to: str) -> Path:
        """Make an entry one of another kind.

        Raises:
            RefusedError: there is none, a job uses it, or the name is taken there.
        """
        with self.lock:
            path = self.entry(kind, name)
            self._check_free(path)
            target = self.fresh(to, path.name)
            path.rename(target)
            self._promised.discard(path)  # what is made from it may have its name
        self.changed()
        return target

    def remove(self, kind: str, name: str) -> str:
        """Move an entry to the trash; return its id there.

        Raises:
            RefusedError: there is none, or a job uses it.
        """
        return self.discard(self.entry(kind, name))

    def discard(self, path: Path) -> str:
        """Move an entry, a file that was exported from one, or a job's folder to the trash; return its id there.

        Raises:
            RefusedError: a job uses it, or it has just been removed.
        """
        with self.lock:
            self._check_free(path)
            if not os.path.lexists(path):
                raise not_found(self.name(path))
            number = f"{time.time_ns():020d}"
            folder = self.hidden("trash") / number
            folder.mkdir()
            self._note_source(folder, path.parent)
            path.rename(folder / path.name)
        self.changed()
        return number

    def _note_source(self, folder: Path, source: Path) -> None:
        """Write into a folder of the trash from which folder of the library its thing came."""
        with written_aside(folder / "from.txt") as aside:
            aside.write_text(self.name(source), encoding="utf-8")

    def trash(self) -> list[dict[str, Any]]:
        """Return what is in the trash, newest first: id, kind, name, entry and when it was removed (s).

        Kind and name are those of an entry; of an exported file, kind is "exports" and `entry` what it was made from
        ("runs/toy"), which is None otherwise; of a job, kind is "jobs" and name its id.
        """
        found = []
        for folder in sorted(self.hidden("trash").iterdir(), reverse=True):
            number = whole_of(folder.name.lstrip("0"))
            if number is None or folder.is_symlink() or not folder.is_dir():
                continue
            source = _removed_from(folder / "from.txt")
            if source is None:
                continue
            kind, entry = source
            for path in folder.iterdir():
                if path.name != "from.txt":
                    facts = {"kind": kind, "name": legible(path.name), "entry": entry}
                    found.append({"id": folder.name, **facts, "removed": number / 1e9})
        return found

    def restore(self, number: str) -> Path:
        """Move an entry, a file that was exported from one, or a job's folder back from the trash.

        Returns:
            The entry, or the job's folder.

        Raises:
            RefusedError: there is none, its name is taken, or the entry of the file is gone.
        """
        with self.lock:
            for removed in self.trash():
                if removed["id"] == number:
                    name, of = removed["name"], removed["entry"]
                    target = self._fresh_place(removed["kind"], name, of)
                    folder = self.hidden("trash") / number
                    (folder / as_file_name(name)).rename(target)
                    _delete(folder)
                    self.changed()
                    return target if of is None else target.parent.parent
        raise not_found(f"trash/{shortened(number)}")

    def _fresh_place(self, kind: str, name: str, of: str | None) -> Path:
        """Return the place to which something returns from the trash; see `trash`."""
        if of is not None:
            return self._fresh_export(of, name)
        if kind != JOBS:
            return self.fresh(kind, name)
        if os.path.lexists(path := self.hidden(JOBS) / checked_name("job", name)):
            raise conflict(f"job {name}: exists already; remove that one first")
        return path

    def _fresh_export(self, entry: str, name: str) -> Path:
        """Return the place of a file that returns to the exports of an entry; the folder is made if it is missing.

        Raises:
            RefusedError: the entry is gone, a file of that name is there, or a link leads out of the entry.
        """
        try:
            _, owner = self.named(entry)
        except RefusedError as error:
            if error.status != HTTPStatus.NOT_FOUND:
                raise
            raise conflict(f"{entry}: does not exist; restore it first, then {name}") from None
        path = below(owner, Path(EXPORTS, checked_name("file", name, LONGEST_FILE)), entry)
        if os.path.lexists(path):
            raise conflict(f"{entry}/{EXPORTS}/{name}: exists already; remove that file first")
        path.parent.mkdir(exist_ok=True)
        return path

    def empty_trash(self) -> None:
        """Delete what is in the trash; adopted entries lose only their link."""
        with self.lock:  # out of reach first, so that nothing is restored while it is deleted
            numbers = {entry["id"] for entry in self.trash()}
            doomed = [(self.hidden("trash") / number).rename(self.part()) for number in numbers]
        for folder in doomed:
            _delete(folder)
        self.changed()

    def _check_free(self, path: Path) -> None:
        if (why := self.in_use(path)) is not None:
            raise conflict(f"{self.name(path)}: {why}")


def check_own_folders(root: Path) -> None:
    """Check, before anything is written, that the library's own folders are folders in it.

    Args:
        root: The library's folder; it need not exist.

    Raises:
        RefusedError: one of them is a link or a file.
    """
    for name in (*KINDS, HIDDEN, *(f"{HIDDEN}/{part}" for part in PARTS)):
        place = root / name
        if place.is_symlink() or (place.exists() and not place.is_dir()):
            raise RefusedError(f"FOLDER: {place} is a link or a file, but has to be a folder; move it away")


def _existing(source: Path) -> Path:
    """Return a place that is to be adopted, with its links followed.

    Raises:
        RefusedError: it does not exist, or cannot be read.
    """
    place = resolved(source)
    try:
        exists = place is not None and place.exists()
    except (OSError, ValueError):  # too long
        exists = False
    if place is None or not exists:
        raise RefusedError(f"path: {source} does not exist; correct it")
    source = place
    try:
        if source.is_dir():
            with os.scandir(source) as found:
                next(found, None)
        else:
            open_file(source).close()
    except OSError as error:
        raise RefusedError(f"path: {unreadable(source, error)}") from None
    return source


def _removed_from(path: Path) -> tuple[str, str | None] | None:
    """Return kind and entry, as `Library.trash` gives them, that a file of the trash names; None if it names none."""
    try:
        with open_file(path) as file:
            text = file.read(4 * LONGEST).decode("utf-8", errors="replace")
    except OSError:
        return None
    if text == f"{HIDDEN}/{JOBS}" and not path.is_symlink():
        return JOBS, None
    kind, *rest = text.split("/")
    if kind not in KINDS or path.is_symlink():
        return None
    if not rest:
        return kind, None
    return (EXPORTS, f"{kind}/{rest[0]}") if rest[1:] == [EXPORTS] else None


def scene_file(folder: Path) -> Path | None:
    """Return the scene of an entry of scenes: its only file with a scene's ending, or meta.json of an unpacked SOG."""
    try:
        found = sorted(path for path in folder.iterdir() if path.suffix.lower() in SCENE_ENDINGS)
    except FileNotFoundError:  # the entry has just been renamed or removed
        return None
    found += [folder / name for name in ("lod-meta.json", "meta.json") if (folder / name).is_file()]
    return found[0] if found else None


def _delete(path: Path) -> None:
    """Delete a file, a link or a folder; links inside are not followed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
