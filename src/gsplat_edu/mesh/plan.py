"""What a mesh will take, before it is made: voxels, triangles, memory and time.

In voxels of edge s, a surface of area A that faces all directions alike crosses A / (2 s²) edges of the grid along each
axis. Each crossed edge becomes a vertex, and a closed mesh has two triangles per vertex:

    triangles = 3 A / s²

A cube of edge c covers c (|nx| + |ny| + |nz|) along a normal n, 3/2 c on average, so the surface crosses 3 A / (2 c²)
cubes. A is found from the number of cubes that small depth maps touch; so rough surfaces count with all their folds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.base.text import short_number, spelled_bytes, spelled_seconds
from gsplat_edu.mesh.depths import LEAST_ALPHA, DepthView, Progress, focal, render_depths
from gsplat_edu.mesh.faces import faces_of
from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

VOXEL_PIXELS = 1.5
"""Edge of a voxel at the median depth, px."""

LARGEST = 16.0
"""Largest voxels that a plan chooses, in voxels of the usual size."""

LONGEST_SIDE = 1_600
"""Depth maps are rendered with at most so many px on the longer side."""

SURVEYED, SHRUNK = 200, 4
"""A survey renders so many views at most, their sides divided by this number, and counts cubes whose edges are as many
voxels, which are larger than its pixels. On a draft of a room it foretold 2.2 of 1.8 million triangles, on a ball 1.1
times their number; 8 instead of 4 misses half of the folds of the room."""

JOINED = 2.0
"""Neighbouring pixels of a survey are of one surface if their points are nearer than this, in cubes."""

PROGRAM_BYTES = 450 * 2**20
"""Memory of the process with a scene before it renders depth maps."""

PIXEL_BYTES = 10
"""Memory of a pixel of the depth maps."""

VOLUME_SHARE = 0.8
"""Share of the memory left by the depth maps that the volume may take. It takes about 170 bytes for each triangle, less
than what follows, and up to twice as much if depth maps disagree."""

FACE_BYTES = 700
"""Memory for each triangle before it is simplified, with the volume freed: tidying, simplifying and what is found out
about the mesh took 510 to 590 on 2.4 million triangles."""

TEXTURE_BYTES = 900 * 2**20
"""Memory of painting a texture: 850 MiB were measured."""

PIXEL_SECONDS = 1.5e-6
"""Time to check and integrate a pixel of a depth map, on one core of a Zen 5."""

FACE_SECONDS = 2e-5
"""Time to tidy, simplify and judge a triangle, likewise."""

TEXTURE_SECONDS = 40.0
"""Time to lay a mesh out and paint it, likewise."""


@dataclass(frozen=True)
class Survey:
    """What small depth maps tell of a scene.

    Args:
        maps: Number of depth maps of the mesh.
        pixels: Number of their pixels.
        voxel: Edge of a voxel of the usual size, world units.
        area: Area of the surfaces, square world units.
        seconds: Time to render the depth maps.
    """

    maps: int
    pixels: int
    voxel: float
    area: float
    seconds: float = 0.0


@dataclass(frozen=True)
class Demand:
    """What a mesh has to be like.

    Args:
        voxel: Edge of a voxel, world units; None to choose it.
        coarse: Without `voxel`, the smallest one is so many of the usual size.
        faces: Most triangles before they are simplified, if the voxel is chosen; None for any number.
        memory: Most memory of the process, bytes; None for what is free.
        texture: Whether it is painted.
    """

    voxel: float | None = None
    coarse: float = 1.0
    faces: int | None = None
    memory: int | None = None
    texture: bool = False


@dataclass(frozen=True)
class MeshPlan:
    """What a mesh will take.

    Args:
        voxel: Edge of a voxel, world units.
        triangles: About how many there are before they are simplified.
        memory: Memory of the process, or, without a limit, of what it still has to take, bytes.
        room: Most memory of the volume, bytes; None for any.
        most_faces: Most triangles before they are simplified; None for any number.
        seconds: About how long it takes.
        reason: Why voxels are larger than wanted; empty if they are not.
    """

    voxel: float
    triangles: int
    memory: int
    room: int | None
    most_faces: int | None
    seconds: float
    reason: str = ""

    @property
    def sentence(self) -> str:
        """The plan in one line."""
        why = f" ({self.reason})" if self.reason else ""
        return (
            f"planned: voxels of {short_number(self.voxel, 3)}{why}, about {_rounded(self.triangles):,} triangles,"
            f" about {spelled_bytes(self.memory)} of memory, roughly {spelled_seconds(self.seconds)}"
        )


def plan_mesh(survey: Survey, demand: Demand, free: int | None) -> MeshPlan:
    """Choose the voxels of a mesh so that it fits the memory and the number of triangles.

    Args:
        survey: The sizes of the scene.
        demand: What is wanted.
        free: Memory that the process can still use, bytes; None if unknown. It counts only without `demand.memory`.

    Raises:
        NotEnoughMemoryError: the depth maps, the texture, or a mesh of the given voxels, or of voxels `LARGEST` times
            as large as wanted, do not fit.
    """
    base, limit, where = 0, free, "are free"
    if demand.memory is not None:
        base, limit, where = PROGRAM_BYTES, demand.memory, "are allowed by `max_memory`"
    base += PIXEL_BYTES * survey.pixels
    painting = TEXTURE_BYTES if demand.texture else 0
    if limit is not None and limit <= base + painting:
        raise NotEnoughMemoryError(
            f"memory: {survey.maps:,} depth maps{' and a texture' if painting else ''} need"
            f" {spelled_bytes(base + painting)}, but {spelled_bytes(limit)} {where}; give more memory"
        )
    room = None if limit is None else limit - base
    fitting = math.inf if room is None else max(room // FACE_BYTES, 1)
    wanted = demand.voxel or demand.coarse * survey.voxel
    most = fitting if demand.voxel is not None or demand.faces is None else min(fitting, demand.faces)
    voxel = math.sqrt(3.0 * survey.area / most)
    if voxel > wanted and most == fitting and (demand.voxel is not None or voxel > LARGEST * wanted):
        needed = spelled_bytes(base + FACE_BYTES * 3.0 * survey.area / wanted**2)
        raise NotEnoughMemoryError(
            f"voxel: {short_number(wanted, 3)} needs about {needed}, but {spelled_bytes(limit or 0)} {where};"
            f" give more memory, or `voxel={voxel:.2g}`"
        )
    reason = ""
    if voxel > wanted:
        aim = "it fits the memory" if most == fitting else f"it has at most {demand.faces:,} triangles"
        reason = f"instead of {short_number(wanted, 3)}, so that {aim}"
    voxel = max(wanted, voxel)
    triangles = 3.0 * survey.area / voxel**2
    return MeshPlan(
        voxel,
        round(triangles),
        base + round(max(painting, FACE_BYTES * triangles)),
        None if room is None else int(VOLUME_SHARE * room),
        None if most == math.inf else int(most),
        survey.seconds
        + PIXEL_SECONDS * survey.pixels
        + FACE_SECONDS * triangles
        + TEXTURE_SECONDS * demand.texture,
        reason,
    )


def survey(
    gaussians: Gaussians,
    cameras: Sequence[tuple[str, Camera]],
    render_settings: RenderSettings,
    backend: Backend,
    bounds: Float64[np.ndarray, "2 3"] | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Survey:
    """Find the sizes of a scene by small depth maps of some of its views, and one that is as large as the mesh's.

    Args:
        gaussians: The scene.
        cameras: Names and cameras of its views.
        render_settings: How the scene is rendered.
        backend: What renders.
        bounds: (2, 3) lower and upper corner of the box to mesh, world units; None for everything that is seen.
        progress: Called after every view.

    Raises:
        ArgumentError: there are no cameras or no Gaussians, or no view shows a surface.
    """
    if not cameras or not len(gaussians):
        raise ArgumentError("mesh: needs at least one camera and one splat")
    shown = [(name, fitting(camera)) for name, camera in cameras]
    sizes = [(face.W * face.H, index) for index, (_, camera) in enumerate(shown) for face in faces_of(camera)]
    some = [shown[i * len(shown) // SURVEYED] for i in range(SURVEYED)] if len(shown) > SURVEYED else shown
    small = [(name, resized(camera, max(max(camera.W, camera.H) // SHRUNK, 1))) for name, camera in some]

    def surveyed(_: str, done: int, total: int) -> None:
        progress("survey", done, total)

    views = render_depths(gaussians, small, render_settings, backend, surveyed)
    start = time.perf_counter()
    full = render_depths(gaussians, shown[len(shown) // 2 :][:1], render_settings, backend)
    seconds = (time.perf_counter() - start) * len(sizes) / max(len(full), 1)
    voxel = default_voxel(views) / SHRUNK  # of the pixels of the large maps
    edge = SHRUNK * voxel
    points = (part for view in views for part in _points(view, bounds, edge))
    area = touched(points, edge) * edge**2 / 1.5
    return Survey(len(sizes), sum(size for size, _ in sizes), voxel, area, seconds)


def fitting(camera: Camera) -> Camera:
    """Return a camera whose image is at most `LONGEST_SIDE` on its longer side."""
    return resized(camera, LONGEST_SIDE) if max(camera.W, camera.H) > LONGEST_SIDE else camera


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


def touched(points: Iterable[Float64[np.ndarray, "_ 3"]], edge: float) -> int:
    """Return how many cubes contain a point; cubes that are 2 million edges apart count once.

    Args:
        points: Points, world units.
        edge: Edge of a cube, world units.
    """
    found = []
    for part in points:
        x, y, z = np.floor(part / edge).astype(np.int64).T & (2**21 - 1)
        found.append(np.unique(x << 42 | y << 21 | z))
    return len(np.unique(np.concatenate(found)))


def _points(
    view: DepthView, bounds: Float64[np.ndarray, "2 3"] | None, edge: float
) -> Iterator[Float64[np.ndarray, "n 3"]]:
    """Yield the points of a depth map within the bounds, and those halfway between neighbours of one surface."""
    depth = view.depth.astype(np.float64)
    points = view.camera.eye + depth[..., None] * view.camera.rays()
    shown = depth > 0
    if bounds is not None:
        shown &= ((points >= bounds[0]) & (points <= bounds[1])).all(axis=-1)
    yield points[shown]
    H, W = depth.shape
    for down, right in ((0, 1), (1, 0), (1, 1)):
        here, there = (slice(H - down), slice(W - right)), (slice(down, H), slice(right, W))
        near = np.linalg.norm(points[there] - points[here], axis=-1) < JOINED * edge
        near &= shown[here] & shown[there]
        yield 0.5 * (points[here][near] + points[there][near])


def _rounded(count: float) -> int:
    """Return a count with two significant digits."""
    return int(float(f"{count:.2g}"))
