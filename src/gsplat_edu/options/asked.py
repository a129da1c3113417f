"""Options of `gsplat-edu train` that ask something of a part of the training beside its settings."""

from __future__ import annotations

import argparse

from gsplat_edu.options.depth import add_depth, check_depth
from gsplat_edu.scene.given_depth import CAPTURE_AS_DEPTH, POINTS_AS_DEPTH
from gsplat_edu.train.setting import PURPOSE, Plain

ASKED = {"given_depth": "depth", "floaters": "clean"}
"""The options, by part."""

OFFERED_ASKED = {
    "depth": Plain(
        "Depth to learn from",
        {
            "": "none",
            POINTS_AS_DEPTH: "the points that photos share",
            CAPTURE_AS_DEPTH: "the capture's own depth maps",
        },
        PURPOSE,
    ),
    "clean": None,
}
"""How pages ask for them, as `gsplat_edu.options.train.OFFERED` has it."""


COMMON_ASKED = ("clean",)
"""Those that `--help` shows."""


def add_of_photos(group: argparse._ActionsContainer) -> None:
    """Add the options that say what else there is beside the photos."""
    add_depth(group, "learn from depth")


def add_of_results(group: argparse._ActionsContainer) -> None:
    """Add the options that change the trained scene."""
    group.add_argument(
        "--clean",
        action="store_true",
        help="remove floaters and splats that no camera sees from the trained scene, as `gsplat-edu clean` does",
    )


def check_asked(arguments: argparse.Namespace) -> None:
    """Check the options without reading a photo.

    Raises:
        ArgumentError: a folder does not exist.
    """
    check_depth(arguments.depth)


def asked_of(arguments: argparse.Namespace) -> dict[str, str]:
    """Return what the user asked of parts, as `gsplat_edu.runs.options.RunOptions` takes it.

    Args:
        arguments: Those of a command that has some of the options.
    """
    values = {part: getattr(arguments, name, None) for part, name in ASKED.items()}
    return {part: "" if value is True else str(value) for part, value in values.items() if value}
