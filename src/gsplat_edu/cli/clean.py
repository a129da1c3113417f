"""`gsplat-edu clean`: remove floaters and splats that no camera supports."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.clean.guard import clean
from gsplat_edu.cli.terminal import Bar, Field, Terminal
from gsplat_edu.io.formats import format_of
from gsplat_edu.io.ply import ORIGIN, save_ply
from gsplat_edu.jobs import emitter
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import SIGNALS, default_target, open_subject, preview, report_lines
from gsplat_edu.runs.source import Source, open_source
from gsplat_edu.viewer import export


def run(arguments: argparse.Namespace) -> None:
    """Judge the scene, report, and write the requested files."""
    console = Terminal()
    scene = open_source(arguments.source).path
    out = arguments.out or default_target(scene)
    if not arguments.dry_run:
        export.check_target("--out", out)
        if out.resolve() == scene.resolve():
            raise ArgumentError(f"--out: {out} is the scene itself; give another file")
    if arguments.preview is not None:
        export.check_target("--preview", arguments.preview)
    backend = load_backend("cpu")  # no other one collects the statistics of each splat
    subject = open_subject(arguments.source, arguments.dataset, backend)
    for note in subject.dataset.notes:
        console.print(str(note), soft_wrap=True)
    source, dataset = subject.source, subject.dataset
    columns = (
        Field("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("judging", total=None)
        cleaning = clean(
            source.scene.gaussians,
            dataset.train,
            dataset.test,
            source.settings,
            arguments.max_loss,
            backend,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    console.print(*report_lines(cleaning), sep="\n", soft_wrap=True)
    if arguments.preview is not None:
        export.write(arguments.preview, preview(source, cleaning))
        colors = ", ".join(
            f"{name}: {reason.sentence.split(':')[0]}" for reason, (name, _) in SIGNALS.items()
        )
        console.print(f"wrote {arguments.preview} ({colors})", soft_wrap=True)
    if arguments.dry_run:
        console.print("dry run: no scene was written")
        return
    kept = cleaning.apply(source.scene.gaussians)
    _write(out, replace(source, scene=replace(source.scene, gaussians=kept)), console)


def _write(out: Path, source: Source, console: Terminal) -> None:
    """Write the cleaned scene; a PLY keeps the coordinates of the original."""
    ply = out.suffix.lower() != export.PAGE and format_of(out).suffix == ".ply"
    if ply and source.origin != ORIGIN:
        save_ply(out, source.scene.gaussians, source.origin, source.scene.antialiased)
    else:
        for note in export.losses(out, source.scene):
            console.print(note, soft_wrap=True)
        if source.origin != ORIGIN:
            where = ", ".join(f"{x:.6g}" for x in source.origin)
            console.print(f"coordinates are relative to the capture's origin ({where})", soft_wrap=True)
        export.write(out, source)
    emitter.report_output(out)
    console.print(f"wrote {out}: {len(source.scene.gaussians):,} splats", soft_wrap=True)
