"""`gsplat-edu clean`: remove floaters and splats that no camera supports."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.links import check_links
from gsplat_edu.base.locks import locked_file
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import write_text
from gsplat_edu.clean.guard import clean
from gsplat_edu.clean.report import report_lines
from gsplat_edu.cli.terminal import Bar, Field, Terminal
from gsplat_edu.edits.carry import for_part
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.edits.stored import MOST_BYTES
from gsplat_edu.jobs import emitter
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import SIGNALS, default_target, open_subject, preview
from gsplat_edu.runs.source import Source, open_source
from gsplat_edu.viewer import export

EDITS = "edits.json"
"""Name of the edits of a cleaned scene, beside it."""


def run(arguments: argparse.Namespace) -> None:
    """Check the outputs, and clean while no other command writes them."""
    console = Terminal()
    scene = open_source(arguments.source).path
    if arguments.out is None and arguments.source.is_dir():
        check_links("SCENE", arguments.source)
    out = arguments.out or default_target(scene)
    if not arguments.dry_run:
        export.check_target("--out", out)
        if out.resolve() == scene.resolve():
            raise ArgumentError(f"--out: {out} is the scene itself; give another file")
    if arguments.preview is not None:
        export.check_target("--preview", arguments.preview)
    with ExitStack() as held:
        if not arguments.dry_run:
            held.enter_context(locked_file("--out", out, "gsplat-edu clean", console.say))
        _clean(arguments, out, console)


def _clean(arguments: argparse.Namespace, out: Path, console: Terminal) -> None:
    """Judge the scene, report, and write the requested files; `out` belongs to this process."""
    carried, edited = None, None
    if arguments.edits is not None:
        edited = open_source(arguments.source)
        carried = _checked_edits(arguments.edits, edited, out)
    backend = load_backend("cpu")  # no other one collects the statistics of each splat
    subject = open_subject(arguments.source, arguments.dataset, backend)
    for note in subject.dataset.notes:
        console.say(str(note))
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
    console.say(*report_lines(cleaning))
    if arguments.preview is not None:
        export.write(arguments.preview, preview(source, cleaning))
        colors = ", ".join(
            f"{name}: {reason.sentence.split(':')[0]}" for reason, (name, _) in SIGNALS.items()
        )
        console.say(f"wrote {arguments.preview} ({colors})")
    if arguments.dry_run:
        console.print("dry run: no scene was written")
        return
    kept = cleaning.apply(source.scene.gaussians)
    _write(out, replace(source, scene=replace(source.scene, gaussians=kept)), console)
    if carried is not None and edited is not None:
        written = open_source(out)
        part = identity_of(written.scene)
        text = for_part(carried, str(arguments.edits), edited.scene.gaussians, cleaning.kept, part)
        with written_aside(out.with_name(EDITS)) as aside:
            write_text(aside, text)
        console.say(f"wrote {out.with_name(EDITS)}: the edits for this scene")


def _checked_edits(file: Path, source: Source, out: Path) -> bytes:
    """Read an edits file of the scene, which must not be overwritten by that of the cleaned one.

    Raises:
        ArgumentError: it is none of this scene, or the edits of the cleaned scene have no place.
        OSError: it cannot be read.
    """
    if out.with_name(EDITS).exists():
        raise ArgumentError(f"--out: there is an {EDITS} beside {out}; give a file in another folder")
    with open_file(file) as opened:
        data = opened.read(MOST_BYTES + 1)
    parse_edits(data, str(file)).check_scene(identity_of(source.scene), str(file))
    return data


def _write(out: Path, source: Source, console: Terminal) -> None:
    """Write the cleaned scene."""
    for note in export.losses(out, source):
        console.say(note)
    export.write(out, source)
    emitter.report_output(out)
    console.say(f"wrote {out}: {len(source.scene.gaussians):,} splats")
