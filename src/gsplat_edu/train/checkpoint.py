"""Checkpoints, from which a run resumes with identical results.

One safetensors file holds everything: tensors as tensors, all other values as JSON in the header. A checkpoint is
therefore either complete or absent.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.headroom import shortage
from gsplat_edu.base.quantities import MOST_SECONDS
from gsplat_edu.base.reading import open_file
from gsplat_edu.train.trainer import Trainer

KEPT = 2
"""Number of checkpoints to keep, including the newest."""

FORMAT = "1"
"""Version of the file's contents."""

LONGEST = 1 << 24
"""Largest number of characters of JSON in the header: the view order takes nine for each photo."""

_NAME = re.compile(r"iteration_(\d+)\.safetensors")


def save_checkpoint(folder: Path, trainer: Trainer, seconds: float) -> Path:
    """Write the trainer's state as folder/iteration_N.safetensors, and remove all but the last two.

    The file does not depend on the number of processes that share the training.

    Args:
        folder: Folder of the checkpoints; created if missing.
        trainer: The run.
        seconds: Wall time of the training so far.

    Returns:
        The file.

    Raises:
        CheckpointError: the file cannot be written. Earlier checkpoints are unchanged.
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
            f"{path}: cannot be written ({reason}); earlier checkpoints are unharmed, make room and resume"
        ) from None
    for old in list_checkpoints(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
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
    with _opened(path) as file:
        return _seconds(file.metadata())


def load_checkpoint(path: Path, trainer: Trainer) -> None:
    """Restore the state of a checkpoint in a trainer made with the same arguments.

    Raises:
        CheckpointError: the file is damaged or belongs to another run. The trainer is unchanged.
    """
    with _opened(path) as file:
        metadata = file.metadata()
        _seconds(metadata)
        trainer.load_state(_tensors(file), _parsed("state", metadata))


def read_checkpoint(path: Path) -> tuple[dict[str, Tensor], Any]:
    """Return the state of a checkpoint, as `Trainer.load_state` takes it.

    Raises:
        CheckpointError: the file is damaged.
    """
    with _opened(path) as file:
        return _tensors(file), _parsed("state", file.metadata())


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a checkpoint; errors about its contents raised in the block name the file."""
    try:
        with open_file(path):  # only a regular file: a pipe would block
            pass
        with safe_open(path, framework="pt") as file:
            if (file.metadata() or {}).get("format") != FORMAT:
                raise CheckpointError(
                    f"{path}: is not a checkpoint of this version of gsplat_edu; start the run again"
                )
            yield file
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ArgumentError, SafetensorError) as error:
        raise _damaged(path, str(error)) from None


def _tensors(file: Any) -> dict[str, Tensor]:  # noqa: ANN401
    found = {}
    for name in file.keys():  # noqa: SIM118
        try:
            # Copy, because safetensors returns memory mapped from the file.
            found[name] = file.get_tensor(name).clone()
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            if shortage(error) is not None:
                raise  # out of memory; the file is intact
            # dtypes that safetensors supports but torch does not, or misaligned data
            raise ArgumentError(f"{name[:60]!r}: is not a tensor: {str(error)[:200]}") from None
    return found


def _parsed(name: str, metadata: dict[str, str]) -> Any:  # noqa: ANN401
    text = metadata.get(name)
    if text is None:
        raise ArgumentError(f"{name}: is missing")
    if len(text) > LONGEST:
        raise ArgumentError(f"{name}: is longer than {LONGEST} characters")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ArgumentError(f"{name}: is not JSON ({error})") from None


def _seconds(metadata: dict[str, str]) -> float:
    seconds = _parsed("seconds", metadata)
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        raise ArgumentError("seconds: has to be a number")
    if not 0 <= seconds <= MOST_SECONDS:
        raise ArgumentError(f"seconds: has to be from 0 to {MOST_SECONDS:g}")
    return float(seconds)


def _damaged(path: Path, reason: str) -> CheckpointError:
    others = [other.name for other in list_checkpoints(path.parent) if other != path]
    advice = f"delete it to resume from {others[-1]}" if others else "delete it to start over"
    return CheckpointError(f"{path}: is damaged ({' '.join(reason.split())}); {advice}")
