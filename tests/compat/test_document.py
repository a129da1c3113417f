"""docs/GSPLAT.md names every argument and every key of meta."""

import inspect
import re
from pathlib import Path

import torch

from gsplat_edu.compat.gsplat import rasterization, rasterization_2dgs

TEXT = (Path(__file__).parents[2] / "docs" / "GSPLAT.md").read_text()


def named(heading):
    """The names in the first column of the table below a heading."""
    section = TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`(\w+)`", row)]


def test_the_table_lists_the_arguments_in_order():
    assert named("Arguments of rasterization") == list(inspect.signature(rasterization).parameters)


def test_the_table_lists_the_keys_of_meta():
    tensors = [torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)]
    _, _, meta = rasterization(
        *tensors, torch.eye(4)[None], torch.eye(3)[None], 4, 4, extra_signals=torch.ones(1, 2)
    )
    assert sorted(named("What meta holds")) == sorted(meta)


def test_the_section_on_2d_gaussians_lists_the_keys_of_meta():
    tensors = [torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)]
    cameras = (torch.eye(4)[None], torch.eye(3)[None], 4, 4)
    meta, flat = (render(*tensors, *cameras)[-1] for render in (rasterization, rasterization_2dgs))
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `meta` |")]
    added = set(re.findall(r"`(\w+)`", row)) - {"meta", "rasterization", "conics"}
    assert set(flat) == (set(meta) - {"conics"}) | added
    assert set(named("2D Gaussians")) - {"meta"} <= set(inspect.signature(rasterization_2dgs).parameters)
