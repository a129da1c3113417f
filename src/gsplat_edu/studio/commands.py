"""Requests for work become command lines: a checked subset of each command's options."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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

LONGEST_TEXT = 200
"""Characters of an option's text."""

Words = list[str]
Option = Callable[[str, Any], Words]
"""Turns name and value of an option into words of the command line."""


@dataclass(frozen=True)
class Work:
    """A command line to run.

    Args:
        argv: Words after `gsplat-edu`.
        title: A few words for people.
        subject: The entry that it works on.
    """

    argv: tuple[str, ...]
    title: str
    subject: str


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
        if type(value) not in (int, float) or not math.isfinite(value) or not least <= value <= most:
            raise RefusedError(
                f"{name}: is {str(value)[:40]}, but has to be a number from {least:g} to {most:g}"
            )
        return [_flag(name), f"{value:g}" if value == float(f"{value:g}") else repr(value)]

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

TRAIN_OPTIONS: Mapping[str, Option] = {
    "quality": _choice(*QUALITIES),
    "iterations": _whole(1, 1_000_000),
    "time_limit": _text,
    "max_memory": _text,
    "max_gaussians": _whole(1, 100_000_000),
    "strategy": _choice(*STRATEGIES),
    "resolution": _number(0.1, 100_000.0),
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


def work_of(library: Library, request: Mapping[str, Any]) -> Work:
    """Turn a request into a command line.

    Args:
        library: Where the entries are.
        request: command, subject ("captures/toy"), to (the name of what is made), options, and for each command
            what docs/STUDIO.md lists.

    Raises:
        RefusedError: the command is unknown, an option is not allowed, or an entry does not exist or exists already.
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
        raise RefusedError(f"{unknown[0]}: is not known; see docs/STUDIO.md")
    return maker(library, request)


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


def _sfm(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "photos")
    out = library.fresh("captures", request.get("to") or library.free_name("captures", entry.name))
    argv = ["sfm", str(photos_source(entry)), str(out), *_options(request, SFM_OPTIONS)]
    return Work(tuple(argv), f"poses of {entry.name}", f"{kind}/{entry.name}")


def _train(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "captures", "photos")
    source = photos_source(entry) if kind == "photos" else entry
    if request.get("resume") is True:
        out = library.entry("runs", str(request.get("to")))
    else:
        out = library.fresh("runs", request.get("to") or library.free_name("runs", entry.name))
    argv = ["train", str(source), "--out", str(out), *_options(request, TRAIN_OPTIONS)]
    argv += ["--resume"] if request.get("resume") is True else []
    return Work(tuple(argv), f"training of {out.name}", f"runs/{out.name}")


def _doctor(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "captures", "runs")
    words = ["--no-forecast"] if kind == "captures" else []
    argv = ["doctor", str(entry), *words, *_options(request, DOCTOR_OPTIONS if kind == "captures" else {})]
    return Work(tuple(argv), f"doctor of {entry.name}", f"{kind}/{entry.name}")


def _clean(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "runs")
    out = library.fresh("scenes", request.get("to") or library.free_name("scenes", f"{entry.name}-clean"))
    argv = ["clean", str(entry), "--out", str(out / f"{out.name}.ply"), *_options(request, CLEAN_OPTIONS)]
    return Work(tuple(argv), f"cleaning of {entry.name}", f"{kind}/{entry.name}")


def _convert(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "runs", "scenes")
    form = request.get("format")
    if form not in FORMATS:
        raise RefusedError(f"format: is {str(form)[:40]!r}, but has to be one of {', '.join(FORMATS)}")
    name = checked_name("to", request.get("to") or entry.name)
    out = entry / EXPORTS / f"{name}.{form}"
    argv = ["convert", str(scene_of(entry, kind)), str(out), *_options(request, CONVERT_OPTIONS)]
    argv += [*_edits(request, kind, entry), "--verify"]
    return Work(tuple(argv), f"export of {out.name}", f"{kind}/{entry.name}")


def _render(library: Library, request: Mapping[str, Any]) -> Work:
    kind, entry = _subject(library, request, "runs", "scenes")
    name = checked_name("to", request.get("to") or entry.name)
    argv = ["render", str(scene_of(entry, kind)), "--out", str(entry / EXPORTS / f"{name}.mp4")]
    argv += [*_edits(request, kind, entry), *_options(request, RENDER_OPTIONS)]
    return Work(tuple(argv), f"video of {entry.name}", f"{kind}/{entry.name}")


def _edits(request: Mapping[str, Any], kind: str, entry: Path) -> Words:
    if request.get("edits") is not True:
        return []
    if not (entry / EDITS).is_file():
        raise RefusedError(f"edits: {kind}/{entry.name} has none; edit the scene first, or leave them out")
    return ["--edits", str(entry / EDITS)]


def _subject(library: Library, request: Mapping[str, Any], *kinds: str) -> tuple[str, Path]:
    kind, entry = library.named(request.get("subject"))
    if kind not in kinds:
        raise RefusedError(f"subject: is of {kind}, but has to be of {' or '.join(kinds)}")
    if kind == "photos" and not any(True for _ in files_within(entry)):
        raise conflict(f"photos/{entry.name}: is empty; add photos first")
    return kind, entry


def _options(request: Mapping[str, Any], known: Mapping[str, Option]) -> Words:
    given = request.get("options", {})
    if not isinstance(given, dict):
        raise RefusedError("options: has to be an object")
    words: Words = []
    for name, value in given.items():
        if name not in known:
            raise RefusedError(f"options.{str(name)[:40]}: is not one of {', '.join(known) or 'none'}")
        if value is not None:
            words += known[name](name, value)
    return words
