"""A run on disk, so that it can go on as if nothing had happened.

One safetensors file holds everything: tensors as tensors, and what is not a tensor as JSON in the header. So a
checkpoint is whole or not there.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from gsplat_edu.errors import CheckpointError
from gsplat_edu.files import written_aside
from gsplat_edu.train.trainer import Trainer

KEPT = 2
"""Checkpoints that stay when a new one has been written."""

FORMAT = "1"
"""Version of the file's contents."""

_NAME = re.compile(r"iteration_(\d+)\.safetensors")


def save_checkpoint(folder: Path, trainer: Trainer, seconds: float) -> Path:
    """Write the trainer's state as folder/iteration_N.safetensors, and remove all but the last two.

    Args:
        folder: Where checkpoints go; made where it is missing.
        trainer: The run.
        seconds: Wall time of the training so far.

    Returns:
        The file.

    Raises:
        CheckpointError: it cannot be written. Those written before are untouched.
    """
    tensors, numbers = trainer.state()
    path = folder / f"iteration_{trainer.iteration}.safetensors"
    header = {"format": FORMAT, "state": json.dumps(numbers), "seconds": json.dumps(seconds)}
    try:
        with written_aside(path) as aside:
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, aside, header)
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise CheckpointError(
            f"{path}: cannot be written ({reason}); earlier checkpoints are unharmed, make room and use --resume"
        ) from None
    for old in list_checkpoints(folder)[:-KEPT]:
        old.unlink()
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints of a folder, oldest first."""
    found = [(int(match[1]), path) for path in folder.glob("*") if (match := _NAME.fullmatch(path.name))]
    return [path for _, path in sorted(found)]


def read_seconds(path: Path) -> float:
    """Return the wall time of the training up to a checkpoint.

    Raises:
        CheckpointError: the file is damaged.
    """
    try:
        with _opened(path) as file:
            return float(json.loads(file.metadata()["seconds"]))
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(path, str(error)) from None


def load_checkpoint(path: Path, trainer: Trainer) -> None:
    """Bring a trainer that was made with the same arguments to where the checkpoint was written.

    Raises:
        CheckpointError: the file is damaged, or of another run.
    """
    try:
        with _opened(path) as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            trainer.load_state(tensors, json.loads(file.metadata()["state"]))
    except (KeyError, IndexError, TypeError, ValueError, SafetensorError) as error:
        raise _damaged(path, str(error)) from None


def _opened(path: Path) -> Any:  # noqa: ANN401 - safetensors has no annotations
    try:
        file: Any = safe_open(path, framework="pt")
        if (file.metadata() or {}).get("format") != FORMAT:
            raise CheckpointError(
                f"{path}: is no checkpoint of this version of gsplat_edu; start the run again"
            )
    except SafetensorError as error:
        raise _damaged(path, str(error)) from None
    return file


def _damaged(path: Path, reason: str) -> CheckpointError:
    others = [other.name for other in list_checkpoints(path.parent) if other != path]
    advice = f"delete it to go on from {others[-1]}" if others else "delete it to start over"
    return CheckpointError(f"{path}: is damaged ({' '.join(reason.split())}); {advice}")
