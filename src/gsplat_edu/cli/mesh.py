"""`gsplat-edu mesh`: a triangle mesh of a scene's surfaces."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.errors import ArgumentError, CheckpointError, DatasetError
from gsplat_edu.base.files import check_writable
from gsplat_edu.base.headroom import available_memory
from gsplat_edu.base.locks import locked, locked_file
from gsplat_edu.base.text import short_number, spelled_bytes
from gsplat_edu.cli.terminal import Terminal, stage_bars
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.intersections import Intersections
from gsplat_edu.evaluate.surface import Comparison, SurfaceScores, score_surface
from gsplat_edu.evaluate.topology import Topology
from gsplat_edu.io.mesh_files import mesh_format_of, mesh_losses, read_mesh, write_mesh
from gsplat_edu.io.mesh_glb import write_parts
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.usd_package import require_usd
from gsplat_edu.jobs import emitter
from gsplat_edu.mesh.convex import convex_parts, fit_of
from gsplat_edu.mesh.depths import Progress, render_depths
from gsplat_edu.mesh.extract import MeshResult, MeshSettings, extract_mesh
from gsplat_edu.mesh.plan import Demand, plan_mesh, survey
from gsplat_edu.mesh.tidy import SMALLEST_SHARE, TidySettings, require_simplification
from gsplat_edu.mesh.trust import (
    FEW_VIEWS,
    MeshTrust,
    PhotoAgreement,
    photo_agreement,
    seen_truth,
    trust_of,
)
from gsplat_edu.options.mesh import ALL, COLLIDER_FACES, COLLIDER_VOXELS, MOST_FACES, TEXTURE_FACES
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import open_subject
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.meshes import KINDS, MadeMesh, photo_pairs, write_mesh_record
from gsplat_edu.runs.painting import painted
from gsplat_edu.runs.source import NamedCamera, Source, open_source, run_of
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.mesh import Mesh

ORBIT_VIEWS, ORBIT_SIZE = 48, 800
"""Cameras around a scene that comes without any, and the longer side of their images, px."""

PATIENCE = 10.0
"""Seconds to wait for another process that writes to the run."""

MOST_HELD_OUT = 8
"""Largest number of held-out views whose depth is compared with the mesh."""


def run(arguments: argparse.Namespace) -> None:
    """Make the mesh, write it, and say how far it can be trusted."""
    console, backend = Terminal(), load_backend(arguments.backend)
    check_writable("OUT", arguments.out)
    # the files beside an OBJ, its material and its image, are covered too
    with locked_file("OUT", arguments.out, "gsplat-edu mesh", console.say), stage_bars(console) as progress:
        _make(arguments, backend, console, progress)


def _make(arguments: argparse.Namespace, backend: Backend, console: Terminal, progress: Progress) -> None:
    if arguments.out.suffix.lower() == ".usdz":
        require_usd(".usdz")  # before the work of minutes
    truth = None if arguments.truth is None else read_mesh(arguments.truth)
    source, dataset = open_source(arguments.source), None
    if arguments.texture:
        subject = open_subject(arguments.source, arguments.dataset, load_backend("cpu"))
        source, dataset = subject.source, subject.dataset
        for note in dataset.notes:
            console.say(str(note))
    cameras = _cameras(source, console)
    settings = _settings(arguments, source, cameras, backend, console, progress)
    gaussians = source.scene.gaussians
    result = extract_mesh(gaussians, cameras, source.settings, backend, settings, progress)
    for sentence in result.notes:
        console.say(sentence)
    mesh = result.mesh
    if dataset is not None:
        mesh = painted(mesh, dataset, result.views, run_of(source.path), progress=progress)
    facts = _written(arguments, mesh, result, source, console, progress)
    scores = None
    if truth is not None:
        scores = _scored(arguments, mesh, truth, result, source, progress)
    held_out = [(name, camera) for name, camera in source.cameras if name in source.held_out]
    others = render_depths(gaussians, held_out[:MOST_HELD_OUT], source.settings, backend, progress)
    photos, why = _photo_agreement(result, source, dataset, progress)
    trust = trust_of(result, others, scores, progress, photos)
    console.say(*_trust(trust, why))
    if scores is not None:
        console.say(*_compared(scores, source.scene.unit or "world units"))
    kind = "collider" if arguments.collider else "mesh"
    progress("pictures", 0, 1)
    _record(MadeMesh(kind, mesh, result, trust, facts), source, dataset, console)
    progress("pictures", 1, 1)


def _photo_agreement(
    result: MeshResult, source: Source, dataset: Dataset | None, progress: Progress
) -> tuple[PhotoAgreement | None, str]:
    """Compare the mesh with held-out photos; without any, return why."""
    run = run_of(source.path)
    if run is None:
        return None, "a scene file has no photos; give its run"
    if not source.held_out:
        return None, "the run held out no photo"
    try:
        capture = run_dataset(run.read_config()) if dataset is None else dataset
        pairs = photo_pairs(source.cameras, source.held_out, capture)
        if not pairs:
            return None, "no held-out photo has another one within 30 degrees that looks from elsewhere"
        return photo_agreement(result.mesh, pairs, result.voxel, progress), ""
    except (CheckpointError, DatasetError) as error:
        return None, str(error)


def _scored(
    arguments: argparse.Namespace,
    mesh: Mesh,
    truth: Mesh,
    result: MeshResult,
    source: Source,
    progress: Progress,
) -> SurfaceScores:
    """Compare the mesh with what the cameras see of the true surface, inside the bounds."""
    bounds = None if arguments.bounds is None else np.array(arguments.bounds).reshape(2, 3)
    comparison = Comparison(arguments.tau or result.voxel, bounds=bounds)
    seen = seen_truth(truth, result.views, result.voxel, source.origin, progress)
    return score_surface(_moved(mesh, source.origin), truth, comparison, seen)


def _written(
    arguments: argparse.Namespace,
    mesh: Mesh,
    result: MeshResult,
    source: Source,
    console: Terminal,
    progress: Progress,
) -> dict[str, Any]:
    """Write the mesh in the coordinates of the capture, and return the facts of its record."""
    unit = source.scene.unit
    if mesh.texture is not None and not mesh_format_of(arguments.out).colors_with_texture:
        mesh = replace(mesh, colors=None)  # the texture has a colour for every place
    mesh = _moved(mesh, source.origin)
    facts: dict[str, Any] = {"file": str(arguments.out), "unit": unit}
    stage = "convex parts" if arguments.collider == "convex" else "writing"
    progress(stage, 0, 1)
    if arguments.collider == "convex":
        facts |= _write_convex(arguments.out, mesh, source.scene, console)
    else:
        for loss in mesh_losses(arguments.out, mesh):
            console.say(loss)
        write_mesh(arguments.out, mesh, unit, up=source.scene.up, earth=source.scene.earth)
        counted = f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles"
        volume = _volume(result, unit or "world units")
        console.say(f"wrote {arguments.out}: {counted}; {volume}")
    progress(stage, 1, 1)
    emitter.report_output(arguments.out)
    return facts


def _record(made: MadeMesh, source: Source, dataset: Dataset | None, console: Terminal) -> None:
    """Write what is known of a run's mesh into the run and its report; nothing for a scene without a run."""
    run = run_of(source.path)
    if run is None:
        return

    def opened() -> Dataset:
        return run_dataset(run.read_config()) if dataset is None else dataset

    iterations = int(source.path.parent.name.removeprefix("iteration_"))
    made = replace(made, facts={**made.facts, "iterations": iterations})
    try:
        with locked("RUN", run.path, "gsplat-edu mesh", console.say, PATIENCE):
            reported = write_mesh_record(run, made, opened, source.settings.background)
    except ArgumentError as error:  # a training runs, or the folder is not writable
        console.say(f"the mesh is not added to the run's report: {error}")
        return
    section = f'{run.report}, section "{KINDS[made.kind]}"'
    where = section if reported else f"{run.meshes}; eval adds it to a report"
    console.say(f"wrote what is known of it to {where}")


def _volume(result: MeshResult, unit: str) -> str:
    """Describe the volume that the mesh was cut from."""
    return f"voxels of {short_number(result.voxel, 3)} {unit}, volume of {spelled_bytes(result.volume_bytes)}"


def _write_convex(out: Path, mesh: Mesh, scene: Scene, console: Terminal) -> dict[str, Any]:
    """Write convex parts of the mesh, say how much of it they leave out, and return both for its record."""
    parts, unit = convex_parts(mesh), scene.unit
    named = [(f"collider_{number}", part) for number, part in enumerate(parts)]
    write_parts(out, named, unit, scene.up, scene.earth)
    fit = fit_of(mesh, parts)
    triangles = sum(len(part.faces) for part in parts)
    counted = f"{len(parts)} convex part{'s' * (len(parts) != 1)}, {triangles:,} triangles"
    outside = f"{short_number(fit.outside, 2)} {unit or 'world units'}"
    console.say(f"wrote {out}: {counted}")
    console.say(f"a vertex of the coarse mesh lies at most {outside} outside of them")
    if fit.filled is None or fit.uncovered is None:
        console.say("the coarse mesh is open, so how much empty space they fill is unknown")
    else:
        filled, uncovered = (short_number(100.0 * share, 2) for share in (fit.filled, fit.uncovered))
        console.say(
            f"{filled} % of their volume is empty in the coarse mesh; they leave out {uncovered} % of its volume"
        )
    return {"convex_parts": len(parts), **fit._asdict()}


def _cameras(source: Source, console: Terminal) -> Sequence[NamedCamera]:
    """Return the training cameras of a run; cameras around a scene that has none."""
    own = [(name, camera) for name, camera in source.cameras if name not in source.held_out]
    if own:
        return own
    if source.cameras:
        return source.cameras
    console.say(
        f"the scene has no cameras: {ORBIT_VIEWS} views around it are used, which may see it from where no photo did"
    )
    return source.probes(ORBIT_VIEWS, ORBIT_SIZE)


def _settings(
    arguments: argparse.Namespace,
    source: Source,
    cameras: Sequence[NamedCamera],
    backend: Backend,
    console: Terminal,
    progress: Progress,
) -> MeshSettings:
    """Plan the mesh, say what it will take, and return its settings; bounds are relative to the run's origin.

    Raises:
        ArgumentError: the mesh has to be simplified, and fast-simplification is not installed.
        NotEnoughMemoryError: the mesh does not fit.
    """
    bounds = None
    if arguments.bounds is not None:
        bounds = np.array(arguments.bounds).reshape(2, 3) - np.array(source.origin)
    found = survey(source.scene.gaussians, cameras, source.settings, backend, bounds, progress)
    usual = TEXTURE_FACES if arguments.texture else COLLIDER_FACES if arguments.collider else MOST_FACES
    faces = None if arguments.faces == ALL else arguments.faces or usual
    demand = Demand(
        voxel=arguments.voxel,
        coarse=COLLIDER_VOXELS if arguments.collider else 1.0,
        faces=None if faces is None else max(faces, MOST_FACES),
        memory=arguments.max_memory,
        texture=arguments.texture,
    )
    plan = plan_mesh(found, demand, available_memory())
    if faces is not None and plan.triangles > faces:
        require_simplification()
    console.say(plan.sentence)
    share = 0.0 if arguments.keep == "all" else SMALLEST_SHARE
    return MeshSettings(
        arguments.voxel,
        plan.voxel if plan.reason or arguments.collider else 0.0,
        plan.most_faces,
        bounds,
        plan.room,
        TidySettings(share, arguments.keep == "largest", faces=faces),
    )


def _moved(mesh: Mesh, origin: tuple[float, float, float]) -> Mesh:
    """Return the mesh in the coordinates of the capture, whose origin was subtracted for the training."""
    return mesh if origin == ORIGIN else replace(mesh, vertices=mesh.vertices + np.array(origin))


def _trust(trust: MeshTrust, why: str) -> list[str]:
    """Say what of the mesh few views saw, how held-out views and photos agree with it, and where it is open.

    Args:
        trust: What is known.
        why: Why no photo was compared.
    """
    certain = short_number(100 * trust.certain, 3)
    said = [f"{certain} % of the area is seen by {FEW_VIEWS} views or more"]
    if trust.held_out is not None:
        within = short_number(100 * trust.held_out.within, 3)
        views = trust.held_out.views
        said.append(
            f"{within} % of the splats' depths from {views} held-out views lie within a voxel of the mesh;"
            " this compares it with the splats, not with photos"
        )
    said.append(_photos(trust.photos, why))
    return [*said, _shape(trust.shape), _intersecting(trust.intersections)]


def _photos(found: PhotoAgreement | None, why: str) -> str:
    """Say at how many points the photos agree with the mesh, or that none says so."""
    if found is None:
        return (
            f"no photo is compared ({why}): where the splats are wrong, as on glossy things, so is the mesh"
        )
    seen = f"{found.views} held-out photo{'s' * (found.views != 1)} and a neighbour of each see"
    if found.share is None:
        return (
            f"photos cannot judge the mesh: too little texture, at {found.textured:,} of the {found.points:,} points"
            f" that {seen}"
        )
    return (
        f"photos agree with the mesh at {short_number(100 * found.share, 3)} % of the textured points"
        f" ({found.textured:,} of the {found.points:,} that {seen});"
        " where they disagree, the surface is wrong, shiny or hidden"
    )


def _shape(shape: Topology) -> str:
    parts = f"{shape.components} connected part" + ("s" if shape.components != 1 else "")
    if shape.boundary_edges == 0:
        return f"{parts}, closed"
    loops = "" if shape.boundary_loops is None else f" around {shape.boundary_loops} holes"
    return f"{parts}, open along {shape.boundary_edges:,} edges{loops}"


def _intersecting(found: Intersections) -> str:
    if not found.found:
        return "no triangle passes through another one" + _of_tested(found)
    share = short_number(100 * found.share, 2)
    return f"{found.found:,} triangles ({share} %) pass through another one" + _of_tested(found)


def _of_tested(found: Intersections) -> str:
    """Say how many triangles were tested, if not all."""
    return "" if found.tested == found.faces else f", of {found.tested:,} that were tested"


def _compared(scores: SurfaceScores, unit: str) -> list[str]:
    """Describe the comparison with the truth."""
    found = scores.distances
    if found.accuracy is None or found.completeness is None:
        raise ArgumentError("--truth: the mesh has no area to compare")
    distances = f"accuracy {short_number(found.accuracy, 3)}, completeness {short_number(found.completeness, 3)} {unit}"
    rates = f"precision {found.precision:.3f}, recall {found.recall:.3f}, F1 {found.f1:.3f}"
    share = short_number(100.0 * found.counted, 3)
    seen = f"the cameras see {share} % of the truth; completeness and recall are of that part"
    angle = (
        "" if scores.normal_degrees is None else f"; normals {short_number(scores.normal_degrees, 3)} degrees"
    )
    return [
        seen,
        f"against the truth: {distances}",
        f"within {short_number(found.tau, 3)} {unit}: {rates}{angle}",
    ]
