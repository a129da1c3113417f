"""Lenses and rolling shutters of gsplat's arguments: against its functions in torch, and against our references.

gsplat's torch functions have ortho and fisheye without distortion. Distortion and shutter exist in its CUDA kernels
only; their formulas are compared as formulas, and whole images with `gsplat_edu.render.api.render` through a `Camera`.
"""

import math
import types

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

import gsplat_witness
from gsplat_edu.compat import gsplat as compat
from gsplat_edu.compat.lenses import half_time
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter
from proofs import proves_gradients

theirs = gsplat_witness.torch_impl
W, H = 23, 18
SHUTTERS = compat.RollingShutterType
DIRECTIONS = {
    SHUTTERS.ROLLING_TOP_TO_BOTTOM: "down",
    SHUTTERS.ROLLING_BOTTOM_TO_TOP: "up",
    SHUTTERS.ROLLING_LEFT_TO_RIGHT: "right",
    SHUTTERS.ROLLING_RIGHT_TO_LEFT: "left",
}
RADIAL = [0.08, -0.03, 0.004, 0.05, -0.01, 0.002]
TANGENTIAL, PRISM = [0.012, -0.008], [0.006, -0.004, 0.003, 0.002]
FISHEYE = [-0.03, 0.006, -0.002, 0.0003]
NO_SKEW = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=torch.float64)


@pytest.fixture
def exact(monkeypatch):
    """Set the 1e-7 that gsplat's fisheye adds to lengths to 0: then it has the derivative of its own formula."""
    function = theirs._fisheye_proj
    constants = tuple(0.0 if c == 1e-7 else c for c in function.__code__.co_consts)
    assert constants != function.__code__.co_consts
    code = function.__code__.replace(co_consts=constants)
    monkeypatch.setattr(theirs, "_fisheye_proj", types.FunctionType(code, function.__globals__))
    return function


def assert_close(found, wanted, bound=1e-9):
    found, wanted = found.detach(), wanted.detach()
    assert found.shape == wanted.shape
    assert float((found - wanted).abs().max()) <= bound * max(1.0, float(wanted.abs().max()))


def gradients(outputs, inputs):
    draw = torch.Generator().manual_seed(1)
    weights = [torch.randn(t.shape, generator=draw, dtype=torch.float64) for t in outputs]
    return torch.autograd.grad(
        sum((w * o).sum() for w, o in zip(weights, outputs, strict=True)), inputs, retain_graph=True
    )


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_the_projection_is_gsplats(model, exact):
    tensors = gsplat_witness.scene()
    covars = theirs._quat_scale_to_covar_preci(tensors["quats"], tensors["scales"])[0].detach()
    with torch.no_grad():
        means, turned = theirs._world_to_cam(tensors["means"], covars, tensors["viewmats"])
    inputs = (means.requires_grad_(), turned.requires_grad_(), tensors["Ks"])
    own = getattr(theirs, f"_{model}_proj")
    found, wanted = compat.proj(*inputs, W, H, camera_model=model), own(*inputs, W, H)
    for mine, other in zip(found, wanted, strict=True):
        assert_close(mine, other)
    for mine, other, used in zip(
        gradients(found, inputs), gradients(wanted, inputs), (1, 1, NO_SKEW), strict=True
    ):
        assert float(other.abs().max()) > 0
        assert_close(mine, other * used, 1e-8)
    if model == "fisheye":  # as it is: 1e-7 is little where a point is not near the axis
        aside = means.detach()[..., :2].norm(dim=-1) > 0.3
        assert int(aside.sum()) > 40
        for mine, other in zip(found, exact(*inputs, W, H), strict=True):
            assert_close(mine[aside], other[aside], 1e-5)


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
@pytest.mark.parametrize("fused", [False, True])
def test_the_fused_projection_is_gsplats(model, fused, exact):
    tensors = gsplat_witness.scene()
    cameras = (tensors["viewmats"], tensors["Ks"], W, H)
    solid = theirs._quat_scale_to_covar_preci(tensors["quats"], tensors["scales"])[0]
    given = (tensors["means"], None, tensors["quats"], tensors["scales"])
    inputs = (tensors["means"], tensors["quats"], tensors["scales"], tensors["viewmats"], tensors["Ks"])
    if not fused:
        given = (tensors["means"], solid[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], None, None)
    both = {"calc_compensations": True, "camera_model": model}
    found = compat.fully_fused_projection(*given, *cameras, **both)
    wanted = theirs._fully_fused_projection(tensors["means"], solid, *cameras, **both)
    seen = (found[0] > 0).all(dim=-1) & (wanted[0] > 0).all(dim=-1)
    assert int(seen.sum()) > 20 and torch.equal(found[0][seen], wanted[0][seen].int())
    mine, other = ([each[seen] for each in result[1:]] for result in (found, wanted))
    for a, b in zip(mine, other, strict=True):
        assert_close(a, b, 1e-8)
    for k, (a, b) in enumerate(zip(gradients(mine, inputs), gradients(other, inputs), strict=True)):
        assert_close(a, b * (NO_SKEW if k == 4 else 1), 1e-7)


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
@pytest.mark.parametrize("mode", ["RGB+ED", "RGB"])
def test_images_are_gsplats(model, mode, exact):
    tensors = gsplat_witness.scene()
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"]
    inputs = [tensors[name] for name in names]
    image, alpha, *_ = gsplat_witness.rendered(
        tensors, W, H, 3, antialiased=mode == "RGB", mode=mode, camera_model=model
    )
    extra = {"render_mode": mode, "rasterize_mode": "antialiased" if mode == "RGB" else "classic"}
    found = compat.rasterization(
        *inputs[:7], W, H, sh_degree=3, backgrounds=inputs[7], camera_model=model, **extra
    )
    assert float(alpha.detach().amax()) > 0.5
    assert_close(found[0], image, 1e-8)
    assert_close(found[1], alpha, 1e-8)
    for name, a, b in zip(
        names, gradients(found[:2], inputs), gradients((image, alpha), inputs), strict=True
    ):
        assert_close(a, b * (NO_SKEW if name == "Ks" else 1), 1e-7)


def lens_arguments(model, count=1):
    if model == "fisheye":
        return {"radial_coeffs": tensor([FISHEYE] * count)}
    given = {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL, "thin_prism_coeffs": PRISM}
    return {name: tensor([values] * count) for name, values in given.items()}


def tensor(values):
    return torch.tensor(np.array(values), dtype=torch.float64)


def our_lens(model):
    if model == "ortho":
        return Projection("orthographic")
    if model == "fisheye":
        return Projection(
            "fisheye", Distortion.of(**dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)))
        )
    named = zip(("k1", "k2", "k3", "d1", "d2", "d3"), RADIAL, strict=True)
    rest = zip(("p1", "p2", "s1", "s2", "s3", "s4"), TANGENTIAL + PRISM, strict=True)
    return Projection("perspective", Distortion.of(**dict(named), **dict(rest)))


def ordered_scene():
    """Return Gaussians in planes of equal z and of equal distance: depth orders agree between lenses and times."""
    g = torch.Generator().manual_seed(3)
    count = 12
    places = 0.9 * (torch.rand(count, 2, generator=g, dtype=torch.float64) - 0.5)
    z = 1.2 + 0.4 * torch.arange(count, dtype=torch.float64)
    return {
        "means": torch.cat([places * z[:, None], z[:, None]], dim=1),
        "quats": torch.randn(count, 4, generator=g, dtype=torch.float64),
        "scales": 0.05 + 0.2 * torch.rand(count, 3, generator=g, dtype=torch.float64),
        "opacities": 0.3 + 0.6 * torch.rand(count, generator=g, dtype=torch.float64),
        "colors": torch.rand(count, 3, generator=g, dtype=torch.float64),
    }


def poses(turn, shift):
    """Return the poses of the first and the last row, and of half time, for a camera far from the origin."""
    R = Rotation.from_euler("xyz", [0.05, -0.04, 0.1]).as_matrix()
    eye = np.array([0.05, -0.1, -0.3])
    ends = []
    for s in (-0.5, 0.5):
        rotation = Rotation.from_rotvec(s * np.array(turn)).as_matrix() @ R
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ (eye + s * np.array(shift))
        ends.append(tensor(matrix))
    return *ends, R, eye


def ours(scene, camera):
    colors = scene["colors"] - 0.5
    gaussians = Gaussians(
        scene["means"],
        scene["quats"],
        scene["scales"].log(),
        (colors / (0.5 / math.sqrt(math.pi)))[:, None],
        torch.zeros(len(colors), 0, 3, dtype=torch.float64),
        scene["opacities"].logit(),
    )
    settings = RenderSettings(alpha_max=0.999, z_near=0.01, stop="pixel", depth=False)
    return render(gaussians, camera, settings=settings, backend="cpu").image


@pytest.mark.parametrize("shutter", [None, *DIRECTIONS])
@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_images_are_those_of_our_camera(model, shutter):
    """A rotation of 0.09 radians and a shift in one image: 4 px, and most of a Gaussian."""
    scene, turn, shift = ordered_scene(), (0.05, -0.07, 0.03), (0.1, 0.06, -0.05)
    start, end, R, eye = poses(turn, shift)
    K = tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]])
    given = {} if model == "ortho" else lens_arguments(model)
    moving = None
    if shutter is None:
        start[:3, :3], start[:3, 3] = tensor(R), tensor(-R @ eye)
    else:
        given |= {"rolling_shutter": shutter, "viewmats_rs": end[None]}
        rows = H if DIRECTIONS[shutter] in ("down", "up") else W
        angle = np.linalg.norm(turn)
        longer = rows / (rows - 1)
        moving = RollingShutter(
            longer * np.array(turn) / angle * 4 * math.tan(angle / 4),
            longer * np.array(shift),
            DIRECTIONS[shutter],
        )
    camera = Camera(R, eye, 21.0, 19.0, 11.2 - 0.5, 9.7 - 0.5, H, W).through(our_lens(model), moving)
    wanted = ours(scene, camera)
    image, alpha, _ = compat.rasterization(
        *scene.values(), start[None], K[None], W, H, camera_model=model, with_ut=True, packed=False, **given
    )
    assert float(alpha.max()) > 0.5
    assert_close(image[0], wanted, 1e-9)
    still = compat.rasterization(*scene.values(), start[None], K[None], W, H, camera_model=model)[0]
    if given:
        assert float((image - still).abs().max()) > 0.02, "lens and shutter change the image"


def test_the_directions_of_harmonics_are_from_the_middle_of_the_path():
    scene = ordered_scene()
    start, end, _, eye = poses((0.05, -0.07, 0.03), (0.4, 0.06, -0.05))
    degree = torch.randn(12, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    K = tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]])
    cameras = {"viewmats": start[None], "Ks": K[None], "width": W, "height": H, "viewmats_rs": end[None]}
    cameras["rolling_shutter"] = SHUTTERS.ROLLING_TOP_TO_BOTTOM
    given = {**scene, "colors": degree}
    found, _, _ = compat.rasterization(**given, **cameras, sh_degree=1)
    directions = torch.nn.functional.normalize(scene["means"] - tensor(eye), dim=-1)
    colors = (compat.spherical_harmonics(1, directions, degree) + 0.5).clamp_min(0.0)
    assert_close(found, compat.rasterization(**{**scene, "colors": colors}, **cameras)[0], 1e-12)


@pytest.mark.parametrize("angle", [1e-9, 0.01, 0.1, 0.3, 0.9])
def test_between_the_ends_the_pose_is_gsplats_up_to_third_order(angle):
    """gsplat turns along the great circle and moves t on a straight line; here the centre moves on one."""
    axis, shift = np.array([2.0, -3.0, 6.0]) / 7, (0.3, -0.2, 0.1)
    start, end, *_ = poses(angle * axis, shift)
    rows = 1_000_000  # so that our readout and gsplat's have equal lengths to 1e-6
    middle, motion = half_time(start[None, None], end[None, None], rows)
    shutter = RollingShutter(*motion[0, 0].numpy().reshape(2, 3) * (rows - 1) / rows)
    R_mid = middle[0, 0, :3, :3].numpy()
    eye = -R_mid.T @ middle[0, 0, :3, 3].numpy()
    between = Slerp([0, 1], Rotation.from_matrix([start[:3, :3].numpy(), end[:3, :3].numpy()]))
    ends = [-pose[:3, :3].numpy().T @ pose[:3, 3].numpy() for pose in (start, end)]
    farthest = max(np.linalg.norm(e) for e in ends)
    for tau in np.linspace(0, 1, 41):
        own = shutter.rotation(tau - 0.5) @ R_mid
        other = between(tau).as_matrix()
        off = np.linalg.norm(Rotation.from_matrix(own @ other.T).as_rotvec())
        assert off <= 0.0042 * angle**3 + 1e-12
        if tau in (0, 1):
            assert off <= 1e-12
        own_eye = eye + shutter.shift * (tau - 0.5)
        t = (1 - tau) * start[:3, 3].numpy() + tau * end[:3, 3].numpy()
        gap = np.linalg.norm(own_eye + other.T @ t)
        # the chord of an arc, and a shift that turns with the camera
        assert (
            gap <= angle**2 / 8 * farthest + 0.25 * angle * np.linalg.norm(shift) * 4 * tau * (1 - tau) + 1e-9
        )
        np.testing.assert_allclose(own_eye, (1 - tau) * ends[0] + tau * ends[1], atol=1e-9)
    if angle == 0.9:
        tau = 0.79  # near the largest difference
        own, other = shutter.rotation(tau - 0.5) @ R_mid, between(tau).as_matrix()
        assert np.linalg.norm(Rotation.from_matrix(own @ other.T).as_rotvec()) > 0.0035 * angle**3


@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_gradients_agree_with_finite_differences(model):
    scene = gsplat_witness.smooth()
    start, end, *_ = poses((0.04, -0.05, 0.03), (0.06, 0.04, -0.05))
    K = tensor([[11.0, 0, 4.2], [0, 10.0, 3.7], [0, 0, 1]])
    lens = {} if model == "ortho" else lens_arguments(model)
    free = {
        "means": scene["means"].detach(),
        "viewmats": start[None],
        "viewmats_rs": end[None],
        "Ks": K[None],
        **lens,
    }

    def image(*values):
        given = dict(zip(free, values, strict=True))
        return compat.rasterization(
            quats=scene["quats"].detach(),
            scales=scene["scales"].detach(),
            opacities=scene["opacities"].detach(),
            colors=scene["colors"].detach()[:, 0],
            width=8,
            height=7,
            camera_model=model,
            rolling_shutter=SHUTTERS.ROLLING_TOP_TO_BOTTOM,
            **given,
        )[0]

    assert proves_gradients(image, list(free.values()))


def test_what_a_lens_does_not_see_has_no_gradient():
    """A Gaussian beyond the fold of a lens, and one behind the camera, would have NaN."""
    K = tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]])
    means = tensor([[0.0, 0, 2], [9.0, 0, 1], [0.1, 0, -1], [0.0, 0, 0]]).requires_grad_()
    solid = (torch.ones(4, 4).double(), torch.full((4, 3), 0.2).double(), torch.full((4,), 0.7).double())
    radial = tensor([[-0.4, 0.0, 0.0, 0.0, 0.0, 0.0]]).requires_grad_()
    image, _, meta = compat.rasterization(
        means,
        *solid,
        torch.ones(4, 3).double(),
        torch.eye(4)[None].double(),
        K[None],
        W,
        H,
        radial_coeffs=radial,
    )
    assert meta["gaussian_ids"].tolist() == [0]
    image.square().sum().backward()
    assert torch.isfinite(means.grad).all() and (means.grad[1:] == 0).all() and means.grad[0].abs().max() > 0
    assert torch.isfinite(radial.grad).all()


def test_several_scenes_and_cameras_have_their_own_lenses():
    scene, K = ordered_scene(), tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]])
    start, end, *_ = poses((0.05, -0.07, 0.03), (0.1, 0.06, -0.05))
    shutter = SHUTTERS.ROLLING_RIGHT_TO_LEFT
    radial = tensor(np.linspace(-0.1, 0.1, 2 * 3 * 6).reshape(2, 3, 6))
    ends = torch.stack([end, start, end]).expand(2, 3, 4, 4)
    together = {name: torch.stack([value, 0.9 * value]) for name, value in scene.items()}
    found, _, _ = compat.rasterization(
        *together.values(),
        start.expand(2, 3, 4, 4),
        K.expand(2, 3, 3, 3),
        W,
        H,
        radial_coeffs=radial,
        rolling_shutter=shutter,
        viewmats_rs=ends,
    )
    for b in (0, 1):
        for c in range(3):
            alone, _, _ = compat.rasterization(
                *(value[b] for value in together.values()),
                start[None],
                K[None],
                W,
                H,
                radial_coeffs=radial[b, c][None],
                rolling_shutter=shutter,
                viewmats_rs=ends[b, c][None],
            )
            assert torch.equal(found[b, c], alone[0])


def test_float32_is_near_float64():
    scene, K = ordered_scene(), tensor([[21.0, 0, 11.2], [0, 19.0, 9.7], [0, 0, 1]])
    start, end, *_ = poses((0.05, -0.07, 0.03), (0.1, 0.06, -0.05))
    images = [
        compat.rasterization(
            *(value.to(dtype) for value in scene.values()),
            start[None].to(dtype),
            K[None].to(dtype),
            W,
            H,
            rolling_shutter=SHUTTERS.ROLLING_TOP_TO_BOTTOM,
            viewmats_rs=end[None].to(dtype),
            **{name: value.to(dtype) for name, value in lens_arguments("pinhole").items()},
        )[0]
        for dtype in (torch.float32, torch.float64)
    ]
    assert images[0].dtype == torch.float32
    assert float((images[0] - images[1]).abs().max()) < 1e-5
