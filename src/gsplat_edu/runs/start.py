"""Start a training from a trained scene."""

from __future__ import annotations

import hashlib
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.io import ply
from gsplat_edu.io.formats import file_in, format_of, read_scene
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.source import run_of
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.initialize import from_gaussians


def scene_file(path: Path) -> Path:
    """Return the scene file for a path: the file itself, or the latest scene of a run.

    Raises:
        ArgumentError: the path names neither a scene nor a run.
        CheckpointError: the run is damaged, or has no scene yet.
    """
    if not path.exists():
        raise ArgumentError(f"--from: {path} does not exist; give a scene file or the folder of a run")
    file = file_in(path)
    if not file.is_dir():
        format_of(file)
        return file
    folder = RunFolder(path)
    if not folder.exists():
        raise ArgumentError(
            f"--from: {path} is neither a scene file nor the folder of a run; give one of these"
        )
    return folder.latest_scene()[0]


def scene_start(path: Path, config: TrainConfig, origin: ArrayLike) -> tuple[Gaussians, list[str]]:
    """Read a scene to start training from.

    Args:
        path: Scene file of any supported format, in the capture's own coordinates, or the folder of a run.
        config: SH degree and cap of the new run.
        origin: (3,) subtracted from the capture's coordinates for training.

    Returns:
        Gaussians of the run's SH degree, float32, relative to the origin; and sentences that report the changes.

    Raises:
        ArgumentError: there is no scene, or it has no usable Gaussians, or more than the cap.
        SceneFormatError: the file is damaged.
        CheckpointError: the run is damaged, or has no scene yet.
        OSError: the file cannot be read.
    """
    file = scene_file(path)
    # A PLY is read with its non-finite Gaussians, which `from_gaussians` drops. PLYs of older runs do not store
    # whether they are antialiased; config.json does.
    scene = ply.read(file, finite=False) if format_of(file).suffix == ".ply" else read_scene(file)
    run = run_of(file)
    antialiased = scene.antialiased if run is None else render_settings(run.read_config()).antialiased
    gaussians = scene.relative_to(origin)
    try:
        start, notes = from_gaussians(gaussians, config)
    except ArgumentError as error:
        raise ArgumentError(f"--from: {file}: {error}") from None
    notes = [f"{file}: {note}" for note in notes]
    if antialiased is not None and antialiased != config.antialiased:
        was, now = ("with", "without") if antialiased else ("without", "with")
        advice = "leave out --antialiased" if config.antialiased else "add --antialiased"
        notes.append(
            f"{file}: was trained {was} antialiasing, but this run trains {now}: the brightness of small splats"
            f" changes; {advice} to keep it"
        )
    return start, [f"{file}: {len(start)} Gaussians to start from", *notes]


def scene_digest(gaussians: Gaussians) -> str:
    """Return a digest of all raw parameters."""
    digest = hashlib.sha256()
    for name, tensor in gaussians.tensors().items():
        digest.update(name.encode())
        digest.update(tensor.contiguous().numpy(force=True).tobytes())
    return digest.hexdigest()
