"""Calls with every argument of gsplat 1.6.0, by the names of its signatures."""

import inspect

import pytest
import torch

from gsplat_calls import C, N, arguments
from gsplat_edu.compat import gsplat as ours

SIGNATURES = {
    "fully_fused_projection": (
        "means covars quats scales viewmats Ks width height eps2d near_plane far_plane radius_clip packed "
        "sparse_grad calc_compensations camera_model opacities"
    ),
    "spherical_harmonics": (
        "degrees_to_use means viewmats coeffs masks batch_ids camera_ids gaussian_ids viewmats_rs"
    ),
    "spherical_harmonics_l0": "sh0",
    "spherical_harmonics_l1_plus": (
        "degrees_to_use means viewmats shN masks batch_ids camera_ids gaussian_ids viewmats_rs"
    ),
    "quat_scale_to_covar_preci": "quats scales compute_covar compute_preci triu",
    "proj": "means covars Ks width height camera_model",
    "world_to_cam": "means covars viewmats",
    "isect_tiles": (
        "means2d radii depths tile_size tile_width tile_height sort segmented packed n_images image_ids "
        "gaussian_ids conics opacities"
    ),
    "isect_offset_encode": "isect_ids n_images tile_width tile_height",
    "rasterize_to_pixels": (
        "means2d conics colors opacities image_width image_height tile_size isect_offsets flatten_ids "
        "backgrounds masks packed absgrad"
    ),
    "rasterize_num_contributing_gaussians": (
        "means2d conics opacities tile_offsets flatten_ids image_width image_height tile_size"
    ),
    "rasterize_contributing_gaussian_ids": (
        "means2d conics opacities tile_offsets flatten_ids image_width image_height tile_size "
        "num_contributing_gaussians"
    ),
    "rasterize_top_contributing_gaussian_ids": (
        "means2d conics opacities tile_offsets flatten_ids image_width image_height tile_size "
        "num_depth_samples"
    ),
    "rasterize_to_indices_in_range": (
        "range_start range_end transmittances means2d conics opacities image_width image_height tile_size "
        "isect_offsets flatten_ids"
    ),
    "accumulate": "means2d conics opacities colors gaussian_ids pixel_ids image_ids image_width image_height",
    "compute_relocation": "opacities scales ratios binoms min_opacity",
    "rasterization": (
        "means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d "
        "sh_degree packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk "
        "distributed camera_model segmented covars with_ut with_eval3d return_normals global_z_order rays "
        "radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs lidar_coeffs "
        "external_distortion_coeffs rolling_shutter viewmats_rs ut_params extra_signals "
        "extra_signals_sh_degree renderer_config"
    ),
}
"""Public signatures of gsplat 1.6.0."""

SCREEN = {
    "means2d": torch.full((C, N, 2), 3.0),
    "radii": torch.full((C, N, 2), 4),
    "depths": torch.ones(C, N),
    "conics": torch.tensor([0.3, 0.1, 0.4]).repeat(C, N, 1),
    "opacities": torch.full((C, N), 0.5),
    "colors": torch.ones(C, N, 3),
    "isect_offsets": torch.tensor([[[0]], [[2]]]),
    "tile_offsets": torch.tensor([[[0]], [[2]]]),
    "flatten_ids": torch.tensor([0, 4, N, N + 1]),
    "tile_size": 16,
    "packed": False,
    "masks": torch.ones(C, 1, 1, dtype=torch.bool),
    "image_ids": torch.zeros(3, dtype=torch.int64),
    "gaussian_ids": torch.arange(3),
}
VALUES = arguments() | {
    "eps2d": 0.3,
    "near_plane": 0.01,
    "far_plane": 1e10,
    "radius_clip": 0.0,
    "packed": True,
    "sparse_grad": True,
    "calc_compensations": True,
    "camera_model": "pinhole",
    "degrees_to_use": 1,
    "coeffs": torch.ones(5, 4, 2),
    "sh0": torch.ones(N, 1, 2),
    "shN": torch.ones(5, 3, 2),
    "masks": torch.ones(5, dtype=torch.bool),
    "batch_ids": torch.zeros(5, dtype=torch.int64),
    "camera_ids": torch.ones(5, dtype=torch.int64),
    "gaussian_ids": torch.arange(5),
    "viewmats_rs": None,
    "covars": None,
    "compute_covar": True,
    "compute_preci": True,
    "triu": True,
    "tile_width": 1,
    "tile_height": 1,
    "sort": True,
    "segmented": False,
    "n_images": C,
    "isect_ids": torch.zeros(0, dtype=torch.int64),
    "image_width": 16,
    "image_height": 12,
    "backgrounds": torch.zeros(C, 3),
    "absgrad": True,
    "num_contributing_gaussians": torch.full((C, 12, 16), 2, dtype=torch.int32),
    "num_depth_samples": 2,
    "range_start": 0,
    "range_end": 3,
    "transmittances": torch.ones(C, 12, 16),
    "pixel_ids": torch.arange(3),
    "ratios": torch.ones(N, dtype=torch.int64),
    "binoms": torch.ones(1, 1),
    "min_opacity": 0.01,
    "sh_degree": None,
    "tile_size": None,
    "render_mode": "RGB+ED",
    "rasterize_mode": "antialiased",
    "channel_chunk": 32,
    "distributed": False,
    "with_ut": False,
    "with_eval3d": False,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "radial_coeffs": torch.zeros(C, 6),
    "tangential_coeffs": torch.zeros(C, 2),
    "thin_prism_coeffs": torch.zeros(C, 4),
    "ftheta_coeffs": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "rolling_shutter": ours.RollingShutterType.GLOBAL,
    "ut_params": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}
OWN = {
    "proj": {"means": torch.ones(C, N, 3), "covars": torch.eye(3).repeat(C, N, 1, 1)},
    "world_to_cam": {"covars": torch.eye(3).repeat(N, 1, 1)},
    "isect_tiles": {"image_ids": None, "gaussian_ids": None},
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_calls_with_every_argument_run(name):
    names = SIGNATURES[name].split()
    values = VALUES | (SCREEN if "means2d" in names else {}) | OWN.get(name, {})
    given = {key: values[key] for key in names}
    by_name = getattr(ours, name)(**given)
    results = [by_name] if isinstance(by_name, torch.Tensor) else list(by_name)
    for result in results:
        assert not isinstance(result, torch.Tensor) or bool(torch.isfinite(result.double()).all())
    if name == "rasterization":  # some of its arguments are keywords only
        assert set(names) == set(inspect.signature(ours.rasterization).parameters)
        return
    by_position = getattr(ours, name)(*given.values())
    pairs = zip(results, [by_position] if isinstance(by_position, torch.Tensor) else by_position, strict=True)
    assert all(one is other is None or torch.equal(one, other) for one, other in pairs)
