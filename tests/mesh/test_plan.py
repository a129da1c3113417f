"""What a mesh will take: voxels, triangles and memory from the sizes of a scene, and the sizes of a known one."""

import math

import numpy as np
import pytest

from gsplat_edu import Camera, load_backend
from gsplat_edu.base.errors import NotEnoughMemoryError
from gsplat_edu.mesh.plan import Demand, Survey, plan_mesh, survey, touched
from gsplat_edu.render.settings import RenderSettings
from splat_ball import RADIUS, ball

MIB = 2**20
ROOM = Survey(maps=100, pixels=100 * 1000 * 750, voxel=0.01, area=300.0, seconds=20.0)
"""3 x 300 / 0.01^2 = 9 million triangles; 715 MiB of depth maps."""


def test_without_limits_voxels_have_their_usual_size():
    plan = plan_mesh(ROOM, Demand(), None)
    assert plan.voxel == 0.01 and plan.triangles == 9_000_000 and plan.reason == ""
    assert plan.room is None and plan.most_faces is None
    assert plan_mesh(ROOM, Demand(coarse=4.0), None).triangles == 9_000_000 // 16
    assert plan_mesh(ROOM, Demand(voxel=0.02), None).triangles == 9_000_000 // 4


def test_voxels_are_chosen_for_the_triangles():
    plan = plan_mesh(ROOM, Demand(faces=2_000_000), None)
    assert plan.most_faces == plan.triangles == 2_000_000
    assert plan.voxel == pytest.approx(0.01 * math.sqrt(4.5))
    assert "instead of 0.01, so that it has at most 2,000,000 triangles" in plan.sentence
    # a given voxel is kept: its triangles are reduced afterwards
    assert plan_mesh(ROOM, Demand(voxel=0.01, faces=2_000_000), None).triangles == 9_000_000


@pytest.mark.parametrize("limit", [2 * 2**30, 4 * 2**30])
def test_voxels_are_chosen_for_the_memory(limit):
    """715 MiB of maps, 450 of the program; then at least 590 bytes a triangle, as measured on 2.4 million."""
    given = plan_mesh(ROOM, Demand(memory=limit), 1)  # what is free does not count then
    assert given.memory <= limit and "so that it fits the memory" in given.reason
    assert 590 * given.triangles < limit - 1165 * MIB and given.voxel > 0.01
    assert given.room < limit - 1165 * MIB
    free = plan_mesh(ROOM, Demand(), limit - 450 * MIB)
    assert free.voxel == pytest.approx(given.voxel) and free.memory == pytest.approx(given.memory - 450 * MIB)


@pytest.mark.parametrize(
    ("demand", "free", "said"),
    [
        (Demand(), 700 * MIB, "memory: 100 depth maps need 715 MiB, but 700 MiB are free"),
        (Demand(memory=1100 * MIB), None, "need 1.14 GiB, but 1.07 GiB are allowed by `max_memory`"),
        (Demand(texture=True), 1500 * MIB, "100 depth maps and a texture need 1.58 GiB"),
        (Demand(), 720 * MIB, "voxel: 0.01 needs about"),
        (Demand(voxel=0.001), 8 * 2**30, "voxel: 0.001 needs about"),
    ],
)
def test_what_cannot_fit_is_one_line(demand, free, said):
    with pytest.raises(NotEnoughMemoryError, match=said) as error:
        plan_mesh(ROOM, demand, free)
    assert "\n" not in str(error.value)


def test_the_advised_voxel_fits():
    with pytest.raises(NotEnoughMemoryError) as error:
        plan_mesh(ROOM, Demand(voxel=0.001), 8 * 2**30)
    advised = 1.05 * float(str(error.value).rstrip("`").rsplit("=", 1)[1])  # two digits are told
    assert plan_mesh(ROOM, Demand(voxel=advised), 8 * 2**30).memory < 8 * 2**30


def test_cubes_around_the_origin_are_all_counted():
    """Points in the middle of 20^3 cubes, half of them at negative coordinates, each cube twice."""
    ticks = np.arange(-10, 10) + 0.5
    points = 0.1 * np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    assert touched([points, points + 0.01, points[:7]], 0.1) == 8_000


def test_the_area_of_a_ball_is_found():
    eyes = 3.0 * np.random.default_rng(0).normal(size=(24, 3))
    cameras = [
        (str(i), Camera.looking_at(eye / np.linalg.norm(eye) * 3.0, (0, 0, 0), 336, 336, 240, 240))
        for i, eye in enumerate(eyes)
    ]
    settings, backend = RenderSettings(jacobian_limit=1.3), load_backend("cpu")
    found = survey(ball(), cameras, settings, backend)
    assert found.maps == 24 and found.pixels == 24 * 240**2
    assert found.area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.25)
    # 1.5 px at the median depth of a ball of 0.8 seen from 3
    assert 1.5 * 2.2 / 336 < found.voxel < 1.5 * 2.6 / 336
    low, high = np.array([[-2.0, -2, -2], [0, 2, 2]]), np.array([[0.0, -2, -2], [2, 2, 2]])
    halves = [survey(ball(), cameras, settings, backend, half).area for half in (low, high)]
    assert min(halves) > 0.3 * found.area and sum(halves) == pytest.approx(found.area, rel=0.05)
