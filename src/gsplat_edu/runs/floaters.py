"""Propose splats to delete, in a process of its own that an editor starts and may end at any time.

    python -m gsplat_edu.runs.floaters SCENE

prints one JSON object per line: {"done": steps, "total": steps} while it judges, and last {"groups": [{"reason": text,
"runs": [start, count, ...]}, ...], "basis": text} or {"error": one line}. It ends when its standard input does, so that
it does not outlive the editor's server.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from gsplat_edu.base.errors import ArgumentError, CheckpointError, DatasetError, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.text import bounded, legible
from gsplat_edu.clean.guard import clean
from gsplat_edu.clean.judge import Reason
from gsplat_edu.clean.shape import Shape, judge_shape
from gsplat_edu.clean.sight import times_seen
from gsplat_edu.edits.runs import runs_of
from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import open_subject
from gsplat_edu.runs.source import Source, open_source

MOST_CAMERAS = 24
"""Without photos, at most this many cameras of the run say what is visible."""

SIGHT_SIDE = 320
"""Longest side of their images, px."""

NICE = 10
"""Niceness of the process, so that the server and a training go first."""

UNSEEN = "visible in none of {} cameras"

Progress = Callable[[int, int], None]
"""Called with (steps done, all steps)."""


def propose(path: Path, progress: Progress = lambda done, total: None) -> dict[str, Any]:
    """Judge the splats of a scene: by its photos, as `gsplat-edu clean` does, or by their shape where there are none.

    Args:
        path: Scene file or run folder.
        progress: Called after every step.

    Returns:
        groups: reason and runs of indices of each group that has splats; basis: what judged, in one sentence.

    Raises:
        ArgumentError: the path names no scene, or the photos support none of its splats.
        CheckpointError: the run is damaged.
        DatasetError: a photo cannot be read.
        SceneFormatError: the scene is damaged.
        OSError: a file cannot be read.
    """
    source = open_source(path)
    backend = load_backend("cpu")
    try:
        subject = open_subject(path, None, backend)
    except (ArgumentError, CheckpointError, DatasetError) as error:
        return _by_shape(source, str(error), progress)
    capture = subject.dataset
    found = clean(
        subject.source.scene.gaussians,
        capture.train,
        capture.test,
        subject.source.settings,
        backend=backend,
        progress=progress,
    )
    return {
        "groups": _groups(found.reasons, [(reason, reason.sentence) for reason in Reason][1:]),
        "basis": f"Judged by {found.views} photos, as by gsplat-edu clean.",
    }


def _by_shape(source: Source, why: str, progress: Progress) -> dict[str, Any]:
    """Judge by shape and, where the cameras are known, by what they see."""
    gaussians = source.scene.gaussians
    reasons = judge_shape(gaussians)
    kinds: list[tuple[int, str]] = [(int(shape), shape.sentence) for shape in Shape][1:]
    cameras = [camera for _, camera in source.cameras]
    cameras = (
        [cameras[i] for i in sorted({round(x) for x in np.linspace(0, len(cameras) - 1, MOST_CAMERAS)})]
        if cameras
        else []
    )
    if cameras:
        small = [
            resized(camera, SIGHT_SIDE) if max(camera.W, camera.H) > SIGHT_SIDE else camera
            for camera in cameras
        ]
        done = iter(range(1, len(small) + 1))
        seen = times_seen(
            gaussians, small, source.settings, load_backend("cpu"), lambda: progress(next(done), len(small))
        )
        unseen = max(Shape) + 1
        reasons[(reasons == Shape.USUAL) & (seen == 0)] = unseen
        kinds.append((unseen, UNSEEN.format(len(small))))
    return {"groups": _groups(reasons, kinds), "basis": f"Judged by shape alone, without photos: {why}"}


def _groups(reasons: UInt8[np.ndarray, " N"], kinds: Sequence[tuple[int, str]]) -> list[dict[str, Any]]:
    """Return the groups that have splats, the largest first."""
    masks = [(text, reasons == kind) for kind, text in kinds]
    masks.sort(key=lambda entry: -int(entry[1].sum()))
    return [{"reason": text, "runs": runs_of(mask)} for text, mask in masks if mask.any()]


def main(path: str) -> None:
    """Print progress and result, or the error."""
    if hasattr(os, "nice"):
        os.nice(NICE)
    said = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries may print to stdout, which is for results only

    def say(**content: Any) -> None:  # noqa: ANN401
        said.write(json.dumps(content) + "\n")
        said.flush()

    threading.Thread(target=_end_with_input, daemon=True).start()
    try:
        say(**propose(Path(path), lambda done, total: say(done=done, total=total)))
    except SplatError as error:
        say(error=bounded(legible(str(error))))
    except OSError as error:
        say(error=bounded(legible(described(error))))
    except MemoryError:
        say(error="ran out of memory; close other programs, and try again")


def _end_with_input() -> None:
    """End this process with its standard input, which its parent holds open."""
    while sys.stdin.buffer.read(1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
