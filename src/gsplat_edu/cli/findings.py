"""Say what is certain about a capture before it is used, and leave out the photos whose poses are certainly wrong."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import Told
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.doctor.certain import certain_findings, known_photos, without_wrong_poses
from gsplat_edu.doctor.diagnosis import event_of, finding_rows, table_lines
from gsplat_edu.evaluate.verdict import PHOTOS
from gsplat_edu.jobs import emitter
from gsplat_edu.runs.dataset import data_settings
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.survey.finding import Finding, counted, listed
from gsplat_edu.survey.proof import Verdict, prove


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
    options: RunOptions, reader: CaptureReader, arguments: argparse.Namespace, say: Callable[[str], None]
) -> tuple[RunOptions, CaptureReader]:
    """Read the poses of a training as its photos show, and leave out the photos with certainly wrong ones.

    What is certain about the capture is said. A resumed run keeps the reading and the photos with which it began.

    Args:
        options: The run.
        reader: Its capture.
        arguments: The command's: trust_poses, not to compare the poses with the photos, and to train on all.
        say: Receives the sentences.

    Returns:
        The run's options and the reader of its capture.

    Raises:
        DatasetError: there is no capture, its poses cannot be read, or they do not agree with its photos.
    """
    settings = options.data_settings
    if options.resume and options.folder.exists():
        return options, reader.under(data_settings(options.folder.read_config()).reading)
    if settings.train_views is not None:
        return options, reader
    if not arguments.trust_poses:
        reader = _proven(reader, settings, say)
        settings = replace(settings, reading=reader.reading)
        options = replace(options, data_settings=settings)
    findings = say_findings(reader, say, settings.left_out)
    chosen = without_wrong_poses(reader, findings)
    if arguments.trust_poses or chosen is None:
        return options, reader
    names = [name for finding in findings if finding.leaves_out for name in finding.images]
    photos = f"{counted(len(names), 'photo')} with wrong poses ({listed(names)})"
    say(
        Told(
            f"training without {photos}; --trust-poses trains on them too",
            f"training without {photos}",
        )
    )
    return replace(options, data_settings=replace(settings, left_out=chosen)), reader


def _proven(reader: CaptureReader, settings: DataSettings, say: Callable[[str], None]) -> CaptureReader:
    """Compare the poses with the photos; return the reader with the reading that agrees."""
    proof = prove(reader, settings.left_out)
    if proof.verdict is Verdict.DISAGREE:
        what = str(proof)
        raise DatasetError(
            f"{reader.path}: {what[0].lower()}{what[1:]}; give the poses of these photos; `gsplat-edu sfm` finds new"
            " ones, and --trust-poses trains with these"
        )
    say(f"{proof}: read so" if proof.verdict is Verdict.MISREAD else str(proof))
    return reader.under(proof.reading or None)


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
