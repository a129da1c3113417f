"""From a scene to a mesh: depth maps, a volume of signed distances, its surface, and tidying."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.base.text import short_number
from gsplat_edu.mesh.depths import (
    CONTRADICTIONS,
    LEAST_ALPHA,
    DepthCounts,
    DepthView,
    Progress,
    checked,
    render_depths,
)
from gsplat_edu.mesh.plan import LONGEST_SIDE, default_voxel, fitting, touched
from gsplat_edu.mesh.tidy import TidySettings, tidied
from gsplat_edu.mesh.volume import TRUNCATION, SparseVolume
from gsplat_edu.paths.orbits import orbit_of_scene
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.rig import through_lenses

COARSEST = 4.0
"""Depths are dropped where a pixel covers more voxels than this: the surface there would be stairs."""

ERRORS = 3.0
"""Least truncation, standard deviations of the depth maps' errors. A view says less and less about voxels that lie more
than half the truncation behind its surface, so errors that put a surface too near count less than those that put it too
far. The surface moves inward by 0.19 deviations at 2, by 0.05 at 3 (normal errors)."""

MOST_TRUNCATION = 8.0
"""Largest truncation, voxels: beyond it, corners and thin things fill up."""

LARGER_VOXEL = 1.25
"""Factor on the voxel if the volume does not fit into the memory."""

MOST_ENLARGEMENTS = 12
"""Largest number of such steps: voxels 15 times as large."""

BLOCK = 8
"""Voxels along an edge of a block of the volume."""

ORBIT_VIEWS, ORBIT_SIDE = 8, 384
"""Views of each of the six orbits around a scene without cameras, and their width and height, px."""

FEWER = 1.02
"""Factor on a voxel that would just give the number of triangles: their number is no exact power of it."""


@dataclass(frozen=True)
class MeshSettings:
    """How a mesh is made.

    Args:
        voxel: Edge of a voxel, world units; None for 1.5 px at the median depth, or more if the limits ask for it.
        least_voxel: Without `voxel`, the smallest edge, world units, as of `plan_mesh`.
        most_faces: Most triangles before tidying, as of `plan_mesh`; None for any number.
        bounds: (2, 3) lower and upper corner of the box to mesh, world units; None for everything that is seen.
        max_bytes: Most memory of the volume, as of `plan_mesh`; None for what is free.
        tidy: How the surface is tidied.
    """

    voxel: float | None = None
    least_voxel: float = 0.0
    most_faces: int | None = None
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
        progress: Called with the stage that runs, after every view or step of it.

    Raises:
        ArgumentError: there are no cameras or no Gaussians, or the views show no surface.
        NotEnoughMemoryError: the volume or its triangles do not fit, with a given voxel, or at all.
    """
    settings = MeshSettings() if settings is None else settings
    if not cameras or not len(gaussians):
        raise ArgumentError("mesh: needs at least one camera and one splat")
    notes = []
    shown = [(name, fitting(camera)) for name, camera in cameras]
    if any(small is not camera for (_, small), (_, camera) in zip(shown, cameras, strict=True)):
        notes.append(f"depth maps have at most {LONGEST_SIDE} px on their longer side")
    if through_lenses(camera for _, camera in shown):
        notes.append(
            "cameras with a lens of their own are shown by pinholes, of wide lenses by faces of a cube"
        )
    rendered = render_depths(gaussians, shown, render_settings, backend, progress)
    wanted = settings.voxel or max(default_voxel(rendered), settings.least_voxel)
    cut = cut_surface(rendered, wanted, settings, progress)
    if cut.voxel > wanted:
        limits = "the volume fits into the memory"
        if settings.most_faces is not None:
            limits += f" and has at most {settings.most_faces:,} triangles"
        notes.append(f"voxels of {cut.voxel:.4g} instead of {wanted:.4g}, so that {limits}")
    before = len(cut.raw.faces)
    if not before:
        raise ArgumentError(
            "mesh: the views show no surface; train longer, choose a larger `voxel`, or look at the"
            " rendered depths"
        )
    mesh = tidied(cut.raw, settings.tidy, progress)
    notes += _sentences(cut.counts)
    if len(mesh.faces) != before:
        notes.append(f"{before:,} faces before tidying, {len(mesh.faces):,} after it")
    return MeshResult(mesh, cut.voxel, cut.truncation, cut.memory, cut.counts, cut.views, tuple(notes))


def mesh_of(
    gaussians: Gaussians,
    cameras: Sequence[CameraLike] | None = None,
    *,
    render_settings: RenderSettings | None = None,
    settings: MeshSettings | None = None,
    backend: str = "auto",
) -> Mesh:
    """Make a mesh of Gaussians in one call; `extract_mesh` returns depth maps and counts as well.

    Args:
        gaussians: The scene: N Gaussians, at least one.
        cameras: The cameras whose view of it counts, such as those of a dataset; None for orbits around each axis,
            which suit an object that is seen from outside.
        render_settings: How the scene is rendered; None for the defaults.
        settings: Voxels, bounds, memory and tidying; None for the defaults.
        backend: What renders, by name.

    Returns:
        Vertices in world units, faces and colours. `gsplat_edu.io.mesh_files.write_mesh` writes it.

    Raises:
        ArgumentError: there are no Gaussians or no cameras, or the views show no surface.
        BackendUnavailableError: the backend cannot run here.
        NotEnoughMemoryError: as for `extract_mesh`.
    """
    if cameras is None:
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        cameras = [camera for up in axes for camera in orbit_of_scene(gaussians, ORBIT_VIEWS, ORBIT_SIDE, up)]
    named = [(f"view {k}", as_camera(f"cameras[{k}]", camera)) for k, camera in enumerate(cameras)]
    chosen = load_backend(backend, gaussians.means.device)
    with torch.no_grad():
        detached = gaussians.map(torch.Tensor.detach)
        return extract_mesh(detached, named, render_settings or RenderSettings(), chosen, settings).mesh


class CutSurface(NamedTuple):
    """The surface of a volume, and what is known of the volume, which is freed."""

    raw: Mesh
    voxel: float
    truncation: float
    memory: int
    views: list[DepthView]
    counts: DepthCounts


def cut_surface(
    rendered: Sequence[DepthView], wanted: float, settings: MeshSettings, progress: Progress
) -> CutSurface:
    """Return the surface of the depth maps.

    Voxels are enlarged until the volume fits into the memory and its surface has at most `settings.most_faces`
    triangles, unless the settings give their size.

    Raises:
        NotEnoughMemoryError: the volume or its surface does not fit.
    """
    voxel = wanted
    for step in range(MOST_ENLARGEMENTS + 1):
        fixed = settings.voxel is not None or step == MOST_ENLARGEMENTS
        volume, views, counts, added = _filled(rendered, voxel, settings, progress, must_fit=fixed)
        if added < len(views):
            del volume
            voxel = _enlarged(voxel, views, max(added, 1))
            continue
        progress("triangles", 0, 1)
        raw = volume.mesh()
        progress("triangles", 1, 1)
        excess = 0.0 if settings.most_faces is None else len(raw.faces) / settings.most_faces
        if excess <= 1.0:
            return CutSurface(raw, volume.voxel, volume.truncation, volume.memory, views, counts)
        if fixed:
            raise NotEnoughMemoryError(
                f"voxel: {voxel:.3g} makes {len(raw.faces):,} triangles, but the memory has room for"
                f" {settings.most_faces:,}; take a `voxel` of {FEWER * voxel * math.sqrt(excess):.2g} or more"
            )
        del volume, raw
        voxel *= FEWER * math.sqrt(excess)
    raise AssertionError("the last step returns or raises")


def _filled(
    rendered: Sequence[DepthView], voxel: float, settings: MeshSettings, progress: Progress, must_fit: bool
) -> tuple[SparseVolume, list[DepthView], DepthCounts, int]:
    """Return the volume of the depth maps, the maps as they were used, their counts, and how many maps fit.

    Raises:
        NotEnoughMemoryError: they do not all fit, but have to.
    """
    views, counts = checked(rendered, COARSEST * voxel, progress)
    if settings.bounds is not None:
        views = [_within(view, settings.bounds) for view in views]
    truncation = max(TRUNCATION * voxel, ERRORS * _error(views, counts))
    volume = SparseVolume(voxel, min(truncation, MOST_TRUNCATION * voxel), settings.max_bytes)
    return volume, views, counts, _integrate(volume, views, progress, must_fit)


def _enlarged(voxel: float, views: Sequence[DepthView], fitting: int) -> float:
    """Return a larger voxel, with which all views touch about as many blocks as the first `fitting` views do now."""
    points = [_some_points(view) for view in views]
    most = touched(points[:fitting], BLOCK * voxel)
    for _ in range(MOST_ENLARGEMENTS):
        voxel *= LARGER_VOXEL
        if touched(points, BLOCK * voxel) <= most:
            break
    return voxel


def _some_points(view: DepthView) -> Float64[np.ndarray, "n 3"]:
    """Return the points of every `BLOCK`-th row and column of a depth map."""
    depth = view.depth[::BLOCK, ::BLOCK].astype(np.float64)
    rows, columns = np.nonzero(depth)
    rays = view.camera.rays()[::BLOCK, ::BLOCK][rows, columns]
    return np.asarray(view.camera.eye + depth[rows, columns][:, None] * rays)


def _error(views: Sequence[DepthView], counts: DepthCounts) -> float:
    """Return the standard deviation of the depth maps' disagreement at the median depth, world units.

    The median of |x| of a normal distribution is 0.6745 of its standard deviation; the difference of two maps has the
    root of two times that of one.
    """
    depths = [float(np.median(view.depth[view.depth > 0])) for view in views if view.depth.any()]
    if not depths:
        return 0.0
    return counts.error * float(np.median(depths)) / (0.6745 * math.sqrt(2.0))


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
