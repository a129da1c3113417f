"""Whether a run fits into the buffers of the device on which it trains."""

from __future__ import annotations

import math

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import spelled_bytes
from gsplat_edu.budget.costs import TRAINED_PAIRS, harmonics_of
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.engine.room import Room
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.resident import leaves_device


def room_of(backend: str) -> Room | None:
    """Return what the device of a backend has room for; None for the processor and CUDA.

    Raises:
        BackendUnavailableError: the device does not start.
    """
    room = load_backend(backend).room
    return None if room is None else room()


def most_gaussians(room: Room, config: TrainConfig) -> int:
    """Return how many Gaussians of a run a device has room for, with the pairs of a trained scene."""
    return room.most_gaussians(harmonics_of(config.sh_degree), TRAINED_PAIRS)


def check_device(options: RunOptions, reader: CaptureReader) -> None:
    """Check that the photos and the cap of a run that stays on a device fit into its buffers.

    Args:
        options: The run, as planned.
        reader: Its capture, which is read only if the run stays on a device.

    Raises:
        ArgumentError: they do not; the message says what would fit.
        BackendUnavailableError: the device does not start.
        DatasetError: the capture cannot be read.
    """
    room = None if leaves_device(options.config, options.asked) else room_of(options.backend)
    if room is not None:
        check_room(room, options.config, Dataset.of(reader, options.data_settings, points=options.points))


def check_room(room: Room, config: TrainConfig, dataset: Dataset) -> None:
    """Do the same for a device that is known; see `check_device`."""
    most, holds = most_gaussians(room, config), f"{room.adapter} has buffers of up to"
    holds += f" {spelled_bytes(room.largest)}, which hold"
    if (config.max_gaussians or 0) > most:
        raise ArgumentError(
            f"--max-gaussians: is {config.max_gaussians:,}, but {holds} {most:,}; give at most that, or --backend cpu"
        )
    W, H = max(((view.camera.W, view.camera.H) for view in dataset.train), key=lambda size: size[0] * size[1])
    if room.most_pixels() < W * H:
        side = int(max(W, H) * math.sqrt(room.most_pixels() / (W * H))) // 10 * 10
        raise ArgumentError(
            f"--resolution: {holds} a view of {room.most_pixels():,} pixels, but photos have {W}x{H}; give"
            f" --resolution {side}, or --backend cpu"
        )


def cap_sentence(room: Room, config: TrainConfig, wanted: int) -> str:
    """Return a sentence that explains a cap that the device's buffers need.

    Args:
        room: The device.
        config: The run with the cap.
        wanted: Gaussians that the run may need.
    """
    return (
        f"--max-gaussians {config.max_gaussians}: {room.adapter} has buffers of up to {spelled_bytes(room.largest)},"
        f" which hold {most_gaussians(room, config):,} Gaussians, and this training may need {wanted:,}; --backend cpu"
        " has no such limit"
    )
