from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import native_scenes
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.edit import IDENTITY, Filter, Similarity, joined
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings

HALF_TURN = Similarity(np.diag([1.0, -1.0, -1.0]), 1.0, np.zeros(3))


def similarity(seed, s=1.0):
    rng = np.random.default_rng(seed)
    return Similarity(Rotation.random(random_state=seed).as_matrix(), s, rng.normal(size=3))


def image(gaussians, camera, **changes):
    return render(gaussians, camera, settings=RenderSettings(**changes), backend="torch").image


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("s", [0.5, 1.0, 3.0])
def test_moving_scene_and_camera_together_keeps_the_image(degree, s):
    made = native_scenes.random(40)
    scene = Filter(sh_degree=degree).apply(Scene(made.gaussians()))
    move = similarity(degree, s)
    before = image(scene.gaussians, made.camera, jacobian_limit=1.3)
    after = image(move.scene(scene).gaussians, move.camera(made.camera), jacobian_limit=1.3)
    # rounding of some hundred float64 operations on values of order 1
    assert (before - after).abs().max() < 1e-12
    unmoved = image(move.scene(scene).gaussians, made.camera, jacobian_limit=1.3)
    assert (before - unmoved).abs().max() > 1e-2, "without the camera's motion, the image differs"


def test_a_half_turn_equals_the_similarity():
    made = native_scenes.random(40)
    gaussians = made.gaussians()
    turned = half_turned(gaussians)
    before = image(gaussians, made.camera)
    assert (before - image(turned, HALF_TURN.camera(made.camera))).abs().max() < 1e-13
    by_matrix = HALF_TURN.scene(Scene(gaussians)).gaussians
    assert torch.equal(by_matrix.means, turned.means)
    torch.testing.assert_close(by_matrix.sh_rest, turned.sh_rest, rtol=0, atol=1e-13)
    for name, tensor in half_turned(turned).tensors().items():
        assert torch.equal(tensor, gaussians.tensors()[name]), name


def test_similarities_compose():
    scene = Scene(native_scenes.random(20).gaussians(), up=(0.0, -1.0, 0.0))
    first, second = similarity(1, 2.0), similarity(2, 0.3)
    one_by_one, at_once = second.scene(first.scene(scene)), second.after(first).scene(scene)
    for name, tensor in at_once.gaussians.tensors().items():
        torch.testing.assert_close(tensor, one_by_one.gaussians.tensors()[name], rtol=0, atol=1e-12)
    np.testing.assert_allclose(at_once.up, one_by_one.up, atol=1e-14)
    np.testing.assert_allclose(at_once.up, second.R @ first.R @ (0.0, -1.0, 0.0), atol=1e-14)


def test_a_matrix_is_decomposed():
    move = similarity(3, 2.5)
    rows = np.hstack([move.s * move.R, move.t[:, None]])
    for matrix in (rows, np.vstack([rows, (0.0, 0.0, 0.0, 1.0)])):
        found = Similarity.of_matrix(matrix)
        np.testing.assert_allclose(found.R, move.R, atol=1e-14)
        np.testing.assert_allclose(found.t, move.t, atol=0)
        assert found.s == pytest.approx(2.5, abs=1e-14)


@pytest.mark.parametrize(
    ("A", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "mirrors"),
        (np.zeros((3, 3)), "singular"),
        (np.diag([1.0, 1.0, 1.001]), "shears or scales"),
        (np.array([[1.0, 0.01, 0], [0, 1.0, 0], [0, 0, 1.0]]), "shears or scales"),
    ],
)
def test_matrices_that_are_not_similarities_are_refused(A, message):
    with pytest.raises(ArgumentError, match=message):
        Similarity.of_matrix(np.hstack([A, np.zeros((3, 1))]))


def test_a_matrix_of_columns_or_another_shape_is_refused():
    with pytest.raises(ArgumentError, match="give it row by row"):
        Similarity.of_matrix(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 6, 7, 1]]))
    with pytest.raises(ShapeError):
        Similarity.of_matrix(np.eye(3))


def test_filters_keep_the_matching_splats_in_order():
    gaussians = native_scenes.random(200).gaussians(torch.float32)
    assert Filter().apply(Scene(gaussians)).gaussians.means is gaussians.means
    kept = (
        Filter(min_opacity=0.4, box=(-0.5, -0.4, -0.3, 0.5, 0.4, 0.3), sh_degree=1)
        .apply(Scene(gaussians))
        .gaussians
    )
    opacities, means = gaussians.opacities.numpy(), gaussians.means.numpy()
    stays = (opacities >= 0.4) & (np.abs(means) <= (0.5, 0.4, 0.3)).all(axis=1)
    assert 0 < stays.sum() < 200
    np.testing.assert_array_equal(kept.means, means[stays])
    np.testing.assert_array_equal(kept.sh_rest, gaussians.sh_rest[stays, :3])
    assert kept.sh_degree == 1


@pytest.mark.parametrize(
    "wrong", [{"min_opacity": 1.5}, {"sh_degree": 4}, {"box": (0, 0, 0, 1, 1, 0)}, {"box": (0, 0, 0, 1, 1)}]
)
def test_filters_out_of_range_are_refused(wrong):
    with pytest.raises(ArgumentError):
        Filter(**wrong)


def test_joining_keeps_the_order_and_pads_harmonics():
    first = Scene(native_scenes.random(5).gaussians(), True, (0.0, -1.0, 0.0))
    low = Filter(sh_degree=1).apply(Scene(native_scenes.random(7, seed=1).gaussians())).gaussians
    both = joined([first, Scene(low, None, (0.0, -1.0, 0.0))])
    assert len(both.gaussians) == 12 and both.gaussians.sh_degree == 3
    assert both.antialiased is True and both.up == (0.0, -1.0, 0.0)
    assert torch.equal(both.gaussians.means[5:], low.means)
    assert torch.equal(both.gaussians.sh_rest[5:, :3], low.sh_rest)
    assert not both.gaussians.sh_rest[5:, 3:].any()
    assert joined([first, replace(first, up=None)]).up is None
    with pytest.raises(ArgumentError, match="no render suits both"):
        joined([first, replace(first, antialiased=False)])


def test_the_identity_changes_only_rounding():
    scene = Scene(native_scenes.random(9).gaussians(torch.float32))
    moved = IDENTITY.scene(scene).gaussians
    for name, tensor in moved.tensors().items():
        torch.testing.assert_close(tensor, scene.gaussians.tensors()[name], rtol=2e-7, atol=0)
