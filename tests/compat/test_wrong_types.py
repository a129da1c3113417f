"""A value of a wrong type raises one of our errors, for each argument of every public function of compat and of
`render`. The message begins with the argument's name, or with that of an argument it has to match.
"""

import inspect
import re

import numpy as np
import pytest
import torch

from gsplat_calls import arguments
from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.compat import gsplat as compat
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from native_scenes import smooth_scene

pytestmark = pytest.mark.usefixtures("as_shipped")

WRONG = {
    "a word": "x",
    "bytes": b"x",
    "an object": object(),
    "an array": np.zeros((2, 3)),
    "a list": [1.0, "x"],
    "a dictionary": {"a": 1},
    "a class": dict,
    "a complex number": 1j,
    "a large number": 2**70,
    "NaN": float("nan"),
    "a complex tensor": torch.zeros(6, 3, dtype=torch.complex64),
    "a tensor of another shape": torch.zeros(7, 7, 7, 7, 7),
    "an empty tensor": torch.zeros(0),
    "booleans": torch.ones(2, 2, dtype=torch.bool),
    "a tensor without data": torch.zeros(6, 3, device="meta"),
}

GIVEN = arguments()
PROJECTION = ("means", "quats", "scales", "viewmats", "Ks", "width", "height")
SEEN = {
    "degrees_to_use": 1,
    "means": torch.ones(6, 3),
    "viewmats": GIVEN["viewmats"],
    "masks": torch.ones(5, dtype=torch.bool),
    "batch_ids": torch.zeros(5, dtype=torch.int64),
    "camera_ids": torch.ones(5, dtype=torch.int64),
    "gaussian_ids": torch.arange(5),
    "viewmats_rs": GIVEN["viewmats"],
}
CALLS = {
    "render": (
        render,
        {
            "gaussians": smooth_scene(0).gaussians(),
            "camera": smooth_scene(0).camera,
            "settings": RenderSettings(),
            "background": torch.zeros(3, dtype=torch.float64),
            "features": torch.zeros(5, 2, dtype=torch.float64),
            "backend": "cpu",
        },
    ),
    "RenderSettings": (RenderSettings, {}),
    "rasterization": (compat.rasterization, GIVEN),
    "fully_fused_projection": (
        compat.fully_fused_projection,
        {name: GIVEN[name] for name in PROJECTION} | {"covars": None},
    ),
    "spherical_harmonics": (
        compat.spherical_harmonics,
        {"degrees_to_use": 1, "dirs": torch.ones(6, 3), "coeffs": torch.ones(6, 4, 3)},
    ),
    "spherical_harmonics of cameras": (compat.spherical_harmonics, SEEN | {"coeffs": torch.ones(5, 4, 3)}),
    "spherical_harmonics_l0": (compat.spherical_harmonics_l0, {"sh0": torch.ones(6, 1, 3)}),
    "spherical_harmonics_l1_plus": (
        compat.spherical_harmonics_l1_plus,
        SEEN | {"shN": torch.ones(5, 3, 3)},
    ),
    "quat_scale_to_covar_preci": (
        compat.quat_scale_to_covar_preci,
        {"quats": GIVEN["quats"], "scales": GIVEN["scales"]},
    ),
    "world_to_cam": (
        compat.world_to_cam,
        {"means": GIVEN["means"], "covars": torch.eye(3).repeat(6, 1, 1), "viewmats": GIVEN["viewmats"]},
    ),
    "proj": (
        compat.proj,
        {
            "means": torch.ones(2, 6, 3),
            "covars": torch.eye(3).repeat(2, 6, 1, 1),
            "Ks": GIVEN["Ks"],
            "width": 16,
            "height": 12,
        },
    ),
    "compute_relocation": (
        compat.compute_relocation,
        {
            "opacities": torch.full((6,), 0.5),
            "scales": GIVEN["scales"],
            "ratios": torch.ones(6, dtype=torch.int64),
            "binoms": torch.ones(1, 1),
        },
    ),
    "isect_tiles": (
        compat.isect_tiles,
        {
            "means2d": torch.ones(6, 2),
            "radii": torch.ones(6, 2, dtype=torch.int32),
            "depths": torch.ones(6),
            "tile_size": 4,
            "tile_width": 4,
            "tile_height": 3,
            "packed": True,
            "n_images": 2,
            "image_ids": torch.zeros(6, dtype=torch.int64),
            "gaussian_ids": torch.arange(6),
        },
    ),
    "isect_offset_encode": (
        compat.isect_offset_encode,
        {"isect_ids": torch.zeros(0, dtype=torch.int64), "n_images": 1, "tile_width": 2, "tile_height": 2},
    ),
    "rasterize_to_pixels": (
        compat.rasterize_to_pixels,
        {
            "means2d": torch.ones(1, 6, 2),
            "conics": torch.ones(1, 6, 3),
            "colors": torch.ones(1, 6, 3),
            "opacities": torch.ones(1, 6),
            "image_width": 5,
            "image_height": 4,
            "tile_size": 8,
            "isect_offsets": torch.zeros(1, 1, 1, dtype=torch.int32),
            "flatten_ids": torch.zeros(0, dtype=torch.int32),
        },
    ),
}
CASES = [
    (function, name)
    for function, (call, given) in CALLS.items()
    for name in (given if "harmonics" in function else inspect.signature(call).parameters)
]
TAKEN = {
    # A number of any size is a limit, and a list of cameras has no length limit.
    "near_plane": {"a large number"},
    "far_plane": {"a large number"},
    "radius_clip": {"a large number"},
    "z_near": {"a large number"},
    "jacobian_limit": {"a large number"},
    # Whole numbers without an upper limit that have no effect on the image.
    "tile_size": {"a large number"},
    "channel_chunk": {"a large number"},
    "binoms": {"booleans"},  # a table of 0 and 1
    # Without Gaussians, the other arguments are the wrong ones.
    "compute_relocation opacities": {"an empty tensor"},
}
"""Values that are accepted, by argument and kind."""


@pytest.mark.parametrize(("function", "name"), CASES)
def test_wrong_types_raise_only_our_errors(function, name):
    call, given = CALLS[function]
    call(**given)
    for what, value in WRONG.items():
        if what in TAKEN.get(name, ()) or what in TAKEN.get(f"{function} {name}", ()):
            continue
        with pytest.raises(SplatError) as found:
            call(**given | {name: value})
            pytest.fail(f"{name}: {what} was taken")
        message = str(found.value)
        assert re.match(rf"(backend|{name})\b", message), (what, message)
        assert "\n" not in message and len(message) < 300, (what, message)


def test_a_gaussian_too_large_to_draw_is_named_as_the_caller_gave_it():
    scales = torch.full((6, 3), 0.2)
    scales[4] = 1e20
    means = torch.zeros(6, 3)
    for name, wide in (
        ("scales", {"scales": scales}),
        ("covars", {"covars": torch.diag_embed(scales * scales)}),
    ):
        if name == "covars":
            wide["covars"] = torch.diag_embed(scales.clamp(max=1e19) ** 2)
        with pytest.raises(ArgumentError, match=rf"^{name}\[4\]: makes a Gaussian of more than 1e\+15 px"):
            compat.rasterization(**arguments(means=means) | wide)
