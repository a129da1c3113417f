"""Clean a scene file or the scene of a run: its capture, the preview."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.clean.guard import Cleaning
from gsplat_edu.clean.judge import Reason
from gsplat_edu.data.dataset import Dataset, load_dataset
from gsplat_edu.io.formats import FORMATS
from gsplat_edu.parts.run_values import Compared
from gsplat_edu.render.backend import Backend
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.identity import capture_difference
from gsplat_edu.runs.parts import stored_config
from gsplat_edu.runs.source import NamedCamera, Source, capture_up, open_source, run_of
from gsplat_edu.scene.frame import as_origin
from gsplat_edu.scene.gaussians import Gaussians

SIGNALS = {
    Reason.UNSEEN: ("blue", (0.1, 0.35, 1.0)),
    Reason.IN_FRONT: ("red", (1.0, 0.1, 0.1)),
    Reason.REFUTED: ("yellow", (1.0, 0.85, 0.0)),
}
"""Colours of removed splats in the preview."""

SIGNAL_OPACITY = 0.6
"""Least opacity of a removed splat in the preview, so that faint ones show."""

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey (Rec. 601)."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene and the photos that it is judged by.

    Args:
        source: The scene in the frame of the capture's cameras, which are its cameras.
        dataset: The capture.
    """

    source: Source
    dataset: Dataset


def open_subject(path: Path, dataset: Path | None, backend: Backend) -> Subject:
    """Read a scene or a run with its capture.

    Args:
        path: Scene file or run folder.
        dataset: The capture; None for that of the run.
        backend: What renders the scene to measure the exposure of each photo.

    Raises:
        ArgumentError: the path names no scene, a scene file has no capture, or the capture is not that of the run.
        CheckpointError: the run is damaged, or its capture is gone.
        DatasetError: the capture cannot be read.
        SceneFormatError: the scene is damaged.
    """
    source = open_source(path)
    run = RunFolder(path) if RunFolder(path).exists() else run_of(source.path)
    if run is None and dataset is None:
        raise ArgumentError(
            f"{path}: a scene file has no photos to judge it by; give its capture with --dataset PATH"
        )
    if run is None:
        assert dataset is not None
        capture = load_dataset(dataset)
        gaussians = source.scene.relative_to(capture.origin)
    else:
        capture = run_dataset(run.read_config(), dataset)
        if found := capture_difference(run, capture):
            raise ArgumentError(f"{capture.path} is not the capture of {run.path}: {found}")
        gaussians = source.scene.gaussians
        config = stored_config(run.read_config())
        capture = Compared(capture, gaussians, source.settings, backend).photos(config)
    cameras = _cameras(capture)
    up = source.scene.up or capture_up(capture)
    held_out = frozenset(view.name for view in capture.test)
    origin = as_origin("origin", capture.origin)
    scene = replace(source.scene, gaussians=gaussians, up=up, origin=origin)
    return Subject(replace(source, scene=scene, cameras=cameras, held_out=held_out), capture)


def default_target(path: Path) -> Path:
    """Return the file that a cleaned scene is written to: scene.ply becomes scene.clean.ply, always a PLY.

    Args:
        path: The scene's file.
    """
    name = path.name
    suffix = next((known.suffix for known in FORMATS if name.lower().endswith(known.suffix)), path.suffix)
    return path.with_name(f"{name[: len(name) - len(suffix)]}.clean.ply")


def preview(source: Source, cleaning: Cleaning) -> Source:
    """Return a scene that shows what was removed: the rest in grey, removed splats in the colour of their reason.

    Args:
        source: The scene before cleaning.
        cleaning: The cleaning.
    """
    return replace(source, scene=replace(source.scene, gaussians=_marked(source.scene.gaussians, cleaning)))


def _marked(gaussians: Gaussians, cleaning: Cleaning) -> Gaussians:
    luma = torch.tensor(LUMA, dtype=gaussians.means.dtype)
    sh0 = (gaussians.sh0 @ luma)[..., None].expand(-1, -1, 3).clone()
    rest = (gaussians.sh_rest @ luma)[..., None].expand(-1, -1, 3).clone()
    logits = gaussians.logit_opacities.clone()
    for reason, (_, color) in SIGNALS.items():
        rows = torch.from_numpy(cleaning.reasons == reason)
        sh0[rows] = (torch.tensor(color, dtype=sh0.dtype) - SH_OFFSET) / C0
        rest[rows] = 0.0
        least = torch.logit(torch.tensor(SIGNAL_OPACITY, dtype=logits.dtype))
        logits[rows] = torch.maximum(logits[rows], least)
    return replace(gaussians, sh0=sh0, sh_rest=rest, logit_opacities=logits)


def _cameras(capture: Dataset) -> tuple[NamedCamera, ...]:
    views: Sequence[Any] = (*capture.train, *capture.test)
    return tuple(sorted(((view.name, view.camera) for view in views), key=lambda entry: entry[0]))
