"""Write a scene in any format, including the HTML page, and check the written file."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsplat_edu.base.constants import POINT_SUFFIXES
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_folder
from gsplat_edu.evaluate.fidelity import compare_scenes
from gsplat_edu.evaluate.metrics import ImageScore, summarize, worst
from gsplat_edu.io import formats, las
from gsplat_edu.io.formats import (
    FORMATS,
    LOD_FORMATS,
    LOD_META,
    READ_FORMATS,
    READ_ONLY,
    SOG_META,
    TILESET,
    format_of,
    read_scene,
    write_scene,
)
from gsplat_edu.io.lod import codec as lod_codec, tiles
from gsplat_edu.io.lod.levels import LodOptions, build_levels
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.usd_package import require_usd
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of
from gsplat_edu.runs.lod_refinement import LevelScore, refine_levels
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.rig import through_lenses
from gsplat_edu.viewer import page
from gsplat_edu.viewer.page_proof import poster_jpeg

VEIL = (
    "the scene was trained through its photos' own lenses: viewers that draw pinholes may show splats far beside the"
    " picture as a veil over it, which a page leaves out; for such viewers, train with --lens undistort"
)
"""What a scene file cannot tell other viewers."""

PAGE = ".html"
"""Suffix of the HTML page that renders a scene in a browser."""

POINTS = "the centres of the splats as points"
"""What a point cloud contains, in words."""

VIEWS = 8
"""Number of cameras used to check a file."""

SIDE = 800
"""Longer side of the images used to check a file, px."""


@dataclass(frozen=True)
class Exported:
    """A written file and its comparison with the source.

    Args:
        path: The file.
        num_bytes: Its size; for a SOG folder, the size of the whole folder.
        num_gaussians: Number of Gaussians in it.
        psnr: Mean over the cameras, dB; 100 for equal images.
        worst_psnr: PSNR of the camera with the largest difference, dB.
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
        """Summarise the comparison in one line."""
        size = f"{self.num_bytes:,} bytes, {self.num_bytes / max(self.num_gaussians, 1):.1f} per splat"
        lowest = f"worst {self.worst_psnr:.2f} ({self.worst_view})"
        return f"{self.path}: PSNR {self.psnr:.2f} dB over {self.num_views} views, {lowest}; {size}"

    def document(self) -> dict[str, Any]:
        """Return the entry for metrics.json."""
        return {**self.__dict__, "path": str(self.path)}


def check_target(name: str, path: Path) -> None:
    """Check that a scene can be written to a path, before anything is computed.

    Args:
        name: The user's name for the argument, for messages.
        path: The file.

    Raises:
        ArgumentError: the suffix belongs to no format that is written, or to one whose library is not installed, the
            path is a folder, or its parent folder is not writable.
    """
    if path.suffix.lower() != PAGE:
        try:
            found = format_of(path)
        except ArgumentError:
            folders = [f"FOLDER/{name}" for name in (SOG_META, *(each.suffix for each in LOD_FORMATS))]
            known = ", ".join([*(each.suffix for each in FORMATS), PAGE, *folders])
            raise ArgumentError(f"{name}: {path}: unknown scene format; known are {known}") from None
        if found in READ_FORMATS:
            raise ArgumentError(f"{name}: {path}: {found.name} {READ_ONLY}")
    if path.suffix.lower() == ".usdc":
        require_usd(f"{name}: {path}")
    if is_points(path):
        las.require_laspy(f"{name}: {path}")
    if path.is_dir():
        raise ArgumentError(f"{name}: {path} is a folder; give a file name")
    check_folder(name, path.parent)


def is_points(path: Path) -> bool:
    """Return whether a path denotes a point cloud, which cannot be rendered or read back as a scene."""
    return path.suffix.lower() in POINT_SUFFIXES


def has_levels(path: Path) -> bool:
    """Return whether a path denotes a folder with levels of detail."""
    return path.name.lower() in (found.suffix for found in LOD_FORMATS)


def write(
    path: Path, source: Source, tour: page.Tour | None = None, options: LodOptions | None = None
) -> None:
    """Write a scene in the format given by the file's name; a page also gets the cameras, settings and a poster.

    Args:
        path: Output file.
        source: The scene.
        tour: Views and a camera path for the page, in the coordinates of the scene; None for none.
        options: How levels of detail are made, for formats that have them; None for the usual way.

    Raises:
        ArgumentError: the suffix belongs to no format, or the format cannot hold the scene.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    if path.suffix.lower() == PAGE:
        tour = with_poster(tour or page.Tour(), source)
        page.write(path, source.scene, source.cameras, source.settings, source.held_out, tour)
    elif path.name.lower() == LOD_META:
        lod_codec.write(path, source.scene, options)
    elif path.name.lower() == TILESET:
        tiles.write(path, source.scene, options)
    else:
        write_scene(path, source.scene)


def with_poster(tour: page.Tour, source: Source) -> page.Tour:
    """Return a page's tour with a still of the scene, if there is something to see."""
    if not len(source.scene.gaussians):
        return tour
    start = tour.start or page.usual_start(source.scene, source.cameras, source.held_out)
    return replace(tour, poster=poster_jpeg(source, start.camera, tour.proof))


def write_refined(
    path: Path, source: Source, options: LodOptions, steps: int, backend: str, say: Callable[[str], None]
) -> list[LevelScore]:
    """Write a lod-meta.json whose levels are refined against photos; see `gsplat_edu.runs.lod_refinement`.

    Args:
        path: The lod-meta.json.
        source: The scene, of a run or without photos.
        options: How levels are made.
        steps: Iterations per level.
        backend: Backend of the renders.
        say: Called with a line per level.

    Returns:
        The score of each level.

    Raises:
        CheckpointError: the run is damaged, or its capture is gone.
        DatasetError: a photo cannot be read.
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    source.scene.gaussians.check_finite()
    root, scores = refine_levels(source, build_levels(source.scene.gaussians, options), steps, backend, say)
    lod_codec.write_levels(path, root, source.scene, options.chunk)
    return scores


def levels_line(path: Path, scene: Scene) -> str:
    """Describe the levels of a written lod-meta.json, or the tiles of a tileset.json, in one line.

    Args:
        path: The file.
        scene: What was written into it.
    """
    if path.name.lower() == TILESET:
        count = len(list((path.parent / "tiles").glob("*.glb")))
        size = f"{formats.stored_bytes(path):,} bytes"
        try:
            middle = tiles.on_globe(scene).place_of(scene.origin)
        except ArgumentError as error:
            return f"{count} tiles, {size}; upright, but not placed on the globe: {error}"
        return f"{count} tiles, {size}; on the globe, zero at {middle}"
    index = lod_codec.read_index(path)
    counts = ", ".join(f"{count:,}" for count in index.counts())
    errors = [max(region.errors[level] for region in index.regions) for level in range(index.levels)]
    lengths = ", ".join(f"{error:.3g}" for error in errors)
    size = f"{len(index.filenames)} files, {lod_codec.stored_bytes(path):,} bytes"
    return f"levels of {counts} splats; errors up to {lengths} units; {len(index.regions)} leaves, {size}"


def losses(path: Path, source: Source) -> list[str]:
    """List the parts of a scene that the format of a path cannot store, one sentence each."""
    if path.suffix.lower() == PAGE:
        return []
    veiled = not is_points(path) and through_lenses(camera for _, camera in source.cameras)
    return [*formats.losses(path, source.scene), *([VEIL] if veiled else [])]


def kept_degree(path: Path, scene: Scene) -> int:
    """Return the highest SH degree of a scene that the format of a path can store."""
    degree = scene.gaussians.sh_degree
    return degree if path.suffix.lower() == PAGE else min(degree, format_of(path).sh_degree)


def read_back(path: Path) -> Scene:
    """Read a file written by `write`.

    Raises:
        SceneFormatError: the file is damaged.
        OSError: the file cannot be read.
    """
    return page.read(path) if path.suffix.lower() == PAGE else read_scene(path)


def check(
    path: Path, source: Source, backend: str, on_score: Callable[[ImageScore], None] | None = None
) -> Exported:
    """Compare renders of a written file with renders of its source from the same cameras.

    A file that stores an origin is placed by it, so that one that lies elsewhere is seen to differ.

    Args:
        path: The file.
        source: The source, with its cameras and settings.
        backend: Backend of the renders.
        on_score: Called with each camera's score.

    Raises:
        ArgumentError: there is nothing to render.
        SceneFormatError: the file cannot be read.
    """
    scene = read_back(path)
    kept = path.suffix.lower() == PAGE or format_of(path).metadata
    written = scene.relative_to(source.origin) if kept else scene.gaussians
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
