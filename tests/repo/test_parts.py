"""What puts trainings together loops over parts: its source names none."""

import re
from pathlib import Path

import pytest

from gsplat_edu.train.part import OWN_PARTS

SOURCE = Path(__file__).parents[2] / "src" / "gsplat_edu"


@pytest.mark.parametrize(
    "module", ["train/compose.py", "train/trainer.py", "train/step.py", "train/objective.py"]
)
def test_the_source_names_no_part(module):
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", (SOURCE / module).read_text()).lower().replace(" ", "_")
    assert len(OWN_PARTS) >= 6
    named = [name for name in OWN_PARTS if re.search(rf"(?<![a-z]){name}(?![a-z])", text)]
    assert not named
