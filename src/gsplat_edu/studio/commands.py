"""Requests for work become command lines: a checked subset of each command's options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.base.text import shortened
from gsplat_edu.jobs.record import Purpose, Work
from gsplat_edu.sfm.options import CAMERA_MODELS, MAPPERS, MATCHERS, PANORAMA
from gsplat_edu.sfm.video import VIDEO_ENDINGS
from gsplat_edu.studio.library import Library, files_within, scene_file
from gsplat_edu.studio.names import checked_name
from gsplat_edu.studio.refusal import RefusedError, conflict
from gsplat_edu.train.config import APPEARANCES, QUALITIES, REFINEMENTS, SKIES, STRATEGIES
from gsplat_edu.train.setting import OUTSIDE_MASKS, TRANSIENTS

EXPORTS = "exports"
"""Folder of an entry with the files that were exported from it."""

EDITS = "edits.json"
"""File of an entry with the edits of its scene."""

FORMATS = ("ply", "compressed.ply", "splat", "spz", "sog", "glb", "html")
"""Endings of exported files."""

MADE = {"sfm": "captures", "train": "runs", "clean": "scenes"}
"""Kinds of the entries that commands make; the others write into the entry that they work on."""

LONGEST_TEXT = 200
"""Characters of an option's text."""

Words = list[str]
Option = Callable[[str, Any], Words]
"""Turns name and value of an option into words of the command line."""


def _choice(*values: str) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if value not in values:
            raise RefusedError(f"{name}: is {str(value)[:40]!r}, but has to be one of {', '.join(values)}")
        return [_flag(name), str(value)]

    return words


def _whole(least: int, most: int) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if type(value) is not int or not least <= value <= most:
            raise RefusedError(
                f"{name}: is {str(value)[:40]}, but has to be a whole number from {least} to {most}"
            )
        return [_flag(name), str(value)]

    return words


def _number(least: float, most: float) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        if type(value) not in (int, float) or not least <= value <= most:  # NaN is not either
            raise RefusedError(
                f"{name}: is {str(value)[:40]}, but has to be a number from {least:g} to {most:g}"
            )
        return [_flag(name), f"{value:g}" if value == float(f"{value:g}") else repr(value)]

    return words


def _word_or(word: str, number: Option) -> Option:
    def words(name: str, value: Any) -> Words:  # noqa: ANN401
        return [_flag(name), word] if value == word else number(name, value)

    return words


def _switch(name: str, value: Any) -> Words:  # noqa: ANN401
    if not isinstance(value, bool):
        raise RefusedError(f"{name}: is {str(value)[:40]}, but has to be true or false")
    return [_flag(name)] if value else []


def _text(name: str, value: Any) -> Words:  # noqa: ANN401
    """Pass a short text on; the command checks it."""
    if (
        not isinstance(value, str)
        or not value
        or len(value) > LONGEST_TEXT
        or not value.isprintable()
        or value[0] == "-"
    ):
        raise RefusedError(f"{name}: has to be a short text that does not begin with a dash")
    return [_flag(name), value]


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


SFM_OPTIONS: Mapping[str, Option] = {
    "frames": _whole(3, 5_000),
    "matcher": _choice(*MATCHERS),
    "mapper": _choice(*MAPPERS),
    "camera_model": _choice(*CAMERA_MODELS),
    "panorama": _choice(*PANORAMA),
    "scale": _text,
    "max_features": _whole(100, 100_000),
    "max_image_size": _whole(64, 20_000),
    "threads": _whole(0, 1_024),
}

AUTO = "auto"
"""The resolution that the planned Gaussians resolve."""

TRAIN_OPTIONS: Mapping[str, Option] = {
    "quality": _choice(*QUALITIES),
    "iterations": _whole(1, 1_000_000),
    "time_limit": _text,
    "max_memory": _text,
    "max_gaussians": _whole(1, 100_000_000),
    "strategy": _choice(*STRATEGIES),
    "resolution": _word_or(AUTO, _number(0.1, 100_000.0)),
    "test_every": _whole(0, 100_000),
    "appearance": _choice("auto", *APPEARANCES),
    "sky": _choice("auto", *SKIES),
    "transients": _choice("auto", *TRANSIENTS),
    "refine": _choice("auto", *REFINEMENTS),
    "outside_masks": _choice("auto", *OUTSIDE_MASKS),
    "panorama": _choice(*PANORAMA),
    "scale": _text,
    "seed": _whole(0, 2**31 - 1),
    "batch": _whole(1, 1_024),
    "eval_every": _whole(0, 1_000_000),
    "save_every": _whole(0, 1_000_000),
    "antialiased": _switch,
    "white_background": _switch,
    "random_background": _switch,
    "clean": _switch,
}

DOCTOR_OPTIONS: Mapping[str, Option] = {"resolution": _number(0.1, 100_000.0)}

CLEAN_OPTIONS: Mapping[str, Option] = {"max_loss": _number(0.0, 100.0)}

CONVERT_OPTIONS: Mapping[str, Option] = {
    "sh_degree": _whole(0, 3),
    "min_opacity": _number(0.0, 1.0),
}

RENDER_OPTIONS: Mapping[str, Option] = {
    "frames": _whole(1, 100_000),
    "size": _whole(16, 8_192),
    "fps": _whole(1, 240),
    "orbit": _switch,
    "white_background": _switch,
}


def work_of(library: Library, request: Mapping[str, Any], purpose: Purpose = Purpose.BEGIN) -> Work:
    """Turn a request into a command line, whose paths all lie in the library or in what it has adopted.

    Args:
        library: Where the entries are.
        request: command, subject ("captures/toy"), to (the name of what is made), options, and for each command
            what docs/STUDIO.md lists.
        purpose: What for; only `BEGIN` chooses a name where `to` is missing.

    Raises:
        RefusedError: the command is unknown, an option is not allowed, an entry does not exist or exists already, or
            a path leads out of the library.
    """
    command = request.get("command")
    makers = {
        "sfm": _sfm,
        "train": _train,
        "doctor": _doctor,
        "clean": _clean,
        "convert": _convert,
        "render": _render,
    }
    maker = makers.get(command) if isinstance(command, str) else None
    if maker is None:
        raise RefusedError(f"command: is {str(command)[:40]!r}, but has to be one of {', '.join(makers)}")
    known = {"command", "subject", "to", "options", "format", "edits", "resume"}
    if unknown := sorted(set(request) - known):
        raise RefusedError(f"{shortened(unknown[0])}: is not known; see docs/STUDIO.md")
    work = maker(_Asked(library, request, purpose))
    for word in work.argv:
        if word.startswith("/"):
            library.check_within(Path(word))
    return work


def renamed(request: Mapping[str, Any], kind: str, old: str, new: str) -> Mapping[str, Any]:
    """Return a request as it is after an entry that it may name got another name.

    Args:
        request: A request of a `Work`.
        kind: The entry's kind.
        old: Its name.
        new: Its new name.
    """
    changes = {}
    if request.get("subject") == f"{kind}/{old}":
        changes["subject"] = f"{kind}/{new}"
    if MADE.get(request["command"]) == kind and request.get("to") == old:
        changes["to"] = new
    return {**request, **changes}


@dataclass(frozen=True)
class _Asked:
    """A request on its way to a command line.

    Args:
        library: Where the entries are.
        request: The request.
        purpose: What the command line is for.
    """

    library: Library
    request: Mapping[str, Any]
    purpose: Purpose

    def subject(self, *kinds: str) -> tuple[str, Path]:
        """Return kind and path of the entry that is worked on."""
        given = self.request.get("subject")
        kind, _, name = given.partition("/") if isinstance(given, str) else ("", "", "")
        if kind not in kinds:
            raise RefusedError(
                f"subject: is {shortened(str(given))!r}, but has to be of {' or '.join(kinds)}"
            )
        if self.purpose is Purpose.SHOW:
            return kind, self.library.place(kind, name)
        entry = self.library.entry(kind, name)
        if kind == "photos" and not any(True for _ in files_within(entry)):
            raise conflict(f"photos/{entry.name}: is empty; add photos first")
        return kind, entry

    def made(self, kind: str, name: str) -> Path:
        """Return the entry that is made, and that a job which is continued has made in part."""
        given = self.request.get("to")
        if self.purpose is Purpose.BEGIN:
            return self.library.fresh(kind, given or self.library.free_name(kind, name))
        place = self.library.place(kind, given)
        if self.purpose is Purpose.CONTINUE and place.exists():
            self.library.check_tree(place)
        return place

    def options(self, known: Mapping[str, Option]) -> Words:
        """Return the words of the options."""
        given = self.request.get("options", {})
        if not isinstance(given, dict):
            raise RefusedError("options: has to be an object")
        words: Words = []
        for name, value in given.items():
            if name not in known:
                raise RefusedError(
                    f"options.{shortened(str(name))}: is not one of {', '.join(known) or 'none'}"
                )
            if value is not None:
                words += known[name](name, value)
        return words

    def edits(self, kind: str, entry: Path) -> Words:
        """Return the words that apply the edits of the entry that is worked on."""
        if self.request.get("edits") is not True:
            return []
        if self.purpose is not Purpose.SHOW and not (entry / EDITS).is_file():
            raise RefusedError(
                f"edits: {kind}/{entry.name} has none; edit the scene first, or leave them out"
            )
        return ["--edits", str(entry / EDITS)]

    def scene(self, kind: str, entry: Path) -> Path:
        """Return what convert and render read."""
        if self.purpose is Purpose.SHOW and not entry.is_dir():
            return entry
        return scene_of(entry, kind)

    def work(self, argv: Words, title: str, subject: str, **chosen: object) -> Work:
        """Return the work, whose request has what was chosen."""
        return Work({**self.request, **chosen}, tuple(argv), title, subject)


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


def _sfm(asked: _Asked) -> Work:
    kind, entry = asked.subject("photos")
    out = asked.made("captures", entry.name)
    argv = ["sfm", str(photos_source(entry)), str(out), *asked.options(SFM_OPTIONS)]
    return asked.work(argv, f"poses of {entry.name}", f"{kind}/{entry.name}", to=out.name)


def _train(asked: _Asked) -> Work:
    kind, entry = asked.subject("captures", "photos")
    source = photos_source(entry) if kind == "photos" else entry
    resumes = asked.request.get("resume") is True
    if resumes and asked.purpose is not Purpose.SHOW:
        out = asked.library.entry("runs", asked.request.get("to"))
        asked.library.check_tree(out)
    else:
        out = asked.made("runs", entry.name)
        resumes |= asked.purpose is Purpose.CONTINUE and (out / "config.json").is_file()
    argv = ["train", str(source), "--out", str(out), *asked.options(TRAIN_OPTIONS)]
    argv += ["--resume"] if resumes else []
    chosen = {"to": out.name} | ({"resume": True} if resumes else {})
    return asked.work(argv, f"training of {out.name}", f"runs/{out.name}", **chosen)


def _doctor(asked: _Asked) -> Work:
    kind, entry = asked.subject("captures", "runs")
    words = ["--no-forecast"] if kind == "captures" else []
    argv = ["doctor", str(entry), *words, *asked.options(DOCTOR_OPTIONS if kind == "captures" else {})]
    return asked.work(argv, f"doctor of {entry.name}", f"{kind}/{entry.name}")


def _clean(asked: _Asked) -> Work:
    kind, entry = asked.subject("runs")
    out = asked.made("scenes", f"{entry.name}-clean")
    argv = ["clean", str(entry), "--out", str(out / f"{out.name}.ply"), *asked.options(CLEAN_OPTIONS)]
    return asked.work(argv, f"cleaning of {entry.name}", f"{kind}/{entry.name}", to=out.name)


def _convert(asked: _Asked) -> Work:
    kind, entry = asked.subject("runs", "scenes")
    form = asked.request.get("format")
    if form not in FORMATS:
        raise RefusedError(f"format: is {str(form)[:40]!r}, but has to be one of {', '.join(FORMATS)}")
    name = checked_name("to", asked.request.get("to") or entry.name)
    out = entry / EXPORTS / f"{name}.{form}"
    argv = ["convert", str(asked.scene(kind, entry)), str(out), *asked.options(CONVERT_OPTIONS)]
    argv += [*asked.edits(kind, entry), "--verify"]
    return asked.work(argv, f"export of {out.name}", f"{kind}/{entry.name}", to=name)


def _render(asked: _Asked) -> Work:
    kind, entry = asked.subject("runs", "scenes")
    name = checked_name("to", asked.request.get("to") or entry.name)
    argv = ["render", str(asked.scene(kind, entry)), "--out", str(entry / EXPORTS / f"{name}.mp4")]
    argv += [*asked.edits(kind, entry), *asked.options(RENDER_OPTIONS)]
    return asked.work(argv, f"video of {entry.name}", f"{kind}/{entry.name}", to=name)
