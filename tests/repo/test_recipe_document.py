"""docs/RECIPE.md names every field of the recipe with its default, and marks what is stretched."""

import dataclasses
import re
from pathlib import Path

from gsplat_edu.train.config import MILESTONES, TrainConfig

TEXT = (Path(__file__).parents[2] / "docs/RECIPE.md").read_text()
# the first table; the one under "Starting from a trained scene" has other defaults
ROWS = re.findall(
    r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \|$", TEXT.split("## Starting from a trained scene")[0], re.M
)


def test_every_field_and_its_default():
    assert [(name, default) for name, default, _ in ROWS] == [
        (field.name, str(field.default)) for field in dataclasses.fields(TrainConfig)
    ]


def test_the_marked_ones_are_stretched():
    assert {name for name, _, text in ROWS if "*" in text} == set(MILESTONES)
