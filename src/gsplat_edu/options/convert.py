"""The options of `gsplat-edu convert`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.constants import POINT_SUFFIXES, SCENE_SUFFIXES, SH_MAX_DEGREE, SIZED
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.options.values import (
    add_backend,
    add_meshes,
    bytes_text,
    number_text,
    numbers_text,
    whole_number_text,
)
from gsplat_edu.sfm.scale_text import POINTS

EXAMPLE = "example: gsplat-edu convert runs/plush plush.spz --min-opacity 0.02 --verify"

OFFERED = ("sh_degree", "min_opacity", "size", "verify")
"""Options that requests may give."""

MOVES = "scale=S, rotate=AXIS:DEGREES (x:90), move=X,Y,Z or matrix=FILE (12 or 16 numbers, row by row)"


LOD_STEPS = 300
"""Iterations per level of `--lod-refine` without a number."""

VERIFY_FILE, VERIFY_PHOTOS = "file", "photos"
"""Values of `--verify`: of an option without a value, and of one that adds photos to a page."""

PHOTOS, MOST_PHOTOS = 12, 200
"""Number of photos in a page, and the largest."""


def evidence_text(text: str) -> str:
    """Parse the value of --verify: file, photos or photos=N."""
    name, _, number = text.partition("=")
    if name == VERIFY_PHOTOS and ((number.isascii() and number.isdigit()) or text == name):
        if not number or 1 <= int(number) <= MOST_PHOTOS:
            return text
        raise argparse.ArgumentTypeError(f"{number} photos: has to be from 1 to {MOST_PHOTOS}")
    if text == VERIFY_FILE:
        return text
    raise argparse.ArgumentTypeError(
        f"{text!r} is not {VERIFY_PHOTOS} or {VERIFY_PHOTOS}=N; put --verify behind OUT"
    )


def photos_asked(arguments: argparse.Namespace) -> int | None:
    """Return how many photos --verify puts into the page; None for no evidence in it."""
    name, _, number = (arguments.verify or "").partition("=")
    return None if name != VERIFY_PHOTOS else int(number or PHOTOS)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("sources", type=Path, nargs="+", metavar="IN", help="scene file or run folder")
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help=f"file to write; its suffix selects the format: {', '.join(SCENE_SUFFIXES)} or .html (a page that shows"
        f" the scene); {' and '.join(POINT_SUFFIXES)} are point clouds of the splats' centres; .usdc needs the extra"
        " usd, point clouds the extra scans; FOLDER/meta.json writes an unzipped SOG, FOLDER/lod-meta.json levels of"
        " detail (streamed SOG), FOLDER/tileset.json 3D Tiles for Cesium",
    )
    parser.add_argument("--merge", action="store_true", help="join several scenes into one")
    _add_filters(parser)
    parser.add_argument(
        "--transform",
        action="append",
        default=[],
        metavar="KIND=VALUE",
        help=f"transform the scene after --crop: {MOVES}; may be repeated and is applied in order",
    )
    parser.add_argument(
        "--scale",
        metavar='"A B 1.20m"',
        help="two points of the scene, after --transform, and their distance in m, cm or mm, which becomes the unit:"
        f" {POINTS}",
    )
    parser.add_argument(
        "--path",
        type=Path,
        metavar="FILE",
        help="keyframes, as for render --path, that the page (OUT.html) plays; in the coordinates of IN",
    )
    add_meshes(parser)
    _add_edits(parser)
    _add_levels(parser.add_argument_group("levels of detail, for OUT/lod-meta.json and OUT/tileset.json"))
    add_backend(parser)


def _add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options that make a file smaller."""
    parser.add_argument(
        "--sh-degree",
        type=whole_number_text,
        default=SH_MAX_DEGREE,
        metavar="N",
        help="highest degree of spherical harmonics to keep (default: %(default)s)",
    )
    parser.add_argument(
        "--min-opacity",
        type=number_text,
        default=0.0,
        metavar="A",
        help="drop Gaussians with a lower opacity (default: 0)",
    )
    parser.add_argument(
        "--size",
        type=bytes_text,
        metavar="BYTES",
        help="write the best file of at most this size, as 500kB, 2MB or 1.5MiB, and at least 99 %% of it: with the"
        " splats that its pictures show most, or fewer that were merged, stored as finely as fits, and trained on for"
        f" a minute or two on the photos of a run; for {', '.join(SIZED)}",
    )
    parser.add_argument(
        "--crop",
        type=numbers_text(6),
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="keep only Gaussians whose centre lies in this box, in the coordinates of IN; write --crop=-1,... if the"
        " first number is negative",
    )


def _add_edits(parser: argparse.ArgumentParser) -> None:
    """Add the options of edits files, and the check of what is written."""
    parser.add_argument(
        "--edits",
        type=Path,
        metavar="FILE",
        help="apply the operations of an edits file, from `gsplat-edu view IN --edit`, before all other options",
    )
    parser.add_argument(
        "--edits-anyway",
        action="store_true",
        help="apply --edits to another scene than it was made for, if it selects by positions only",
    )
    parser.add_argument(
        "--verify",
        type=evidence_text,
        nargs="?",
        const=VERIFY_FILE,
        metavar=f"{VERIFY_PHOTOS}[=N]",
        help="read OUT back, render it and the original from some of the run's cameras (or an orbit), print the PSNR;"
        f" --verify {VERIFY_PHOTOS} also lets visitors of a run's page verify it: a switch colours what fewer than two"
        f" training photos saw, and N photos can be compared with the picture (default: {PHOTOS})",
    )
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help=f"the run's capture if it has moved, for --size and --verify {VERIFY_PHOTOS}",
    )


def _add_levels(group: argparse._ArgumentGroup) -> None:
    """Add the options of levels of detail; their defaults are those of `gsplat_edu.io.lod.levels.LodOptions`."""
    group.add_argument(
        "--lod-smallest",
        type=whole_number_text,
        metavar="N",
        help="halve the number of splats until a level has at most N (default: 1,000,000; one tile for"
        " tileset.json)",
    )
    group.add_argument(
        "--lod-chunk",
        type=whole_number_text,
        metavar="N",
        help="splats per file, at most (default: 524,288)",
    )
    group.add_argument(
        "--lod-leaf",
        type=whole_number_text,
        metavar="N",
        help="splats of the finest level per region, which viewers load and show at one level, at most"
        " (default: 32,768)",
    )
    group.add_argument(
        "--lod-refine",
        type=whole_number_text,
        nargs="?",
        const=LOD_STEPS,
        metavar="STEPS",
        help="train each coarser level against the run's photos, reduced to the size at which it is shown (renders of"
        f" the scene for a scene file), and print PSNR per level (default: {LOD_STEPS} steps); for lod-meta.json",
    )


def check(arguments: argparse.Namespace) -> None:
    """Check the numbers, and the options that depend on each other.

    Raises:
        ArgumentError: a number is out of range, or an option needs another, or excludes it.
        DatasetError: there is nothing under --dataset.
    """
    whole_number("--sh-degree", arguments.sh_degree, 0, SH_MAX_DEGREE)
    in_range("--min-opacity", arguments.min_opacity, 0.0, 1.0)
    if arguments.edits_anyway and arguments.edits is None:
        raise ArgumentError("--edits-anyway: has an effect only with --edits; add --edits FILE")
    if photos_asked(arguments) is not None:
        if arguments.out.suffix.lower() != ".html":
            raise ArgumentError(
                f"--verify {VERIFY_PHOTOS}: {arguments.out} is no page; give a name that ends in .html"
            )
        if len(arguments.sources) > 1:
            raise ArgumentError(
                f"--verify {VERIFY_PHOTOS}: is for the page of one run; convert one at a time"
            )
    elif arguments.dataset is not None and arguments.size is None:
        raise ArgumentError(
            f"--dataset: has an effect only with --size or --verify {VERIFY_PHOTOS}; add one of them"
        )
    _check_size(arguments)
    if arguments.dataset is not None and not arguments.dataset.exists():
        raise DatasetError(f"--dataset: {arguments.dataset} does not exist; give the folder of a capture")
    if arguments.edits is not None and len(arguments.sources) > 1:
        raise ArgumentError(
            "--edits: is for one scene; convert each scene with its edits, then merge the results"
        )


def _check_size(arguments: argparse.Namespace) -> None:
    if arguments.size is None:
        return
    if arguments.size < 1:
        raise ArgumentError("--size: is 0 bytes; give more, for example 2MB")
    if not arguments.out.name.lower().endswith(SIZED):
        raise ArgumentError(f"--size: {arguments.out} cannot be fitted; write {', '.join(SIZED)}")
