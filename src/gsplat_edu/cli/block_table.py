"""A table of the progress of all blocks, on this or other computers."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.table import Table

from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.status import BlockStatus, statuses
from gsplat_edu.runs.blocks_folder import BlocksFolder

SHOWN = 40
"""Largest number of rows; finished blocks are left out first, then waiting ones."""


class BlockTable:
    """Shows the state of every block during training; without a terminal, prints a line for each finished block.

    Args:
        console: The terminal.
        folder: The run in blocks.
        plan: Its plan.
    """

    def __init__(self, console: Console, folder: BlocksFolder, plan: BlockPlan) -> None:
        self._console, self._folder, self._plan, self._digest = console, folder, plan, plan.digest()
        self._known = {status.number for status in self._statuses() if status.done}
        self._live = (
            Live(console=console, get_renderable=self.table, refresh_per_second=1, transient=True)
            if console.is_terminal
            else None
        )

    def __enter__(self) -> BlockTable:
        """Show the table."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Remove the table."""
        if self._live is not None:
            self._live.stop()

    def look(self) -> None:
        """Print a line for every block that was finished since the last call."""
        found = [status for status in self._statuses() if status.done]
        for status in found:
            if status.number not in self._known:
                self._known.add(status.number)
                self._console.print(
                    f"block {status.number}: finished, {status.gaussians:,} Gaussians"
                    f" ({len(self._known)} of {len(self._plan.blocks)})",
                    soft_wrap=True,
                )

    def table(self) -> Table:
        """Return the table as it is now."""
        found = self._statuses()
        table = Table("block", "views", "state", "iteration", "loss", "Gaussians", box=None, pad_edge=False)
        rank = sorted(found, key=lambda status: (status.done, status.iteration == 0, status.number))
        shown = {status.number for status in rank[:SHOWN]}
        for status in found:
            if status.number in shown:
                table.add_row(*_cells(status))
        if hidden := len(found) - len(shown):
            table.add_row("...", f"{hidden} more")
        return table

    def _statuses(self) -> list[BlockStatus]:
        return statuses(self._folder, self._plan, self._digest)


def _cells(status: BlockStatus) -> list[str]:
    state = "finished" if status.done else "training" if status.iteration else "waiting"
    return [
        str(status.number),
        str(status.views),
        state,
        f"{status.iteration}/{status.iterations}",
        "" if status.loss is None else f"{status.loss:.4f}",
        "" if status.gaussians is None else f"{status.gaussians:,}",
    ]
