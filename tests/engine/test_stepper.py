"""A training that stays on the device: near the native backend's, the same bits again, and few bytes a step."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.engine import frame
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.fast import PlannedDensity
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.resident import ResidentStepper, why_not
from gsplat_edu.train.step import TensorStepper
from gsplat_edu.train.team import Alone

pytestmark = pytest.mark.usefixtures("webgpu")

STRATEGIES = {
    "fast": {"strategy": "fast", "max_gaussians": 120},
    "adc": {"strategy": "adc", "grad_threshold": 1e-5, "reset_every": 9},
    "mcmc": {"strategy": "mcmc", "max_gaussians": 120},
}
ITERATIONS = 50


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(40, 6, splats=80)


def trainer(capture, backend="webgpu", iterations=12, **changes):
    """Return a training that densifies a few times."""
    views, points, colors = capture
    given = {"densify_start": 2, "densify_every": 4, "sh_every": 3} | STRATEGIES["fast"] | changes
    config = recipe(iterations, **given)
    start = Start(sorted_in_space(from_points(points, colors, config)), extent=2.0)
    return training(config, Views(views), load_backend(backend), start)


def tensors_of(one):
    flat, _ = one.state()
    return flat


def assert_same(one, other):
    ours, theirs = tensors_of(one), tensors_of(other)
    assert set(ours) == set(theirs)
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[name]), name


def masked(capture, alpha):
    """Return the capture with masks, and alpha by request."""
    views, points, colors = capture
    generator = np.random.default_rng(1)

    def changed(view):
        photo = view.read()
        shape = photo.image.shape[:2]
        through = (255 * generator.random(shape)).astype(np.uint8) if alpha else None
        mask = generator.random(shape) > 0.2
        return View(view.camera, photo.image, alpha=through, mask=mask, name=view.name)

    return [changed(view) for view in views], points, colors


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_fifty_steps_follow_the_native_backend(capture, strategy):
    """Gradients agree to 3e-4 (test_render.py), and Adam divides by their size: the error of a step is 3e-4 of a rate,
    or a whole one where a gradient is rounding only. The loss, in which such parameters do not matter, stays within
    fifty times 3e-4 of itself. Nothing is added or removed, which would turn a rounding into another number of
    Gaussians.
    """
    changes = STRATEGIES[strategy] | {"densify_every": 1000, "reset_every": 0, "sh_every": 10}
    ours, native = (trainer(capture, backend, ITERATIONS, **changes) for backend in ("webgpu", "cpu"))
    assert isinstance(ours.stepper, ResidentStepper) and isinstance(native.stepper, TensorStepper)
    terms = [list[dict[str, float]](), list[dict[str, float]]()]
    for run, seen in zip((ours, native), terms, strict=True):
        run.run(
            callbacks=[lambda _, event, seen=seen: seen.append({k: float(t) for k, t in event.terms.items()})]
        )
    for found, expected in zip(*terms, strict=True):
        assert found == pytest.approx(expected, rel=ITERATIONS * 3e-4)
    assert terms[0][-1]["photo"] < 0.9 * terms[0][0]["photo"]
    theirs = {"fast": "norm_sums", "adc": "norm_sums"}.get(strategy)
    if theirs:
        sums, expected = (tensors_of(run)[f"density.{theirs}"] for run in (ours, native))
        assert torch.allclose(sums, expected, rtol=0.02, atol=float(ITERATIONS * 3e-4 * expected.max()))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_same_bits_again_after_a_resume_and_with_too_little_room(
    capture, tmp_path, monkeypatch, strategy
):
    """A run is stopped between two changes of the Gaussians. The last one has room for eight pairs at first."""
    changes = STRATEGIES[strategy]
    first = trainer(capture, **changes)
    first.run(lambda: first.iteration >= 7)
    path = save_checkpoint(tmp_path, first, 1.0)
    first.run()
    again, resumed, crowded = (trainer(capture, **changes) for _ in range(3))
    again.run()
    load_checkpoint(path, resumed)
    resumed.run()
    monkeypatch.setattr(frame, "FEWEST_PAIRS", 8)
    crowded.stepper.device_run.resident.most_pairs_each = 0.0
    losses = crowded.run().losses
    assert crowded.stepper.device_run.resident.most_pairs_each > 1.0, (
        "more pairs were found than there was room for"
    )
    assert len(losses) == 12
    for run in (again, resumed, crowded):
        assert_same(first, run)


def test_a_checkpoint_moves_to_another_backend_and_back(capture, tmp_path):
    ours, native, back = (trainer(capture, backend) for backend in ("webgpu", "cpu", "webgpu"))
    ours.run(lambda: ours.iteration >= 6)
    load_checkpoint(save_checkpoint(tmp_path / "a", ours, 1.0), native)
    assert_same(ours, native)
    native.run(lambda: native.iteration >= 9)
    load_checkpoint(save_checkpoint(tmp_path / "b", native, 1.0), back)
    assert_same(native, back)
    back.run()
    assert back.iteration == 12


@pytest.mark.parametrize("alpha", [False, True], ids=["masks", "alpha"])
def test_masks_and_random_backgrounds_reach_the_device(capture, alpha):
    given = masked(capture, alpha)
    runs = [
        trainer(given, backend, 8, random_background=alpha, densify_every=1000)
        for backend in ("webgpu", "cpu")
    ]
    ours, native = (run.run().losses for run in runs)
    assert ours == pytest.approx(native, rel=8 * 3e-4)
    image, photo, mask = runs[0].last
    expected = runs[1].last
    assert torch.equal(photo, expected[1]) and torch.equal(mask, expected[2])
    assert torch.allclose(image, expected[0], atol=2 / 255)
    kept = runs[0].stepper.device_run.resident.photos
    assert len(kept) == (0 if alpha else 6), "photos over random backgrounds are sent for each step"


def test_photos_beyond_the_room_are_sent_again_with_the_same_result(capture):
    plain, streamed = (trainer(capture, iterations=14) for _ in range(2))
    streamed.stepper.device_run.resident.photo_room = 2 * 4 * 40 * 40
    plain.run()
    streamed.run()
    assert len(streamed.stepper.device_run.resident.photos) == 2
    assert_same(plain, streamed)


def test_photos_on_disk_are_read_once_at_each_size(capture):
    views, points, colors = capture
    reads = []

    def stored(view):
        return View.stored(view.camera, lambda: reads.append(view.name) or view.read(), view.name)

    run = trainer(([stored(view) for view in views], points, colors), iterations=40, fast_start_factor=1.0)
    run.run()
    assert sorted(reads) == sorted(view.name for view in views)


def bytes_of_steps(device, side, splats):
    """Return the bytes sent and received in five steps between which nothing is due, with photos on the device."""
    capture = procedural_capture(side, 2, splats=splats)
    run = trainer(capture, iterations=30, densify_every=1000, fast_start_factor=1.0)
    counted, unfinished = [], set()

    def count(_, event):
        unfinished.add(len(run.stepper.device_run.resident.unfinished))
        if event.iteration in (7, 12):
            counted.append((device.sent, device.received))

    run.run(lambda: run.iteration >= 13, [count])
    assert unfinished == {1}, "no step waits for itself"
    (sent, received), (sent_later, received_later) = counted
    return sent_later - sent, received_later - received


def test_bytes_of_a_step_do_not_grow_with_gaussians_or_pixels(device):
    small, large = bytes_of_steps(device, 32, 40), bytes_of_steps(device, 96, 400)
    assert small == large
    assert 0 < large[0] <= 5 * 512 and 0 < large[1] <= 6 * 32


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"appearance": "exposure"}, r"the view model corrects images or cameras"),
        ({"batch": 2}, r"a batch has several views"),
        ({"outside_masks": "empty"}, r"the objective has the term 'outside'"),
    ],
    ids=["appearance", "batch", "outside"],
)
def test_what_the_device_cannot_do_steps_on_the_host_and_says_why(capture, changes, reason):
    with pytest.warns(
        BackendWarning, match=rf"^backend 'webgpu': .* pass through the host .* because {reason}"
    ):
        run = trainer(capture, iterations=4, **changes)
    assert isinstance(run.stepper, TensorStepper)
    run.run()


def test_a_strategy_that_does_not_follow_a_device_is_named(capture):
    class Watcher:
        observes_renders_only = is_over = True

        def observe(self, gaussians, output): ...
        def update(self, iteration, gaussians, optimizer):
            return gaussians, []

        def state(self):
            return {}, {}

        def load_state(self, tensors, numbers, gaussians): ...

    class Curious(PlannedDensity):
        def observe(self, gaussians, output):
            super().observe(gaussians, output)

    class Renamed(PlannedDensity):
        pass

    class Two(Alone):
        size = 2

    run = trainer(capture)
    backend, host = load_backend("webgpu"), run.stepper
    config, start = run.config, run.gaussians

    def reason(**parts):
        return why_not(start, backend, dataclasses.replace(host.parts, **parts), 1)

    assert reason() is None and reason(density=Renamed(config, start)) is None
    for other in (Watcher(), Curious(config, start)):
        assert reason(density=other) == "the density strategy does not follow a device"
    assert reason(team=Two()) == "processes share the step"


def test_a_training_that_loses_all_gaussians_goes_on_without_them(capture):
    """As on the other backends; the run's folder then says so."""
    runs = [
        trainer(capture, backend, 8, strategy="adc", min_opacity=0.99, densify_stop=8)
        for backend in ("webgpu", "cpu")
    ]
    ours, native = (run.run().losses for run in runs)
    assert [run.stepper.count for run in runs] == [0, 0]
    assert ours == pytest.approx(native, rel=8 * 3e-4)


def test_a_step_that_gets_no_room_ends_the_run_and_saves_nothing(capture, device, monkeypatch):
    """The host has counted steps that did not happen, so no checkpoint is written from then on."""
    monkeypatch.setattr(frame, "FEWEST_PAIRS", 8)
    run = trainer(capture)
    run.stepper.device_run.resident.most_pairs_each = 0.0
    right = device.check_fits

    def tight(program, counts):
        if counts.get("pairs", 0) > 8:
            right(program, counts | {"pairs": 1 << 30})
        right(program, counts)

    monkeypatch.setattr(device, "check_fits", tight)
    message = r"^backend 'webgpu': the buffer slots needs 40960 MiB for .*, or use the backend cpu$"
    with pytest.raises(BackendUnavailableError, match=message):
        run.run()
    with pytest.raises(BackendUnavailableError, match=message):
        run.state()
    with pytest.raises(BackendUnavailableError, match=message):
        run.run()
