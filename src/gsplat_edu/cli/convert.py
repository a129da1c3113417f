"""`gsplat-edu convert`: write a scene in another format; filter, transform, merge and verify it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError, CheckpointError, DatasetError
from gsplat_edu.base.locks import locked_file
from gsplat_edu.base.reading import read_text
from gsplat_edu.cli.exporting import check_and_say
from gsplat_edu.cli.terminal import Bar, Field, Terminal
from gsplat_edu.edits.apply import views_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.edits.operations import Measure
from gsplat_edu.io.edit import IDENTITY, Filter, Similarity, joined
from gsplat_edu.io.formats import LOD_META, TILESET
from gsplat_edu.io.lod.levels import LodOptions
from gsplat_edu.io.lod.tiles import tile_options
from gsplat_edu.jobs import emitter
from gsplat_edu.options.convert import MOVES, photos_asked
from gsplat_edu.options.values import numbers_text
from gsplat_edu.paths.keyframes import read_path
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.runs.importance import BACKEND, MOST_CAMERAS, importance_of
from gsplat_edu.runs.lod_refinement import photos_of_run
from gsplat_edu.runs.source import Source, open_source, run_of
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.views import View
from gsplat_edu.sfm.scale_text import points_of
from gsplat_edu.viewer import export
from gsplat_edu.viewer.edited import edited_meshes, edited_source, toured
from gsplat_edu.viewer.page import Tour
from gsplat_edu.viewer.page_mesh import Meshes, open_meshes
from gsplat_edu.viewer.page_proof import Proof, photos_of, seen_of, training_cameras
from gsplat_edu.viewer.sizing import STEPS, write_sized


def run(arguments: argparse.Namespace) -> None:
    """Convert, report the written file, and verify it if requested; no other command writes it meanwhile."""
    console = Terminal()
    _check(arguments)
    with locked_file("OUT", arguments.out, "gsplat-edu convert", console.say):
        _convert(arguments, console)


def _convert(arguments: argparse.Namespace, console: Terminal) -> None:
    keep = Filter(arguments.min_opacity, arguments.crop, arguments.sh_degree)
    move = IDENTITY
    for text in arguments.transform:
        move = _similarity(text).after(move)
    if arguments.scale is not None:
        given = points_of(arguments.scale)
        move = Similarity(np.eye(3), given.length / given.apart, np.zeros(3)).after(move)
    backend = resolve_backend(arguments.backend) if arguments.verify or arguments.lod_refine else ""
    along = None if arguments.path is None else read_path(arguments.path)
    edits = None if arguments.edits is None else read_edits(arguments.edits)
    views = views_after(() if edits is None else edits.operations)
    options = _levels(arguments)
    columns = (
        Field("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        steps = bar.add_task("reading", total=len(arguments.sources) + 1)
        sources: list[Source] = []
        meshes: Meshes | None = None
        for path in arguments.sources:
            bar.update(steps, description=f"reading {path}")
            source = opened = open_source(path)
            meshes = open_meshes(arguments.surface, arguments.collider, source) if not sources else meshes
            if edits is not None:
                meshes = meshes if sources else edited_meshes(meshes, source, edits)
                source = edited_source(source, edits, str(arguments.edits), arguments.edits_anyway)
            sources.append(_moved(_filtered(source, keep), move))
            if len(sources) == 1:
                along = None if along is None else along.shifted(-np.array(opened.origin))
                total = move.local(source.origin, sources[0].origin).after(views.move)
            bar.advance(steps)
        source = _joined(sources)
        if arguments.scale is not None:
            source = replace(source, scene=replace(source.scene, unit=given.unit))
        say = console.say
        for note in (*_origin(source, arguments.out), *export.losses(arguments.out, source)):
            say(note)
        for measure in views.measures:
            say(_measured(measure, total.s, source.scene.unit))
        tour = toured(source, views, total, along)
        tour = _proven(replace(tour, meshes=meshes and meshes.moved(total)), source, arguments, bar, say)
        bar.update(steps, description=f"writing {arguments.out}")
        content = _write(source, tour, options, arguments, backend, bar, say)
        bar.advance(steps)
        emitter.report_output(arguments.out)
        _say_written(arguments.out, source, meshes, say, content)
        if arguments.scale is not None:
            say(
                f"1 unit of {arguments.out.name} = 1 {given.unit}; it was {given.apart / given.length:.6g} units before"
            )
        if arguments.verify:
            check_and_say(arguments.out, source, backend, bar, say)


def _proven(
    tour: Tour, source: Source, arguments: argparse.Namespace, bar: Bar, say: Callable[[str], None]
) -> Tour:
    """Return the tour with the evidence that --verify photos asks for, and say what it takes."""
    most = photos_asked(arguments)
    if most is None:
        return tour
    photos = photos_of(source, arguments.dataset, most)
    task = bar.add_task("what photos saw", total=len(training_cameras(source)))
    proof = Proof(seen_of(source, lambda: bar.advance(task)), photos)
    bar.remove_task(task)
    say(proof.line())
    return replace(tour, proof=proof)


def _write(
    source: Source,
    tour: Tour,
    options: LodOptions,
    arguments: argparse.Namespace,
    backend: str,
    bar: Bar,
    say: Callable[[str], None],
) -> str | None:
    """Write OUT; return what it contains, in words, or None if it is the scene."""
    if arguments.size is not None:
        return _write_sized(source, tour, arguments, bar, say)
    if arguments.lod_refine is None:
        export.write(arguments.out, source, tour, options)
    else:
        export.write_refined(arguments.out, source, options, arguments.lod_refine, backend, say)
    return export.POINTS if export.is_points(arguments.out) else None


def _write_sized(
    source: Source, tour: Tour, arguments: argparse.Namespace, bar: Bar, say: Callable[[str], None]
) -> str:
    """Write the best file within --size; return what it contains, in words."""
    task = bar.add_task("weighing splats", total=min(len(source.cameras), MOST_CAMERAS))
    importance = importance_of(source, lambda: bar.advance(task))
    bar.remove_task(task)
    photos = _photos_to_tune(source, arguments, say)
    task = bar.add_task("choosing, then tuning" if photos else "choosing", total=STEPS if photos else None)
    written = write_sized(
        arguments.out, source, tour, importance, arguments.size, photos, lambda: bar.advance(task)
    )
    bar.remove_task(task)
    found = written.file
    total, kept, degree = len(source.scene.gaussians), len(found.part.rows), found.setting.sh_degree
    size = f"{len(found.data):,} of {arguments.size:,} bytes"
    if found.whole:
        return f"the whole scene in the format's full precision: {total:,} splats, SH degree {degree}, {size}"
    shiny = found.part.with_harmonics
    some = f" ({shiny:,} splats; the others 0)" if degree and shiny < kept else ""
    how = (
        f"{kept:,} splats, some merged, for {total:,}" if written.merged else f"{kept:,} of {total:,} splats"
    )
    tuned = "; training on its photos did not make it better, so it is untuned" if photos else ""
    if written.tuned is not None:
        tuned = "; tuned from {:.2f} to {:.2f} dB on its photos".format(*written.tuned)
    return f"{how}, SH degree {degree}{some}, {size}{tuned}"


def _photos_to_tune(
    source: Source, arguments: argparse.Namespace, say: Callable[[str], None]
) -> Sequence[View]:
    """Return the training photos of the scene's run; none, with a sentence, where they do not show the scene."""
    run = run_of(source.path)
    if run is None:
        return ()
    if (change := _change(arguments)) is not None:
        say(f"not tuned, because the photos do not show the scene after {change}")
        return ()
    try:
        return photos_of_run(source, run, 1.0, BACKEND, arguments.dataset)[0]
    except (CheckpointError, DatasetError) as error:
        say(f"not tuned on the photos: {error}")
        return ()


def _say_written(
    path: Path, source: Source, meshes: Meshes | None, say: Callable[[str], None], content: str | None
) -> None:
    """Say what a written file contains, and the size of a page with a mesh.

    Args:
        path: The file.
        source: The scene.
        meshes: Those of a page.
        say: Called with each line.
        content: What it contains, in words; None if it is the scene.
    """
    count, degree = len(source.scene.gaussians), export.kept_degree(path, source.scene)
    more = ""
    if meshes is not None and meshes.stays:
        say("--edits: move some splats without the others; the mesh shows them where they were")
    if meshes is not None:
        more = f"; mesh of {len(meshes.surface.faces):,} triangles; {path.stat().st_size:,} bytes"
    say(f"wrote {path}: {content or f'{count:,} splats, SH degree {degree}'}{more}")
    if export.has_levels(path):
        say(export.levels_line(path, source.scene))


def _measured(measure: Measure, scale: float, unit: str | None) -> str:
    """Describe a measured distance, in the units of the written scene."""
    length = scale * float(np.linalg.norm(np.subtract(*measure.points)))
    return f"measured {length:.4g} {unit or 'units'}{f': {measure.note}' if measure.note else ''}"


def _check(arguments: argparse.Namespace) -> None:
    """Check OUT, and the options that need certain formats of OUT."""
    export.check_target("OUT", arguments.out)
    if len(arguments.sources) > 1 and not arguments.merge:
        raise ArgumentError("IN: several scenes given; add --merge to join them, or convert one at a time")
    if arguments.path is not None and arguments.out.suffix.lower() != export.PAGE:
        raise ArgumentError(
            f"--path: only a page can play a camera path; {arguments.out} is not a page, use {export.PAGE}"
        )
    if arguments.surface is not None and arguments.out.suffix.lower() != export.PAGE:
        raise ArgumentError(
            f"--surface: only a page can show a mesh; {arguments.out} is not a page, use {export.PAGE}"
        )
    if arguments.verify and export.is_points(arguments.out):
        raise ArgumentError(
            f"--verify: {arguments.out} is a point cloud, which has no renders to compare; omit it"
        )
    _check_refining(arguments)


def _levels(arguments: argparse.Namespace) -> LodOptions:
    """Return the options of levels of detail; reject them for formats without levels."""
    given = {name: getattr(arguments, f"lod_{name}") for name in ("smallest", "chunk", "leaf")}
    given = {name: value for name, value in given.items() if value is not None}
    if given and not export.has_levels(arguments.out):
        raise ArgumentError(
            f"--lod-{next(iter(given))}: {arguments.out} has no levels of detail; write FOLDER/{LOD_META} or {TILESET}"
        )
    if arguments.out.name.lower() != TILESET:
        return LodOptions(**given)
    if "chunk" in given:
        raise ArgumentError("--lod-chunk: a tile is a file; set --lod-leaf")
    return tile_options(**given)


def _check_refining(arguments: argparse.Namespace) -> None:
    """Reject --lod-refine for formats without levels and for scenes that no longer match their photos."""
    if arguments.lod_refine is None:
        return
    if arguments.lod_refine < 1:
        raise ArgumentError(f"--lod-refine: is {arguments.lod_refine}, but has to be at least 1")
    if arguments.out.name.lower() != LOD_META:
        raise ArgumentError(f"--lod-refine: {arguments.out} cannot be refined; write FOLDER/{LOD_META}")
    if (change := _change(arguments)) is not None:
        raise ArgumentError(
            f"--lod-refine: the photos do not show the scene after {change}; refine without it"
        )


def _change(arguments: argparse.Namespace) -> str | None:
    """Return what makes a scene another one than its run's photos show; None for nothing."""
    changes = {
        "several scenes": len(arguments.sources) > 1,
        "--transform": arguments.transform,
        "--scale": arguments.scale is not None,
        "--crop": arguments.crop is not None,
        "--edits": arguments.edits is not None,
    }
    return next((name for name, given in changes.items() if given), None)


def _filtered(source: Source, keep: Filter) -> Source:
    kept = keep.apply(source.scene)
    if not len(kept.gaussians):
        raise ArgumentError(
            f"{source.path}: no splat is left ({len(source.scene.gaussians):,} before); relax the filters"
        )
    return replace(source, scene=kept)


def _moved(source: Source, move: Similarity) -> Source:
    """Return a scene and its cameras after --transform, which acts on positions with their origin, in double."""
    if move is IDENTITY:
        return source
    scene = move.scene(source.scene)
    local = move.local(source.origin, scene.origin)
    cameras = tuple((name, local.camera(camera)) for name, camera in source.cameras)
    return replace(source, scene=scene, cameras=cameras)


def _joined(sources: Sequence[Source]) -> Source:
    if len(sources) == 1:
        return sources[0]
    scene = joined([source.scene for source in sources])
    cameras = tuple(
        (name, IDENTITY.local(source.origin, scene.origin).camera(camera))
        for source in sources
        for name, camera in source.cameras
    )
    settings = replace(sources[0].settings, antialiased=bool(scene.antialiased))
    return replace(sources[0], scene=scene, cameras=cameras, settings=settings)


def _origin(source: Source, out: Path) -> list[str]:
    """Say where a file keeps the origin of its coordinates."""
    if (
        source.origin == ORIGIN
        or export.is_points(out)
        or any("origin" in loss for loss in export.losses(out, source))
    ):
        return []
    where = ", ".join(f"{x:.15g}" for x in source.origin)
    return [f"coordinates are relative to the origin ({where}), which {out.name} stores in double"]


def _similarity(text: str) -> Similarity:
    """Parse one --transform."""
    kind, _, value = text.partition("=")
    try:
        match kind:
            case "scale":
                return Similarity.of_matrix(np.hstack([float(value) * np.eye(3), np.zeros((3, 1))]))
            case "move":
                return Similarity(np.eye(3), 1.0, np.array(numbers_text(3)(value)))
            case "rotate":
                axis, _, degrees = value.partition(":")
                turn = (
                    Rotation.from_euler(axis, float(degrees), degrees=True)
                    if axis in ("x", "y", "z")
                    else None
                )
                if turn is not None:
                    return Similarity(turn.as_matrix(), 1.0, np.zeros(3))
            case "matrix":
                numbers = read_text(Path(value), errors="replace").replace(",", " ").split()
                if len(numbers) in (12, 16):
                    return Similarity.of_matrix(np.array(numbers, dtype=np.float64).reshape(-1, 4))
    except ArgumentError as error:
        raise ArgumentError(f"--transform: {text}: {error}") from None
    except (ValueError, argparse.ArgumentTypeError):
        pass
    raise ArgumentError(f"--transform: {text!r} cannot be read; give {MOVES}")
