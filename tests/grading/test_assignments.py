"""Solutions of assignments get all points, typical mistakes their sentence, constants nothing."""

import dataclasses
import re

import numpy as np
import pytest

import build_notebooks
from chapters import ROOT
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.grading.assignment import RIGHT, graded
from gsplat_edu.grading.capture import judged
from gsplat_edu.grading.submission import ASSIGNMENTS, CAPTURE, grades
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from splats import splats_on

SOLUTIONS = ROOT / "notebooks" / "solutions" / "assignments"
PATHS = {re.sub(r"^\d_", "", path.stem): path for path in sorted(SOLUTIONS.glob("*.py"))}
PARTS = [(name, i) for name, parts in ASSIGNMENTS.items() for i in range(len(parts))]


@pytest.fixture
def graded_text(tmp_path):
    """Grade a text: reasons by the parts' names."""

    def run(text, seed=0):
        path = tmp_path / "answers.py"
        path.write_text(text)
        return {one.part: one.reason for one in grades(path, seed)[1]}

    return run


def test_there_are_six_of_ten_points_each():
    assert list(PATHS) == [*ASSIGNMENTS, CAPTURE]
    assert {sum(part.points for part in parts) for parts in ASSIGNMENTS.values()} == {10}
    assert sum(one.of for one in judged(0, 0, None, None)) == 10


@pytest.mark.parametrize("name", ASSIGNMENTS)
@pytest.mark.parametrize("seed", [0, 1, 7_000])
def test_the_solutions_get_all_points_for_any_seed(name, seed):
    assert {one.reason for one in grades(PATHS[name], seed)[1]} == {RIGHT}


def test_what_students_begin_with_is_the_solution_without_answers():
    given = {path.name: path.read_text() for path in (ROOT / "notebooks" / "assignments").iterdir()}
    assert given == {path.name: build_notebooks.template(path.read_text()) for path in PATHS.values()}
    for name in ASSIGNMENTS:
        found = grades(ROOT / "notebooks" / "assignments" / PATHS[name].name)[1]
        assert all(
            f"NotImplementedError: write {one.part}" in one.reason and one.points == 0 for one in found
        )


@pytest.mark.parametrize(("name", "number"), PARTS)
def test_every_mistake_is_told_by_its_sentence_and_no_constant_passes(name, number):
    part = ASSIGNMENTS[name][number]
    for seed in (0, 1, 2):
        for sentence, mistaken in part.mistakes.items():
            assert graded(part, mistaken, seed, number).reason == sentence
        answers = [part.answer(*case) for case in part.cases(np.random.default_rng([seed, number]))]
        for constant in (0, None, "", [], *answers):
            found = graded(part, lambda *_, constant=constant: constant, seed, number)
            assert found.points == 0 and found.reason != RIGHT


WRONG = [
    (
        "projection",
        "(points - eye) @ R.T",
        "points @ R.T - eye",
        "the eye is subtracted after the rotation; subtract it before",
    ),
    ("projection", "quat / np.linalg.norm(quat)", "quat", "the quaternion is not normalised"),
    (
        "projection",
        "R * np.square(scales)",
        "R * scales",
        "the scales are not squared: they are standard deviations",
    ),
    ("projection", " + 0.3 * np.eye(2)", "", "the dilation of 0.3 px² is missing on the diagonal"),
    ("projection", "fx * x / z**2", "fx * x / z", "case 1 of 4: returns"),
    ("compositing", "value if value >= 1 / 255 else 0.0", "value", "alphas below 1/255 have to be 0"),
    (
        "compositing",
        "light * background",
        "background",
        "the background has to be weighted by the light that is left",
    ),
    ("compositing", "np.argsort(depths, kind", "np.argsort(-depths, kind", "the order is from far to near"),
    (
        "gradients",
        "- behind / (1 - alphas[i])",
        "- behind",
        "what is behind a layer has its factor 1 - alpha in it; divide by that",
    ),
    ("gradients", "np.prod(1 - alphas)\n", "np.prod(1 - alphas[1:])\n", "case 1 of 3: returns"),
    (
        "gradients",
        " - unit * (unit @ gradient)",
        "",
        "the part along the quaternion has to go: its length does not matter",
    ),
    (
        "tiles",
        "row * columns + column",
        "column * columns + row",
        "tiles are numbered row by row: row * columns + column",
    ),
    (
        "tiles",
        "right // tile + 1, bottom // tile + 1",
        "right // tile, bottom // tile",
        "the ends are the tiles behind the last ones",
    ),
    (
        "tiles",
        "np.concatenate([[0], np.cumsum(lengths)])",
        "np.cumsum(lengths)",
        "these are the ends of the lists",
    ),
    (
        "density",
        "np.where(large, 2, 1)",
        "np.where(large, 1, 2)",
        "small Gaussians are cloned and large ones split",
    ),
    ("density", "1 - (1 - opacity) ** (1 / copies)", "opacity / copies", "opacities do not add"),
    ("density", ", scales / 1.6", ", scales", "the children have to be smaller, by a factor of 1.6"),
]


@pytest.mark.parametrize(("name", "right", "wrong", "sentence"), WRONG)
def test_a_typical_wrong_answer_loses_its_part_and_reads_why(graded_text, name, right, wrong, sentence):
    text = PATHS[name].read_text()
    assert right in text
    reasons = set(graded_text(text.replace(right, wrong, 1)).values()) - {RIGHT}
    assert len(reasons) == 1 and reasons.pop().startswith(sentence)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("return 1", "case 1 of 3: returns the shape () instead of (1,)"),
        ("return None", "case 1 of 3: returns NoneType, not numbers"),
        ("return [[1], [2, 3]]", "case 1 of 3: returns list, not numbers"),
        ("return alphas * float('nan')", "case 1 of 3: returns nan instead of"),
        ("return undefined", "line 3 raises NameError: name 'undefined' is not defined"),
        ("alphas *= 2; return alphas", "changes its arguments; make new arrays"),
        ("raise SystemExit(0)", "line 3 raises SystemExit: 0"),
    ],
)
def test_answers_of_any_kind_are_told(graded_text, body, reason):
    text = f'ASSIGNMENT = "gradients"\ndef layer_gradient(alphas, colors, background, g):\n    {body}\n'
    found = graded_text(text)
    assert found["layer_gradient"].startswith(reason)
    assert found["unit_gradient"] == "is missing: write a function of this name"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "x = 1\n",
            "has to set ASSIGNMENT to one of projection, compositing, gradients, tiles, density, capture",
        ),
        ("ASSIGNMENT = []\n", "has to set ASSIGNMENT"),
        ("def f(:\n", "line 1: is not Python"),
        (
            "import os\nfrom gsplat_edu import project_cov3d\n",
            "line 2: may import NumPy and Python's own modules only, not gsplat_edu",
        ),
        ("def f():\n    import torch\n", "line 2: may import NumPy"),
        ("from . import answers\n", "line 1: may import NumPy"),
        ("1 / 0\n", "raises an error when it is executed, ZeroDivisionError: division by zero"),
        ("raise SystemExit\n", "raises an error when it is executed, SystemExit"),
        ('ASSIGNMENT = "capture"\nRUN = 3\n', "RUN: 3 is no run folder"),
    ],
)
def test_a_file_that_cannot_be_graded_is_one_line(tmp_path, text, message):
    path = tmp_path / "answers.py"
    path.write_text(text)
    with pytest.raises(ArgumentError, match=re.escape(message)) as caught:
        grades(path)
    assert "\n" not in str(caught.value)
    for other in (tmp_path, tmp_path / "none.py"):
        with pytest.raises(ArgumentError, match="cannot be read"):
            grades(other)


def test_the_command_prints_points_and_reasons(capsys):
    assert main(["grade", str(PATHS["density"]), "--seed", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "density: 10 of 10 points",
        "  signal          2 of 2  right",
        "  decision        3 of 3  right",
        "  split           3 of 3  right",
        "  shared_opacity  2 of 2  right",
    ]
    assert main(["grade", str(PATHS["density"]), "--seed", "-1"]) == 2
    assert "--seed: -1 is negative" in capsys.readouterr().err


def test_a_run_is_scored_anew(tmp_path, capsys):
    """The run of a procedural capture of 36 photos; its metrics.json is then made to claim more."""
    views, points, colors = procedural_capture(size=32, count=36)
    write_colmap(tmp_path / "capture", views, points, colors)
    data = {
        **dataclasses.asdict(DataSettings(test_every=6)),
        "path": str(tmp_path / "capture"),
        "points": None,
    }
    render = dataclasses.asdict(RenderSettings())
    run = RunFolder(tmp_path / "run")
    run.write_config({"data": data, "render": render, "origin": [0.0, 0.0, 0.0]})
    save_ply(run.scene(30), splats_on(points, colors))
    path = tmp_path / "answers.py"
    path.write_text('ASSIGNMENT = "capture"\nRUN = "run"\n')
    unscored = {one.part: one for one in grades(path)[1]}
    assert unscored["metrics"].reason == "metrics.json has no score of the scene; run gsplat-edu eval"
    assert main(["eval", str(run.path)]) == 0
    scored = {one.part: one for one in grades(path)[1]}
    assert [scored[part].reason for part in ("photos", "held_out", "metrics")] == [RIGHT] * 3
    metrics = run.read_metrics()
    assert scored["quality"].points == sum(metrics["test"]["psnr"] >= level for level in (20, 22, 24, 26, 28))
    metrics["test"]["psnr"] = 40.0
    run.write_metrics(metrics)
    claimed = {one.part: one for one in grades(path)[1]}
    assert claimed["quality"] == scored["quality"] and "says 40.00 dB" in claimed["metrics"].reason


@pytest.mark.parametrize(
    ("facts", "points", "reasons"),
    [
        ((40, 5, 28.4, 28.4), (2, 1, 5, 2), ()),
        (
            (29, 3, 25.0, 25.05),
            (0, 1, 3, 2),
            ("29 photos; take at least 30", "25.00 dB; a point for each of 20, 22"),
        ),
        ((30, 2, 19.0, 31.0), (2, 0, 0, 0), ("2 are held out", "19.00 dB", "metrics.json says 31.00 dB")),
        (
            (30, 0, None, None),
            (2, 0, 0, 0),
            ("0 are held out", "no photo is held out", "metrics.json has no score of the scene"),
        ),
    ],
)
def test_a_run_is_judged_by_photos_and_quality(facts, points, reasons):
    found = judged(*facts)
    assert tuple(one.points for one in found) == points
    told = " | ".join(one.reason for one in found)
    assert all(reason in told for reason in reasons) and told.count(RIGHT) == 4 - len(reasons)
