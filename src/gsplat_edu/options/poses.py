"""The options of a capture's poses: the file that they are read from, and whether the photos prove them."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError


def add_poses(group: argparse._ActionsContainer) -> None:
    """Add the option.

    Args:
        group: Receives it.
    """
    group.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="read the poses of this file in the capture's folder, such as cameras.xml or sparse/1/images.bin (default:"
        " transforms.json or a COLMAP model, else the file that poses the most photos)",
    )


def add_trust(group: argparse._ActionsContainer, more: str = "") -> None:
    """Add the option that keeps poses from being judged.

    Args:
        group: Receives it.
        more: What else it does in a command.
    """
    group.add_argument(
        "--trust-poses",
        action="store_true",
        help="read the poses as their file has them, without comparing them with the photos" + more,
    )


def posed_by(capture: Path | None, poses: Path | None) -> Path | None:
    """Return what is read: the file with poses, if one is given, or else the capture.

    Args:
        capture: The capture's folder.
        poses: The value of the option: a path, or one relative to the capture; None if it is not given.

    Raises:
        ArgumentError: it is no file with poses, or not in the capture's folder.
    """
    if poses is None:
        return capture
    from gsplat_edu.data.capture import capture_folder, is_file
    from gsplat_edu.data.reader import layout_of

    if capture is None:
        raise ArgumentError("--poses: needs the folder of a capture; give it, too")
    path = next((each for each in (capture / poses, poses) if is_file(each)), None)
    if path is None:
        raise ArgumentError(f"--poses: {poses} is no file in {capture}; correct the name")
    if layout_of(path) is None:
        raise ArgumentError(
            f"--poses: {path} has no poses of a known program; see docs/howto/other-programs-poses.md"
        )
    if capture_folder(path).resolve() != capture.resolve():
        raise ArgumentError(f"--poses: {path} does not belong to {capture}; put it into that folder")
    return path
