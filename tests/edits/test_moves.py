"""Moved splats: means by the written order, and a picture that moves with them."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import native_scenes
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.apply import SELECTED, edited, flags_after
from gsplat_edu.io.edit import Filter, Similarity
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from js.random_edits import gaussians_at, parsed, random_moves, witness

ALL = ops.Select("replace", ops.Everything())


def move(vector, translation, center):
    rows = tuple(tuple(row) for row in Rotation.from_rotvec(vector).as_matrix().tolist())
    return ops.Move(rows, tuple(translation), tuple(center))


MOVE = move((0.5, -1.2, 0.8), (0.3, -0.2, 0.1), (0.2, 0.4, -0.3))


def scene_of(degree, n=40):
    return Filter(sh_degree=degree).apply(Scene(native_scenes.random(n).gaussians()))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_moved_scene_looks_the_same_to_a_view_that_moves_along(degree):
    """All splats move rigidly, so a camera moved the same way sees the same picture, harmonics included."""
    scene = scene_of(degree)
    R, t, c = (np.array(x) for x in (MOVE.rotation, MOVE.translation, MOVE.center))
    rigid = Similarity(R, 1.0, c + t - R @ c)
    eye = np.array((0.3, -0.4, -3.0))
    camera = Camera(look_at(eye, np.zeros(3)), eye, 40.0, 40.0, 23.5, 15.5, 32, 48)

    def image(gaussians, camera):
        return render(gaussians, camera, settings=RenderSettings(), backend="torch").image

    before = image(scene.gaussians, camera)
    there = edited(scene, [ALL, MOVE]).gaussians
    # the means are rounded to float32
    assert (before - image(there, rigid.camera(camera))).abs().max() < 1e-5
    assert (before - image(there, camera)).abs().max() > 1e-2


def test_only_selected_splats_move_and_later_selections_find_them_there():
    gaussians = scene_of(3).gaussians
    means = gaussians.means.double().numpy()
    center = tuple(means[5].tolist())
    near = ops.Select("replace", ops.Sphere(center, 0.5))
    away = move((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    chosen = flags_after([near], gaussians) == SELECTED
    assert 0 < chosen.sum() < len(gaussians)
    result = edited(Scene(gaussians), [near, away, ops.Deselect()]).gaussians
    for name in ("means", "quats", "sh_rest"):
        assert torch.equal(result.tensors()[name][~chosen], gaussians.tensors()[name][~chosen]), name
    np.testing.assert_allclose(result.means[chosen], means[chosen] + (100.0, 0.0, 0.0), rtol=1e-6)
    there = ops.Select("replace", ops.Sphere((center[0] + 100.0, center[1], center[2]), 0.6))
    assert not (flags_after([there], gaussians) == SELECTED).any()
    np.testing.assert_array_equal(flags_after([near, away, there], gaussians) == SELECTED, chosen)
    assert len(edited(Scene(gaussians), [near, away, there, ops.Delete()]).gaussians) == (~chosen).sum()


def test_a_move_of_nothing_is_the_same_object_and_the_opened_scene_never_changes():
    scene = scene_of(1)
    copies = {name: tensor.clone() for name, tensor in scene.gaussians.tensors().items()}
    assert edited(scene, [ops.Deselect(), MOVE]) is scene
    edited(scene, [ALL, MOVE, MOVE])
    for name, tensor in scene.gaussians.tensors().items():
        assert torch.equal(tensor, copies[name]), name


def test_infinite_and_missing_centres_move_without_a_warning():
    gaussians = scene_of(0, 4).gaussians
    gaussians.means[0, 0], gaussians.means[1, 1] = float("nan"), float("inf")
    far = move((0.0, 0.0, 0.7), (1e30, 0.0, 0.0), (0.0, 0.0, 0.0))
    result = edited(Scene(gaussians), [ALL, far]).gaussians
    assert torch.isnan(result.means[0, 0]) and torch.isfinite(result.means[2:]).all()


@pytest.mark.parametrize("case", range(3))
def test_random_operations_agree_with_a_witness_on_every_bit(case):
    """The page's JavaScript agrees with the same witness: tests/js/edits.test.js."""
    means, cases = random_moves()
    flags, after = witness(cases[case], means)
    operations = parsed(cases[case], len(means)).operations
    np.testing.assert_array_equal(flags_after(operations, gaussians_at(means)), flags)
    left = edited(Scene(gaussians_at(means)), operations).gaussians
    np.testing.assert_array_equal(left.means.double().numpy(), after[flags <= SELECTED])
    assert np.abs(after - means).max() > 0.1 and (flags <= SELECTED).any()
