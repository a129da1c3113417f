"""The Python interface: wrong use raises an error that names the argument, before any computation."""

import numpy as np
import pytest
import torch

from gsplat_edu import Camera, Gaussians, ShapeError, load_backend, recipe, render, training, write_scene
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.views import View
from gsplat_edu.train import Start, Views
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.objective import Objective, PhotoTerm

CAMERA = Camera.looking_at((0, 0, -3), (0, 0, 0), 30, 30, 20, 24)


def ball(count=30):
    return random_ball(count, torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def views():
    image = np.full((20, 24, 3), 99, dtype=np.uint8)
    return [View(CAMERA, image, name="a")]


def test_the_repr_of_a_scene_is_one_line():
    assert repr(ball(1_234)) == "Gaussians(1,234, SH degree 0, float32 on cpu)"
    assert repr(Scene(ball(3))).count("\n") == 0


@pytest.mark.parametrize(
    "index",
    [
        torch.arange(30) < 5,
        np.arange(30) < 5,
        [True] * 5 + [False] * 25,
        slice(0, 5),
        range(5),
        [0, 1, 2, 3, -26],
        torch.arange(5),
    ],
    ids=["mask", "NumPy mask", "list mask", "slice", "range", "list", "indices"],
)
def test_gaussians_are_indexed_by_masks_and_indices(index):
    scene = ball()
    some = scene[index]
    assert isinstance(some, Gaussians)
    for name, tensor in some.tensors().items():
        assert torch.equal(tensor, scene.tensors()[name][:5]), name
    assert len(scene[[]]) == 0


@pytest.mark.parametrize(
    "index", [3, "all", torch.ones(29, dtype=torch.bool), [30], [-31], torch.ones(30), [[1]]]
)
def test_other_indices_are_refused(index):
    with pytest.raises(ArgumentError, match="^index: "):
        ball()[index]


def test_a_camera_from_matrices():
    camera = Camera.from_viewmat(
        torch.tensor(CAMERA.viewmat), CAMERA.intrinsics.K.tolist(), CAMERA.W, CAMERA.H, first_pixel=0
    )
    np.testing.assert_allclose(camera.eye, CAMERA.eye, atol=1e-12)
    np.testing.assert_allclose(camera.R, CAMERA.R)
    assert camera.intrinsics == CAMERA.intrinsics
    shifted = CAMERA.intrinsics.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    other = Camera.from_viewmat(CAMERA.viewmat, shifted, CAMERA.W, CAMERA.H, first_pixel=0.5)
    assert other.intrinsics == CAMERA.intrinsics


@pytest.mark.parametrize(
    ("viewmat", "K", "names"),
    [
        (CAMERA.viewmat.T, CAMERA.intrinsics.K, "viewmat"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), CAMERA.intrinsics.K, "viewmat"),
        (2 * np.eye(4) - np.diag([0, 0, 0, 1.0]), CAMERA.intrinsics.K, "viewmat"),
        (np.eye(3), CAMERA.intrinsics.K, "viewmat"),
        (CAMERA.viewmat, CAMERA.intrinsics.K + np.eye(3, k=1), "K"),
        (CAMERA.viewmat, np.eye(4), "K"),
    ],
)
def test_matrices_that_are_no_camera_are_refused(viewmat, K, names):
    with pytest.raises((ArgumentError, ShapeError), match=f"^{names}: "):
        Camera.from_viewmat(viewmat, K, 24, 20, first_pixel=0.0)


def test_the_callers_of_from_viewmat_say_where_the_first_pixel_is():
    """A K of gsplat or COLMAP, whose first pixel's centre is (0.5, 0.5), maps the same ray to its pixel plus a half."""
    with pytest.raises(TypeError, match="first_pixel"):
        Camera.from_viewmat(np.eye(4), np.diag([20.0, 20.0, 1.0]), 24, 20)
    K = np.array([[20.0, 0, 12.0], [0, 20.0, 10.0], [0, 0, 1]])
    ours, theirs = (Camera.from_viewmat(np.eye(4), K, 24, 20, first_pixel=first) for first in (0.0, 0.5))
    u, v, _ = ours.project(np.array([[0.1, -0.2, 1.0]]))
    expected = K[:2, :2] @ (0.1, -0.2) + K[:2, 2]
    np.testing.assert_allclose((u[0], v[0]), expected, atol=1e-12)
    u, v, _ = theirs.project(np.array([[0.1, -0.2, 1.0]]))
    np.testing.assert_allclose((u[0] + 0.5, v[0] + 0.5), expected, atol=1e-12)


def test_backgrounds_and_features_are_numbers_arrays_or_tensors():
    scene, features = ball(), np.random.default_rng(0).uniform(size=(30, 2))
    outputs = [
        render(scene, CAMERA, background=background, features=values)
        for background, values in (
            ((0.1, 0.2, 0.3), features.tolist()),
            (np.array([0.1, 0.2, 0.3]), features),
            (torch.tensor([0.1, 0.2, 0.3]), torch.tensor(features).float()),
        )
    ]
    for output in outputs[1:]:
        assert torch.equal(output.image, outputs[0].image)
        assert torch.equal(output.features, outputs[0].features)


def test_bare_gaussians_are_written(tmp_path):
    write_scene(tmp_path / "a.ply", ball().trainable())
    write_scene(tmp_path / "b.ply", Scene(ball()))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


class HalfAStrategy:
    def observe(self, gaussians, output):
        pass


class Depth:
    def __call__(self, rendered):
        return rendered.output.depth.mean()


CONFIG = recipe(2, strategy="none")


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda views: render(ball(), CAMERA, background=(1, 1)), "^background: "),
        (lambda views: render((1, 2), CAMERA), "^gaussians: "),
        (lambda views: write_scene("x.ply", (1, 2)), "^scene: .* Scene"),
        (lambda views: training(CONFIG, views, load_backend()), "^dataset: .* lacks colors, points, train"),
        (
            lambda views: training(CONFIG, Views(views), "cpu", Start(ball())),
            "^backend: is 'cpu', .*load_backend",
        ),
        (lambda views: training({}, Views(views), load_backend()), "^config: .* TrainConfig"),
        (lambda views: training(CONFIG, Views([]), load_backend()), "^dataset: has no training views"),
        (lambda views: training(CONFIG, Views(views), load_backend()), "^points: is empty"),
        (
            lambda views: training(
                recipe(2), Views(views), load_backend(), Start(ball()), density=HalfAStrategy()
            ),
            "^parts.density: .* lacks load_state, state, update; see DensityStrategy",
        ),
        (
            lambda views: training(CONFIG, Views(views), load_backend(), Start(ball()), view_model=object()),
            "^parts.view_model: .* lacks camera, correct, groups, measure, needs, parameters",
        ),
        (
            lambda views: training(
                CONFIG,
                Views(views),
                load_backend(),
                Start(ball()),
                objective=Objective({"photo": PhotoTerm(0.0), "depth": Depth()}),
            ).run(),
            r"^terms\['depth'\]: reads output.depth, .* needs = Needs\(depth=True\)",
        ),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_wrong_use_names_the_argument(views, use, message):
    with pytest.raises((ArgumentError, ShapeError), match=message):
        use(views)
