"""Say what is certain about a capture before it is used, and leave out the photos whose poses are certainly wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gsplat_edu.base.text import Told
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.certain import certain_findings, known_photos, without_wrong_poses
from gsplat_edu.doctor.diagnosis import event_of, finding_rows, table_lines
from gsplat_edu.evaluate.verdict import PHOTOS
from gsplat_edu.jobs import emitter
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.survey.finding import Finding, counted, listed


def say_findings(
    reader: CaptureReader, say: Callable[[str], None], left_out: tuple[str, ...] | None = None
) -> tuple[Finding, ...]:
    """Say what is certain about a capture, and return it.

    Args:
        reader: The capture.
        say: Receives a line for each finding.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read.
    """
    findings = certain_findings(reader, left_out)
    for finding, line in zip(findings, table_lines(finding_rows(findings)), strict=True):
        emitter.emit(event_of(finding))
        say(line)
    return findings


def with_right_poses(
    options: RunOptions, reader: CaptureReader, keep: bool, say: Callable[[str], None]
) -> RunOptions:
    """Say what is certain about the capture of a training, and leave out the photos with certainly wrong poses.

    A resumed run keeps the photos with which it began.

    Args:
        options: The run.
        reader: Its capture.
        keep: Train on these photos, too.
        say: Receives the sentences.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read.
    """
    settings = options.data_settings
    if (options.resume and options.folder.exists()) or settings.train_views is not None:
        return options
    findings = say_findings(reader, say, settings.left_out)
    chosen = without_wrong_poses(reader, findings)
    if keep or chosen is None:
        return options
    names = [name for finding in findings if finding.leaves_out for name in finding.images]
    photos = f"{counted(len(names), 'photo')} with wrong poses ({listed(names)})"
    say(
        Told(
            f"training without {photos}; --keep-photos trains on them too",
            f"training without {photos}",
        )
    )
    return replace(options, data_settings=replace(settings, left_out=chosen))


def with_known_photos(options: RunOptions, reader: CaptureReader) -> RunOptions:
    """Return the options of a new run with what the verdict has to know about its photos, for config.json.

    Args:
        options: The run; a resumed one has that in its config.json.
        reader: Its capture.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read.
    """
    if options.folder.exists():
        return options
    known = {PHOTOS: known_photos(reader, options.data_settings.left_out)}
    return replace(options, records={**options.records, **known})
