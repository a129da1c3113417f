"""A scene to show or convert, from a file or a run, with its cameras and render settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.io.formats import file_in, read_scene
from gsplat_edu.io.scene import Scene, direction
from gsplat_edu.paths.orbits import common_up, orbit_of_scene, resized
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import ORIGIN, UNITS, Vector, as_origin
from gsplat_edu.scene.gaussians import Gaussians

COLMAP = "COLMAP"
"""The layout whose axes are those of the first camera, or any."""

VERTICAL = math.cos(math.radians(30.0))
"""Least cosine between an axis of the coordinates and the cameras' up for the axis to be vertical."""

SCENE_LEVELS = 3
"""Path levels from a scene up to its run: RUN/point_cloud/iteration_N/point_cloud.ply."""

CAPTURE_JACOBIAN_LIMIT = 1.3
"""Jacobian limit for scenes without settings. Captures are trained with it, here and in Kerbl et al.'s code."""

NamedCamera = tuple[str, Camera]


@dataclass(frozen=True, eq=False)
class Source:
    """A scene with its cameras and settings.

    Args:
        path: The scene's file.
        scene: The scene.
        cameras: Name and camera of each view of its capture, relative to the scene's origin and sorted by name, as in
            the capture; empty if unknown.
        settings: Settings to render it with.
        held_out: Names of the views that were not used for training.
    """

    path: Path
    scene: Scene
    cameras: tuple[NamedCamera, ...]
    settings: RenderSettings
    held_out: frozenset[str] = frozenset()

    @property
    def origin(self) -> Vector:
        """Position of the zero of the splats and the cameras in the capture's coordinates."""
        return self.scene.origin

    def probes(self, most: int, longest: int) -> list[NamedCamera]:
        """Choose cameras to render the scene from: its own, spread evenly over the list, or an orbit if it has none.

        Args:
            most: Largest number of cameras.
            longest: Upper bound of the longer side of their images, px; an orbit's images have this side.

        Raises:
            ArgumentError: there are neither cameras nor Gaussians to orbit.
        """
        if not self.cameras:
            orbit = orbit_of_scene(self.scene.gaussians, most, longest)
            return [(f"orbit {i}", camera) for i, camera in enumerate(orbit)]
        count = min(most, len(self.cameras))
        chosen = [self.cameras[i * len(self.cameras) // count] for i in range(count)]
        return [(name, resized(c, longest) if max(c.W, c.H) > longest else c) for name, c in chosen]


def open_source(path: str | Path) -> Source:
    """Read a scene of any supported format, or the latest scene of a run.

    A scene in a run's folder gets the run's cameras and settings. Other scenes have no cameras and get the settings
    of their file, or else the usual ones of captures.

    Args:
        path: Scene file, folder of a SOG or of levels of detail, or folder of a run.

    Raises:
        ArgumentError: the path names neither a scene nor a run.
        SceneFormatError: the scene is damaged.
        CheckpointError: the run is damaged, or has no scene yet.
        OSError: a file cannot be read.
    """
    path = file_in(Path(path))
    if path.is_dir():
        folder = RunFolder(path)
        if not folder.exists():
            raise ArgumentError(
                f"{path}: is not a run (it has no config.json); give a scene file or the folder of a run"
            )
        return _of_run(folder, folder.latest_scene()[0])
    if not path.exists():
        raise ArgumentError(f"{path}: does not exist; give a scene file or the folder of a run")
    if (run := run_of(path)) is not None:
        return _of_run(run, path)
    scene = read_scene(path)
    return Source(path, scene, (), file_settings(scene))


def run_of(path: Path) -> RunFolder | None:
    """Return the run that a scene file belongs to; None if it is not in a run's folder."""
    above = path.absolute().parents
    if path.name != "point_cloud.ply" or len(above) < SCENE_LEVELS or above[1].name != "point_cloud":
        return None
    folder = RunFolder(above[SCENE_LEVELS - 1])
    return folder if folder.exists() else None


def file_settings(scene: Scene) -> RenderSettings:
    """Return the settings to render a scene file with: antialiasing from the file, the rest as for captures."""
    return RenderSettings(
        antialiased=bool(scene.antialiased), jacobian_limit=CAPTURE_JACOBIAN_LIMIT, depth=False
    )


def _of_run(folder: RunFolder, path: Path) -> Source:
    config = folder.read_config()
    settings = replace(render_settings(config), depth=False)
    origin = run_origin(folder, config)
    gaussians = read_scene(path).relative_to(origin)
    cameras: tuple[NamedCamera, ...] = ()
    held_out: frozenset[str] = frozenset()
    if folder.cameras.is_file():
        known = sorted(folder.read_cameras(origin), key=lambda entry: entry[0])
        cameras = tuple((name, camera) for name, _, camera in known)
        held_out = frozenset(name for name, split, _ in known if split == "test")
    up, unit = up_and_unit(config, [camera for _, camera in cameras])
    scene = Scene(gaussians, settings.antialiased, up, unit, origin, run_earth(folder, config))
    return Source(path, scene, cameras, settings, held_out)


def run_origin(folder: RunFolder, config: Mapping[str, Any]) -> Vector:
    """Return the origin of a run's coordinates.

    Args:
        folder: The run.
        config: The content of its config.json.

    Raises:
        CheckpointError: the file has no usable origin.
    """
    try:
        return as_origin("origin", config.get("origin") or ORIGIN)
    except ArgumentError as error:
        raise CheckpointError(f"{folder.config}: {error}; fix the file") from None


def run_earth(folder: RunFolder, config: Mapping[str, Any]) -> Earth | None:
    """Return where on earth a run's coordinates are; None if it is unknown.

    Args:
        folder: The run.
        config: The content of its config.json.

    Raises:
        CheckpointError: the file has no usable place.
    """
    try:
        return Earth.parsed((config.get("scale") or {}).get("earth"))
    except ArgumentError as error:
        raise CheckpointError(f"{folder.config}: {error}; fix the file") from None


def up_and_unit(config: Mapping[str, Any], cameras: Sequence[Camera]) -> tuple[Vector, str | None]:
    """Return the up direction of a run, and the unit of its coordinates, "m", "cm" or "mm"; None if it is unknown.

    Args:
        config: The content of config.json.
        cameras: The run's cameras.
    """
    unit = (config.get("scale") or {}).get("unit")
    return direction(config.get("up")) or scene_up(cameras), unit if unit in UNITS else None


def scene_up(cameras: Sequence[Camera]) -> Vector:
    """Return the up direction of a capture's cameras; the world's, (0, -1, 0), if there are no cameras."""
    x, y, z = common_up(cameras) if cameras else WORLD_UP
    return float(x), float(y), float(z)


def capture_scene(gaussians: Gaussians, dataset: Dataset, antialiased: bool) -> Scene:
    """Return the scene of a training: its Gaussians with the capture's origin, up direction and unit.

    Args:
        gaussians: Relative to the dataset's origin.
        dataset: The capture.
        antialiased: Whether they were trained for antialiased rendering.
    """
    unit, earth = (None, None) if dataset.scale is None else (dataset.scale.unit, dataset.scale.earth)
    origin = as_origin("origin", dataset.origin)
    return Scene(gaussians.map(Tensor.detach), antialiased, capture_up(dataset), unit, origin, earth)


def capture_up(dataset: Dataset) -> Vector:
    """Return the up direction of a capture.

    It is (0, -1, 0) where GPS has levelled the capture. Otherwise it follows from the cameras, and in layouts whose
    coordinates have a vertical axis (all but COLMAP's), it is the axis that lies near.
    """
    if dataset.scale is not None and dataset.scale.level:
        return WORLD_UP
    up = scene_up([view.camera for view in (*dataset.train, *dataset.test)])
    axis = int(np.argmax(np.abs(up)))
    if dataset.layout == COLMAP or abs(up[axis]) < VERTICAL:
        return up
    x, y, z = np.copysign(np.eye(3)[axis], up[axis]) + 0.0
    return float(x), float(y), float(z)
