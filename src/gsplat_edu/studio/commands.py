"""Requests become work, and work becomes a command line: a checked subset of each command's options.

`command_line` is the only way to a command line, for work from a request as for work from a record on disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msgspec import structs

from gsplat_edu.base.constants import POINT_SUFFIXES, SCENE_SUFFIXES
from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.text import as_file_name, legible, option_flag, shortened
from gsplat_edu.jobs.record import Purpose, Rendered, Work
from gsplat_edu.options.offers import check_words, offered, words_of
from gsplat_edu.server.refusal import RefusedError, conflict
from gsplat_edu.sfm.video import VIDEO_ENDINGS
from gsplat_edu.studio.contents import files_within
from gsplat_edu.studio.library import EXPORTS, Library, scene_file
from gsplat_edu.studio.listing import is_unfinished
from gsplat_edu.studio.names import LONGEST_FILE, checked_name

EDITS = "edits.json"
"""File of an entry with the edits of its scene."""

FORMATS = (*(suffix.removeprefix(".") for suffix in (*SCENE_SUFFIXES, *POINT_SUFFIXES)), "html")
"""Endings of exported scenes."""

SURFACE, COLLIDER = "mesh.glb", "collider.glb"
"""Endings of exported meshes."""

MESHES = {"surface": SURFACE, "collider": COLLIDER}
"""Exported meshes that a page can show, by their names in a request, and the endings of their files."""

Line = list[str | Path]
"""Words of a command line; every path of the library is a Path, and is checked before it becomes a word."""


@dataclass(frozen=True)
class _Asked:
    """Work on its way to a command line.

    Args:
        library: Where the entries are.
        work: The work.
        purpose: What the command line is for.
    """

    library: Library
    work: Work
    purpose: Purpose

    @property
    def command(self) -> _Command:
        """What the command reads, writes and accepts."""
        return COMMANDS[self.work.command]

    def source(self) -> tuple[str, Path]:
        """Return kind and path of the entry that is read."""
        inputs = self.work.inputs
        if not inputs or inputs != (inputs[0], *self._along().values()):
            raise RefusedError(f"inputs: are not what {self.work.command} reads: {self.command.reading}")
        kind, place = _entry_at(self.library, "inputs", inputs[0], self.command.reads)
        if self.purpose is Purpose.SHOW:
            return kind, place
        entry = self.library.entry(kind, place.name)
        if kind == "photos" and not any(True for _ in files_within(entry)):
            raise conflict(f"{inputs[0]}: is empty; add photos first")
        if kind == "captures" and is_unfinished(entry):
            raise conflict(f"{inputs[0]}: its photos are not placed yet; place them first")
        return kind, entry

    def _along(self) -> dict[str, str]:
        """Return the files of the entry that are read along with it, those that the command may read."""
        entry, along, found = self.work.inputs[0], self.work.inputs[1:], {}
        if self.command.edits and f"{entry}/{EDITS}" in along:
            found["edits"] = f"{entry}/{EDITS}"
        for name, ending in MESHES.items() if self._writes_page() else ():
            meshes = [place for place in along if place.endswith(f".{ending}")]
            if meshes and (name == "surface" or "surface" in found):
                found[name] = meshes[0]
        return found

    def _writes_page(self) -> bool:
        """Return whether the work writes a page, which can show meshes."""
        return self.work.command == "convert" and all(place.endswith(".html") for place in self.work.outputs)

    def scene(self) -> Path:
        """Return what convert and render read."""
        kind, entry = self.source()
        if self.purpose is Purpose.SHOW and not entry.is_dir():
            return entry
        return scene_of(entry, kind)

    def made(self) -> Path:
        """Return the entry that is made, and that a job which is started again has made in part."""
        outputs, makes = self.work.outputs, self.command.makes
        if len(outputs) != 1:
            raise RefusedError(f"outputs: are not what {self.work.command} writes: one of {makes}")
        kind, place = _entry_at(self.library, "outputs", outputs[0], (makes,))
        if self.purpose is Purpose.SHOW:
            return place
        if self.work.options.get("resume") is True:
            place = self.library.entry(kind, place.name)
        elif self.purpose is Purpose.BEGIN:
            return self.library.fresh(kind, place.name)
        if place.exists():
            self.library.check_tree(place)
        return place

    def exported(self) -> Path:
        """Return the file that is written beside the entry that is read."""
        _, entry = self.source()
        folder = f"{self.work.inputs[0]}/{EXPORTS}/"
        name = self.work.outputs[0].removeprefix(folder) if len(self.work.outputs) == 1 else ""
        endings = tuple(f".{form}" for form in self.command.forms)
        if self.work.outputs != (f"{folder}{name}",) or not name.endswith(endings) or name in endings:
            raise RefusedError(
                f"outputs: are not what {self.work.command} writes: a file in {folder}"
                f" that ends in {', '.join(self.command.forms)}"
            )
        path = checked_name("outputs", name, LONGEST_FILE)
        if legible(path) != name:
            raise RefusedError(f"outputs: {shortened(name)!r} is not in Unicode's composed form; rename it")
        return entry / EXPORTS / path

    def options(self) -> list[str]:
        """Return the words of the options."""
        kind = self.work.inputs[0].partition("/")[0]
        if kind in self.command.without_options and self.work.options:
            raise RefusedError(f"options: {self.work.command} has none for {kind}; leave them out")
        try:
            return words_of(self.work.command, self.work.options)
        except ArgumentError as error:
            raise RefusedError(f"options.{error}") from None

    def edits(self) -> Line:
        """Return the words that apply the edits of the entry that is read."""
        kind, entry = self.source()
        if "edits" not in self._along():
            return []
        if self.purpose is not Purpose.SHOW and not (entry / EDITS).is_file():
            raise RefusedError(
                f"edits: {kind}/{entry.name} has none; edit the scene first, or leave them out"
            )
        return ["--edits", entry / EDITS]

    def meshes(self) -> Line:
        """Return the words that put exported meshes of the entry that is read into a page."""
        kind, entry = self.source()
        words: Line = []
        for name, place in self._along().items():
            if name not in MESHES:
                continue
            folder = f"{self.work.inputs[0]}/{EXPORTS}/"
            file = checked_name(name, place.removeprefix(folder), LONGEST_FILE)
            if place != f"{folder}{file}":
                raise RefusedError(f"{name}: {shortened(place)!r} is not a mesh in {folder}")
            path = entry / EXPORTS / file
            if self.purpose is not Purpose.SHOW and not path.is_file():
                raise RefusedError(f"{name}: {kind}/{entry.name} has no {file}; make the mesh first")
            words += [option_flag(name), path]
        return words


def _place_of(library: Library, what: str, given: str, kinds: tuple[str, ...]) -> tuple[str, Path]:
    """Return kind and path of the entry that a text like "runs/toy" names.

    Raises:
        RefusedError: it names none of these kinds.
    """
    kind, _, name = given.partition("/")
    if kind not in kinds:
        raise RefusedError(f"{what}: is {shortened(given)!r}, but has to be of {' or '.join(kinds)}")
    return kind, library.place(kind, name)


def _entry_at(library: Library, what: str, place: str, kinds: tuple[str, ...]) -> tuple[str, Path]:
    """Return kind and path of an input or output.

    Raises:
        RefusedError: it is not of these kinds, or named in another way than the library does: places are compared.
    """
    kind, path = _place_of(library, what, place, kinds)
    if library.name(path) != place:
        raise RefusedError(f"{what}: {shortened(place)!r} is not in Unicode's composed form; rename it")
    return kind, path


def photos_source(entry: Path) -> Path:
    """Return what sfm reads of an entry of photos: the folder, or its only file if that is a video."""
    names = [name for name, _, _ in files_within(entry)]
    if len(names) == 1 and Path(names[0]).suffix.lower() in VIDEO_ENDINGS:
        return entry / names[0]
    return entry


def scene_of(entry: Path, kind: str) -> Path:
    """Return what convert reads of an entry: the run's folder, or the scene's file.

    Raises:
        RefusedError: the entry holds no scene.
    """
    if kind == "runs":
        return entry
    if kind == "scenes" and (found := scene_file(entry)) is not None:
        return found
    raise RefusedError(f"{kind}/{entry.name}: holds no scene; choose a run or a scene")


def _sfm(asked: _Asked) -> Line:
    _, entry = asked.source()
    return [photos_source(entry), asked.made(), *asked.options()]


def _train(asked: _Asked) -> Line:
    kind, entry = asked.source()
    source = photos_source(entry) if kind == "photos" else entry
    return [source, "--out", asked.made(), *asked.options()]


def _doctor(asked: _Asked) -> Line:
    kind, entry = asked.source()
    return [entry, *(["--no-forecast"] if kind == "captures" else []), *asked.options()]


def _clean(asked: _Asked) -> Line:
    _, entry = asked.source()
    out = asked.made()
    return [entry, "--out", out / f"{out.name}.ply", *asked.edits(), *asked.options()]


def _convert(asked: _Asked) -> Line:
    line = [asked.scene(), asked.exported(), *asked.options(), *asked.edits(), *asked.meshes()]
    is_points = asked.work.outputs[0].endswith(POINT_SUFFIXES)
    return line if is_points or "verify" in asked.work.options else [*line, "--verify"]


def _render(asked: _Asked) -> Line:
    return [asked.scene(), "--out", asked.exported(), *asked.edits(), *asked.options()]


def _mesh(asked: _Asked) -> Line:
    out = asked.exported()
    collider = ["--collider"] if out.name.endswith(f".{COLLIDER}") else []
    return [asked.scene(), out, *collider, *asked.options()]


@dataclass(frozen=True)
class _Command:
    """What a command reads, writes and accepts.

    Args:
        line: Makes the command line of a work.
        title: A few words for people; INPUT and OUTPUT stand for the names of what it reads and writes.
        reads: Kinds of the entries that it works on.
        makes: Kind of the entry that it makes; empty if it makes none.
        suffix: Added to the name of what it reads, for the default name of the entry that it makes.
        word: Goes before the number of a further one of that name.
        forms: Endings of the file that it writes among the exports of what it reads; none if it writes none.
        edits: Whether it can apply edits.
        without_options: Kinds of entries with which it accepts no options.
    """

    line: Callable[[_Asked], Line]
    title: str
    reads: tuple[str, ...]
    makes: str = ""
    suffix: str = ""
    word: str = ""
    forms: tuple[str, ...] = ()
    edits: bool = False
    without_options: tuple[str, ...] = ()

    @property
    def reading(self) -> str:
        """Say what the command reads."""
        more = ", and perhaps its edits" if self.edits else ""
        return f"an entry{more}" + (", and for a page its meshes" if "html" in self.forms else "")


COMMANDS: Mapping[str, _Command] = {
    "sfm": _Command(_sfm, "cameras of INPUT", ("photos",), "captures", word="poses"),
    "train": _Command(_train, "training of OUTPUT", ("captures", "photos"), "runs", word="run"),
    "doctor": _Command(_doctor, "doctor of INPUT", ("captures", "runs"), without_options=("runs",)),
    "clean": _Command(_clean, "cleaning of INPUT", ("runs",), "scenes", "-clean", edits=True),
    "convert": _Command(_convert, "export of OUTPUT", ("runs", "scenes"), forms=FORMATS, edits=True),
    "mesh": _Command(_mesh, "mesh of INPUT", ("runs", "scenes"), forms=(SURFACE, COLLIDER)),
    "render": _Command(_render, "video of INPUT", ("runs", "scenes"), forms=("mp4",), edits=True),
}
"""The commands that can be asked for."""


def work_of(library: Library, request: Mapping[str, Any]) -> Work:
    """Turn a request into work; `command_line` checks the rest of it.

    Args:
        library: Where the entries are.
        request: command, subject ("captures/toy"), to (the name of what is made), options, and for each command
            what docs/STUDIO.md lists.

    Raises:
        RefusedError: the command or a field is unknown, or a name is not allowed.
    """
    name = request.get("command")
    command = _command_of(name if isinstance(name, str) else str(name))
    known = {"command", "subject", "to", "options", "format", "edits", "resume", *MESHES}
    if unknown := sorted(set(request) - known):
        raise RefusedError(f"{shortened(unknown[0])}: is not known; see docs/STUDIO.md")
    _, path = _place_of(library, "subject", str(request.get("subject")), command.reads)
    subject, entry, to = library.name(path), path.name, request.get("to")
    options = request.get("options", {})
    if not isinstance(options, dict):
        raise RefusedError("options: has to be an object")
    options = {option: value for option, value in options.items() if value is not None}
    if request.get("resume") is True and "resume" in offered(str(name)):
        options["resume"] = True
    outputs: tuple[str, ...] = ()
    if command.makes:
        free = to or library.free_name(command.makes, f"{entry}{command.suffix}", command.word)
        outputs = (f"{command.makes}/{legible(checked_name('to', free))}",)
    elif command.forms:
        form = request.get("format") if len(command.forms) > 1 else command.forms[0]
        if form not in command.forms:
            raise RefusedError(
                f"format: is {str(form)[:40]!r}, but has to be one of {', '.join(command.forms)}"
            )
        outputs = (
            f"{subject}/{EXPORTS}/{_free_export(path, legible(checked_name('to', to or entry)), form)}",
        )
    inputs = [subject, *([f"{subject}/{EDITS}"] if request.get("edits") is True else [])]
    for mesh in MESHES:
        if request.get(mesh) is not None:
            inputs.append(f"{subject}/{EXPORTS}/{checked_name(mesh, request[mesh], LONGEST_FILE)}")
    return Work(str(name), tuple(inputs), outputs, options)


def _free_export(entry: Path, name: str, form: str) -> str:
    """Return the name of a file to export, with a number if there is one of its name: no export replaces another."""
    chosen, copy = f"{name}.{form}", 2
    while os.path.lexists(entry / EXPORTS / as_file_name(chosen)):
        chosen, copy = f"{name} ({copy}).{form}", copy + 1
    return chosen


def command_line(library: Library, work: Work, purpose: Purpose) -> Rendered:
    """Validate work and render its command line, whose paths all lie in the library or in what it has adopted.

    Args:
        library: Where the entries are.
        work: The work; a training that has begun its run gets the option `resume` when it is started again.
        purpose: What for.

    Raises:
        RefusedError: the command is unknown, an option is not allowed, the places are not those of the command, an
            entry does not exist or exists already, or a path leads out of the library.
    """
    command = _command_of(work.command)
    asked = _Asked(library, work, purpose)
    if (
        purpose is Purpose.CONTINUE
        and "resume" in offered(work.command)
        and (asked.made() / "config.json").is_file()
    ):
        asked = replace(asked, work=structs.replace(work, options={**work.options, "resume": True}))
    if not (command.makes or command.forms) and work.outputs:
        raise RefusedError(f"outputs: {work.command} writes nothing; leave them out")
    argv = [work.command]
    for word in command.line(asked):
        if isinstance(word, Path):
            library.check_within(word)
        argv.append(str(word))
    try:
        check_words(work.command, argv[1:], check=purpose is not Purpose.SHOW)
    except SplatError as error:
        raise RefusedError(_in_request(work.command, str(error))) from None
    return Rendered(asked.work, tuple(argv))


def _in_request(command: str, message: str) -> str:
    """Return an error of the command line in the words of a request: "--batch: is" becomes "options.batch: is"."""
    said = message.removeprefix("argument ")
    flag, colon, rest = said.partition(": ")
    name = flag.removeprefix("--").replace("-", "_")
    return f"options.{name}: {rest}" if colon and name in offered(command) else said


def _command_of(name: str) -> _Command:
    if name not in COMMANDS:
        raise RefusedError(f"command: is {name[:40]!r}, but has to be one of {', '.join(COMMANDS)}")
    return COMMANDS[name]


def title_of(work: Work) -> str:
    """Return a few words for people that say what work does."""
    words = {"INPUT": work.inputs[0], "OUTPUT": work.outputs[0] if work.outputs else ""}
    return " ".join(
        words[word].rpartition("/")[2] if word in words else word
        for word in COMMANDS[work.command].title.split()
    )


def subject_of(work: Work) -> str:
    """Return the entry on whose screen work is shown: the run of a training, else what is read."""
    return work.outputs[0] if work.command == "train" else work.inputs[0]
