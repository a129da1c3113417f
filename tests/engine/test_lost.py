"""A device that is lost is replaced, and what was done on it is done again with the same bits.

`destroy` really takes a device away: wgpu then reports it lost, as it does when a driver is reset, and never answers
what was waited for.
"""

import pytest
import torch

from float32_backends import SETTINGS, SMALLER
from gsplat_edu.base.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.engine import adapters, frame, host
from gsplat_edu.engine.failures import DeviceLostError
from gsplat_edu.engine.passes import LIMITS
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.webgpu import resident as webgpu_resident
from gsplat_edu.render.webgpu.render import rendering_with
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.initialize import from_points

pytestmark = pytest.mark.slow

STRATEGIES = {
    "fast": {"strategy": "fast", "max_gaussians": 120},
    "adc": {"strategy": "adc", "grad_threshold": 1e-5, "reset_every": 9},
    "mcmc": {"strategy": "mcmc", "max_gaussians": 120},
}
ITERATIONS = 12


@pytest.fixture
def losable(device):
    """Let the backend use a device of its own."""
    with rendering_with(frame.Pool(host.Device(limits=LIMITS))) as pool:
        yield pool


@pytest.fixture(scope="module")
def capture():
    return procedural_capture(40, 6, splats=80)


def lose(pool):
    pool.device.device.destroy()


def trainer(capture, strategy="fast", **changes):
    views, points, colors = capture
    given = {"densify_start": 2, "densify_every": 4, "sh_every": 3} | STRATEGIES[strategy] | changes
    config = recipe(ITERATIONS, **given)
    start = Start(sorted_in_space(from_points(points, colors, config)), extent=2.0)
    return training(config, Views(views), load_backend("webgpu"), start)


def what_it_is(run):
    """Return the state of a training and its last image, away from the device."""
    tensors, numbers = run.state()
    return {name: tensor.clone() for name, tensor in tensors.items()}, numbers, run.last[0].clone()


def assert_same(run, expected):
    (ours, numbers, image), (theirs, others, other) = what_it_is(run), expected
    assert set(ours) == set(theirs) and numbers == others
    assert torch.equal(image, other)
    for name, tensor in ours.items():
        assert torch.equal(tensor, theirs[name]), name


def images_and_gradients(lost_at, pool):
    gaussians = SMALLER["random"].gaussians(torch.float32).trainable()
    if lost_at == "render":
        lose(pool)
    out = render(gaussians, SMALLER["random"].camera, settings=SETTINGS, backend="webgpu")
    if lost_at == "backward":
        lose(pool)
    out.image.square().sum().backward()
    return out.image.detach(), *(tensor.grad for tensor in gaussians.tensors().values())


@pytest.mark.parametrize("lost_at", ["render", "backward"])
def test_an_image_and_its_gradients_survive_a_lost_device(losable, lost_at):
    expected = images_and_gradients("", losable)
    before = losable.device
    with pytest.warns(
        BackendWarning, match=r"^backend 'webgpu': .* was lost; the image is rendered again on a new"
    ):
        found = images_and_gradients(lost_at, losable)
    assert losable.device is not before
    for ours, other in zip(found, expected, strict=True):
        assert torch.equal(ours, other)
    for ours, other in zip(images_and_gradients("", losable), expected, strict=True):
        assert torch.equal(ours, other)


def test_gradients_of_an_image_of_the_lost_device_come_from_the_new_one(losable):
    """Another render noticed the loss and replaced the device."""
    gaussians = SMALLER["random"].gaussians(torch.float32).trainable()
    expected = images_and_gradients("", losable)
    out = render(gaussians, SMALLER["random"].camera, settings=SETTINGS, backend="webgpu")
    with pytest.warns(BackendWarning):
        images_and_gradients("render", losable)
    out.image.square().sum().backward()
    for tensor, other in zip(gaussians.tensors().values(), expected[1:], strict=True):
        assert torch.equal(tensor.grad, other)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_training_goes_on_with_the_same_bits(losable, capture, strategy):
    """The device is lost after seven steps, with one unfinished: the steps since the last change are repeated."""
    undisturbed, run = trainer(capture, strategy), trainer(capture, strategy)
    expected = undisturbed.run().losses
    state = what_it_is(undisturbed)

    def disturb(one, event):
        if event.iteration == 7 and losable.device is first:
            assert run.stepper.device_run.repeatable
            lose(losable)

    first = losable.device
    with pytest.warns(
        BackendWarning, match=r"was lost; [1-9]\d* steps and what followed them are done again on a new"
    ):
        losses = run.run(callbacks=[disturb]).losses
    assert losable.device is not first and losses == expected
    assert_same(run, state)


@pytest.mark.parametrize("at", ["start", "read", "image"])
def test_a_loss_is_noticed_wherever_the_device_is_used(losable, capture, at):
    undisturbed, run = trainer(capture), trainer(capture)
    undisturbed.run(lambda: undisturbed.iteration >= 7)
    state = what_it_is(undisturbed)
    if at == "start":
        lose(losable)
        with pytest.warns(BackendWarning):
            run.run(lambda: run.iteration >= 7)
    else:
        run.run(lambda: run.iteration >= 7)
        lose(losable)
        with pytest.warns(BackendWarning):
            _ = run.state() if at == "read" else run.last
    assert_same(run, state)


def test_what_is_kept_for_a_repetition_is_bounded(losable, capture, monkeypatch):
    """Beyond the bound the state is read, and a loss after that repeats only what followed."""
    undisturbed = trainer(capture, densify_every=1000)
    expected, state = undisturbed.run().losses, what_it_is(undisturbed)
    kept = []
    for name, most in (("MOST_STEPS", 3), ("REPEATED_PHOTOS", 2 * 40 * 40 * 3)):
        monkeypatch.setattr(webgpu_resident, name, most)
        run = trainer(capture, densify_every=1000)

        def disturb(one, event, run=run, first=losable.device):
            kept.append(len(run.stepper.device_run.repeatable))
            if event.iteration == 7 and losable.device is first:
                lose(losable)

        with pytest.warns(BackendWarning):
            assert run.run(callbacks=[disturb]).losses == expected
        assert max(kept) <= 3 and max(kept) > 0
        monkeypatch.undo()
        assert_same(run, state)


@pytest.mark.filterwarnings("ignore::gsplat_edu.base.errors.BackendWarning")
def test_a_device_that_is_lost_again_and_again_ends_the_run_and_its_checkpoint_continues(
    losable, capture, tmp_path, monkeypatch
):
    undisturbed, run, resumed = (trainer(capture) for _ in range(3))
    undisturbed.run()
    state = what_it_is(undisturbed)
    run.run(lambda: run.iteration >= 6)
    path = save_checkpoint(tmp_path, run, 1.0)
    renewed, devices = host.Device.renewed, []

    def doomed(lost):
        device = renewed(lost)
        device.device.destroy()
        devices.append(device)
        return device

    monkeypatch.setattr(host.Device, "renewed", doomed)
    lose(losable)
    with pytest.raises(
        DeviceLostError,
        match="was lost 3 times .*; resume from the last checkpoint",
    ) as raised:
        run.run()
    assert "\n" not in str(raised.value) and len(devices) == 2
    monkeypatch.setattr(host.Device, "renewed", renewed)
    losable.renew(losable.device)
    load_checkpoint(path, resumed)
    resumed.run()
    assert_same(resumed, state)


def test_an_adapter_that_is_gone_is_named(losable, monkeypatch):
    lost = losable.device
    lose(losable)
    listed = adapters.listed_adapters

    def none():
        return ()

    none.cache_clear = listed.cache_clear
    for module in (adapters, host):
        monkeypatch.setattr(module, "listed_adapters", none)
    with pytest.raises(BackendUnavailableError, match=r"^backend 'webgpu': .* is gone; restart the computer"):
        losable.renew(lost)
    assert losable.device is lost


def test_other_failures_are_not_losses(device):
    """A device refuses a shader and still works."""
    assert not device.is_lost()
    with pytest.raises(BackendUnavailableError) as raised:
        device.allocate(
            frame.program(16, False),
            {"gaussians": 10**7, "rest": 1, "pixels": 1, "edges": 2, "live": 4, "pairs": 1},
        )
    assert not isinstance(raised.value, DeviceLostError)
