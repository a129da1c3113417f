"""Operations select, hide and delete splats, and turn and scale the scene."""

import numpy as np
import pytest
import torch

import native_scenes
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.apply import (
    DELETED,
    HIDDEN,
    SELECTED,
    edited,
    flags_after,
    placed,
    placed_view,
    upright_rotation,
    views_after,
)
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.edit import IDENTITY, Filter
from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframeRecord, PathRecord
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
ALL = ops.Select("replace", ops.Everything())


def row(n=6):
    """Splats at x = 0, 1, 2, ..."""
    means = torch.zeros(n, 3)
    means[:, 0] = torch.arange(n)
    return Gaussians(means, torch.ones(n, 4), means - 3, means[:, None], torch.zeros(n, 0, 3), means[:, 0])


def between(low, high, how="replace"):
    """Select the splats of `row` with low <= x <= high."""
    middle, half = (low + high) / 2, (high - low) / 2 + 0.1
    return ops.Select(how, ops.Box((middle, 0.0, 0.0), AXES, (half, 1.0, 1.0)))


S, H, D = SELECTED, HIDDEN, DELETED


@pytest.mark.parametrize(
    ("operations", "flags"),
    [
        ([], [0, 0, 0, 0, 0, 0]),
        ([between(1, 3)], [0, S, S, S, 0, 0]),
        ([between(1, 3), between(2, 4, "add")], [0, S, S, S, S, 0]),
        ([between(1, 3), between(2, 4, "subtract")], [0, S, 0, 0, 0, 0]),
        ([between(1, 3), between(2, 4, "intersect")], [0, 0, S, S, 0, 0]),
        ([between(1, 3), between(2, 4)], [0, 0, S, S, S, 0]),
        ([between(1, 3), ops.Invert()], [S, 0, 0, 0, S, S]),
        ([between(1, 3), ops.Deselect()], [0] * 6),
        ([between(1, 3), ops.Delete(), ALL], [S, D, D, D, S, S]),
        ([between(1, 3), ops.Hide(), ops.Invert(), ops.Delete()], [D, H, H, H, D, D]),
        ([between(1, 3), ops.Hide(), ALL, ops.Show(), ops.Invert()], [0, S, S, S, 0, 0]),
        ([between(0, 1), ops.Hide(), ops.Crop((2.5, 0.0, 0.0), AXES, (1.6, 1.0, 1.0))], [D, H, 0, 0, 0, D]),
        ([between(0, 1), ops.Delete(), ops.Show(), between(0, 9, "add")], [D, D, S, S, S, S]),
        ([ops.Delete(), ops.Hide(), ops.Show()], [0] * 6),
    ],
)  # fmt: skip
def test_operations_give_these_states(operations, flags):
    assert flags_after(operations, row()).tolist() == flags
    left = edited(Scene(row()), operations).gaussians
    assert left.means[:, 0].tolist() == [float(i) for i, flag in enumerate(flags) if flag in (0, S)]


def test_nothing_removed_is_the_same_object_and_everything_removed_is_empty():
    scene = Scene(row())
    assert edited(scene, [ALL, ops.Hide(), ops.Show()]) is scene
    assert len(edited(scene, [ALL, ops.Delete()]).gaussians) == 0
    nobody = Scene(row(0))
    assert edited(nobody, [ALL, ops.Delete(), between(0, 1)]) is nobody


def test_the_identity_depends_on_every_parameter_and_the_origin():
    one = row()
    found = {identity_of(Scene(one)).sha256}
    for name, tensor in one.tensors().items():
        if tensor.numel():
            changed = one.tensors() | {name: tensor + 1e-3}
            found.add(identity_of(Scene(Gaussians(**changed))).sha256)
    assert len(found) == 1 + 5, "sh_rest is empty"
    assert identity_of(Scene(one, origin=(1.0, 2.0, 3.0))).difference(identity_of(Scene(one))) is not None
    assert identity_of(Scene(one)).difference(identity_of(Scene(row()))) is None


def floor(normal_turn, swap=False):
    """Return three points of the floor y = 1, counterclockwise seen from above, rotated by `normal_turn`."""
    points = np.array([(0.0, 1.0, 0.0), (0.0, 1.0, 3.0), (2.0, 1.0, 0.0)])  # (b - a) x (c - a) = (0, 6, 0)
    points = points[[0, 2, 1]] @ normal_turn.T
    chosen = points[[0, 2, 1]] if swap else points
    return ops.Upright(tuple(tuple(point) for point in chosen.tolist()))


def turned(axis, angle):
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 2.0, 3.1, np.pi])
def test_the_floor_becomes_horizontal(angle):
    # about a horizontal axis, so the shortest rotation back is the inverse
    tilt = turned((0.3, 0.0, 1.0), angle)
    R = upright_rotation(floor(tilt))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ tilt @ (0.0, -1.0, 0.0), (0.0, -1.0, 0.0), atol=1e-9)
    if angle < 3.0:
        # the points are rounded to 1e-16, which 1 / (1 + cos) at most amplifies
        np.testing.assert_allclose(R, tilt.T, atol=1e-12)


def test_points_seen_clockwise_turn_the_scene_upside_down():
    np.testing.assert_array_equal(upright_rotation(floor(np.eye(3), swap=True)), np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_turned_and_scaled_scene_looks_the_same_to_the_turned_view(degree):
    """The harmonics turn with the scene. Renders in float64 differ by rounding only."""
    made = native_scenes.random(40)
    scene = Filter(sh_degree=degree).apply(Scene(made.gaussians()))
    points = ((0.1, 0.0, 0.0), (0.9, 0.4, -0.2), (-0.2, 0.3, 0.8))
    scale = ops.Scale(((0.0, 0.0, 0.0), (0.0, 3.0, 4.0)), 10.0, "cm")
    views = views_after([ops.Scale(scale.points, 1.0, "m"), ops.Upright(points), scale])
    assert views.move.s == pytest.approx(2.0) and views.unit == "cm"
    after = placed(scene, views)
    assert after.unit == "cm" and after.up == (0.0, -1.0, 0.0)
    normal = np.cross(np.subtract(points[1], points[0]), np.subtract(points[2], points[0]))
    np.testing.assert_allclose(views.move.R @ normal / np.linalg.norm(normal), (0, -1, 0), atol=1e-12)

    def image(scene, camera):
        return render(scene.gaussians, camera, settings=RenderSettings(), backend="torch").image

    eye = np.array((0.3, -0.4, -3.0))
    view = Keyframe(eye, look_at(eye, np.zeros(3)), 60.0)
    there = placed_view(view, views.move)
    before = image(scene, Camera(view.R, view.eye, 40.0, 40.0, 23.5, 15.5, 32, 48))
    moved = image(after, Camera(there.R, there.eye, 40.0, 40.0, 23.5, 15.5, 32, 48))
    # twice as large at twice the distance; the dilation of 0.3 px² is the same in both
    assert (before - moved).abs().max() < 1e-11
    assert (
        before - image(after, Camera(view.R, view.eye, 40.0, 40.0, 23.5, 15.5, 32, 48))
    ).abs().max() > 1e-2


def view(x):
    return {"position": (float(x), 0.0, 0.0), "rotation": AXES, "fov": 50.0}


def test_the_last_operation_of_a_kind_counts():
    path = PathRecord("gsplat_edu path", 1, False, (KeyframeRecord(**view(0)), KeyframeRecord(**view(1))))
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    views = views_after(
        [
            ops.StartView(**view(1), pivot=(0.0, 0.0, 0.0)),
            ops.NamedView(name="a", **view(1)),
            ops.NamedView(name="b", **view(2)),
            ops.Measure(points, "door"),
            ops.NamedView(name="a", **view(3)),
            ops.RemoveView("none of this name"),
            ops.CameraPath(path),
            ops.StartView(**view(4), pivot=(0.0, 1.0, 0.0)),
            ops.Measure(points, ""),
        ]
    )
    assert views.start.view.eye[0] == 4 and views.start.pivot == (0.0, 1.0, 0.0)
    assert [(named.name, named.view.eye[0]) for named in views.named] == [("a", 3), ("b", 2)]
    assert views.path.document() == path.path.document() and views.move is IDENTITY and not views.upright
    assert [measure.note for measure in views.measures] == ["door", ""]
    assert (
        views_after(
            [
                ops.CameraPath(path),
                ops.CameraPath(None),
                ops.NamedView(name="a", **view(1)),
                ops.RemoveView("a"),
            ]
        ).named
        == ()
    )
    assert views_after([ops.CameraPath(path), ops.CameraPath(None)]).path is None


def test_named_views_take_the_order_of_the_last_list():
    named = [ops.NamedView(name=name, **view(i)) for i, name in enumerate("abcd")]
    order = ops.OrderViews(("d", "none", "b"))

    def names(*operations):
        return "".join(one.name for one in views_after(operations).named)

    assert names(*named, order) == "dbac", "those without a place follow in their order"
    assert (
        names(*named, order, ops.NamedView(name="b", **view(9)), ops.NamedView(name="e", **view(5)))
        == "dbace"
    )
    assert names(*named, order, ops.RemoveView("d"), ops.NamedView(name="d", **view(5))) == "bacd"
    assert names(order, *named) == "abcd", "a view has to exist before it gets a place"
    assert names(*named, order, ops.OrderViews(("c",))) == "cdba"
