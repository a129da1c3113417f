"""From a scene to a mesh: depth maps, a volume of signed distances, its surface, and tidying."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.base.headroom import available_memory
from gsplat_edu.base.text import short_number, spelled_bytes
from gsplat_edu.evaluate.paths import resized
from gsplat_edu.mesh.depths import (
    CONTRADICTIONS,
    LEAST_ALPHA,
    DepthCounts,
    DepthView,
    Progress,
    checked,
    focal,
    render_depths,
)
from gsplat_edu.mesh.faces import faces_of
from gsplat_edu.mesh.tidy import TidySettings, tidied
from gsplat_edu.mesh.volume import TRUNCATION, SparseVolume
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.rig import through_lenses

VOXEL_PIXELS = 1.5
"""Edge of a voxel at the median depth, px."""

COARSEST = 4.0
"""Depths are dropped where a pixel covers more voxels than this: the surface there would be stairs."""

MOST_TRUNCATION = 8.0
"""Largest truncation, voxels: beyond it, corners and thin things fill up."""

LARGER_VOXEL = 1.25
"""Factor on the voxel if the volume does not fit into the memory."""

BLOCK = 8
"""Voxels along an edge of a block of the volume."""

MOST_ENLARGEMENTS = 12
"""Largest number of such steps: voxels 15 times as large."""

LONGEST_SIDE = 1_600
"""Depth maps are rendered with at most so many px on the longer side."""


PROGRAM_BYTES = 450 * 2**20
"""Memory of the process with a scene before it renders depth maps."""

PIXEL_BYTES = 10
"""Memory of a pixel of the depth maps."""

AFTERWARDS = 1.6
"""Memory of mesh, tidying and what is found out about the mesh, as a multiple of the volume's, which is freed first."""


@dataclass(frozen=True)
class MeshSettings:
    """How a mesh is made.

    Args:
        voxel: Edge of a voxel, world units; None for `VOXEL_PIXELS` at the median depth.
        bounds: (2, 3) lower and upper corner of the box to mesh, world units; None for everything that is seen.
        max_bytes: Most memory of the volume, as of `volume_room`; None for what is free.
        tidy: How the surface is tidied.
    """

    voxel: float | None = None
    bounds: Float64[np.ndarray, "2 3"] | None = None
    max_bytes: int | None = None
    tidy: TidySettings = field(default_factory=TidySettings)


@dataclass(frozen=True, eq=False)
class MeshResult:
    """A mesh, and how it came about.

    Args:
        mesh: The mesh, with a colour for each vertex.
        voxel: Edge of a voxel, world units.
        truncation: Truncation of the signed distances, world units.
        volume_bytes: Memory of the volume.
        counts: What happened to the pixels of the depth maps.
        views: The depth maps that the mesh is made from.
        notes: What was left out or changed, and why, a sentence each.
    """

    mesh: Mesh
    voxel: float
    truncation: float
    volume_bytes: int
    counts: DepthCounts
    views: Sequence[DepthView]
    notes: tuple[str, ...]


def extract_mesh(
    gaussians: Gaussians,
    cameras: Sequence[tuple[str, Camera]],
    render_settings: RenderSettings,
    backend: Backend,
    settings: MeshSettings | None = None,
    progress: Progress = lambda what, done, total: None,
) -> MeshResult:
    """Make a mesh of the surfaces that cameras see.

    Args:
        gaussians: The scene.
        cameras: Names and cameras of its views, at least one; the order of the views is part of the result.
        render_settings: How the scene is rendered.
        backend: What renders.
        settings: Voxels, bounds, memory and tidying; None for the defaults.
        progress: Called after every view of every stage.

    Raises:
        ArgumentError: there are no cameras or no Gaussians, or the views show no surface.
        NotEnoughMemoryError: the volume does not fit, with a given voxel, or at all.
    """
    settings = MeshSettings() if settings is None else settings
    if not cameras or not len(gaussians):
        raise ArgumentError("mesh: needs at least one camera and one splat")
    notes = []
    shown = [(name, _fitting(camera)) for name, camera in cameras]
    if any(small is not camera for (_, small), (_, camera) in zip(shown, cameras, strict=True)):
        notes.append(f"depth maps have at most {LONGEST_SIDE} px on their longer side")
    if through_lenses(camera for _, camera in shown):
        notes.append(
            "cameras with a lens of their own are shown by pinholes, of wide lenses by faces of a cube"
        )
    rendered = render_depths(gaussians, shown, render_settings, backend, progress)
    wanted = settings.voxel or default_voxel(rendered)
    volume, views, counts = _filled(rendered, wanted, settings, progress)
    voxel, truncation, memory = volume.voxel, volume.truncation, volume.memory
    if voxel > wanted:
        notes.append(
            f"voxels of {voxel:.4g} instead of {wanted:.4g}, so that the volume fits into the memory"
        )
    raw = volume.mesh()
    del volume  # tidying needs memory too
    if not len(raw.faces):
        raise ArgumentError(
            "mesh: the views show no surface; train longer, choose a larger --voxel, or look at the depths with"
            " render --maps"
        )
    progress("tidying", 0, 1)
    before = len(raw.faces)
    mesh = tidied(raw, settings.tidy)
    progress("tidying", 1, 1)
    notes += _sentences(counts)
    if len(mesh.faces) != before:
        notes.append(f"{before:,} faces before tidying, {len(mesh.faces):,} after it")
    return MeshResult(mesh, voxel, truncation, memory, counts, views, tuple(notes))


def volume_room(most: int | None, cameras: Sequence[tuple[str, Camera]]) -> int | None:
    """Return how much memory the volume may take so that all work on a mesh fits.

    Args:
        most: Most memory of the process, bytes; None for what it has now and what is free.
        cameras: Names and cameras of the depth maps.

    Returns:
        Bytes, for `MeshSettings.max_bytes`; None if `most` is None and the system does not say what is free.

    Raises:
        NotEnoughMemoryError: the depth maps alone do not fit.
    """
    faces = [face for _, camera in cameras for face in faces_of(_fitting(camera))]
    maps = PIXEL_BYTES * sum(face.W * face.H for face in faces)
    left = available_memory() if most is None else most - PROGRAM_BYTES
    if left is None:
        return None
    if left <= maps:
        needed = spelled_bytes(maps if most is None else maps + PROGRAM_BYTES)
        raise NotEnoughMemoryError(f"mesh: {len(faces)} depth maps need {needed}; give more memory")
    return int((left - maps) / AFTERWARDS)


def _fitting(camera: Camera) -> Camera:
    """Return a camera whose image is at most `LONGEST_SIDE` on its longer side."""
    return resized(camera, LONGEST_SIDE) if max(camera.W, camera.H) > LONGEST_SIDE else camera


def _filled(
    rendered: Sequence[DepthView], wanted: float, settings: MeshSettings, progress: Progress
) -> tuple[SparseVolume, list[DepthView], DepthCounts]:
    """Return the volume of the depth maps, the maps as they were used, and their counts.

    Voxels are enlarged until the volume fits into the memory, unless the settings give their size.

    Raises:
        NotEnoughMemoryError: the volume does not fit.
    """
    voxel = wanted
    for step in range(MOST_ENLARGEMENTS + 1):
        views, counts = checked(rendered, COARSEST * voxel, progress)
        if settings.bounds is not None:
            views = [_within(view, settings.bounds) for view in views]
        truncation = max(TRUNCATION * voxel, _twice_the_error(views, counts))
        volume = SparseVolume(voxel, min(truncation, MOST_TRUNCATION * voxel), settings.max_bytes)
        fixed = settings.voxel is not None or step == MOST_ENLARGEMENTS
        fitting = _integrate(volume, views, progress, must_fit=fixed)
        if fitting == len(views):
            return volume, views, counts
        del volume
        voxel = _enlarged(voxel, views, max(fitting, 1))
    raise AssertionError("the last step returns or raises")


def _enlarged(voxel: float, views: Sequence[DepthView], fitting: int) -> float:
    """Return a larger voxel, with which all views touch about as many blocks as the first `fitting` views do now."""
    points = [_some_points(view) for view in views]
    most = _touched(points[:fitting], voxel)
    for _ in range(MOST_ENLARGEMENTS):
        voxel *= LARGER_VOXEL
        if _touched(points, voxel) <= most:
            break
    return voxel


def _some_points(view: DepthView) -> Float64[np.ndarray, "n 3"]:
    """Return the points of every `BLOCK`-th row and column of a depth map."""
    depth = view.depth[::BLOCK, ::BLOCK].astype(np.float64)
    rows, columns = np.nonzero(depth)
    rays = view.camera.rays()[::BLOCK, ::BLOCK][rows, columns]
    return np.asarray(view.camera.eye + depth[rows, columns][:, None] * rays)


def _touched(points: Sequence[Float64[np.ndarray, "_ 3"]], voxel: float) -> int:
    """Return about how many blocks contain a point: those of one hash count once."""
    x, y, z = np.floor(np.concatenate(points) / (BLOCK * voxel)).astype(np.int64).T
    return len(np.unique(x * 73_856_093 ^ y * 19_349_663 ^ z * 83_492_791))


def default_voxel(views: Sequence[DepthView]) -> float:
    """Return `VOXEL_PIXELS` times the size of a pixel at the median depth of all views.

    Raises:
        ArgumentError: no view shows a surface.
    """
    sizes = [
        float(np.median(view.depth[view.depth > 0])) / focal(view.camera)
        for view in views
        if view.depth.any()
    ]
    if not sizes:
        raise ArgumentError(
            f"mesh: no view has a pixel with an alpha of {LEAST_ALPHA:g} or more; train longer, or render other views"
        )
    return VOXEL_PIXELS * float(np.median(sizes))


def _twice_the_error(views: Sequence[DepthView], counts: DepthCounts) -> float:
    """Return two standard deviations of the depth maps' disagreement at the median depth, world units.

    The median of |x| of a normal distribution is 0.6745 of its standard deviation; the difference of two maps has the
    root of two times that of one.
    """
    depths = [float(np.median(view.depth[view.depth > 0])) for view in views if view.depth.any()]
    if not depths:
        return 0.0
    return 2.0 * counts.error * float(np.median(depths)) / (0.6745 * math.sqrt(2.0))


def _within(view: DepthView, bounds: Float64[np.ndarray, "2 3"]) -> DepthView:
    """Return the view without the depths outside a box."""
    points = view.camera.eye + view.depth[..., None] * view.camera.rays()
    return view.only(((points >= bounds[0]) & (points <= bounds[1])).all(axis=-1))


def _integrate(volume: SparseVolume, views: Sequence[DepthView], progress: Progress, must_fit: bool) -> int:
    """Add the views to the volume; return how many of them fit.

    Raises:
        NotEnoughMemoryError: they do not all fit, but have to.
    """
    for done, view in enumerate(views, 1):
        if view.depth.any():
            try:
                volume.integrate(view.depth, view.camera, view.weight, view.image)
            except NotEnoughMemoryError:
                if must_fit:
                    raise
                return done - 1
        progress("volume", done, len(views))
    return len(views)


def _sentences(counts: DepthCounts) -> list[str]:
    """Say what share of the depth maps' pixels was left out, and why."""
    reasons = (
        (counts.transparent, f"show nothing opaque (alpha below {LEAST_ALPHA:g})"),
        (counts.edge_on, "see a surface edge-on or at its border"),
        (counts.far, f"are so far away that a pixel covers more than {COARSEST:g} voxels"),
        (counts.contradicted, f"are seen through by {CONTRADICTIONS} neighbouring views"),
    )
    return [
        f"{short_number(100 * number / counts.pixels, 2)} % of the pixels left out: they {reason}"
        for number, reason in reasons
        if number
    ]
