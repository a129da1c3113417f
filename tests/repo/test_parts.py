"""What puts trainings together, runs, reports and commands them loops over parts: its source names none."""

import re
from pathlib import Path

import pytest

from gsplat_edu.train.part import OWN_PARTS

IMPORTERS = {
    "runs/meshes.py": "which photos see the same from elsewhere: a mesh is checked by pairs of photos",
    "runs/painting.py": "where the masks of what moved lie: they outlast the training, and only paint asks for them",
}
"""Modules that use what a part offers beside its hooks, and what that is; no other may."""

LOOPING = (
    "train/resident.py",
    "runs/dataset.py",
    "runs/evaluation.py",
    "runs/training.py",
    "runs/options.py",
)
LOOPING += ("runs/identity.py", "runs/parts.py", "runs/pilot.py")
LOOPING += ("budget/forecast.py", "budget/trial.py", "runs/cleaning.py", "runs/lod_refinement.py")
"""Modules that ask each part for what they need of its settings, and of what the user asked of it."""

OPTIONS = ("options/train.py", "options/block_parts.py", "options/settings.py", "options/length.py")
OPTIONS += ("options/asked.py", "options/blocks.py")
"""Modules that read from the declarations of settings where an option belongs, and what may not be given with it."""

COMMANDS = ("cli/train.py", "cli/blocks.py", "cli/doctor.py")
"""Commands that choose, share and repeat settings of a training."""

SOURCE = Path(__file__).parents[2] / "src" / "gsplat_edu"


@pytest.mark.parametrize(
    "module",
    [
        *("train/compose.py", "train/trainer.py", "train/step.py", "train/objective.py"),
        *("runs/training.py", "runs/evaluation.py", "runs/options.py", "runs/parts.py", "runs/dataset.py"),
        *("runs/pilot.py", "train/resident.py", "budget/costs.py", "budget/forecast.py"),
        *("evaluate/report.py", "doctor/diagnosis.py", "survey/trained.py", "cli/result.py"),
    ],
)
def test_the_source_names_no_part(module):
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", (SOURCE / module).read_text()).lower().replace(" ", "_")
    assert len(OWN_PARTS) >= 8
    named = [name for name in OWN_PARTS if re.search(rf"(?<![a-z]){name}(?![a-z])", text)]
    assert not named


@pytest.mark.parametrize(
    "module", ["train/compose.py", "runs/training.py", "runs/options.py", "runs/dataset.py", "cli/train.py"]
)
def test_a_training_does_not_name_the_files_of_a_capture(module):
    """What they say of the photos comes with the data settings: which photos are left out, which pixels count."""
    assert not re.findall("region|left_out", (SOURCE / module).read_text())


@pytest.mark.parametrize("module", ["runs/cleaning.py", "runs/lod_refinement.py", "parts/floaters/part.py"])
def test_parts_say_how_photos_are_compared_with_a_scene(module):
    assert not re.findall("appearance|vignetting", (SOURCE / module).read_text())


@pytest.mark.parametrize("module", ["cli/train.py", *OPTIONS, *LOOPING])
def test_what_users_ask_of_parts_is_named_by_its_options(module):
    """`RunOptions.asked` carries it; the parts know what it is, and the registry which of them ask."""
    text = (SOURCE / module).read_text()
    assert not re.findall(r"given_depth|floaters|\bdepth\b(?!=False)|arguments\.clean|[\"']clean[\"']", text)


@pytest.mark.parametrize(
    "module",
    [
        *(
            "cli/doctor.py",
            "runs/thin.py",
            "survey/residuals.py",
            "evaluate/verdict.py",
            "evaluate/report.py",
        ),
        "parts/bench.py",
    ],
)
def test_the_correction_of_exposures_is_named_by_its_part(module):
    assert not re.findall(r"appearance|vignetting", (SOURCE / module).read_text())


@pytest.mark.parametrize(
    "module",
    sorted(
        str(path.relative_to(SOURCE))
        for place in ("doctor/*.py", "studio/*.py", "studio/web/*.js", *COMMANDS, *OPTIONS, *LOOPING)
        for path in SOURCE.glob(place)
    ),
)
def test_the_source_names_no_setting_of_a_part(module):
    """It may speak of the poses and the exposure of photos, but what a part changes is for the part to advise."""
    settings = "sky|appearance|refine|transients|outside[-_]masks|surface|depth"
    if module.startswith("studio/"):  # a mesh is a surface, and a folder of a run has the masks of transients
        settings = "sky|appearance|refine|outside[-_]masks|depth"
    text = (SOURCE / module).read_text()
    assert not re.findall(rf"--(?:{settings})\b|[\"'](?:{settings})[\"']", text)


def test_no_other_module_imports_a_part():
    rooms = "|".join(OWN_PARTS)
    found = {
        str(path.relative_to(SOURCE))
        for path in SOURCE.rglob("*.py")
        if re.search(rf"^\s*(from|import) gsplat_edu\.parts\.({rooms})\b", path.read_text(), re.MULTILINE)
    }
    assert {path for path in found if not path.startswith("parts/")} == set(IMPORTERS)
