"""Scenes and files that the tests of scene formats share."""

from pathlib import Path

import torch

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.io.formats import FORMATS, SOG_META, write_scene
from gsplat_edu.io.scene import Scene

READABLE = [found for found in FORMATS if found.readable]


def random_scene(count: int, rest: int = 15, seed: int = 0) -> Scene:
    """Random Gaussians of sizes, opacities and colours as scenes have them."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=normal(count, 3),
        quats=normal(count, 4),
        log_scales=0.7 * normal(count, 3) - 3.0,
        sh0=normal(count, 1, 3),
        sh_rest=0.2 * normal(count, rest, 3),
        logit_opacities=1.5 * normal(count),
    )
    return Scene(gaussians, antialiased=False, up=(0.0, -1.0, 0.0))


def small_file(folder: Path, suffix: str, rest: int = 3) -> Path:
    """Write a scene of 40 splats into a file of at most 16 KiB."""
    path = folder / f"small{suffix}"
    write_scene(path, random_scene(40, rest))
    assert path.stat().st_size <= 16 * 1024
    return path


def small_folder(folder: Path) -> Path:
    """Write the same scene as a SOG in a folder; return its meta.json."""
    path = folder / "small" / SOG_META
    write_scene(path, random_scene(40, 3))
    return path
