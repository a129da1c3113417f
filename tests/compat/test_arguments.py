"""Unsupported arguments of `rasterization`, and wrong shapes, types and ranges, are refused by the argument's name."""

import inspect
import re

import pytest
import torch

from gsplat_calls import C, N, arguments
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.compat.gsplat import RollingShutterType, fully_fused_projection, rasterization

pytestmark = pytest.mark.usefixtures("as_shipped")

UNSUPPORTED = {
    "distributed": True,
    "with_eval3d": True,
    "ftheta_coeffs": object(),
    "return_normals": True,
    "global_z_order": False,
    "rays": torch.zeros(C, 12, 16, 6),
    "lidar_coeffs": object(),
    "external_distortion_coeffs": object(),
    "ut_params": object(),
    "renderer_config": object(),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_unsupported_arguments_are_refused_by_name(name):
    with pytest.raises(ArgumentError, match=f"^{name}: .* only .* is supported"):
        rasterization(**arguments(), **{name: UNSUPPORTED[name]})


ADDED = {
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "ut_params": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}
"""Arguments that gsplat 1.6.0 has added, with their defaults."""


def test_added_arguments_have_gsplats_defaults():
    parameters = inspect.signature(rasterization).parameters.values()
    assert {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY} == ADDED
    plain, given = rasterization(**arguments()), rasterization(**arguments(), **ADDED)
    assert torch.equal(plain[0], given[0]) and sorted(plain[2]) == sorted(given[2])


def test_the_name_of_gsplats_default_renderer_is_accepted():
    default = type("RendererConfig_MixedBatch", (), {})()
    images = rasterization(**arguments(), renderer_config=default)[0]
    assert torch.equal(images, rasterization(**arguments())[0])
    other = type("RendererConfig_ParallelBatch", (), {})()
    with pytest.raises(
        ArgumentError, match="^renderer_config: is of type RendererConfig_ParallelBatch, but only None"
    ):
        rasterization(**arguments(), renderer_config=other)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (
            "ftheta",
            "camera_model: is 'ftheta', which is not supported; fit radial_coeffs of camera_model='fisheye'",
        ),
        (
            "lidar",
            "camera_model: is 'lidar', which is not supported; give cameras by viewmats, Ks and camera_model",
        ),
        ("panorama", "camera_model: "),
        (None, "camera_model: "),
    ],
)
def test_every_other_camera_model_is_refused(value, says):
    with pytest.raises(ArgumentError, match=f"^{re.escape(says)}"):
        rasterization(**arguments(), camera_model=value)


SHUTTER = {"rolling_shutter": RollingShutterType.ROLLING_TOP_TO_BOTTOM}
END = torch.eye(4).repeat(C, 1, 1)
TURNED = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0])).repeat(C, 1, 1)


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        (
            {"radial_coeffs": torch.zeros(C, 4)},
            ShapeError,
            "radial_coeffs: has shape (2, 4), but has to be (2, 6)",
        ),
        (
            {"radial_coeffs": torch.zeros(C, 6).double()},
            ArgumentError,
            "radial_coeffs: is torch.float64 on cpu",
        ),
        ({"radial_coeffs": torch.full((C, 6), float("nan"))}, ArgumentError, "radial_coeffs[0, 0]: "),
        ({"tangential_coeffs": torch.zeros(2)}, ShapeError, "tangential_coeffs: has shape (2,)"),
        ({"thin_prism_coeffs": [0.0] * 4}, ArgumentError, "thin_prism_coeffs: is list"),
        (
            {"radial_coeffs": torch.zeros(C, 6), "camera_model": "fisheye"},
            ShapeError,
            "radial_coeffs: has shape (2, 6), but has to be (2, 4)",
        ),
        (
            {"thin_prism_coeffs": torch.zeros(C, 4), "camera_model": "fisheye"},
            ArgumentError,
            "thin_prism_coeffs: a camera with camera_model='fisheye' has none; leave it out",
        ),
        (
            {"radial_coeffs": torch.zeros(C, 6), "camera_model": "ortho"},
            ArgumentError,
            "radial_coeffs: a camera with camera_model='ortho' has none; leave it out",
        ),
        ({"rolling_shutter": "down"}, ArgumentError, "rolling_shutter: is 'down', but has to be a member of"),
        (
            SHUTTER,
            ArgumentError,
            "viewmats_rs: is None; a rolling shutter needs the poses of what is read last",
        ),
        (
            {"viewmats_rs": END},
            ArgumentError,
            "viewmats_rs: is given, but rolling_shutter is GLOBAL; name the",
        ),
        (SHUTTER | {"viewmats_rs": END[0]}, ShapeError, "viewmats_rs: has shape (4, 4)"),
        (
            SHUTTER | {"viewmats_rs": 2 * END},
            ArgumentError,
            "viewmats_rs: a rolling shutter needs matrices with",
        ),
        (
            SHUTTER | {"viewmats_rs": TURNED},
            ArgumentError,
            "viewmats_rs: the camera turns by more than a radian",
        ),
        ({"with_ut": "yes"}, ArgumentError, "with_ut: "),
    ],
)
def test_lenses_and_shutters_are_refused_by_name(given, error, says):
    with pytest.raises(error, match=f"^{re.escape(says)}"):
        rasterization(**arguments(), **given)


WRONG = {
    "render_mode": "BGR",
    "rasterize_mode": "fancy",
    "width": 0,
    "height": 2.5,
    "tile_size": 0,
    "channel_chunk": 0,
    "near_plane": -1.0,
    "far_plane": float("nan"),
    "radius_clip": -1.0,
    "eps2d": -0.1,
    "means": torch.zeros(N, 3, dtype=torch.int32),
    "quats": torch.zeros(N, 4),
    "scales": torch.zeros(N, 3, dtype=torch.float64),
    "opacities": torch.full((N,), float("nan")),
    "colors": torch.full((N, 3), 2e6),
    "covars": torch.full((N, 3, 3), float("inf")),
    "backgrounds": [0.0, 0.0, 0.0],
    "extra_signals": torch.full((N, 2), float("nan")),
    "extra_signals_sh_degree": 0,
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_values_are_refused_by_name(name):
    with pytest.raises(ArgumentError, match=rf"^{name}(\[|:)"):
        rasterization(**arguments(**{name: WRONG[name]}))


SHAPES = {
    "means": (N, 2),
    "quats": (N, 3),
    "scales": (N + 1, 3),
    "opacities": (N, 1),
    "colors": (C + 1, N, 3),
    "viewmats": (C, 3, 4),
    "Ks": (C + 1, 3, 3),
    "covars": (N, 6),
    "backgrounds": (C, 4),
    "extra_signals": (C + 1, N, 2),
}


@pytest.mark.parametrize("name", SHAPES)
def test_wrong_shapes_are_refused_by_name(name):
    with pytest.raises(ShapeError, match=f"^{name}: has shape"):
        rasterization(**arguments(**{name: torch.zeros(SHAPES[name])}))


@pytest.mark.parametrize("degree", [2, 4, -1, 1.0])
def test_harmonics_need_a_degree_that_the_coefficients_have(degree):
    with pytest.raises(ArgumentError, match="^(colors|sh_degree): "):
        rasterization(**arguments(colors=torch.zeros(N, 4, 3)), sh_degree=degree)


@pytest.mark.parametrize("degree", [2, 5, -1, 1.0])
def test_harmonics_of_extra_signals_need_a_degree_that_their_coefficients_have(degree):
    with pytest.raises(ArgumentError, match="^(extra_signals|extra_signals_sh_degree): "):
        rasterization(**arguments(), extra_signals=torch.zeros(N, 4, 2), extra_signals_sh_degree=degree)


def test_coefficients_of_extra_signals_have_no_axis_of_cameras():
    coefficients = torch.zeros(C, N, 4, 2)
    with pytest.raises(
        ShapeError, match=r"^extra_signals: has shape \(2, 6, 4, 2\), but has to be \(6, 4, 2\)"
    ):
        rasterization(**arguments(), extra_signals=coefficients, extra_signals_sh_degree=1)


def test_extra_signals_need_a_channel():
    with pytest.raises(ShapeError, match="^extra_signals: has shape"):
        rasterization(**arguments(), extra_signals=torch.zeros(N, 0))


@pytest.mark.parametrize("mode", ["RGB", "RGB+D", "RGB+ED"])
def test_colors_may_be_missing_only_if_none_are_returned(mode):
    with pytest.raises(
        ArgumentError, match=f"^colors: is None, but render_mode '{re.escape(mode)}' returns colours"
    ):
        rasterization(**arguments(colors=None), render_mode=mode)
    with pytest.raises(ArgumentError, match="^sh_degree: is given, but colors is None"):
        rasterization(**arguments(colors=None), render_mode="ED", sh_degree=1)


def test_backgrounds_cover_extra_signals():
    signals = torch.zeros(N, 2)
    for mode, right, wrong in (("RGB", 5, 3), ("RGB+ED", 5, 3), ("D", 2, 3)):
        given = arguments(backgrounds=torch.zeros(C, right)) | {"extra_signals": signals, "render_mode": mode}
        rasterization(**given)
        expected = rf"^backgrounds: has shape \(2, {wrong}\), but has to be \(2, {right}\)"
        with pytest.raises(ShapeError, match=expected):
            rasterization(**given | {"backgrounds": torch.zeros(C, wrong)})


def test_quats_and_scales_are_required_without_covars():
    for missing in ("quats", "scales"):
        with pytest.raises(ArgumentError, match=f"^{missing}: is None"):
            rasterization(**arguments(**{missing: None}))


def test_arguments_for_gsplats_kernels_change_no_image():
    plain = rasterization(**arguments())
    for changes in ({"tile_size": 8}, {"channel_chunk": 1}, {"segmented": True}, {"packed": False}):
        images, alphas, meta = rasterization(**arguments(), **changes)
        assert torch.equal(images, plain[0]) and torch.equal(alphas, plain[1])
    assert (plain[2]["tile_width"], plain[2]["tile_height"], plain[2]["tile_size"]) == (1, 1, 16)
    _, _, meta = rasterization(**arguments(), tile_size=8)
    assert (meta["tile_width"], meta["tile_height"], meta["tile_size"]) == (2, 2, 8)


def test_the_projection_refuses_by_name():
    given = arguments()
    names = ("means", "covars", "quats", "scales", "viewmats", "Ks", "width", "height")
    args = [given.get(name) for name in names]
    for name, value in (("sparse_grad", True), ("camera_model", "ftheta")):
        with pytest.raises(ArgumentError, match=f"^{name}: "):
            fully_fused_projection(*args, **{name: value})
    with pytest.raises(ShapeError, match="^covars: "):
        fully_fused_projection(args[0], torch.zeros(N, 3, 3), *args[2:])
    with pytest.raises(ShapeError, match="^opacities: "):
        fully_fused_projection(*args, opacities=torch.zeros(N + 1))
