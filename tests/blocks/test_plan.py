"""Cells cover the ground without overlap, and each has its share of the cameras and points."""

import dataclasses
import math

import numpy as np
import pytest

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.blocks.plan import Block, BlockPlan, Cell, automatic_count, halved, measured_area
from gsplat_edu.runs.blocks_folder import PLAN, BlocksFolder, Done
from gsplat_edu.scene.camera import Camera, look_at


def flight(rows, columns, turn=0.0, spacing=2.0):
    """Cameras on a grid that look down obliquely, the grid turned about the vertical."""
    cameras = []
    for i in range(rows * columns):
        x, z = spacing * (i % columns), spacing * (i // columns)
        x, z = math.cos(turn) * x - math.sin(turn) * z, math.sin(turn) * x + math.cos(turn) * z
        eye, heading = np.array([x, -8.0, z]), i % 4 * math.pi / 2
        target = eye + np.array([6 * math.cos(heading), 8.0, 6 * math.sin(heading)])
        cameras.append(Camera(look_at(eye, target), eye, 50.0, 50.0, 31.5, 23.5, 48, 64))
    return cameras


def under(cameras, rng, count=2000):
    eyes = np.stack([camera.eye for camera in cameras])
    points = eyes[rng.integers(len(eyes), size=count)] + rng.normal(size=(count, 3))
    points[:, 1] = -rng.uniform(0, 2, count)
    return points


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_every_place_lies_in_one_cell(count):
    rng = np.random.default_rng(count)
    cameras = flight(6, 9)
    points = under(cameras, rng)
    area = measured_area(cameras, points)
    cells = halved(area, cameras, points, count)
    assert len(cells) == count
    anywhere = rng.uniform(-100, 100, (5000, 2))
    corners = np.array([[cell.low[0], cell.low[1]] for cell in cells])
    on_edges = np.concatenate([anywhere, corners[np.isfinite(corners).all(axis=1)]])
    assert (sum(cell.holds(on_edges).astype(int) for cell in cells) == 1).all()
    weights = np.array([cell.holds(area.ground.coordinates(points)).mean() for cell in cells])
    # Points and cameras have equal weight. A cell holds 1 / count of them on average; one row of cameras is 9 of 54.
    eyes = area.ground.coordinates(np.stack([camera.eye for camera in cameras]))
    weights = (weights + np.array([cell.holds(eyes).mean() for cell in cells])) / 2
    assert np.abs(weights - 1 / count).max() < 9 / 54 / 2 + 0.02


def test_the_axes_are_parallel_to_the_flight_and_the_cut_halves_the_longer_side():
    cameras = flight(4, 16, turn=0.5)
    points = under(cameras, np.random.default_rng(0))
    area = measured_area(cameras, points)
    up = np.array(area.ground.axes[2])
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-6)
    sides = [area.high[i] - area.low[i] for i in range(2)]
    longer = int(sides[1] > sides[0])
    along = np.array(area.ground.axes[longer])
    assert abs(along @ [math.cos(0.5), 0, math.sin(0.5)]) > math.cos(math.radians(1.0)), (
        "axes are searched in steps of one degree"
    )
    (one, _) = halved(area, cameras, points, 2)
    assert math.isfinite(one.high[longer]) and math.isinf(one.high[1 - longer])


def test_far_points_do_not_stretch_the_ground():
    cameras = flight(6, 6)
    points = under(cameras, np.random.default_rng(1))
    hills = np.array([[500.0, -30.0, 500.0]]) + np.zeros((300, 1))
    near, far = (measured_area(cameras, p) for p in (points, np.concatenate([points, hills])))
    assert near == far


def test_a_plan_is_read_as_it_was_written(tmp_path):
    cameras = flight(4, 4)
    area = measured_area(cameras, under(cameras, np.random.default_rng(2)))
    block = Block(Cell((-math.inf, 0.1), (1 / 3, math.inf)), ("a.png", "b.png"), ("c.png",), "digest", 7)
    plan = BlockPlan(
        "capture", (1.0, 2.0, 3.0), area, (block,), {"train": {"iterations": 5}, "data": {}, "save_every": 10}
    )
    plan.write(tmp_path)
    assert BlockPlan.read(tmp_path) == plan
    assert BlockPlan.read(tmp_path).digest() == plan.digest()
    assert dataclasses.replace(plan, capture="elsewhere").digest() == plan.digest()
    assert dataclasses.replace(plan, origin=(1.0, 2.0, 4.0)).digest() != plan.digest()
    with pytest.raises(
        CheckpointError, match=r"has no plan\.json; `train CAPTURE .* --until split` makes it"
    ):
        BlockPlan.read(tmp_path / "nothing")
    (tmp_path / PLAN).write_text('{"area": 3}')
    with pytest.raises(CheckpointError, match="is damaged"):
        BlockPlan.read(tmp_path)


def test_the_record_of_another_block_or_plan_is_refused(tmp_path):
    folder = BlocksFolder(tmp_path)
    done = Done(3, "plan", "scene", 100, 30, 1.5, 0, "host", "v4", "1.0")
    done.write(folder)
    assert folder.read_done(3, "plan") == done and folder.read_done(2, "plan") is None
    with pytest.raises(CheckpointError, match="belongs to another plan"):
        folder.read_done(3, "another")
    folder.record(3).rename(folder.record(2))
    with pytest.raises(CheckpointError, match="belongs to another plan"):
        folder.read_done(2, "plan")


def test_one_block_for_every_200_views():
    assert [automatic_count(views) for views in (1, 299, 301, 1500, 10**6)] == [1, 1, 2, 8, 256]
