"""The tempo maps a run's iterations to those of its recipe, in order."""

import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.tempo import MOST_CHANGES, Tempo


@pytest.mark.parametrize("batch", [1, 4])
@pytest.mark.parametrize(
    "text", ["", "400,100:300", "400,100:1200", "400,100:300,200:900,880:884", "400,0:44"]
)
def test_every_position_is_passed_once_and_in_order(text, batch):
    tempo = Tempo.parsed(text, 400, batch)
    iterations = tempo.iterations // batch * batch
    passed = [position for i in range(0, iterations, batch) for position in tempo.passed(i)]
    assert passed == list(range(0, tempo.position(iterations), batch))
    assert tempo.position(iterations) == 400, "the run ends at the end of the recipe"
    assert all(tempo.position(i) < 400 for i in range(0, iterations, batch))


def test_a_change_does_not_affect_past_iterations():
    before = Tempo.parsed("1000,200:800", 1000)
    after = before.changed(500, 2_000)
    assert [after.position(i) for i in range(501)] == [before.position(i) for i in range(501)]
    assert str(after) == "1000,200:800,500:2000" and Tempo.parsed(str(after), 7) == after
    assert str(after.changed(500, 600)) == "1000,200:800,500:600", (
        "a second change at the same iteration replaces the first"
    )


def test_an_extended_run_continues_one_by_one():
    tempo = Tempo.parsed("100,50:70", 100)
    assert [tempo.position(i) for i in (69, 70, 71, 90)] == [97, 100, 101, 120]
    assert [Tempo.parsed("", 100).position(i) for i in (0, 99, 130)] == [0, 99, 130]


TOO_LONG = "100," + ",".join(["5:9"] * (MOST_CHANGES + 1))


@pytest.mark.parametrize(
    "text",
    [
        "fast",
        "100",
        "100,",
        "100,5",
        "100,5:x",
        "0,5:9",
        "100,5:5",
        "100,9:20,5:30",
        "100,-1:5",
        "1e3,5:9",
        TOO_LONG,
    ],
)
def test_a_damaged_tempo_is_refused_by_name(text):
    with pytest.raises(ArgumentError, match="^tempo: ") as refused:
        recipe(100, tempo=text)
    assert len(str(refused.value)) < 200


def run(tempo, iterations, **changes):
    """Train a tiny fast recipe of 120 iterations with a tempo; return the trainer, its scene and its events."""
    settings = {
        "strategy": "fast",
        "max_gaussians": 300,
        "densify_every": 20,
        "sh_degree": 0,
        "seed": 3,
    } | changes
    config = recipe(120, **settings).changed(iterations=iterations, tempo=tempo)
    capture = procedural_capture(size=32, count=6)[0]
    views = tuple(View(view.camera, view.read().image, name=view.name) for view in capture)
    start = Start(random_ball(60, torch.Generator().manual_seed(1)), extent=1.0)
    events = []
    trainer = training(
        config, Views(views), load_backend("cpu"), start, callbacks=[lambda _, e: events.append(e)]
    )
    trainer.run()
    return trainer, torch.cat([t.flatten() for t in trainer.gaussians.tensors().values()]), events


def test_the_identity_changes_no_bit():
    _, plain, _ = run("", 120)
    _, same, _ = run("120,40:120", 120)
    assert torch.equal(plain, same)


@pytest.mark.parametrize(("tempo", "iterations"), [("120,40:70", 70), ("120,40:260", 260)])
def test_a_stretched_run_passes_the_whole_schedule(tempo, iterations):
    trainer, _, events = run(tempo, iterations)
    _, _, plain = run("", 120)
    steps, densified = ([e for e in events if isinstance(e, kind)] for kind in (StepEvent, DensifyEvent))
    assert [step.iteration for step in steps] == list(range(iterations))
    assert len(densified) == sum(isinstance(event, DensifyEvent) for event in plain), (
        "each densification happens once"
    )
    assert [event.iteration for event in densified] == sorted(event.iteration for event in densified)
    assert all(event.iteration < iterations for event in densified), "events have the iterations of the run"
    assert len(trainer.gaussians) > 60 and steps[0].photo_factor > steps[-1].photo_factor == 1.0
    final = trainer.stepper.optimizer.learning_rates["means"]
    assert final == pytest.approx(trainer.config.means_rate_final, rel=0.1), (
        "the rates have fallen completely"
    )


def test_a_batch_keeps_whole_steps():
    trainer, _, events = run("120,40:80", 80, batch=4)
    assert trainer.iteration == 80 and len([e for e in events if isinstance(e, StepEvent)]) == 20


def test_a_resumed_run_repeats_the_decisions():
    decisions = "120,40:200,90:150"
    _, scene, _ = run(decisions, 150)
    stopped, _, _ = run(decisions, 60)
    resumed, _, _ = run(decisions, 1)
    resumed.config = resumed.config.changed(iterations=150)
    resumed.load_state(*stopped.state())
    resumed.run()
    assert torch.equal(scene, torch.cat([t.flatten() for t in resumed.gaussians.tensors().values()]))
