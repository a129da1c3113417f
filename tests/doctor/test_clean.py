"""Clean captures of many kinds get no warning."""

import functools

import pytest

from doctor.rooms import room
from gsplat_edu.data import procedural
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_blender
from gsplat_edu.doctor.before import examine
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Severity

LAYOUTS = ("orbit", "forward", "outward", "walk")

procedural_capture = functools.cache(procedural.procedural_capture)


@pytest.mark.parametrize(
    ("layout", "size", "count", "height", "with_points"),
    [
        *((layout, 128, 24, None, True) for layout in LAYOUTS),
        *((layout, 72, 16, 120, False) for layout in LAYOUTS),
        ("orbit", 96, 36, None, False),
    ],
)
def test_a_clean_room_gets_no_warning(named, layout, size, count, height, with_points):
    views, points = room(layout, size, count, height)
    assert named(views, points if with_points else None) == {}


@pytest.mark.parametrize(
    ("size", "count", "height", "with_points"),
    [(48, 12, None, True), (64, 24, None, False), (80, 36, None, True), (72, 18, 128, False)],
)
def test_the_procedural_scene_gets_no_warning(named, size, count, height, with_points):
    views, points, _ = procedural_capture(size, count, height=height)
    assert named(views, points if with_points else None) == {}


def test_blenders_layout_gets_no_warning(tmp_path):
    views, _, _ = procedural_capture(64, 24)
    write_blender(tmp_path, views[3:], views[:3])
    (tmp_path / "test" / "view_000_depth.png").write_bytes((tmp_path / "test" / "view_000.png").read_bytes())
    diagnosis = examine(prepare(CaptureReader(tmp_path)))
    assert [f for f in diagnosis.findings if f.severity > Severity.NOTE] == []


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_camera_layout_is_recognised(diagnosed, layout):
    views, points = room(layout, 128)
    said = {"orbit": "common centre", "forward": "one way", "outward": "outwards", "walk": "one way"}[layout]
    assert said in dict(diagnosed(views, points).facts)["cameras"]
