"""Scenes and files shared by the tests of scene formats."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import POINT_SUFFIXES
from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.formats import FORMATS, LOD_META, SOG_META, read_scene, write_scene
from gsplat_edu.io.lod import codec as lod
from gsplat_edu.io.lod.levels import LodOptions
from gsplat_edu.io.ply import save_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).parents[2] / "shared" / "data"))

IN_A_PROCESS = (".usda", ".usdc", ".usdz")
"""Formats whose files are read in a process of their own, which takes a second to start."""

RUN_UP = np.array([0.0, -0.6, 0.8])


def random_scene(count: int, rest: int = 15, seed: int = 0) -> Scene:
    """Return random Gaussians with realistic sizes, opacities and colours."""
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


def kept_file(name: str) -> Path:
    """Return a file of the machine's data by its name there; skip the test without it."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return path


def refused(path: Path, read: Callable[[Path], object] = read_scene) -> str:
    """Return why a reader refuses a file: one line that names it, or a file beside the meta.json of a SOG folder."""
    with pytest.raises(SceneFormatError) as caught:
        read(path)
    message, named = str(caught.value), path.parent if path.name == SOG_META else path
    assert str(named) in message and "\n" not in message and len(message) < 400
    return message


def matched(given: Gaussians, back: Gaussians) -> Gaussians:
    """Return the given Gaussians in the order in which they were read, matched one to one by the nearest mean."""
    _, nearest = cKDTree(given.means.numpy()).query(back.means.numpy())
    assert sorted(nearest) == list(range(len(given))), "each splat appears once"
    return given.map(lambda tensor: tensor[torch.from_numpy(np.asarray(nearest, dtype=np.int64))])


def small_file(folder: Path, suffix: str, rest: int = 3) -> Path:
    """Write a scene of 40 splats into a file of at most 16 KiB."""
    path = folder / f"small{suffix}"
    write_scene(path, random_scene(40, rest))
    assert path.stat().st_size <= 16 * 1024
    return path


def suffixes() -> list[str]:
    """Return the suffixes of the formats that can be read here: those of USD need a library."""
    there = importlib.util.find_spec("pxr") is not None
    known = [found.suffix for found in FORMATS if found.suffix not in POINT_SUFFIXES]
    return [suffix for suffix in known if there or suffix not in IN_A_PROCESS]


def small_folder(folder: Path) -> Path:
    """Write the same scene as a SOG in a folder; return its meta.json."""
    path = folder / "small" / SOG_META
    write_scene(path, random_scene(40, 3))
    return path


def small_levels(folder: Path) -> Path:
    """Write the same scene as two levels of detail in three files; return its lod-meta.json."""
    path = folder / "levels" / LOD_META
    lod.write(path, random_scene(40, 3), LodOptions(smallest=20, chunk=20, leaf=10))
    return path


def make_run(
    path: Path, origin: tuple[float, float, float] = (0.0, 0.0, 0.0), count: int = 5
) -> tuple[RunFolder, Gaussians, list[Camera]]:
    """Make a run whose cameras look at the origin from a ring around RUN_UP; return it, its scene and the cameras."""
    folder = RunFolder(path)
    side = np.array([1.0, 0.0, 0.0])
    views = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        eye = 3.0 * (np.cos(angle) * side + np.sin(angle) * np.cross(RUN_UP, side)) + RUN_UP
        camera = Camera.looking_at(eye, (0, 0, 0), 50.0, 55.0, 40, 60, RUN_UP)
        views.append(View(camera, np.zeros((40, 60, 3), np.uint8), name=f"{angle:.2f}.jpg"))
    folder.write_config(
        {"render": {"antialiased": True, "background": [1.0, 0.5, 0.0]}, "origin": list(origin)}
    )
    folder.write_cameras(views[1:], views[:1], origin)
    scene = random_scene(30)
    save_ply(folder.scene(7), scene.gaussians, origin)
    return folder, scene.gaussians, [view.camera for view in views[1:] + views[:1]]
