"""The table of all blocks shows their state, which it reads from their files alone."""

import io
import shutil

import pytest
from rich.console import Console

from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.cli.block_table import BlockTable
from gsplat_edu.runs.blocks_folder import BlocksFolder

pytestmark = pytest.mark.slow


def test_waiting_training_and_finished_blocks(serial, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(serial, run)
    folder, plan = BlocksFolder(run), BlockPlan.read(run)
    folder.record(1).unlink()
    lines = folder.run(1).log_file.read_text().splitlines(keepends=True)
    half = [line for line in lines if '"iteration": 20,' in line and '"loss"' in line]
    folder.run(1).log_file.write_text(
        "".join([*half, '{"iteration": 30, "lo'])
    )  # the last line is being written
    folder.record(3).unlink()
    shutil.rmtree(folder.run(3).path)
    console = Console(width=100, record=True, file=io.StringIO())
    with BlockTable(console, folder, plan) as table:
        console.print(table.table())
        folder.record(3).write_text(folder.record(2).read_text().replace('"block": 2', '"block": 3'))
        table.look()
        table.look()
    text = console.export_text()
    rows = [line.split() for line in text.splitlines()]
    views = [str(len(block.train)) for block in plan.blocks]
    assert [row[:4] for row in rows[1:5]] == [
        ["0", views[0], "finished", "40/40"],
        ["1", views[1], "training", "20/40"],
        ["2", views[2], "finished", "40/40"],
        ["3", views[3], "waiting", "0/40"],
    ]
    assert len(rows[2]) == 6 and 0 < float(rows[2][4]) < 1, "loss and number of Gaussians"
    assert text.count("block 3: finished") == 1 and "(3 of 4)" in text
