"""The options of `gsplat-edu render`."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.options.values import add_backend, whole_number_text
from gsplat_edu.render.settings import MAPS
from gsplat_edu.scene.projection import STEEPEST_FISHEYE

EXAMPLE = "example: gsplat-edu render out/plush --orbit --frames 120 --out plush.mp4"

OFFERED = ("frames", "size", "fps", "orbit", "white_background")
"""Options that requests may give."""

LENSES = ("pinhole", "fisheye", "equirectangular", "orthographic")
"""Names of the lenses of --camera-model."""

FISHEYE_DEGREES = 180.0
"""Field of view of a fisheye unless one is given."""

WIDEST_FISHEYE = 2 * math.degrees(STEEPEST_FISHEYE)
"""Largest field of view of a fisheye, degrees."""

SCENE_SIZE = 512
"""px: size of the images of a scene file that comes without cameras."""

KEYFRAMES = 24
"""Most keyframes that --save-path writes."""

ORBIT_FRAMES = 120
"""Frames of an orbit."""

RUNS_CAMERAS = ""
"""Value of --dataset without a path."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="RUN|SCENE", help="run folder or scene file")
    parser.add_argument(
        "--dataset",
        nargs="?",
        const=RUNS_CAMERAS,
        metavar="PATH",
        help="render from the run's cameras, or from those of the capture PATH",
    )
    parser.add_argument(
        "--orbit",
        action="store_true",
        help="render along a path that stays where the photos were taken: a full circle if the cameras surround the"
        " scene, otherwise only as far as they reach (default)",
    )
    _add_path(parser)

    def number(flag: str, default: int | None, text: str) -> None:
        parser.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=text)

    number(
        "--frames",
        None,
        f"number of frames along the path (default: {ORBIT_FRAMES}; with --path, what --fps makes of its duration)",
    )
    number(
        "--size",
        None,
        f"longer side of the images, px (default: that of the cameras; {SCENE_SIZE} for a scene file)",
    )
    number("--fps", 30, "frames per second of a video (default: 30)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR|X.mp4",
        help="folder for PNGs, or a video (VP9 in MP4) (default: renders/ in the run, out/ for a scene file)",
    )
    parser.add_argument(
        "--camera-model",
        metavar="NAME[:N]",
        default="pinhole",
        help=f"lens: fisheye[:DEGREES] (a circle with this field of view, {FISHEYE_DEGREES:g} if none is given),"
        " equirectangular (the whole sphere, level, 2:1, marked for players of 360-degree images and videos), or"
        " orthographic; without --orbit, --path and --dataset, orthographic[:HEIGHT] is a floor plan that leaves out"
        " what is higher above the floor, world units (default: pinhole)",
    )
    parser.add_argument(
        "--maps",
        metavar="NAMES",
        help=f"also write maps, separated by commas: {', '.join(MAPS)}; each as float32 TIFF, 16-bit PNG (maps.json has"
        " the scales) and coloured preview; needs a folder for --out",
    )
    parser.add_argument(
        "--white-background", action="store_true", help="render over white (default: the run's background)"
    )
    add_backend(parser)


def _add_path(parser: argparse.ArgumentParser) -> None:
    """Add the options of camera paths in files."""
    parser.add_argument(
        "--path",
        type=Path,
        metavar="FILE",
        help="render along the keyframes of a JSON file, from --save-path or from the page of view and convert",
    )
    parser.add_argument(
        "--edits",
        type=Path,
        metavar="FILE",
        help="apply an edits file, from `gsplat-edu view SCENE --edit`, and render along its camera path if it has one",
    )
    parser.add_argument(
        "--save-path",
        type=Path,
        metavar="FILE",
        help="instead of rendering, write the orbit, or with --dataset the cameras in order of their names, as"
        " keyframes for --path",
    )
    parser.add_argument(
        "--keyframes",
        type=whole_number_text,
        metavar="N",
        help=f"most keyframes that --save-path writes (default: {KEYFRAMES})",
    )


@dataclass(frozen=True)
class LensChoice:
    """What --camera-model says.

    Args:
        kind: One of `LENSES`.
        value: The number after it: degrees of a fisheye, or height of a plan, world units; None if there is none.
    """

    kind: str
    value: float | None = None


def lens_choice(text: str) -> LensChoice:
    """Read the value of --camera-model.

    Raises:
        ArgumentError: the lens is unknown, or its number is none, out of range or not wanted.
    """
    kind, colon, number = text.partition(":")
    if kind not in LENSES:
        raise ArgumentError(f"--camera-model: does not know {kind!r}; use {', '.join(LENSES)}")
    if not colon:
        return LensChoice(kind)
    if kind in ("pinhole", "equirectangular"):
        raise ArgumentError(f"--camera-model: {kind} takes no number; leave out {text.removeprefix(kind)!r}")
    what, most = ("degrees", WIDEST_FISHEYE) if kind == "fisheye" else ("height", float("inf"))
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not 0.0 < value <= most or value == float("inf"):
        limit = "" if kind == "orthographic" else f" of at most {most:g}"
        raise ArgumentError(
            f"--camera-model: {text!r} has no {what}; write {kind}:N with a positive N{limit}"
        )
    return LensChoice(kind, value)


def check(arguments: argparse.Namespace) -> None:
    """Check the numbers, and the options that exclude each other.

    Raises:
        ArgumentError: a number is out of range, or two of them were given.
    """
    for name in ("frames", "fps", "size"):
        if (value := getattr(arguments, name)) is not None:
            whole_number(f"--{name}", value, 1)
    others = {
        "--dataset": arguments.dataset is not None,
        "--orbit": arguments.orbit,
        "--save-path": arguments.save_path is not None,
    }
    if arguments.path is not None and (given := [flag for flag, is_given in others.items() if is_given]):
        raise ArgumentError(f"--path: cannot be combined with {given[0]}; give one of them")
    edits_exclude = {"--dataset": others["--dataset"], "--save-path": others["--save-path"]}
    if arguments.edits is not None and (
        given := [flag for flag, is_given in edits_exclude.items() if is_given]
    ):
        raise ArgumentError(
            f"--edits: cannot be combined with {given[0]}; convert the scene with its edits first"
        )
    if arguments.save_path is not None and (given := _given(arguments, "out", "maps")):
        raise ArgumentError(f"--save-path: renders nothing; remove {given[0]}")
    if arguments.save_path is not None and arguments.camera_model != "pinhole":
        raise ArgumentError("--save-path: renders nothing; remove --camera-model")
    if arguments.save_path is None and arguments.keyframes is not None:
        raise ArgumentError("--keyframes: is only for --save-path; remove it")


def _given(arguments: argparse.Namespace, *names: str) -> list[str]:
    return [f"--{name}" for name in names if getattr(arguments, name) is not None]
