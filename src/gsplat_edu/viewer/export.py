"""Writing a scene in any format, the page included, and checking what the file shows."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.errors import ArgumentError
from gsplat_edu.evaluate.fidelity import compare_scenes
from gsplat_edu.evaluate.metrics import ImageScore, summarize, worst
from gsplat_edu.files import check_folder
from gsplat_edu.io import formats
from gsplat_edu.io.formats import FORMATS, SOG_META, format_of, read_scene, write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of
from gsplat_edu.runs.source import Source
from gsplat_edu.viewer import page

PAGE = ".html"
"""Suffix of the page that draws a scene in a browser."""

VIEWS = 8
"""Cameras that a file is checked from."""

SIDE = 800
"""px: longer side of the images it is checked by."""


@dataclass(frozen=True)
class Exported:
    """What was written, and how it compares with what was to be written.

    Args:
        path: The file.
        num_bytes: Its size; that of the whole folder for a SOG in one.
        num_gaussians: Gaussians in it.
        psnr: Mean over the cameras, dB; 100 for equal images.
        worst_psnr: Of the camera that shows the largest difference, dB.
        worst_view: That camera's name.
        num_views: Number of cameras.
    """

    path: Path
    num_bytes: int
    num_gaussians: int
    psnr: float
    worst_psnr: float
    worst_view: str
    num_views: int

    def line(self) -> str:
        """Say it in one line."""
        size = f"{self.num_bytes:,} bytes, {self.num_bytes / max(self.num_gaussians, 1):.1f} per splat"
        lowest = f"worst {self.worst_psnr:.2f} ({self.worst_view})"
        return f"{self.path}: PSNR {self.psnr:.2f} dB over {self.num_views} views, {lowest}; {size}"

    def document(self) -> dict[str, Any]:
        """Return what metrics.json holds of it."""
        return {**self.__dict__, "path": str(self.path)}


def check_target(name: str, path: Path) -> None:
    """Find out, before anything is computed, whether a scene can be written under a name.

    Args:
        name: What the user calls it, for the message.
        path: The file.

    Raises:
        ArgumentError: its name has no suffix of a format, it is a folder, or its folder cannot be written to.
    """
    if path.suffix.lower() != PAGE:
        try:
            format_of(path)
        except ArgumentError:
            known = ", ".join([*(found.suffix for found in FORMATS), PAGE, f"FOLDER/{SOG_META}"])
            raise ArgumentError(f"{name}: {path}: ends like no scene format; known are {known}") from None
    if path.is_dir():
        raise ArgumentError(f"{name}: {path} is a folder; give the name of a file")
    check_folder(name, path.parent)


def write(path: Path, source: Source) -> None:
    """Write a scene in the format of the file's name; a page gets the cameras and settings too.

    Raises:
        ArgumentError: the name has no suffix of a format, or the format cannot hold the scene.
        OSError: it cannot be written. What stood there before is untouched.
    """
    if path.suffix.lower() == PAGE:
        page.write(path, source.scene, source.cameras, source.settings, source.held_out)
    else:
        write_scene(path, source.scene)


def losses(path: Path, scene: Scene) -> list[str]:
    """Say what of a scene a file of that name cannot hold at all: a sentence each."""
    return [] if path.suffix.lower() == PAGE else formats.losses(path, scene)


def kept_degree(path: Path, scene: Scene) -> int:
    """Return the highest degree of harmonics of a scene that a file of that name holds."""
    degree = scene.gaussians.sh_degree
    return degree if path.suffix.lower() == PAGE else min(degree, format_of(path).sh_degree)


def read_back(path: Path) -> Scene:
    """Read what `write` wrote.

    Raises:
        SceneFormatError: the file is damaged.
        OSError: it cannot be read.
    """
    return page.read(path) if path.suffix.lower() == PAGE else read_scene(path)


def check(
    path: Path, source: Source, backend: str, on_score: Callable[[ImageScore], None] | None = None
) -> Exported:
    """Render a file and what was written to it from the same cameras.

    Args:
        path: The file.
        source: What was to be written, its cameras and its settings.
        backend: Of the renders.
        on_score: Is told of every camera.

    Raises:
        ArgumentError: there is nothing to render.
        SceneFormatError: the file cannot be read.
    """
    written = read_back(path).gaussians
    device = device_of(backend)
    scores = compare_scenes(
        source.scene.gaussians.to(device),
        written.to(device),
        source.probes(VIEWS, SIDE),
        functools.partial(render, settings=source.settings, backend=backend),
        on_score,
    )
    lowest = worst(scores)
    mean = float(summarize(scores)["psnr"] or 0.0)
    return Exported(
        path, formats.stored_bytes(path), len(written), mean, lowest.psnr, lowest.name, len(scores)
    )
