"""Cameras of another class, like one that a chapter defines, whose members are lists and NumPy scalars."""

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError, Camera, CameraLike, ShapeError, project_cov3d, render_gaussians
from gsplat_edu.render.api import render
from gsplat_edu.render.cpu.render import render_covariances
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch.render import render_t
from gsplat_edu.scene.gaussians import Gaussians

pytestmark = pytest.mark.usefixtures("as_shipped")  # otherwise the hook checks annotations first

OURS = Camera(
    [[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]], (0.1, -0.05, -3.0), 50.0, 45.5, 20.25, 16.75, 35, 41
)


class ChapterCamera:
    """A camera class as a chapter defines it."""

    def __init__(self):
        self.R, self.eye = OURS.R.tolist(), OURS.eye.tolist()
        self.fx, self.fy = np.float32(50.0), np.float64(45.5)
        self.cx, self.cy = 20.25, np.float32(16.75)
        self.H, self.W = np.int64(35), np.int32(41)

    def world_to_cam(self, points):
        return (points - np.array(self.eye)) @ np.array(self.R).T

    def project(self, points):
        x, y, z = np.moveaxis(points, -1, 0)
        return self.fx * x / z + self.cx, self.fy * y / z + self.cy, z


def splats(seed=0, n=12):
    rng = np.random.default_rng(seed)
    roots = 0.15 * rng.normal(size=(n, 3, 3))
    means = rng.uniform(-0.8, 0.8, (n, 3)) + np.array([1.5, 0, 0])
    return means, roots @ roots.swapaxes(1, 2), rng.uniform(0, 1, (n, 3)), rng.uniform(0.1, 0.9, n)


@pytest.mark.parametrize("limit", [None, 1.3])
def test_the_oracle_renders_the_same(limit):
    expected = render_gaussians(OURS, *splats(), jacobian_limit=limit)
    found = render_gaussians(ChapterCamera(), *splats(), jacobian_limit=limit)
    assert expected[1].min() < 0.9, "the scene is visible"
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_covariance_is_projected_the_same():
    means, covs, _, _ = splats()
    arguments = covs, OURS.world_to_cam(means)
    for limit in (None, 1.3):
        np.testing.assert_array_equal(
            project_cov3d(*arguments, ChapterCamera(), jacobian_limit=limit),
            project_cov3d(*arguments, OURS, jacobian_limit=limit),
        )


def test_the_dense_renderer_renders_the_same():
    tensors = [torch.tensor(array) for array in splats()]
    assert torch.equal(render_t(*tensors, ChapterCamera()).image, render_t(*tensors, OURS).image)


def test_the_native_renderer_of_covariances_renders_the_same():
    tensors = [torch.tensor(array) for array in splats()]
    expected = render_covariances(*tensors, OURS).image
    assert torch.equal(render_covariances(*tensors, ChapterCamera()).image, expected)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_the_backends_render_the_same(backend):
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    gaussians = Gaussians(
        means=draw(9, 3) / 2 + torch.tensor([1.5, 0, 0]),
        quats=draw(9, 4),
        log_scales=draw(9, 3) - 2,
        sh0=draw(9, 1, 3),
        sh_rest=draw(9, 3, 3),
        logit_opacities=draw(9),
    )
    # settings accept NumPy scalars as well
    plain = RenderSettings(sh_degree=1, antialiased=True, jacobian_limit=1.3)
    numpy = RenderSettings(sh_degree=np.int64(1), antialiased=np.True_, jacobian_limit=np.float64(1.3))
    assert numpy == plain and hash(numpy) == hash(plain)
    expected = render(gaussians, OURS, settings=plain, backend=backend).image
    assert torch.equal(render(gaussians, ChapterCamera(), settings=numpy, backend=backend).image, expected)
    several = render(gaussians, [OURS, ChapterCamera()], settings=plain, backend=backend)
    assert torch.equal(several.image[1], expected)


def test_both_classes_are_accepted_as_cameras():
    assert isinstance(OURS, CameraLike)
    assert isinstance(ChapterCamera(), CameraLike)


@pytest.mark.parametrize("missing", ["R", "eye", "fx", "fy", "cx", "cy", "H", "W"])
def test_a_missing_member_is_named(missing):
    camera = ChapterCamera()
    delattr(camera, missing)
    tensors = [torch.tensor(array) for array in splats()]
    for call in (
        lambda: render_gaussians(camera, *splats()),
        lambda: project_cov3d(np.eye(3), (0, 0, 1), camera),
        lambda: render_t(*tensors, camera),
    ):
        with pytest.raises(ArgumentError, match=f"^cam: .*ChapterCamera has no {missing};"):
            call()


@pytest.mark.parametrize(
    ("member", "value", "error"),
    [
        ("fx", -1.0, ArgumentError),
        ("eye", [0, 0], ShapeError),
        ("H", 3.5, ArgumentError),
        ("R", 1.0, ShapeError),
    ],
)
def test_an_invalid_member_is_named(member, value, error):
    camera = ChapterCamera()
    setattr(camera, member, value)
    with pytest.raises(error, match=rf"^cam\.{member}: "):
        render_gaussians(camera, *splats())
