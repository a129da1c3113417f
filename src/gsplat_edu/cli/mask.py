"""`gsplat-edu mask`: exclude parts of a photo by its mask, or restore the mask as it was."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.data.drawn_masks import draw_mask, masked_photo
from gsplat_edu.data.mask_shapes import parse_shape, shape_text


def run(arguments: argparse.Namespace) -> None:
    """Change the mask of a photo, and print what is drawn on it."""
    capture: Path = arguments.capture
    if arguments.undo and arguments.shapes:
        raise ArgumentError("--undo: takes all shapes back; give it without shapes")
    shapes = [parse_shape(text) for text in arguments.shapes]
    try:
        if shapes or arguments.undo:
            found = draw_mask(capture, arguments.photo, shapes)
        else:
            found = masked_photo(capture, arguments.photo)
    except OSError as error:
        raise DatasetError(
            f"{error.filename or capture}: {error.strerror}; the mask cannot be changed"
        ) from None
    console = Terminal()
    own = " besides its own mask" if found.has_own else ""
    count = f"{len(found.shapes)} shape{'s' if len(found.shapes) != 1 else ''}"
    where = f"; mask {found.mask}" if found.mask else ""
    console.say(
        f"{legible(found.photo)}, {found.W}x{found.H}: {count}{own}{where}",
        *(shape_text(shape) for shape in found.shapes),
    )
