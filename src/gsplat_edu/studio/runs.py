"""A run's curves and its held-out views, read from its folder."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.text import image_file_names, whole_of
from gsplat_edu.evaluate.comparison import comparison_size, read_comparison
from gsplat_edu.photos.image_files import UNDECODABLE
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.server.refusal import RefusedError, not_found
from gsplat_edu.studio.pictures import cache_name
from gsplat_edu.studio.workers import Worker

MOST_READ = 8 << 20
"""Bytes of a log in one answer."""

GAIN = 4
"""Factor of a difference picture."""

PICTURES = ("render", "photo", "difference")

PREVIEW_SIDE = 512
"""Longest side of a preview, px."""

PREVIEW_QUALITY = 90

POINT = ("iteration", "loss", "num_gaussians", "ms", "seconds")
SCORE = ("iteration", "psnr", "ssim")


def curves(folder: RunFolder, after: str) -> dict[str, Any]:
    """Read the new lines of a run's log.

    Args:
        folder: The run.
        after: `next` of the previous answer; empty for the whole log.

    Returns:
        points and scores as columns; next; reset, whether the log was rewritten, so that earlier points are void; and
        more, whether more lines can be read now.
    """
    try:
        with open_file(folder.log_file) as file:
            facts = os.fstat(file.fileno())  # of this file: a resumed training puts another one in its place
            known, _, offset = after.partition(".")
            file_id = f"{facts.st_ino:x}"
            begin = (whole_of(offset) or 0) if known == file_id else 0
            begin = begin if begin <= facts.st_size else 0
            file.seek(begin)
            data = file.read(MOST_READ)
    except OSError:
        return {
            "points": _columns(POINT, []),
            "scores": _columns(SCORE, []),
            "next": "",
            "reset": True,
            "more": False,
        }
    end = data.rfind(b"\n") + 1
    points, scores = [], []
    for line in data[:end].splitlines():
        try:
            entry = parse_json(line)
        except ValueError:
            continue
        if isinstance(entry, dict) and "loss" in entry:
            points.append(entry)
        elif isinstance(entry, dict) and "psnr" in entry:
            scores.append(entry)
    return {
        "points": _columns(POINT, points),
        "scores": _columns(SCORE, scores),
        "next": f"{file_id}.{begin + end}",
        "reset": begin == 0,
        "more": len(data) == MOST_READ,
    }


def _columns(names: tuple[str, ...], entries: list[dict[str, Any]]) -> dict[str, list[Any]]:
    return {name: [entry.get(name) for entry in entries] for name in names}


def held_out_views(folder: RunFolder) -> list[dict[str, Any]]:
    """Return the scores of a run's held-out views, worst first, each with its index for `view_picture`.

    W and H are the size of its pictures, None if there are none.

    Raises:
        RefusedError: the run is damaged.
    """
    scores = _scores(folder)
    names = image_file_names([str(score["name"]) for score in scores])
    sizes = [_size(folder.renders / "test" / name) for name in names]
    entries = [
        {"index": i, **score, **size} for i, (score, size) in enumerate(zip(scores, sizes, strict=True))
    ]
    return sorted(entries, key=lambda entry: (entry.get("psnr") is None, entry.get("psnr")))


def compared(a: RunFolder, b: RunFolder) -> dict[str, Any]:
    """Compare the held-out views that two runs share, by name; the largest loss of `b` first."""
    one, other = ({view["name"]: view for view in held_out_views(folder)} for folder in (a, b))
    shared = []
    for name in one:
        if name in other:
            left, right = one[name].get("psnr"), other[name].get("psnr")
            gain = None if left is None or right is None else right - left
            shared.append({"name": name, "a": one[name], "b": other[name], "gain": gain})
    shared.sort(key=lambda entry: (entry["gain"] is None, entry["gain"]))
    return {
        "views": shared,
        "only_a": sorted(set(one) - set(other)),
        "only_b": sorted(set(other) - set(one)),
    }


def view_picture(
    decoder: Worker, cache: Path, folder: RunFolder, index: str, what: str, small: bool = False
) -> Path:
    """Return the file of a picture of a held-out view, made if there is none yet.

    Args:
        decoder: The process that decodes pictures, so that the server's memory never holds one.
        cache: Folder of such files.
        folder: The run.
        index: The view, as `views` numbers it.
        what: render, photo, or difference: their absolute difference times `GAIN`.
        small: Whether to make a JPEG of at most `PREVIEW_SIDE` px instead of a PNG of the whole picture.

    Raises:
        RefusedError: there is no such view or picture.
    """
    path = _picture_file(folder, index, what)
    try:
        made = cache_name(path, path.stat())
    except OSError:
        raise not_found(f"picture {path.name}") from None
    names = PICTURES if small else (what,)  # a page asks for all three previews at once
    targets = {name: cache / f"{made}-{name}.{'jpg' if small else 'png'}" for name in names}
    if not targets[what].is_file():
        outs = {name: str(target) for name, target in targets.items()}
        decoder.ask("view_pictures", comparison=str(path), outs=outs, small=small)
    return targets[what]


def make_view_pictures(comparison: str, outs: Mapping[str, str], small: bool) -> dict[str, Any]:
    """Write pictures of a held-out view; a task of `gsplat_edu.studio.worker`.

    Args:
        comparison: File of the photo beside its render.
        outs: File to write by picture; nothing is done if all exist, because another request may have made them.
        small: See `view_picture`.

    Raises:
        RefusedError: the file is damaged.
    """
    if all(Path(out).is_file() for out in outs.values()):
        return {}
    parts = _parts(Path(comparison))
    for name, out in outs.items():
        image = Image.fromarray(parts[name])
        if small:
            image.thumbnail((PREVIEW_SIDE, PREVIEW_SIDE))
        how: dict[str, Any] = (
            {"format": "JPEG", "quality": PREVIEW_QUALITY}
            if small
            else {"format": "PNG", "compress_level": 1}
        )
        with written_aside(Path(out)) as aside:
            image.save(aside, **how)
    return {}


def _picture_file(folder: RunFolder, index: str, what: str) -> Path:
    scores = _scores(folder)
    number = whole_of(index)
    if what not in PICTURES or number is None or number >= len(scores):
        raise not_found(f"{folder.path.name}: view {index[:20]}/{what[:20]}")
    return folder.renders / "test" / image_file_names([str(score["name"]) for score in scores])[number]


def _size(path: Path) -> dict[str, int | None]:
    try:
        W, H = comparison_size(path)
    except UNDECODABLE:
        return {"W": None, "H": None}
    return {"W": W, "H": H}


def _parts(path: Path) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]:
    """Split a photo beside its render into the pictures."""
    try:
        found = read_comparison(path)
    except FileNotFoundError:
        raise not_found(f"picture {path.name}") from None
    except UNDECODABLE:
        raise RefusedError(f"{path.name}: is not a photo beside its render; evaluate the run again") from None
    render, photo = found["render"], found["photo"]
    apart = np.abs(render.astype(np.int16) - photo)
    return {"render": render, "photo": photo, "difference": np.minimum(GAIN * apart, 255).astype(np.uint8)}


def _scores(folder: RunFolder) -> list[dict[str, Any]]:
    try:
        found = folder.read_metrics().get("test_views")
    except (CheckpointError, OSError) as error:
        raise RefusedError(str(error)) from None
    if not isinstance(found, list):
        return []
    return [score for score in found if isinstance(score, dict) and isinstance(score.get("name"), str)]
