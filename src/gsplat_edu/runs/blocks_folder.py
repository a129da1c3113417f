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

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from msgspec.structs import asdict

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.reading import open_file, parse_json, read_text
from gsplat_edu.base.records import ONE_LINE, Record, record_of
from gsplat_edu.runs.folder import RunFolder, write_json

PLAN = "plan.json"
"""Name of the plan's file."""

MOST_BLOCKS = 256
"""Largest number of blocks."""


LONGEST_TEXT = 1_000
"""Characters of a text in a record."""

LARGEST_NUMBER = 2**53
"""Largest number in a record; JSON's readers keep whole numbers up to it exactly."""

Whole = Annotated[int, Meta(ge=0, le=LARGEST_NUMBER)]
Text = Annotated[str, Meta(max_length=LONGEST_TEXT, pattern=ONE_LINE)]


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
            done: Done = record_of("", parse_json(read_text(path)), Done)
        except ValueError as error:
            raise CheckpointError(
                f"{path}: is damaged ({error}); remove it to train the block again"
            ) from None
        if done.plan != plan or done.block != number:
            raise CheckpointError(
                f"{path}: belongs to another plan; give another folder, or remove {path.parent} to train again"
            )
        return done


class Done(Record, frozen=True):
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

    block: Whole
    plan: Text
    sha256: Text
    gaussians: Whole
    iterations: Whole
    seconds: Annotated[float, Meta(ge=0, le=LARGEST_NUMBER)]
    peak_memory: Whole
    host: Text
    instructions: Text
    version: Text

    def write(self, folder: BlocksFolder) -> None:
        """Write the record.

        Raises:
            OSError: the file cannot be written.
        """
        write_json(folder.record(self.block), asdict(self))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
