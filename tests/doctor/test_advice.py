"""Advice has one order of causes, and no piece of it contradicts another."""

import ast
import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

import gsplat_edu
from doctor.rooms import replaced, room
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.doctor.after import examine_run
from gsplat_edu.doctor.diagnosis import Advice, Diagnosis
from gsplat_edu.evaluate.verdict import RANKED
from gsplat_edu.parts.transients.findings import check_moved
from gsplat_edu.runs.parts import judgements
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.survey.finding import Change, Examined, Finding, Severity
from gsplat_edu.survey.order import CAUSES, CHECKS, EXPLAINS
from gsplat_edu.survey.residuals import Residual
from gsplat_edu.survey.trained import Trained
from splats import splats_on

TURNS = {
    "iterations": (
        ("train for longer", "or for longer", "finish the training"),
        ("stop earlier", "iterations alone"),
    ),
    "Gaussians": (("more Gaussians",), ("lower --max-gaussians",)),
    "photos used": (("remove", "without it"), ("keep all photos",)),
}
"""Words of advice that turn a quantity one way, and the other way."""


def opposed(texts):
    """Return the quantities that some texts turn one way and others the other way, by their words alone."""
    return [
        quantity
        for quantity, ways in TURNS.items()
        if all(any(words in text for words in way for text in texts) for way in ways)
    ]


@pytest.fixture(scope="module")
def gaussians():
    _, points, colors = procedural_capture(16, 4)
    return splats_on(points, colors)


def residuals_of(scores):
    return [Residual(f"{i:02}.png", psnr, stops, veiled) for i, (psnr, stops, veiled) in enumerate(scores)]


def examined(run, moved=()):
    """Examine a run with what the parts of its training find, and these photos of things that moved."""
    things = {"things that moved": check_moved(moved, len(run.train))}
    return examine_run(run, [*judgements({}, run), Examined(things)])


VIEWS = st.lists(
    st.tuples(
        st.sampled_from([8.0, 18.0, 24.0, 26.0, 31.0, 36.0]),
        st.sampled_from([0.0, 0.9]),
        st.sampled_from([0.0, 0.1]),
    ),
    min_size=4,
    max_size=12,
)


@settings(max_examples=200, deadline=None)
@given(
    train=VIEWS,
    test=VIEWS,
    length=st.tuples(st.sampled_from([300, 1000, 3000, 10_000]), st.sampled_from([0, 500])),
    strategy=st.sampled_from(["fast", "adc"]),
    gain=st.sampled_from([-1.0, 0.0, 1.0]),
    moved=st.integers(0, 4),
    blurred=st.booleans(),
)
def test_no_advice_about_a_run_contradicts_another(
    gaussians, train, test, length, strategy, gain, moved, blurred
):
    reached, left = length
    log = [
        {"iteration": reached * k // 8, "psnr": 20.0 + gain * k, "loss": 0.1 * 0.8**k} for k in range(1, 9)
    ]
    run = Trained(Path("a"), gaussians, 3.0, residuals_of(train), residuals_of(test), reached, reached + left)
    run = replace(run, log=log, strategy=strategy, capture=Path("c"))
    diagnosis = examined(run, [(f"{i:02}.png", 0.1) for i in range(moved)])
    assert not opposed(diagnosis.advice)
    assert not opposed([finding.advice for finding in diagnosis.findings])
    directions = {}
    for name, value in itertools.chain.from_iterable(finding.options for finding in diagnosis.findings):
        is_more = (
            float(value) > (reached if name == "iterations" else len(gaussians)) if value.isdigit() else value
        )
        assert directions.setdefault(name, is_more) == is_more


CHANGES = [Change("iterations", way) for way in ("more", "fewer", "same")] + [
    Change("photos used", way) for way in ("fewer", "all")
]


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(CAUSES),
            st.sampled_from(list(Severity)),
            st.sets(st.sampled_from(CHANGES), max_size=1),
        ),
        max_size=8,
        unique_by=lambda one: one[0],
    ),
    st.lists(st.sets(st.sampled_from(CHANGES), max_size=1), max_size=3),
)
def test_no_combination_of_findings_gives_advice_that_contradicts_itself(found, further):
    findings = tuple(
        Finding(name, severity, "is so", f"do {name}", changes=tuple(changes))
        for name, severity, changes in found
    )
    otherwise = tuple(Advice(f"then {i}", tuple(changes)) for i, changes in enumerate(further))
    diagnosis = Diagnosis((), findings, (), otherwise)
    changes = {f"do {name}": turned for name, _, turned in found}
    changes |= {f"then {i}": turned for i, turned in enumerate(further)}
    for texts in (diagnosis.advice, [one.advice for one in diagnosis.findings if one.advice]):
        turned = [change for text in texts for change in changes[text]]
        assert len({quantity for quantity, _ in turned}) == len(set(turned))
    grave = [one for one in findings if one.severity > Severity.NOTE]
    explained = {name for one in grave for name in EXPLAINS.get(one.name, ())}
    order = sorted(grave, key=lambda one: (-one.severity, CAUSES.index(one.name)))
    if order and order[0].name not in explained:
        assert diagnosis.advice[0] == f"do {order[0].name}", "the gravest cause is never silenced"


def test_every_finding_has_a_place_in_the_order():
    named, package = set(), Path(gsplat_edu.__file__).parent
    for path in (*package.glob("doctor/*.py"), *package.glob("parts/*/*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                named |= {node.args[0].value} if isinstance(node.args[0], ast.Constant) else set()
    assert len(named) > 30 and named | {"exposure", "white balance", "depth", *RANKED} == set(CAUSES)
    assert "exposure" in CHECKS and len(CHECKS) == len(set(CHECKS))
    assert set(EXPLAINS) | set(itertools.chain.from_iterable(EXPLAINS.values())) <= set(CAUSES)


def overfitted(gaussians, reached):
    train, test = ([Residual(f"{i}.png", psnr, 0.0, 0.0) for i in range(8)] for psnr in (36.0, 22.0))
    return Trained(
        Path("a"), gaussians, 3.0, train, test, reached, reached, capture=Path("c"), strategy="fast"
    )


def test_a_scene_that_overfits_is_not_trained_for_longer(gaussians):
    for reached in (1000, 3000):
        diagnosis = examined(overfitted(gaussians, reached))
        assert diagnosis.advice[0].startswith("take more photos")
        assert not any("longer" in text or "--iterations" in text for text in diagnosis.advice)


@pytest.mark.parametrize(("count", "name"), [(1, "moved"), (6, "moving subject")])
def test_a_subject_that_moves_through_the_scene_is_named(gaussians, count, name):
    diagnosis = examined(overfitted(gaussians, 10_000), [(f"{i}.png", 0.2) for i in range(count)])
    found = {finding.name: finding for finding in diagnosis.findings}
    assert name in found and ("overfitted" in found)
    assert diagnosis.advice[0].startswith("train with --transients mask" if count > 1 else "take more photos")
    assert bool(found["overfitted"].advice) is (count == 1), "the subject explains what the test views lack"


def test_cameras_calibrated_one_by_one_are_not_told_to_be_one(diagnosed):
    views, points = room("forward", 24)

    def zoomed(view, factor, shift):
        one = view.camera
        camera = Camera(
            one.R, one.eye, one.fx * factor, one.fy * factor, one.cx + shift, one.cy, one.H, one.W
        )
        return View(camera, view.image, name=view.name)

    own = [zoomed(view, 1.0 + 0.002 * i, 0.0) for i, view in enumerate(views)]
    for cameras, one_for_all in ((views, True), (own, False)):
        found = {
            f.name: f
            for f in diagnosed(replaced(cameras, {3: zoomed(cameras[3], 1.6, 0.0)}), points).findings
        }
        assert ("one camera for all" in found["intrinsics"].advice) is one_for_all


def test_of_photos_to_remove_and_photos_to_keep_the_graver_counts():
    blurred = Finding("blurred", Severity.WARNING, "", "remove a", changes=(Change("photos used", "fewer"),))
    alike = Finding(
        "duplicates", Severity.NOTE, "", "keep all photos", changes=(Change("photos used", "all"),)
    )
    assert Diagnosis((), (alike, blurred), (), ()).advice == ["remove a"]
    assert Diagnosis((), (alike,), (), ()).advice == ["keep all photos"]
