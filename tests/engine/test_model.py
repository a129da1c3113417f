"""The model of a step: its bytes against what the host binds and allocates, and small cases by hand."""

import dataclasses

import numpy as np
import pytest

from engine.frames import packed, view_of
from float32_backends import SMALLER
from gsplat_edu.engine import frame, measure
from gsplat_edu.engine.model import (
    GPUS,
    LISTS,
    Cost,
    Counters,
    Gpu,
    bindings_of,
    cost_of,
    forecast,
    step_costs,
)
from gsplat_edu.engine.passes import WORD, Pass, Size
from gsplat_edu.engine.step import STATE, step_program

COUNTERS = Counters(1000, 15, 3, 700, 3000, 2640, 60, 4, 160, 90, 4096)
ALL = [*COUNTERS.program.parts["step"], *COUNTERS.program.parts["noise"]]
PASSES = {one.entry: one for one in ALL}


@pytest.mark.parametrize("entry", PASSES)
def test_bytes_are_of_buffers_that_the_pass_binds(entry):
    """It reads what it binds for reading, writes only what it binds for writing, and uses every buffer it binds."""
    one = PASSES[entry]
    cost = cost_of(one, COUNTERS)
    assert set(cost.written) <= set(one.writes) and set(cost.read) <= {*one.reads, *one.writes}
    assert {*cost.read, *cost.written} == {*one.reads, *one.writes} == set(bindings_of(one).values())
    assert cost.operations > 0 and all(size >= 0 for size in (*cost.read.values(), *cost.written.values()))


def test_no_buffer_moves_more_than_the_host_allocates(device):
    """Except records, which tiles fetch again. The sizes are those of the buffers that exist."""
    scene, view = packed(SMALLER["random"]), view_of(SMALLER["random"])
    run = measure.StepRun(device, scene, view)
    counters = Counters.of(run.memory, 15, 3, (view.camera.W, view.camera.H))
    assert counters.counts == run.memory.counts and counters.program is run.memory.program
    sizes = {name: buffer.size for name, buffer in run.memory.buffers.items()}
    declared = {one.name: WORD * one.size.of(counters.counts) for one in counters.program.buffers}
    assert all(sizes[name] == max(size, 16) for name, size in declared.items()), "16: the smallest buffer"
    for cost in step_costs(counters):
        for moved in (cost.read, cost.written):
            for name, size in moved.items():
                assert size <= sizes[name] or name == "records", (cost.entry, name)


def test_counters_are_those_of_the_frame(pool):
    scene = SMALLER["opaque, tiles stop"]
    view = view_of(scene)
    drawn = frame.draw_frame(pool, packed(scene), view)
    found = Counters.of(drawn.memory, 15, 3, (view.camera.W, view.camera.H))
    assert (found.gaussians, found.visible, found.pairs) == (
        len(scene.means),
        len(drawn.visible),
        drawn.num_pairs,
    )
    done = drawn.memory.read("done")[: view.tiles].astype(int)
    edges = drawn.memory.read("tiles")[: view.tiles + 1].astype(int)
    assert found.taken == done.sum() < found.pairs and found.batches == np.ceil(done / 64).sum()
    assert found.stopped == (done < np.diff(edges)).sum() > 0 and found.tiles == view.tiles


def test_adam_of_the_harmonics_by_hand():
    """Four numbers of a coefficient are read, three written; a gradient among them."""
    cost = cost_of(PASSES["rest_step"], COUNTERS)
    numbers = 4 * 3 * 15 * 1000
    assert cost.read == {
        "rest": numbers,
        "rest_first": numbers,
        "rest_second": numbers,
        "rest_grads": numbers,
        "live": 32,
    }
    assert cost.written == {"rest": numbers, "rest_first": numbers, "rest_second": numbers}


def test_compositing_by_hand():
    """48 bytes of each pair's record; its slot and owner; 6 floats of a pixel; the stop and the begin of a tile."""
    cost = cost_of(PASSES["composite"], COUNTERS)
    groups, tiles = 60 + 2, 60
    assert COUNTERS.tiles == tiles
    taken = 2640 * groups / tiles  # the two workgroups beyond the last tile are not told from the others
    assert cost.read["records"] == pytest.approx(48 * taken)
    assert cost.read["slot_of"] == cost.read["owner"] == pytest.approx(4 * taken)
    assert cost.written["image"] == 4 * 6 * 160 * 90
    evaluations = 256 * taken
    assert 25 * evaluations < cost.operations < 60 * evaluations
    backward = cost_of(PASSES["composite_backward"], COUNTERS)
    assert backward.written["slots"] == pytest.approx(4 * 10 * 3000, rel=0.05)
    assert backward.operations > cost.operations


def test_a_sort_by_hand():
    """Keys twice and values once are read, both are written, and 16 counts for 1,024 keys."""
    keys = [one for one in ALL if one.module == "sort" and one.items.count == "pairs"]
    count, scatter = (cost_of(one, COUNTERS) for one in keys[:2])
    assert count.read["tile_keys"] == scatter.read["tile_keys"] == 4 * 3000
    assert count.written["tile_sort_digits"] == 4 * 16 * 4
    assert (
        scatter.read["slot_of"]
        == scatter.written["tile_sort_keys"]
        == scatter.written["tile_sort_values"]
        == 12000
    )


def test_more_of_anything_costs_more():
    base = forecast(step_costs(COUNTERS))["step"]
    for change in (
        {"gaussians": 2000, "visible": 1400},
        {"pairs": 6000, "taken": 5280, "batches": 120, "room": 8192},
        {"width": 320, "batches": 90},
        {"harmonics": 15, "visible": 900},
    ):
        more = forecast(step_costs(dataclasses.replace(COUNTERS, **change)))["step"]
        assert more["MB"] > base["MB"] and more["G operations"] > base["G operations"], change
    fewer = dataclasses.replace(COUNTERS, harmonics=0, degree=0)
    least = base["MB"] - forecast(step_costs(fewer))["step"]["MB"]
    assert least == pytest.approx(4 * 45 * (700 + 700 + 1000 + 7 * 1000) / 1e6, rel=0.1), (
        "project, back, Adam"
    )


def test_a_pass_takes_the_longer_of_its_two_times():
    gpu = Gpu("one", 100.0, 2.0)
    assert Cost("a", 1e9, {"x": 1e8}, {"y": 1e8}).milliseconds(gpu) == pytest.approx(2.0)
    assert Cost("a", 5e9, {"x": 1e8}, {"y": 1e8}).milliseconds(gpu) == pytest.approx(5.0)


def test_the_forecast_adds_up_and_says_that_it_is_computed():
    found = forecast(step_costs(COUNTERS))
    assert list(found)[-1] == "step" and LISTS in found and len(found) == 8
    for column, total in found["step"].items():
        assert total == pytest.approx(sum(row[column] for name, row in found.items() if name != "step"))
    assert found["step"]["dispatches"] == len(COUNTERS.program.parts["step"])
    assert [column for column in found["step"] if "ms" in column] == [
        f"{gpu.name}, ms (computed)" for gpu in GPUS
    ]


def test_the_moved_bytes_of_a_million_gaussians_are_near_those_counted_by_hand():
    """Adam of 59 numbers reads four and writes three of each."""
    found = forecast(step_costs(Counters.assumed(1_000_000, (990, 742))))
    least = 7 * 4 * 59 * 1e6 / 1e6
    assert least < found["Adam"]["MB"] < 1.1 * least
    assert 100 < found["composite"]["MB"] < 200 and 200 < found["composite_backward"]["MB"] < 400


def test_a_measured_step_and_its_table(device):
    scene, view = packed(SMALLER["random"]), view_of(SMALLER["random"])
    found = measure.measure_step(device, scene, view, 2)
    assert found.same_bits and found.passes == len(step_program(8).parts["step"])
    assert (found.sent, found.received) == (416, 32)
    assert found.step_ms > found.record_ms > 0 and found.submit_ms > 0
    table = found.table()
    if device.measures:
        assert set(found.entries) == {one.entry for one in step_program(8).parts["step"]}
        assert table["step"]["ms (measured)"] == pytest.approx(sum(found.entries.values()))
    lines = measure.as_table(table).splitlines()
    assert len(lines) == 2 + len(table) and len({line.count("|") for line in lines}) == 1


def test_another_order_of_sums_is_found(device, monkeypatch):
    """A device whose second run differs in one bit of the state."""
    states, right = [], measure.StepRun.state

    def state(run):
        found = right(run)
        states.append(found)
        found["core"][0] += len(states)
        return found

    monkeypatch.setattr(measure.StepRun, "state", state)
    assert not measure.measure_step(
        device, packed(SMALLER["random"]), view_of(SMALLER["random"]), 1
    ).same_bits


def test_steps_get_room_for_their_pairs(device):
    """A scene with more than two pairs a Gaussian begins with too little room."""
    scene = SMALLER["hundreds of layers"]
    run = measure.StepRun(device, packed(scene), view_of(scene))
    live = next(run.steps(1))
    assert not live[frame.LIVE - 1] and run.memory.counts["pairs"] >= live[frame.PAIRS] > 0
    assert set(run.state()) == set(STATE)


def test_a_pass_without_rates_for_its_loop_is_an_error(monkeypatch):
    from gsplat_edu.engine import model

    monkeypatch.setattr(model, "rates_of", lambda one, counters: {})
    with pytest.raises(KeyError, match="composite.k"):
        cost_of(PASSES["composite"], COUNTERS)
    assert isinstance(PASSES["composite"], Pass) and PASSES["composite"].items == Size("edges")
