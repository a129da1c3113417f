"""docs/GSPLAT.md names every argument and every key of meta."""

import inspect
import re
from pathlib import Path

import torch

from gsplat_edu.compat import gsplat as compat
from gsplat_edu.compat.gsplat import rasterization, rasterization_2dgs

TEXT = (Path(__file__).parents[2] / "docs" / "GSPLAT.md").read_text()


def named(heading):
    """The names in the first column of the table below a heading."""
    section = TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall(r"`(\w+)`", row)]


def test_the_table_lists_the_arguments_in_order():
    assert named("Arguments of rasterization") == list(inspect.signature(rasterization).parameters)


NAMES = """
color_correct_affine color_correct_quadratic PngCompression DefaultStrategy MCMCStrategy Strategy CameraModel
ExternalDistortionModelMeta ExternalDistortionModelParameters RasterizeMode RendererConfig RendererConfig_MixedBatch
RendererConfig_ParallelBatch RenderMode rasterization rasterization_2dgs rasterization_inria_wrapper spherical_harmonics
spherical_harmonics_l0 spherical_harmonics_l1_plus isect_offset_encode isect_tiles isect_tiles_lidar isect_tiles_sparse
build_sparse_tile_layout proj fully_fused_projection quat_scale_to_covar_preci rasterize_to_pixels
rasterize_num_contributing_gaussians rasterize_num_contributing_gaussians_sparse rasterize_contributing_gaussian_ids
rasterize_contributing_gaussian_ids_sparse rasterize_top_contributing_gaussian_ids
rasterize_top_contributing_gaussian_ids_sparse world_to_cam accumulate rasterize_to_indices_in_range
fully_fused_projection_2dgs rasterize_to_pixels_2dgs rasterize_to_indices_in_range_2dgs accumulate_2dgs
rasterization_2dgs_inria_wrapper RollingShutterType fully_fused_projection_with_ut rasterize_to_pixels_eval3d
rasterize_to_pixels_sparse export_splats __version__ has_2dgs has_3dgs has_3dgut has_adam has_camera_wrappers has_losses
has_reloc FusedGaussianLosses gaussian_scale_reg gaussian_density_reg gaussian_z_scale_reg out_of_bound_loss
RowOffsetStructuredSpinningLidarModelParameters RowOffsetStructuredSpinningLidarModelParametersExt
compute_lidar_angles_to_columns_map compute_lidar_tiling LidarTiling SpinningDirection
"""
"""What gsplat 1.6.0 exports in `__all__`."""


def test_the_table_lists_the_names_of_1_6_0():
    """ "Same" is what this package has; only `compute_relocation` and our own names are not exported by 1.6.0."""
    listed = named("Names of gsplat 1.6.0")
    assert len(NAMES.split()) == 67 and sorted(listed) == sorted(NAMES.split())
    section = TEXT.split("## Names of gsplat 1.6.0\n")[1].split("\n## ")[0]
    same = [
        name
        for line in section.splitlines()
        if line.startswith("| `") and line.split("|")[2].strip().startswith("same")
        for name in re.findall(r"`(\w+)`", line.split("|")[1])
    ]
    assert all(hasattr(compat, name) for name in same)
    assert set(compat.__all__) - set(same) == {"compute_relocation", "skipping_bad_gaussians"}


def test_the_table_lists_the_keys_of_meta():
    tensors = [torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)]
    _, _, meta = rasterization(
        *tensors, torch.eye(4)[None], torch.eye(3)[None], 4, 4, extra_signals=torch.ones(1, 2)
    )
    assert sorted(named("What meta holds")) == sorted(meta)


def test_the_section_on_2d_gaussians_lists_the_keys_of_meta():
    tensors = [torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3)]
    cameras = (torch.eye(4)[None], torch.eye(3)[None], 4, 4)
    meta, flat = (render(*tensors, *cameras)[-1] for render in (rasterization, rasterization_2dgs))
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `meta` |")]
    added = set(re.findall(r"`(\w+)`", row)) - {"meta", "rasterization", "conics"}
    assert set(flat) == (set(meta) - {"conics"}) | added
    assert set(named("2D Gaussians")) - {"meta"} <= set(inspect.signature(rasterization_2dgs).parameters)
