"""The folder of a run in blocks, and the records of what is finished.

    plan.json                  the cells, the views of each block, and the recipe
    cameras.json, photos.json  the views when the capture was split; the merged run's, too
    coarse/                    the run of the coarse model, unless a scene was given
    starts/block_00.ply        what each block starts from
    blocks/block_00/           an ordinary run folder for each block
    blocks/block_00.json       renamed into place when the block is finished
    config.json, ...           the merged run

The module imports nothing slow.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.json_fields import checked_text, checked_whole, number_within
from gsplat_edu.base.reading import open_file, parse_json, read_text
from gsplat_edu.runs.folder import RunFolder, write_json

PLAN = "plan.json"
"""Name of the plan's file."""

MOST_BLOCKS = 256
"""Largest number of blocks."""


LONGEST_TEXT = 1_000
"""Characters of a text in a record."""

LARGEST_NUMBER = 2**53
"""Largest number in a record; JSON's readers keep whole numbers up to it exactly."""


@dataclass(frozen=True)
class BlocksFolder:
    """The folder of a run in blocks; it need not exist yet.

    Args:
        path: The folder.
    """

    path: Path

    @property
    def plan(self) -> Path:
        """Cells, views and recipe."""
        return self.path / PLAN

    @property
    def coarse(self) -> Path:
        """Run of the coarse model."""
        return self.path / "coarse"

    @property
    def merged(self) -> RunFolder:
        """The merged run."""
        return RunFolder(self.path)

    def start(self, number: int) -> Path:
        """Return the scene that a block starts from."""
        return self.path / "starts" / f"block_{number:02d}.ply"

    def run(self, number: int) -> RunFolder:
        """Return the run of a block."""
        return RunFolder(self.path / "blocks" / f"block_{number:02d}")

    def scene(self, number: int, iterations: int) -> Path:
        """Return the trained scene of a block."""
        return self.run(number).scene(iterations)

    def record(self, number: int) -> Path:
        """Return the file whose presence means that a block is finished."""
        return self.path / "blocks" / f"block_{number:02d}.json"

    def read_done(self, number: int, plan: str) -> Done | None:
        """Read the record of a block; None if it is not finished.

        Args:
            number: The block.
            plan: Digest of the plan.

        Raises:
            CheckpointError: the record is damaged, or belongs to another plan.
        """
        path = self.record(number)
        if not path.is_file():
            return None
        try:
            done = Done.checked(parse_json(read_text(path)))
        except (ValueError, TypeError, ArgumentError) as error:
            raise CheckpointError(
                f"{path}: is damaged ({error}); remove it to train the block again"
            ) from None
        if done.plan != plan or done.block != number:
            raise CheckpointError(
                f"{path}: belongs to another plan; give another folder, or remove {path.parent} to train again"
            )
        return done


@dataclass(frozen=True)
class Done:
    """The record of a finished block.

    Args:
        block: Its number.
        plan: Digest of the plan.
        sha256: Digest of its scene: `BlocksFolder.scene`.
        gaussians: Number of Gaussians in it.
        iterations: Steps of the training.
        seconds: Duration of the training.
        peak_memory: Largest resident memory so far of the process that trained it, bytes; 0 if unknown.
        host: Name of the computer.
        instructions: Instruction set of the kernels; others round differently.
        version: Version of this package.
    """

    block: int
    plan: str
    sha256: str
    gaussians: int
    iterations: int
    seconds: float
    peak_memory: int
    host: str
    instructions: str
    version: str

    @classmethod
    def checked(cls, entry: object) -> Done:
        """Return the record in a JSON object.

        Raises:
            ArgumentError: a field is of another type or out of range.
            TypeError: a field is missing or unknown, or the value is no object.
        """
        if not isinstance(entry, dict):
            raise TypeError("is not an object")
        for name in ("block", "gaussians", "iterations", "peak_memory"):
            checked_whole(name, entry.get(name), 0, LARGEST_NUMBER)
        for name in ("plan", "sha256", "host", "instructions", "version"):
            checked_text(name, entry.get(name), LONGEST_TEXT)
        number_within("seconds", entry.get("seconds"), 0, LARGEST_NUMBER)
        return cls(**entry)

    def write(self, folder: BlocksFolder) -> None:
        """Write the record.

        Raises:
            OSError: the file cannot be written.
        """
        write_json(folder.record(self.block), dataclasses.asdict(self))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
