"""Degenerate input to a public function gives the documented result, or an error that names the argument."""

import inspect
import re

import numpy as np
import pytest
import torch

import gsplat_edu
from gsplat_edu import (
    ArgumentError,
    Camera,
    ShapeError,
    build_cov3d,
    build_cov3d_batch,
    eval_sh,
    look_at,
    orbit_camera,
    project_cov3d,
    quat_to_R,
    quat_to_R_batch,
    render_gaussians,
    sh_basis,
    sphere_shell,
)
from gsplat_edu.io.ply import save_ply
from gsplat_edu.ops.losses import l1
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch.render import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t, quat_to_R_t

pytestmark = pytest.mark.usefixtures("as_shipped")

I3 = np.eye(3)
CAM = Camera(I3, (0, 0, 0), 10, 10, 4, 4, 8, 9)
SPLAT = ([[0, 0, 1.0]], [I3 * 0.1], [[1, 1, 1]], [0.5])
NAN, INF = float("nan"), float("inf")


def splat(**changes):
    arguments = dict(zip(("means", "cov3ds", "colors", "opacities"), SPLAT, strict=True)) | changes
    return {"cam": CAM} | arguments


def camera(**changes):
    return {"R": I3, "eye": (0, 0, 0), "fx": 1, "fy": 1, "cx": 0, "cy": 0, "H": 2, "W": 2} | changes


# function, arguments, error, and the argument that the error names
REJECTED = [
    (look_at, {"eye": (0, 0), "target": (0, 0, 1)}, ShapeError, "eye"),
    (look_at, {"eye": (0, 0, 1), "target": (0, 0, 1)}, ArgumentError, "target"),
    (look_at, {"eye": (0, 0, NAN), "target": (0, 0, 1)}, ArgumentError, "eye[2]"),
    (look_at, {"eye": (0, -1, 0), "target": (0, 1, 0)}, ArgumentError, "up"),
    (look_at, {"eye": (0, 0, 0), "target": (0, 0, 1), "up": (0, 0, 0)}, ArgumentError, "up"),
    (look_at, {"eye": "here", "target": (0, 0, 1)}, ArgumentError, "eye"),
    (look_at, {"eye": torch.ones(3, requires_grad=True), "target": (0, 0, 1)}, ArgumentError, "eye"),
    (look_at, {"eye": [(0, 0), (1,)], "target": (0, 0, 1)}, ArgumentError, "eye"),
    (orbit_camera, {"azimuth": NAN, "elevation": 0, "size": 8, "fx": 1}, ArgumentError, "azimuth"),
    (orbit_camera, {"azimuth": 0, "elevation": INF, "size": 8, "fx": 1}, ArgumentError, "elevation"),
    (orbit_camera, {"azimuth": 0, "elevation": 0, "size": 0, "fx": 1}, ArgumentError, "H"),
    (orbit_camera, {"azimuth": 0, "elevation": 0, "size": 8, "fx": 0}, ArgumentError, "fx"),
    (orbit_camera, {"azimuth": 0, "elevation": 0, "size": 8, "fx": 1, "radius": 0}, ArgumentError, "radius"),
    (Camera, camera(R=np.eye(4)), ShapeError, "R"),
    (Camera, camera(R=2 * I3), ArgumentError, "R"),
    (Camera, camera(R=I3 + 1e-3), ArgumentError, "R"),
    (Camera, camera(H=8.0), ArgumentError, "H"),
    (Camera, camera(R=np.diag([1, 1, -1])), ArgumentError, "R"),
    (Camera, camera(R=np.full((3, 3), NAN)), ArgumentError, "R[0, 0]"),
    (Camera, camera(eye=(0, 0, 0, 1)), ShapeError, "eye"),
    (Camera, camera(fx=-1), ArgumentError, "fx"),
    (Camera, camera(fy=0), ArgumentError, "fy"),
    (Camera, camera(fx=NAN), ArgumentError, "fx"),
    (Camera, camera(cx=INF), ArgumentError, "cx"),
    (Camera, camera(cy=(1, 2)), ShapeError, "cy"),
    (Camera, camera(H=0), ArgumentError, "H"),
    (Camera, camera(W=2.5), ArgumentError, "W"),
    (Camera, camera(W=True), ArgumentError, "W"),
    (CAM.world_to_cam, {"points": (1, 2)}, ShapeError, "points"),
    (CAM.world_to_cam, {"points": 1.0}, ShapeError, "points"),
    (CAM.world_to_cam, {"points": [(1, 2, INF)]}, ArgumentError, "points[0, 2]"),
    (CAM.project, {"points_cam": np.zeros((3, 2))}, ShapeError, "points_cam"),
    (CAM.project, {"points_cam": (NAN, 0, 1)}, ArgumentError, "points_cam[0]"),
    (quat_to_R, {"quat": (0, 0, 0, 0)}, ArgumentError, "quat"),
    (quat_to_R, {"quat": (1, 0, 0)}, ShapeError, "quat"),
    (quat_to_R, {"quat": (1, 0, 0, NAN)}, ArgumentError, "quat[3]"),
    (quat_to_R_batch, {"quats": (1, 0, 0, 0)}, ShapeError, "quats"),
    (quat_to_R_batch, {"quats": [(1, 0, 0, 0), (0, 0, 0, 0)]}, ArgumentError, "quats[1]"),
    (build_cov3d, {"scale": (1, -1, 1), "R": I3}, ArgumentError, "scale[1]"),
    (build_cov3d, {"scale": (1, 1), "R": I3}, ShapeError, "scale"),
    (build_cov3d, {"scale": (1, 1, 1), "R": np.eye(2)}, ShapeError, "R"),
    (build_cov3d, {"scale": (1, 1, NAN), "R": I3}, ArgumentError, "scale[2]"),
    (build_cov3d_batch, {"scales": [(1, 1, -2)], "Rs": [I3]}, ArgumentError, "scales[0, 2]"),
    (build_cov3d_batch, {"scales": [(1, 1, 1)], "Rs": [I3, I3]}, ShapeError, "Rs"),
    (build_cov3d_batch, {"scales": (1, 1, 1), "Rs": I3}, ShapeError, "scales"),
    (project_cov3d, {"cov3d": I3, "mean_cam": (0, 0, 0), "cam": CAM}, ArgumentError, "mean_cam"),
    (project_cov3d, {"cov3d": I3, "mean_cam": (0, 0, -1), "cam": CAM}, ArgumentError, "mean_cam"),
    (project_cov3d, {"cov3d": I3, "mean_cam": (0, 1), "cam": CAM}, ShapeError, "mean_cam"),
    (project_cov3d, {"cov3d": [I3], "mean_cam": (0, 0, 1), "cam": CAM}, ShapeError, "mean_cam"),
    (project_cov3d, {"cov3d": (1, 2, 3), "mean_cam": (0, 0, 1), "cam": CAM}, ShapeError, "cov3d"),
    (render_gaussians, splat(means=[[0, 0]]), ShapeError, "means"),
    (render_gaussians, splat(means=[[0, 0, NAN]]), ArgumentError, "means[0, 2]"),
    (render_gaussians, splat(cov3ds=I3), ShapeError, "cov3ds"),
    (render_gaussians, splat(cov3ds=[I3, I3]), ShapeError, "cov3ds"),
    (render_gaussians, splat(cov3ds=[-I3]), ArgumentError, "cov3ds[0]"),
    (render_gaussians, splat(cov3ds=[-0.001 * I3]), ArgumentError, "cov3ds[0]"),
    (render_gaussians, splat(cov3ds=[np.diag([1, 1, -9])]), ArgumentError, "cov3ds[0]"),
    (render_gaussians, splat(cov3ds=[I3 + np.eye(3, k=1) / 2]), ArgumentError, "cov3ds[0]"),
    (render_gaussians, splat(means=[[0, 1j, 1]]), ArgumentError, "means"),
    (render_gaussians, splat(colors=[1, 1, 1]), ShapeError, "colors"),
    (render_gaussians, splat(colors=[[1, INF, 1]]), ArgumentError, "colors[0, 1]"),
    (render_gaussians, splat(opacities=[[0.5]]), ShapeError, "opacities"),
    (render_gaussians, splat(opacities=[1.5]), ArgumentError, "opacities[0]"),
    (render_gaussians, splat(opacities=[-0.1]), ArgumentError, "opacities[0]"),
    (render_gaussians, splat(bg=(0, 0)), ShapeError, "bg"),
    (render_gaussians, splat(bg=(0, 0, NAN)), ArgumentError, "bg[2]"),
    (render_gaussians, splat(z_near=-1), ArgumentError, "z_near"),
    (render_gaussians, splat(extent="3sigma"), ArgumentError, "extent"),
    (render_gaussians, splat(stop="pixel"), ArgumentError, "stop"),
    (sphere_shell, {"n": -1}, ArgumentError, "n"),
    (sphere_shell, {"n": 2.5}, ArgumentError, "n"),
    (sphere_shell, {"s_t": -0.1}, ArgumentError, "s_t"),
    (sphere_shell, {"s_n": NAN}, ArgumentError, "s_n"),
    (sphere_shell, {"opacity": 1.1}, ArgumentError, "opacity"),
    (sphere_shell, {"seed": -1}, ArgumentError, "seed"),
    (sh_basis, {"dirs": (0, 0, 0)}, ArgumentError, "dirs"),
    (sh_basis, {"dirs": [(0, 0, 1), (0, 0, 2)]}, ArgumentError, "dirs[1]"),
    (sh_basis, {"dirs": (0, 1)}, ShapeError, "dirs"),
    (sh_basis, {"dirs": (0, NAN, 1)}, ArgumentError, "dirs[1]"),
    (eval_sh, {"degree": 4, "sh": np.zeros((1, 16, 3)), "dirs": [(0, 0, 1)]}, ArgumentError, "degree"),
    (eval_sh, {"degree": 2.0, "sh": np.zeros((1, 16, 3)), "dirs": [(0, 0, 1)]}, ArgumentError, "degree"),
    (eval_sh, {"degree": True, "sh": np.zeros((1, 16, 3)), "dirs": [(0, 0, 1)]}, ArgumentError, "degree"),
    (eval_sh, {"degree": -1, "sh": np.zeros((1, 16, 3)), "dirs": [(0, 0, 1)]}, ArgumentError, "degree"),
    (eval_sh, {"degree": 2, "sh": np.zeros((1, 4, 3)), "dirs": [(0, 0, 1)]}, ShapeError, "sh"),
    (eval_sh, {"degree": 0, "sh": np.zeros((2, 1, 3)), "dirs": [(0, 0, 1)]}, ShapeError, "dirs"),
    (
        eval_sh,
        {"degree": 0, "sh": np.full((1, 1, 3), NAN), "dirs": [(0, 0, 1)]},
        ArgumentError,
        "sh[0, 0, 0]",
    ),
]


@pytest.mark.parametrize(("function", "arguments", "error", "names"), REJECTED)
def test_bad_arguments_are_rejected_by_name(function, arguments, error, names):
    with pytest.raises(error) as caught:
        function(**arguments)
    assert str(caught.value).startswith(f"{names}:")
    assert "\n" not in str(caught.value)


def test_every_public_function_is_covered():
    functions = {
        name
        for name in set(gsplat_edu.__all__) - set(gsplat_edu.LAZY)  # tests/test_library.py tests those
        if inspect.isfunction(getattr(gsplat_edu, name)) or name == "Camera"
    }
    assert functions <= {function.__name__ for function, *_ in REJECTED}


def test_empty_input():
    empty = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0)
    image, T = render_gaussians(CAM, *empty, bg=(0.1, 0.2, 0.3))
    assert image.shape == (8, 9, 3) and (image == (0.1, 0.2, 0.3)).all() and (T == 1).all()
    assert quat_to_R_batch(np.zeros((0, 4))).shape == (0, 3, 3)
    assert build_cov3d_batch(np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0, 3, 3)
    assert project_cov3d(np.zeros((0, 3, 3)), np.zeros((0, 3)), CAM).shape == (0, 2, 2)
    assert sh_basis(np.zeros((0, 3))).shape == (0, 16)
    assert eval_sh(3, np.zeros((0, 16, 3)), np.zeros((0, 3))).shape == (0, 3)
    assert [a.shape for a in sphere_shell(n=0)] == [(0, 3), (0, 3, 3), (0, 3), (0,)]
    assert CAM.world_to_cam(np.zeros((0, 3))).shape == (0, 3)
    assert [a.shape for a in CAM.project(np.zeros((0, 3)))] == [(0,)] * 3


def test_a_single_element():
    image, T = render_gaussians(CAM, *SPLAT)
    assert T.min() < 0.6 and image.max() > 0.4
    assert [len(a) for a in sphere_shell(n=1)] == [1, 1, 1, 1]
    assert quat_to_R_batch([(1, 0, 0, 0)]).shape == (1, 3, 3)


def test_a_gaussian_behind_the_camera_is_not_drawn():
    image, T = render_gaussians(**splat(means=[[0, 0, -1.0]]))
    assert (image == 0).all() and (T == 1).all()
    u, v, z = CAM.project((0, 0, -1))
    assert np.isnan(u) and np.isnan(v) and z == -1


def test_a_gaussian_without_extent_is_drawn():
    assert (build_cov3d((0, 0, 0), I3) == 0).all()
    _, T = render_gaussians(**splat(cov3ds=[np.zeros((3, 3))]))
    assert T[4, 4] == 0.5, "only the dilation remains"


def test_a_gaussian_far_outside_the_image_does_not_overflow():
    for x in (1e3, 1e30, -1e30):
        _, T = render_gaussians(**splat(means=[[x, 0, 1.0]], cov3ds=[np.zeros((3, 3))]))
        assert (T == 1).all()


FIRST = {"means": [[0, 0, 1.0]] * 2, "colors": np.ones((2, 3)), "opacities": [0.5, 0.5]}


@pytest.mark.parametrize("length", [1e12, 1e20, 1e60, 1e200, 1e300])
def test_a_covariance_beyond_float64_is_named(length):
    """NumPy's LinAlgError would name neither the Gaussian nor the cause."""
    along = np.array([0.6, 0.8, 0.0])
    needle = length * np.outer(along, along)
    with pytest.raises(ArgumentError, match=r"cov3ds\[1\]: "):
        render_gaussians(**splat(**FIRST, cov3ds=[I3, needle]))


def test_a_position_beyond_float64_is_named():
    with pytest.raises(ArgumentError, match=r"means\[1\], cov3ds\[1\]: "):
        render_gaussians(**splat(**FIRST | {"means": [[0, 0, 1.0], [1e200, 0, 1.0]]}, cov3ds=[I3, I3]))
    far = Camera(I3, (0, 0, -1.7e308), 10.0, 10.0, 4.0, 4.0, 8, 9)
    with pytest.raises(ArgumentError, match=r"means\[1\]: is too far"):
        render_gaussians(
            **splat(**FIRST | {"means": [[0, 0, 1.0], [0, 0, 1.7e308]]}, cov3ds=[I3, I3], cam=far)
        )


def test_extreme_scenes_raise_no_numpy_error():
    """Each of 300 scenes, with scales over 40 decades, gives an image or an ArgumentError that names the Gaussian."""
    refused = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        scales, quats = 10 ** rng.uniform(-20, 20, (4, 3)), rng.normal(size=(4, 4))
        scene = {
            "means": rng.normal(size=(4, 3)) * 10 ** rng.uniform(-3, 3, (4, 1)),
            "cov3ds": build_cov3d_batch(scales, quat_to_R_batch(quats)),
            "colors": rng.uniform(size=(4, 3)),
            "opacities": rng.uniform(size=4),
        }
        try:
            image, _ = render_gaussians(**splat(**scene), extent="exact")
        except ArgumentError as error:
            assert re.search(r"(means|cov3ds)\[[0-3]\]", str(error))
            refused += 1
        else:
            assert np.isfinite(image).all()
    assert 0 < refused < 300


def test_a_gaussian_wider_than_the_image_covers_it():
    _, T = render_gaussians(**splat(cov3ds=[I3 * 1e6]))
    np.testing.assert_allclose(T, 0.5, rtol=1e-4)  # exponent at the corner: 20 px² / (2 x 1e8 px²) = 1e-7


# functions of torch tensors

DIRS = torch.ones(1, 3)
T1 = {
    "means": torch.tensor([[0.0, 0, 1]]),
    "cov3ds": 0.1 * torch.eye(3)[None],
    "colors": torch.ones(1, 3),
    "opacities": torch.tensor([0.5]),
}
REJECTED_TENSORS = [
    (quat_to_R_t, {"quats": torch.zeros(1, 4)}, ArgumentError, "quats[0]"),
    (quat_to_R_t, {"quats": torch.zeros(4)}, ShapeError, "quats"),
    (quat_to_R_t, {"quats": torch.full((1, 4), NAN)}, ArgumentError, "quats[0, 0]"),
    (cov3d_t, {"log_scales": torch.zeros(2, 3), "quats": torch.ones(1, 4)}, ShapeError, "quats"),
    (
        cov3d_t,
        {"log_scales": torch.full((1, 3), INF), "quats": torch.ones(1, 4)},
        ArgumentError,
        "log_scales[0, 0]",
    ),
    (
        eval_sh_t,
        {"degree": 4, "sh": torch.zeros(1, 16, 3), "dirs": DIRS},
        ArgumentError,
        "degree",
    ),
    (eval_sh_t, {"degree": 1, "sh": torch.zeros(1, 1, 3), "dirs": DIRS}, ShapeError, "sh"),
    (eval_sh_t, {"degree": 0, "sh": torch.zeros(1, 1, 3), "dirs": torch.ones(2, 3)}, ShapeError, "dirs"),
    (render_t, T1 | {"cam": CAM, "means": torch.zeros(1, 2)}, ShapeError, "means"),
    (render_t, T1 | {"cam": CAM, "cov3ds": torch.zeros(2, 3, 3)}, ShapeError, "cov3ds"),
    (render_t, T1 | {"cam": CAM, "colors": torch.full((1, 3), NAN)}, ArgumentError, "colors[0, 0]"),
    (render_t, T1 | {"cam": CAM, "opacities": torch.ones(1, 1)}, ShapeError, "opacities"),
    (render_t, T1 | {"cam": CAM, "opacities": torch.tensor([-5.0])}, ArgumentError, "opacities[0]"),
    (render_t, T1 | {"cam": CAM, "alpha_min": -1.0}, ArgumentError, "alpha_min"),
    (render_t, T1 | {"cam": CAM, "chunk": 0}, ArgumentError, "chunk"),
    (RenderSettings, {"sh_degree": 9}, ArgumentError, "sh_degree"),
    (RenderSettings, {"background": (0, 0)}, ShapeError, "background"),
    (RenderSettings, {"sh_degree": -1}, ArgumentError, "sh_degree"),
]


@pytest.mark.parametrize(("function", "arguments", "error", "names"), REJECTED_TENSORS)
def test_bad_tensors_are_rejected_by_name(function, arguments, error, names):
    with pytest.raises(error) as caught:
        function(**arguments)
    assert str(caught.value).startswith(f"{names}:")


def gaussians(n, **changes):
    tensors = {
        "means": torch.zeros(n, 3),
        "quats": torch.ones(n, 4),
        "log_scales": torch.zeros(n, 3),
        "sh0": torch.zeros(n, 1, 3),
        "sh_rest": torch.zeros(n, 15, 3),
        "logit_opacities": torch.zeros(n),
    }
    return Gaussians(**tensors | changes)


@pytest.mark.parametrize(
    ("name", "shape"), [("quats", (2, 3)), ("sh0", (2, 3)), ("sh_rest", (2, 5, 3)), ("logit_opacities", (3,))]
)
def test_gaussians_of_inconsistent_shapes_are_refused(name, shape):
    with pytest.raises(ShapeError, match=f"^{name}: "):
        gaussians(2, **{name: torch.zeros(shape)})


@pytest.mark.parametrize("case", ["empty", "culled"])
def test_nothing_visible_gives_the_background_and_zero_gradients(case):
    scene = gaussians(0 if case == "empty" else 3).trainable()  # means at the camera
    out = render(scene, CAM, settings=RenderSettings(background=(0.1, 0.2, 0.3)))
    torch.testing.assert_close(out.image, torch.tensor([0.1, 0.2, 0.3]).expand(8, 9, 3))
    assert (out.transmittance == 1).all() and len(out.visible) == 0
    out.image.sum().backward()
    for name in ("means", "quats", "log_scales", "sh0", "logit_opacities"):
        assert (scene.tensors()[name].grad == 0).all(), name
    assert out.means2d_grad_norms().shape == (0,)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"quats": np.ones((2, 4), np.float32)}, "quats"),
        ({"sh0": torch.zeros(2, 1, 3, dtype=torch.float64)}, "sh0"),
        ({"logit_opacities": torch.zeros(2, dtype=torch.int64)}, "logit_opacities"),
    ],
)
def test_gaussians_of_wrong_types_are_refused(changes, names):
    with pytest.raises(ArgumentError, match=f"^{names}: "):
        gaussians(2, **changes)


def test_the_length_and_sign_of_a_quaternion_do_not_matter():
    expected = quat_to_R_t(torch.tensor([[1.0, 1, 0, 0]]))
    for factor in (1e20, 1e-30, -1.0):
        torch.testing.assert_close(quat_to_R_t(factor * torch.tensor([[1.0, 1, 0, 0]])), expected)


def test_a_needle_is_drawn():
    """The 2D determinant has cancellation, but the covariance is symmetric and positive semi-definite."""
    direction = np.array([0.6, 0.8, 0.0])
    _, T = render_gaussians(**splat(cov3ds=[1e4 * np.outer(direction, direction)]))
    assert T.min() < 0.6


def test_losses_and_scene_files_refuse_bad_input(tmp_path):
    with pytest.raises(ShapeError, match="^target: "):
        l1(torch.zeros(2, 2, 3), torch.zeros(1, 1, 3))
    bad = gaussians(2, log_scales=torch.full((2, 3), NAN))
    with pytest.raises(ArgumentError, match=r"^log_scales\[0, 0\]"):
        save_ply(tmp_path / "x.ply", bad)
    assert list(tmp_path.iterdir()) == []


def test_gradient_norms_before_backward_are_refused():
    out = render(gaussians(1, means=torch.tensor([[0.0, 0, 2]])).trainable(), CAM)
    with pytest.raises(ArgumentError, match="backward"):
        out.means2d_grad_norms()
