"""The parts of a page that depend on edits: the editor's data, or the views of an edited scene."""

from __future__ import annotations

import math
import shlex
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from gsplat_edu.base.reading import open_file
from gsplat_edu.data.region import document_of
from gsplat_edu.doctor.subject import subject_region
from gsplat_edu.edits.apply import Views, placed_view
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.edits.stored import MOST_BYTES
from gsplat_edu.io.edit import Similarity
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.rig import stand_in
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.survey.geometry import Geometry
from gsplat_edu.viewer.page import Editing, Tour
from gsplat_edu.viewer.page_start import SIDE, Start
from gsplat_edu.viewer.proposing import NAME as FLOATERS

EXAMPLE_FORMAT = ".spz"
"""Format in the command that the page shows."""


def editing_of(source: Source, named: Path, file: Path, url: str | None = None) -> Editing:
    """Return what the editor needs for a scene.

    Args:
        source: The scene.
        named: The scene as the user named it, for the commands that the page shows.
        file: The edits file, as the user named it.
        url: Where the page reads and writes that file; None for a page without a server, which starts with no edits.
    """
    identity = identity_of(source.scene)
    stem = named.resolve().name.split(".")[0] or "scene"
    scene, edits = shlex.quote(str(named)), shlex.quote(str(file))
    convert = f"gsplat-edu convert {scene} --edits {edits} {shlex.quote(stem + EXAMPLE_FORMAT)}"
    render = f"gsplat-edu render {scene} --edits {edits} --out {shlex.quote(stem + '.mp4')}"
    facts = {
        "scene": identity.document(),
        "file": file.name,
        "commands": {"convert": convert, "render": render},
        "url": url,
        "floaters": None if url is None else str(PurePosixPath(url).with_name(FLOATERS)),
        "subject": _subject_box(source),
    }
    return Editing(facts, _values(source))


def _subject_box(source: Source) -> dict[str, Any] | None:
    """Return the box around what most cameras look at, as region.json writes one; None without cameras."""
    if not source.cameras:
        return None
    gaussians = source.scene.gaussians
    points = gaussians.means[gaussians.logit_opacities > 0].double().numpy(force=True)
    geometry = Geometry([stand_in(camera) for _, camera in source.cameras], points[~far_shell(points)])
    up = None if source.scene.up is None else np.array(source.scene.up, dtype=np.float64)
    return document_of(subject_region(geometry, up))


def read_content(file: Path) -> bytes | None:
    """Read the edits file of an editor; None if there is none.

    Raises:
        OSError: it cannot be read.
    """
    if not file.exists():
        return None
    with open_file(file) as opened:
        return opened.read(MOST_BYTES + 1)


def tour_of(source: Source, views: Views, move: Similarity, path: KeyframePath | None) -> Tour:
    """Return the tour of the page of an edited scene.

    Args:
        source: The edited scene, after its move.
        views: Start view and named views of the edits; those with a text are the guided tour.
        move: The transform that the edits applied to the scene.
        path: The camera path, moved already.
    """
    W, H = (source.cameras[0][1].W, source.cameras[0][1].H) if source.cameras else (SIDE, SIDE)
    named = [(view.name, _camera(placed_view(view.view, move), W, H)) for view in views.named]
    start = None
    if views.start is not None:
        up = np.array(source.scene.up or WORLD_UP, dtype=np.float64)
        pivot = move.s * move.R @ np.array(views.start.pivot) + move.t
        camera = _camera(placed_view(views.start.view, move), W, H)
        start = Start(camera, pivot, up / np.linalg.norm(up), -1)
    texts = {view.name: view.text for view in views.named if view.text}
    return Tour(path, start, named, texts=texts)


def _camera(view: Keyframe, W: int, H: int) -> Camera:
    focal = 0.5 * H / math.tan(math.radians(view.fov) / 2)
    return Camera(view.R, view.eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def _values(source: Source) -> bytes:
    """Return sh0 and logit_opacities as little-endian float32."""
    gaussians = source.scene.gaussians
    parts = (gaussians.sh0, gaussians.logit_opacities)
    return b"".join(
        part.detach().to(torch.float32).cpu().contiguous().numpy().astype("<f4", copy=False).tobytes()
        for part in parts
    )
