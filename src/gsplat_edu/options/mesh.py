"""The options of `gsplat-edu mesh`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.constants import PAGE_FACES
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.validation import in_range
from gsplat_edu.options.values import (
    NumberOr,
    add_backend,
    bytes_text,
    number_text,
    numbers_text,
)

EXAMPLE = "example: gsplat-edu mesh runs/plush plush.glb --faces 50000"

OFFERED = ("voxel", "faces", "keep", "max_memory", "texture")
"""Options that requests may give."""

READ = (".glb", ".ply", ".obj")
"""Suffixes of meshes that are read, as in `gsplat_edu.io.mesh_files`, which imports NumPy."""

SUFFIXES = (*READ, ".usdz")
"""Suffixes of meshes that are written."""

TEXTURE_FACES = 50_000
"""Faces of a mesh with a texture unless --faces gives another number: the layout of more takes minutes."""

COLLIDER_VOXELS = 4.0
"""Edge of a collider's voxels, in edges of the mesh's."""

COLLIDERS = ("triangles", "convex")
"""What a collider is made of."""

COLLIDER_FACES = 5_000
"""Faces of a collider unless --faces gives another number."""

MOST_FACES = PAGE_FACES - COLLIDER_FACES
"""Most faces of a mesh unless --faces gives another number: a page has room for it and for a collider."""

ALL = "all"
"""Value of --faces that keeps all triangles."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="SCENE|RUN", help="scene file or run folder")
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help=f"mesh to write; its suffix selects the format: {', '.join(SUFFIXES)} (extra usd)",
    )
    parser.add_argument(
        "--voxel",
        type=number_text,
        metavar="SIZE",
        help="edge of a voxel, world units; details below about two voxels are lost (default: 1.5 px of the photos at"
        " their median depth, or more, so that --faces and --max-memory are kept)",
    )
    parser.add_argument(
        "--faces",
        type=NumberOr(ALL, whole=True),
        metavar="N|all",
        help=f"reduce the mesh to about N triangles (extra mesh); {ALL}: as many as the memory holds (default: at most"
        f" {MOST_FACES:,}, by larger voxels, so that a page can show it; with --voxel, by reduction)",
    )
    parser.add_argument(
        "--keep",
        choices=("large", "largest", "all"),
        default="large",
        help='connected parts to keep: "large" those with at least 1 %% of the area, "largest" one, or "all" (default:'
        " %(default)s)",
    )
    parser.add_argument(
        "--bounds",
        type=numbers_text(6),
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="mesh only what lies in this box, in the scene's coordinates; write --bounds=-1,... if the first number is"
        " negative",
    )
    _add_kinds(parser)
    parser.add_argument(
        "--max-memory",
        type=bytes_text,
        metavar="SIZE",
        help="memory of the command, for example 2GiB; without --voxel, voxels are chosen so large that all fits"
        " (default: what is free)",
    )
    _add_truth(parser)
    add_backend(parser)


def _add_kinds(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--collider",
        nargs="?",
        choices=COLLIDERS,
        const="triangles",
        help="make a coarse mesh for collisions: voxels four times as large, and 5,000 triangles unless --faces says"
        ' otherwise; "convex" cuts it into convex parts, nodes collider_0, collider_1, ... of a .glb (extra mesh);'
        " they fill hollows, and how much and what they leave out is printed"
        ' (default without a value: "triangles")',
    )
    parser.add_argument(
        "--texture",
        action="store_true",
        help="paint the mesh with the capture's photos instead of colours per vertex: the best three of each place"
        " (extra mesh); 50,000 triangles unless --faces says otherwise",
    )
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help="for --texture: the capture; needed for a scene file, or if a run's capture has moved",
    )


def _add_truth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="true surface in the same coordinates, a mesh file; print distances to it, F1 and the angle of normals;"
        " only what the cameras see of it, and what --bounds contains, counts",
    )
    parser.add_argument(
        "--tau",
        type=number_text,
        metavar="SIZE",
        help="distance below which a point counts as correct for --truth, world units (default: one voxel)",
    )


def check(arguments: argparse.Namespace) -> None:
    """Check the options that need no scene.

    Raises:
        ArgumentError: an option is out of range, or excludes another.
        DatasetError: there is nothing under --dataset.
    """
    for flag, value in (("--voxel", arguments.voxel), ("--tau", arguments.tau)):
        if value is not None:
            in_range(flag, value, 0.0, open_low=True)
    if arguments.out.suffix.lower() not in SUFFIXES:
        raise ArgumentError(f"{arguments.out}: unknown mesh format; known are {', '.join(SUFFIXES)}")
    if isinstance(arguments.faces, int) and arguments.faces < 4:
        raise ArgumentError(f"--faces: is {arguments.faces}, but has to be at least 4")
    if arguments.dataset is not None and not arguments.texture:
        raise ArgumentError("--dataset: is for --texture; add it, or leave --dataset out")
    if arguments.texture and arguments.collider:
        raise ArgumentError("--texture: a collider has none; leave one of them out")
    if arguments.collider == "convex" and arguments.out.suffix.lower() != ".glb":
        raise ArgumentError(f"--collider convex: {arguments.out} cannot hold several parts; write a .glb")
    if arguments.dataset is not None and not arguments.dataset.exists():
        raise DatasetError(f"--dataset: {arguments.dataset} does not exist; give the folder of a capture")
    if arguments.tau is not None and arguments.truth is None:
        raise ArgumentError("--tau: is for --truth; give the true surface, or leave it out")
    if arguments.truth is not None and not arguments.truth.is_file():
        raise ArgumentError(f"--truth: {arguments.truth} does not exist; give a mesh file")
    if arguments.truth is not None and arguments.truth.suffix.lower() not in READ:
        raise ArgumentError(f"--truth: {arguments.truth} is no mesh; known formats are {', '.join(READ)}")
    if arguments.bounds is not None:
        low, high = arguments.bounds[:3], arguments.bounds[3:]
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ArgumentError("--bounds: X1, Y1 and Z1 have to be larger than X0, Y0 and Z0")
