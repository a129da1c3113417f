"""What is known of a run's meshes: a record in its folder, pictures, and a section of its report."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float64, UInt8

from gsplat_edu.base.errors import CheckpointError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.links import check_links
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.images import PICTURE_SIDE, small_jpeg
from gsplat_edu.evaluate.mesh_report import (
    MANY_VIEWS,
    PANELS,
    MeshEntry,
    MeshFigure,
    replace_mesh_section,
)
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.mesh.depths import DepthView
from gsplat_edu.mesh.extract import MeshResult
from gsplat_edu.mesh.faces import drawn_in
from gsplat_edu.mesh.raster import Raster, lit, picture, rasterized
from gsplat_edu.mesh.trust import FEW_VIEWS, MeshTrust
from gsplat_edu.parts.surface.patches import neighbours_of
from gsplat_edu.paths.orbits import resized
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import NamedCamera
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View, read_scaled

KINDS = {"mesh": "Mesh", "collider": "Collider"}
"""The kinds of meshes that a run has a record of, the latest of each, and their titles in the report."""

PHOTOS = 8
"""Largest number of held-out photos that are compared with the mesh."""

PHOTO_SIDE = 800
"""Longer side, px, of photos that are compared with the mesh."""

CAMERAS = 2
"""Number of training cameras that a mesh is shown from."""

SHADE = 0.45
"""How much darker a face is drawn that is seen from the side, in pictures of evidence."""

BEHIND = (238, 238, 238)
"""Colour behind a mesh, sRGB."""

JPEG = b"\xff\xd8\xff"
"""First bytes of a JPEG."""


@dataclass(frozen=True, eq=False)
class MadeMesh:
    """A mesh, and all that is known of it.

    Args:
        kind: One of `KINDS`.
        mesh: The mesh that was written, in the frame of the run's cameras.
        result: How it was made.
        trust: How far it can be trusted.
        facts: Further entries of its record: "file", "iterations", "unit".
    """

    kind: str
    mesh: Mesh
    result: MeshResult
    trust: MeshTrust
    facts: Mapping[str, Any]


def record_of(made: MadeMesh) -> dict[str, Any]:
    """Collect what is known of a mesh, for mesh.json.

    Args:
        made: The mesh. `gsplat_edu.runs.fields.MESH` has the types of the entries.
    """
    mesh, result, trust = made.mesh, made.result, made.trust
    held_out, photos, scores = trust.held_out, trust.photos, trust.scores
    truth = None
    if scores is not None:
        truth = {**dataclasses.asdict(scores.distances), "normal_degrees": scores.normal_degrees}
    return {
        **made.facts,
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "size": (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).tolist(),
        "area": trust.shape.area,
        "voxel": result.voxel,
        "volume_bytes": result.volume_bytes,
        "few_views": FEW_VIEWS,
        "certain": trust.certain,
        "spread": trust.spread,
        "held_out": None if held_out is None else dataclasses.asdict(held_out),
        "photos": None if photos is None else {**dataclasses.asdict(photos), "share": photos.share},
        "parts": trust.shape.components,
        "boundary_edges": trust.shape.boundary_edges,
        "holes": trust.shape.boundary_loops,
        "intersections": trust.intersections._asdict(),
        "truth": truth,
        "left_out": dataclasses.asdict(result.counts),
        "notes": list(result.notes),
    }


def photo_pairs(
    cameras: Sequence[NamedCamera], held_out: Set[str], dataset: Dataset
) -> list[tuple[View, View]]:
    """Choose held-out photos spread evenly over all, and for each another photo that sees its subject from elsewhere.

    Args:
        cameras: The run's cameras, by the names of the photos.
        held_out: Names of the photos that were not used for training.
        dataset: The capture.

    Returns:
        At most `PHOTOS` pairs, at most `PHOTO_SIDE` px wide and high; those without another photo are left out.
    """
    photos = {view.name: view for view in (*dataset.test, *dataset.train)}
    views = [_small(photos[name], camera) for name, camera in cameras if name in photos]
    if not views:
        return []
    own = [view.camera for view in views]
    neighbours = neighbours_of(own, scene_extent(own))
    usable = [i for i, view in enumerate(views) if view.name in held_out and neighbours[i]]
    count = min(PHOTOS, len(usable))
    chosen = [usable[i * len(usable) // count] for i in range(count)]
    return [(views[i], views[neighbours[i][len(neighbours[i]) // 2]]) for i in chosen]


def _small(view: View, camera: Camera) -> View:
    """Return a photo with the run's camera, so small that many can be compared in seconds."""
    longest = max(view.camera.W, view.camera.H)
    if longest > PHOTO_SIDE or (camera.W, camera.H) != (view.camera.W, view.camera.H):
        camera = resized(camera, min(longest, PHOTO_SIDE))
    return View.stored(camera, partial(read_scaled, view, camera.W, camera.H), view.name)


def write_mesh_record(
    folder: RunFolder, made: MadeMesh, dataset: Callable[[], Dataset], background: ArrayLike
) -> bool:
    """Write what is known of a mesh into its run: mesh.json, pictures, and the section of the report.

    The record of a mesh of the other kind stays.

    Args:
        folder: The run.
        made: The mesh.
        dataset: Opens the capture. If it or a photo cannot be read, the pictures show renders of the splats instead.
        background: (3,) colour behind photos that are not opaque.

    Returns:
        Whether there is a report, which has the section now. `evaluate_run` puts it into a new one.

    Raises:
        ArgumentError: a link leads out of the run.
        CheckpointError: the record of an earlier mesh is damaged.
        OSError: a file cannot be written.
    """
    check_links("RUN", folder.path)
    figures = list(_figures(made, dataset, background))
    record = record_of(made)
    record["pictures"] = [figure.name for figure in figures]
    record["rendered"] = [figure.name for figure in figures if figure.rendered]
    for number, figure in enumerate(figures):
        for panel, data in figure.panels.items():
            with written_aside(folder.renders / "mesh" / f"{made.kind}_{number}_{panel}.jpg") as aside:
                aside.write_bytes(data)
    folder.write_meshes({**folder.read_meshes(), made.kind: record})
    return folder.report.is_file() and replace_mesh_section(folder.report, mesh_entries(folder))


def mesh_entries(folder: RunFolder) -> list[MeshEntry]:
    """Read what is known of a run's meshes, for its report.

    Args:
        folder: The run.

    Raises:
        CheckpointError: mesh.json is damaged.
    """
    records = folder.read_meshes()
    return [
        MeshEntry(title, records[kind], _stored_figures(folder, kind, records[kind]))
        for kind, title in KINDS.items()
        if kind in records
    ]


def _stored_figures(folder: RunFolder, kind: str, record: Mapping[str, Any]) -> list[MeshFigure]:
    """Read the pictures of a mesh; those that are gone are left out."""
    figures = []
    for number, name in enumerate((record.get("pictures") or [])[:CAMERAS]):
        paths = {panel: folder.renders / "mesh" / f"{kind}_{number}_{panel}.jpg" for panel in PANELS}
        if all(path.is_file() for path in paths.values()):
            panels = {panel: read_bytes(path) for panel, path in paths.items()}
            if all(data.startswith(JPEG) for data in panels.values()):
                figures.append(MeshFigure(name, panels, name in (record.get("rendered") or [])))
    return figures


def _figures(made: MadeMesh, dataset: Callable[[], Dataset], background: ArrayLike) -> Iterator[MeshFigure]:
    """Yield the pictures of a mesh from the cameras that show it best."""
    photos: dict[str, Any] = {}
    views = _apart(made.result.views)
    try:
        names = {view.name for view in views}
        for taken in dataset().train:
            if taken.name in names:
                photos[taken.name] = to_bytes(taken.read().over(background))
    except (CheckpointError, DatasetError):
        photos.clear()
    for view in views:
        camera = resized(view.camera, min(PICTURE_SIDE, max(view.camera.W, view.camera.H)))
        raster = rasterized(made.mesh, camera)
        images = {
            "photo": _as_seen(view, photos.get(view.name)),
            "mesh": picture(made.mesh, raster, BEHIND),
            **_evidence(made, raster, camera),
        }
        panels = {name: small_jpeg(image) for name, image in images.items()}
        yield MeshFigure(view.name, panels, view.name not in photos)


def _as_seen(view: DepthView, photo: UInt8[np.ndarray, "h w 3"] | None) -> UInt8[np.ndarray, "H W 3"]:
    """Return a view's photo, drawn in the face if the view is one of a lens; without a photo, the rendered view."""
    if photo is None:
        return view.image
    if view.lens is None:
        return photo
    h, w = photo.shape[:2]
    return drawn_in(view.camera, view.rendered, view.lens.scaled(w, h), photo)[0]


def _apart(views: Sequence[DepthView]) -> list[DepthView]:
    """Choose the view that shows most, and the one that looks in the most different direction and shows half of it."""
    shown = np.array([np.count_nonzero(view.depth) / view.depth.size for view in views])
    first = int(shown.argmax())
    axes = np.stack([view.camera.R[2] for view in views])
    angles = np.where(shown >= 0.5 * shown[first], -(axes @ axes[first]), -np.inf)
    angles[first] = -np.inf
    second = int(angles.argmax())
    return [views[first], views[second]] if np.isfinite(angles[second]) else [views[first]]


def _evidence(made: MadeMesh, raster: Raster, camera: Camera) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
    """Draw the mesh in colours of what the depth maps say of its vertices."""
    seen = made.trust.seen
    values = {
        "views": np.minimum(seen.views / MANY_VIEWS, 1.0),
        "agreement": np.where(
            seen.views < FEW_VIEWS, 0.0, 1.0 - np.minimum(seen.error / made.result.voxel, 1.0)
        ),
    }
    light = 1.0 - SHADE * (1.0 - lit(made.mesh, raster, camera))
    return {name: _shaded(made.mesh, raster, value, light) for name, value in values.items()}


def _shaded(
    mesh: Mesh, raster: Raster, values: Float64[np.ndarray, " V"], light: np.ndarray
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw values from 0 to 1 in the colours of viridis, with the light of each pixel."""
    at = raster.of_vertices(mesh, values[:, None])[..., 0]
    colors = 255.0 * np.asarray(mpl.colormaps["viridis"](at))[..., :3] * light[..., None]
    return np.where(raster.covered[..., None], np.rint(colors), BEHIND).astype(np.uint8)
