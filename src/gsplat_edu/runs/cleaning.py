"""Clean a scene file or the scene of a run: its capture, the report, the preview."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.clean.guard import Cleaning, clean
from gsplat_edu.clean.judge import Reason
from gsplat_edu.data.dataset import Dataset, load_dataset
from gsplat_edu.evaluate.metrics import SPILLED
from gsplat_edu.io.formats import FORMATS
from gsplat_edu.parts.exposure.photos import at_exposure_of_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.dataset import appearance_of, run_dataset
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.identity import capture_difference
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
        appearance = appearance_of(run.read_config())
        capture = _at_exposure(capture, gaussians, source.settings, appearance, backend)
    cameras = _cameras(capture)
    up = source.scene.up or capture_up(capture)
    held_out = frozenset(view.name for view in capture.test)
    origin = as_origin("origin", capture.origin)
    scene = replace(source.scene, gaussians=gaussians, up=up, origin=origin)
    return Subject(replace(source, scene=scene, cameras=cameras, held_out=held_out), capture)


def _at_exposure(
    dataset: Dataset, gaussians: Gaussians, settings: RenderSettings, appearance: str, backend: Backend
) -> Dataset:
    """Return the dataset with photos at the scene's exposure; unchanged if the training corrected no exposures."""
    if appearance == "none":
        return dataset
    shown = functools.partial(render, settings=settings, backend=backend)
    vignetting = appearance == "vignetting"
    return at_exposure_of_scene(dataset, gaussians, shown, settings.background, vignetting=vignetting)


def cleaner(
    settings: RenderSettings, say: Callable[[str], None], appearance: str = "none"
) -> Callable[[Gaussians, Dataset], tuple[Gaussians, dict[str, Any]]]:
    """Return the function that `gsplat_edu.runs.training.CaptureRun.finish` cleans the scene with.

    Args:
        settings: The scene's render settings.
        say: Receives the report, line by line.
        appearance: The training's setting `appearance`. Unless it is "none", photos are converted to the scene's
            exposure first.
    """
    backend = load_backend("cpu")

    def cleaned(gaussians: Gaussians, dataset: Dataset) -> tuple[Gaussians, dict[str, Any]]:
        here = gaussians.to(torch.device("cpu"))
        photos = _at_exposure(dataset, here, settings, appearance, backend)
        cleaning = clean(here, photos.train, photos.test, settings, backend=backend)
        for line in report_lines(cleaning):
            say(line)
        return cleaning.apply(gaussians), document(cleaning)

    return cleaned


def default_target(path: Path) -> Path:
    """Return the file that a cleaned scene is written to: scene.ply becomes scene.clean.ply, always a PLY.

    Args:
        path: The scene's file.
    """
    name = path.name
    suffix = next((known.suffix for known in FORMATS if name.lower().endswith(known.suffix)), path.suffix)
    return path.with_name(f"{name[: len(name) - len(suffix)]}.clean.ply")


def report_lines(cleaning: Cleaning) -> list[str]:
    """Describe a cleaning: counts by reason, PSNR before and after, and what the guard took back.

    Args:
        cleaning: The cleaning.
    """
    counts, judged = cleaning.counts(), int((cleaning.judged != Reason.KEPT).sum())
    total, removed = len(cleaning.reasons), sum(counts.values())
    text = [f"removed {removed:,} of {total:,} splats, judged by {cleaning.views} views"]
    text += [f"  {count:9,}  {reason.sentence}" for reason, count in counts.items()]
    which = "held-out" if cleaning.held_out else "training"
    if not cleaning.held_out:
        text.append("no view is held out, so the training views guard, whose PSNR is weaker evidence")
    if cleaning.before is None or cleaning.after is None:
        text.append("PSNR: no view has a pixel that counts")
        return text
    if removed < judged:
        assert cleaning.all_removed is not None
        text.append(
            f"{judged:,} were judged removable, but without them PSNR would be {cleaning.all_removed:.2f} dB:"
            f" kept the {judged - removed:,} least certain"
        )
    change = cleaning.after - cleaning.before
    text.append(
        f"PSNR of {cleaning.guards} {which} views: {cleaning.before:.2f} dB before,"
        f" {cleaning.after:.2f} dB after ({change:+.3f} dB)"
    )
    if cleaning.outside is not None and cleaning.outside > SPILLED:
        text.append(
            f"{100 * cleaning.outside:.0f} % of the scene's solid area still lies outside of what the photos cut out,"
            " where their alpha is 0; train again without --white-background and --background"
        )
    return text


def document(cleaning: Cleaning) -> dict[str, Any]:
    """Return the entry for metrics.json."""
    counts = {reason.name.lower(): count for reason, count in cleaning.counts().items()}
    return {
        "removed": counts,
        "judged": int((cleaning.judged != Reason.KEPT).sum()),
        "psnr_before": cleaning.before,
        "psnr_after": cleaning.after,
        "held_out": cleaning.held_out,
        "outside_cut_outs": cleaning.outside,
    }


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
