"""`gsplat-edu leave-out`: take photos out of use in a capture, or bring them back."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.data.left_out import change_left_out, is_left_out, read_left_out
from gsplat_edu.data.reader import CaptureReader


def run(arguments: argparse.Namespace) -> None:
    """Change the list of a capture, and print it."""
    capture: Path = arguments.capture
    contents = CaptureReader(capture).capture
    frames = contents.frames
    if not arguments.photos and not arguments.undo:
        listed = read_left_out(capture)
    else:
        try:
            photos = arguments.photos or None
            listed = change_left_out(capture, frames, photos, arguments.undo, contents.notes)
        except OSError as error:
            raise DatasetError(
                f"{capture}: {error.strerror}; the list of photos to leave out is not changed"
            ) from None
    console = Terminal()
    left_out = {str(frame.image) for frame in frames if is_left_out(frame, capture, listed)}
    total = len({str(frame.image) for frame in frames})
    console.say(f"{len(left_out)} of {total} photos are left out", *sorted(listed))
