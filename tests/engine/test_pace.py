"""A part in many submissions gives the bits of one: renders, gradients and steps, down to a workgroup in each."""

import math

import numpy as np
import pytest

from engine.frames import drawn, packed, view_of
from float32_backends import SMALLER
from gsplat_edu.engine import dispatch, frame, host
from gsplat_edu.engine.pace import GROWTH, REACH, Pace, Stretch, Timing
from gsplat_edu.engine.passes import LIMITS, sort_bits
from gsplat_edu.engine.step import GROUPS, LIVE, STATE, Noise, PackedPhoto, StepNumbers, step_program
from native_scenes import random

SPLITS = {"one submission": math.inf, "as on this device": 0.2, "a workgroup in each": 0.0}


def paced(limit, **given):
    return host.Device(limits=LIMITS, pace=Pace(limit), **given)


def counted(device, monkeypatch):
    """Return a list that grows by the workgroups of each submission."""
    submitted, recorded = [], dispatch.recorded

    def count(encoder, calls):
        submitted.append(sum(x * y for *_, x, y in calls))
        return recorded(encoder, calls)

    monkeypatch.setattr(dispatch, "recorded", count)
    return submitted


def frames_of(device, scene, times=2):
    """Return what renders and their gradients give, of which the first is timed if the pace has a limit."""
    pool, found = frame.Pool(device), []
    for _ in range(times):
        one = drawn(pool, scene)
        grads = np.random.default_rng(0).normal(size=(*one.transmittance.shape, frame.GRADS))
        given = frame.differentiate_frame(one, packed(scene), grads.astype(np.float32), None)
        images = (one.image, one.transmittance, one.depth, one.median_depth, one.visible, one.radii)
        found.append((*images, given.core, given.rest, given.norms, given.camera))
    return found


@pytest.mark.parametrize("name", ["random", "opaque, tiles stop"])
def test_renders_and_gradients_have_the_same_bits_however_they_are_split(device, monkeypatch, name):
    expected = frames_of(paced(math.inf), SMALLER[name])[0]
    for limit in SPLITS.values():
        submitted = counted(device, monkeypatch)
        for found in frames_of(paced(limit), SMALLER[name]):
            for ours, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(ours, other)
        if limit == 0.0:
            assert max(submitted) == 1 and len(submitted) > 150
        if limit == math.inf:
            assert len(submitted) == 6
        monkeypatch.undo()


@pytest.mark.parametrize("count", [3_000, 100_000, 3_000_000])
def test_a_device_too_fast_to_tell_its_pace_is_timed_once(count):
    """The levels of a scan dispatch one entry point in sizes that differ a hundred times."""
    counts = {"gaussians": count, "rest": 45 * count, "pixels": 1_000_000, "edges": 4_000, "live": LIVE}
    passes = [(one.name, one.groups(counts | {"pairs": 2 * count})) for one in step_program(12).parts["step"]]
    pace = Pace(0.2)
    for name, groups in passes:
        pace.note(name, [(groups, 1e-4)])
    assert [name for name, groups in passes if not pace.is_known(name, groups)] == []


def steps_of(device):
    """Return the state after three steps, a random one included, by `play` and `submit`."""
    scene, view = packed(SMALLER["random"]), view_of(SMALLER["random"])
    H, W = view.camera.H, view.camera.W
    counts = {"gaussians": len(scene.core), "rest": scene.rest.size, "pixels": H * W, "live": LIVE}
    counts |= {"edges": view.tiles + 2, "pairs": 1 << 12}
    memory = device.allocate(step_program(sort_bits(view.tiles.bit_length())), counts)
    photo = PackedPhoto.packed((255 * np.random.default_rng(2).random((H, W, 3))).astype(np.uint8), None)
    memory.write("core", scene.core)
    memory.write("rest", scene.rest)
    rates = dict.fromkeys(GROUPS, (1e-3, 0.9, 0.999, 1e-15, 0.1, 0.001))
    numbers = StepNumbers(rates, opacity_weight=0.01, scale_weight=0.01, collects=True)
    block = view.packed(scene.rest.shape[1]) + numbers.packed(H * W, len(scene.core), photo.floats)
    kept, live = device.keep(photo.words), []
    for _ in range(3):
        ticket = memory.submit("step", block, "live", kept, "photo")
        memory.play("noise", Noise((1, 2), 1e-3, 100.0, 0.995).packed())
        live.append(ticket.words())
    return [*live, *(memory.read(name) for name in STATE)]


def test_a_step_of_training_has_the_same_bits_however_it_is_split(device):
    expected, *others = (steps_of(paced(limit)) for limit in SPLITS.values())
    assert any(np.any(array) for array in expected[3:])
    for found in others:
        for ours, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(ours, other)


def test_a_pass_of_two_dimensions_is_split_into_stretches_of_one(device, monkeypatch):
    """As if a dimension took 3 workgroups."""
    scene = random(300, (64, 80), seed=1)
    expected = frames_of(device, scene, 1)[0]
    slow = paced(0.2, most_groups=3)
    frames_of(slow, scene, 1)
    slow.pace.known = dict.fromkeys(slow.pace.known, Timing(0.05, math.inf))
    slow.pace.version += 1
    submitted = counted(device, monkeypatch)
    found = frames_of(slow, scene, 1)[0]
    assert 1 < max(submitted) <= 6  # four take the limit; a whole pass of four is two rows of three
    for ours, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, other)


def test_a_plan_stays_below_the_limit_and_covers_every_workgroup_once():
    pace = Pace(0.2)
    pace.known = {
        "long": Timing(0.03, math.inf),
        "short": Timing(0.001, math.inf),
        "huge": Timing(0.5, math.inf),
    }
    parts = [("short", 10), ("long", 20), ("absent", 5), ("short", 0), ("huge", 2), ("short", 300)]
    plan = pace.plan(parts, 120)
    covered = [0] * len(parts)
    for piece in plan:
        seconds = 0.0
        for place, first, groups in piece:
            assert first == covered[place] and (groups <= 120 or groups == parts[place][1])
            covered[place] += groups
            seconds += groups * pace.known.get(parts[place][0], Timing(0.0, 0)).each
        assert seconds <= 0.2 + 1e-6 or piece == [Stretch(4, piece[0].first, 1)]
    assert covered == [groups for _, groups in parts]
    assert len(Pace(math.inf).plan(parts, 120)) == 1


def test_times_hold_for_what_they_were_measured_on():
    pace = Pace(0.2)
    assert not pace.is_known("pass", 1)
    pace.note("pass", [(4, 0.001)])  # far below the limit: says little about a pass of a thousand
    assert pace.is_known("pass", 4 * REACH) and not pace.is_known("pass", 4 * REACH + 1)
    pace.note("pass", [(64, 9.0), (64, 0.02), (100, 0.1)])  # the first included a compiler
    assert pace.known["pass"] == Timing(0.001, math.inf)
    pace.watch(["pass"], 0.39, 1)
    assert pace.is_known("pass", 10**6)
    pace.watch(["pass"], 0.41, 1)
    assert not pace.is_known("pass", 1)


def test_stretches_grow_to_half_the_limit():
    pace = Pace(0.2)
    assert pace.first_stretch(10) == 10 and pace.first_stretch(10**6) == 64
    assert pace.next_stretch(64, 0.0, 10**6, 65535) == 64 * GROWTH
    assert pace.next_stretch(64, 0.2, 10**6, 65535) == 32
    assert pace.next_stretch(64, 100.0, 10**6, 65535) == 1
    assert pace.next_stretch(64, 0.0, 7, 65535) == 7
