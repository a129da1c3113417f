"""The options of `gsplat-edu train`, and the run they describe."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from gsplat_edu.base.constants import AUTO as AUTO
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.text import option_flag
from gsplat_edu.base.validation import one_of
from gsplat_edu.data.settings import LENS_MODES, DataSettings
from gsplat_edu.options.asked import (
    COMMON_ASKED,
    OFFERED_ASKED,
    add_of_photos,
    add_of_results,
    asked_of,
    check_asked,
)
from gsplat_edu.options.blocks import add_blocks, add_cluster, check_blocks
from gsplat_edu.options.length import length_of, strategy_of
from gsplat_edu.options.poses import add_poses, add_trust, posed_by
from gsplat_edu.options.settings import (
    add_setting,
    add_settings,
    appendix as appendix,
    explain_unknown as explain_unknown,
)
from gsplat_edu.options.several import check_several
from gsplat_edu.options.sfm import add_panorama, add_scale
from gsplat_edu.options.values import NumberOr, add_backend, bytes_text, seconds_text, whole_number_text
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.sfm.options import PANORAMA
from gsplat_edu.sfm.scale_text import check_scale
from gsplat_edu.train.capacity import PLANNED_VIEWS
from gsplat_edu.train.config import (
    BY_NAME,
    DEFAULT_STRATEGY,
    FAST_FROM_SCENE,
    FOR_START,
    FROM_SCENE,
    ONLY_FOR,
    ONLY_WITH,
    RECIPE_ITERATIONS,
    SETTINGS,
    WITH_OPTION,
    TrainConfig,
    recipe,
)
from gsplat_edu.train.length import DEFAULT_QUALITY, QUALITIES, UNIT
from gsplat_edu.train.setting import BY_DEFAULT, LENGTH, PHOTOS, Plain

EXAMPLE = "example: gsplat-edu train captures/plush --out runs/plush --quality high"

COMMON = (
    *("out", "resume", "scene", "time_limit", "max_memory", "quality", "resolution", "test_every"),
    *("white_background", "backend", "debug", "eval_every", "export", "view", "settings"),
    *COMMON_ASKED,
    *(name for name, option in WITH_OPTION.items() if option.common),
)
"""What `--help` shows; `--help-all` shows the other options too."""

RANDOM_POINTS = Path("random")
"""Value of --points: do not triangulate start points."""

OFFERED = {
    "time_limit": Plain("Time instead of a quality", group=LENGTH, example="30m"),
    "max_memory": Plain("Memory limit", group=LENGTH, example="8GiB"),
    "resolution": Plain(
        "Size of the photos: 2 for half, longest side in px, or auto",
        group=LENGTH,
        example="full size",
        again="Train with smaller photos",
    ),
    "lens": Plain(
        "Lens",
        {
            "": "straighten the photos",
            "auto": "keep wide lenses, panoramas, rolling shutters",
            "native": "keep every lens as it is",
        },
        PHOTOS,
    ),
    "trust_poses": Plain(
        "Poses",
        {"": "correct those that the photos show to be misread", "true": "use them as their file has them"},
        PHOTOS,
    ),
    **OFFERED_ASKED,
    **{setting.name: setting.option.plain for setting in SETTINGS if setting.option and setting.is_single},
    **dict.fromkeys(("quality", "resume", "test_every", "panorama", "scale", "eval_every", "save_every")),
    **dict.fromkeys(("white_background", "set")),
}
"""Options that requests may give, and how pages ask for them; a page does not ask for those with None."""

OPEN = tuple(name for name, option in WITH_OPTION.items() if option.auto)
"""Settings that can be left open by `AUTO`."""

OPEN_FOR_FAST = tuple(name for name in OPEN if WITH_OPTION[name].auto == BY_DEFAULT)
"""Those that the strategy fast leaves open unless they are given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_training(parser)
    add_blocks(parser)
    add_cluster(parser)


def runner(arguments: argparse.Namespace) -> str:
    """Return the module of `gsplat_edu.cli` that runs the command."""
    return "train" if arguments.blocks is None else "blocks"


def add_training(parser: argparse.ArgumentParser) -> None:
    """Add the options of a training."""
    parser.usage = "%(prog)s DATA --out RUN [options]"
    parser.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="capture (COLMAP, transforms.json, Blender and others), or photos or a video, whose poses are found first",
    )
    run = parser.add_argument_group("run")
    run.add_argument("--out", type=Path, metavar="RUN", required=True, help="run folder to write (required)")
    run.add_argument(
        "--resume",
        action="store_true",
        help="continue from the last checkpoint in RUN; a larger --iterations extends the run, keeping its"
        " milestones and learning rates",
    )
    _add_start(run.add_mutually_exclusive_group())
    add_setting(run, "seed")
    add_backend(run)
    _add_length(parser.add_argument_group("length and limits"))
    photos = parser.add_argument_group("photos")
    _add_photos(photos)
    add_poses(photos)
    add_trust(photos, ", and train on photos whose poses are certainly wrong too")
    add_panorama(photos)
    add_scale(photos)
    _add_results(parser.add_argument_group("results"))
    _add_view(parser.add_argument_group("live view"))
    _add_recipe(parser, parser.add_argument_group("recipe", "docs/RECIPE.md explains it."))


def _add_number(
    group: argparse._ActionsContainer, flag: str, text: str, default: int | None = None
) -> argparse.Action:
    return group.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=text)


def _add_start(start: argparse._MutuallyExclusiveGroup) -> None:
    start.add_argument(
        "--from",
        dest="scene",
        type=Path,
        metavar="SCENE|RUN",
        help="start from the Gaussians of a trained scene, or of a run's latest one, instead of points; all harmonics"
        f" are in use from the first iteration, and means_rate is {FROM_SCENE['means_rate']:g} unless --set gives it",
    )
    start.add_argument(
        "--points",
        type=Path,
        metavar="X.ply|X.las",
        help="start from these points instead of the capture's: PLY, PCD, LAS, LAZ, E57;"
        f" {RANDOM_POINTS}: where the capture has none, do not triangulate any",
    )


def _add_length(group: argparse._ArgumentGroup) -> None:
    add_setting(
        group,
        "iterations",
        "those of --quality, or as many as fit --time-limit;"
        f" {RECIPE_ITERATIONS:,} for strategies other than fast",
    )
    group.add_argument(
        "--no-rescale",
        action="store_true",
        help="keep the milestones of 30,000 iterations for any --iterations",
    )
    group.add_argument(
        "--time-limit",
        type=seconds_text,
        metavar="TIME",
        help="end this long after the start of the command, for example 90s, 20m or 2h;"
        " without --iterations, run as many as fit",
    )
    group.add_argument(
        "--max-memory",
        type=bytes_text,
        metavar="SIZE",
        help="keep the process below this size, for example 4GiB, by choosing the photos' resolution, how many"
        " photos stay in memory, and the cap on Gaussians; based on a forecast",
    )
    add_setting(group, "strategy", f"{DEFAULT_STRATEGY}, or that of the run to resume")
    lengths = ", ".join(f"{name} {share * UNIT:,}" for name, share in QUALITIES.items())
    group.add_argument(
        "--quality",
        metavar="NAME",
        help=f"length of the recipe fast in iterations: {lengths}, more for captures of more than {PLANNED_VIEWS}"
        f" photos and less where more would hurt (default: {DEFAULT_QUALITY}, unless --iterations or --time-limit"
        " is given)",
    )
    add_setting(group, "max_gaussians", "fast plans one from the capture; others have none")


def _add_results(group: argparse._ArgumentGroup) -> None:
    for flag, what, zero, every in (
        (
            "--eval-every",
            "evaluations on the test views",
            "0 scores nothing, not even at the end",
            RunOptions.eval_every,
        ),
        ("--save-every", "checkpoints", "0 for the end only", RunOptions.save_every),
    ):
        _add_number(group, flag, f"iterations between {what}; {zero} (default: {every})", every)
    add_of_results(group)
    group.add_argument(
        "--export",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="also write the scene in other formats, as `gsplat-edu convert --verify` does: scene.spz scene.html ...",
    )


def _add_view(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--view",
        action="store_true",
        help="show the training in the browser, with curves, pause and single step. Snapshots take at most 2 %% of the"
        " time and do not change the result. The printed URL contains a token that is required for access. After the"
        " training the view stays open until the last browser is closed, or Ctrl-C",
    )
    group.add_argument(
        "--view-host",
        metavar="ADDRESS",
        help="address to listen on (default: 127.0.0.1, reachable from this computer only)",
    )
    group.add_argument(
        "--view-port",
        type=whole_number_text,
        metavar="N",
        help="port to listen on; 0 for any free one (default: 8080)",
    )


def _add_photos(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--resolution",
        type=NumberOr(AUTO),
        metavar="R",
        help="below 32: divide the photos' size by this; from 32 on: their longest side in px; auto: what the"
        " planned Gaussians resolve, if the photos are much larger (default: full size)",
    )
    group.add_argument(
        "--lens",
        choices=LENS_MODES,
        help="native: train through the photos' own lenses and rolling shutters, without resampling or cropping"
        " them; auto: only fisheyes, panoramas, rolling shutters and photos that would lose a tenth; undistort:"
        " none (default: undistort)",
    )
    _add_number(
        group,
        "--test-every",
        "hold out every N-th view, by name, for testing; 0 for none (default: the capture's own split, or 8)",
    )
    group.add_argument(
        "--image-memory",
        type=bytes_text,
        metavar="SIZE",
        help="memory for decoded photos, for example 500MB; others are read again for each use (default: 4GiB)",
    )
    for name, option in WITH_OPTION.items():
        if option.plain is not None and option.plain.group == PHOTOS:
            add_setting(group, name)
    add_of_photos(group)
    _add_background(group)


def _add_background(group: argparse._ArgumentGroup) -> None:
    behind = group.add_mutually_exclusive_group()
    behind.add_argument(
        "--white-background",
        action="store_true",
        help="white background; as --background 1 1 1",
    )
    add_setting(behind, "background", "black")
    add_setting(group, "random_background")


def _add_recipe(parser: argparse.ArgumentParser, group: argparse._ArgumentGroup) -> None:
    listed = {action.dest for action in parser._actions}
    for name in WITH_OPTION:
        if name not in listed:
            add_setting(group, name)
    add_settings(group)


def check(arguments: argparse.Namespace) -> None:
    """Check what can be checked without importing torch or reading a photo.

    Raises:
        ArgumentError: an option is out of range.
        CheckpointError: the config.json of a run to resume is damaged.
        DatasetError: there is nothing under DATA.
    """
    check_blocks(arguments)
    _options(arguments, arguments.backend)
    one_of("--panorama", arguments.panorama, PANORAMA)
    check_scale(arguments.scale)
    if not arguments.data.exists():
        raise DatasetError(
            f"{arguments.data}: does not exist; give the folder of a capture, of photos, or a video"
        )
    arguments.data = posed_by(arguments.data, arguments.poses)
    check_asked(arguments)
    check_several(arguments)
    for flag, path in (("--points", arguments.points), ("--from", arguments.scene)):
        if path is not None and not path.exists() and (flag, path) != ("--points", RANDOM_POINTS):
            raise ArgumentError(f"{flag}: {path} does not exist; correct the name, or omit the option")


def options_from(arguments: argparse.Namespace) -> RunOptions:
    """Turn what `add_arguments` parsed into the options of a run.

    Raises:
        ArgumentError: an option is out of range.
        BackendUnavailableError: the backend does not run here.
        CheckpointError: the config.json of a run to resume is damaged.
    """
    from gsplat_edu.render.backends import resolve_backend  # it imports torch

    return _options(arguments, resolve_backend(arguments.backend))


def _options(arguments: argparse.Namespace, backend: str) -> RunOptions:
    folder = RunFolder(arguments.out)
    if arguments.resume and folder.exists():
        folder.check_plugins()
    config = _config(arguments)
    flattened = config.alpha_background == "fixed" and not config.random_background
    settings = DataSettings(
        resolution=_resolution(arguments),
        test_every=arguments.test_every,
        background=config.background if flattened else None,
        image_memory=DataSettings.image_memory if arguments.image_memory is None else arguments.image_memory,
        lens=arguments.lens or DataSettings.lens,
        region=() if config.region == "none" else None,
    )
    return RunOptions(
        data=arguments.data,
        out=arguments.out,
        config=config,
        data_settings=settings,
        points=None if arguments.points == RANDOM_POINTS else arguments.points,
        scene=arguments.scene,
        backend=backend,
        eval_every=arguments.eval_every,
        save_every=arguments.save_every,
        resume=arguments.resume,
        asked=asked_of(arguments),
    )


def _resolution(arguments: argparse.Namespace) -> float | None:
    """Return the resolution: given, or for auto that of the run to resume, or none yet."""
    if arguments.resolution != AUTO:
        return None if arguments.resolution is None else float(arguments.resolution)
    if arguments.blocks is not None:
        raise ArgumentError("--resolution auto: is for trainings in one piece; give a number with --blocks")
    folder = RunFolder(arguments.out)
    stored = folder.read_config().get("data") if arguments.resume and folder.exists() else None
    found = stored.get("resolution") if isinstance(stored, dict) else None
    return float(found) if isinstance(found, int | float) else None


def _config(arguments: argparse.Namespace) -> TrainConfig:
    strategy = strategy_of(arguments)
    changes: dict[str, Any] = {"strategy": strategy}
    changes |= {
        name: getattr(arguments, name)
        for name in WITH_OPTION
        if name not in ("iterations", "background") and getattr(arguments, name) is not None
    }
    changes |= arguments.settings
    changes |= {name: _given_or_stored(arguments, name) for name in OPEN}
    if arguments.white_background or arguments.background:
        changes["background"] = tuple(arguments.background or (1.0, 1.0, 1.0))
        changes = ({} if arguments.random_background else {"alpha_background": "fixed"}) | changes
    for only, names in ONLY_FOR.items():
        if only != strategy and (idle := [name for name in names if name in changes]):
            raise ArgumentError(
                f"{BY_NAME[idle[0]].written}: only --strategy {only} uses it; leave it out or choose that strategy"
            )
    for only, names in ONLY_WITH.items():
        if (idle := [name for name in names if name in changes]) and not getattr(arguments, only):
            raise ArgumentError(
                f"{BY_NAME[idle[0]].written}: only {option_flag(only)} uses it; leave it out or add {option_flag(only)}"
            )
    planned = arguments.max_memory is not None or (
        arguments.time_limit is not None and arguments.iterations is None
    )
    if _starts_from_scene(arguments):
        if idle := [BY_NAME[name].written for name in FOR_START if changes.get(name, "none") != "none"]:
            raise ArgumentError(f"{idle[0]}: only a start from points uses it, not --from; leave it out")
        changes = FROM_SCENE | (FAST_FROM_SCENE if strategy == "fast" else {}) | changes
    iterations = length_of(arguments, strategy)
    config = recipe(iterations, rescale=not arguments.no_rescale, **changes)
    if config.strategy == "mcmc" and config.max_gaussians is None and not planned:
        raise ArgumentError("--max-gaussians: mcmc grows up to a cap; give one, for example 200000")
    return config


def _given_or_stored(arguments: argparse.Namespace, name: str) -> str:
    """Return the value of one of `OPEN`: given, of the run to resume, or the default (see `left_open`)."""
    given, setting = getattr(arguments, name), BY_NAME[name]
    if given is not None:
        one_of(setting.written, given, (*setting.names, AUTO))
    if given not in (None, AUTO):
        return str(given)
    folder = RunFolder(arguments.out)
    stored = folder.read_config().get("train") if arguments.resume and folder.exists() else None
    return str(stored.get(name, setting.default) if isinstance(stored, dict) else setting.default)


def left_open(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return which of `OPEN` have to be chosen for a new run: those that are auto, some by default for fast.

    A run that starts from a scene has what only a start from points chooses, such as a sky, from that scene.
    """
    if arguments.resume and RunFolder(arguments.out).exists():
        return ()
    default = OPEN_FOR_FAST if strategy_of(arguments) == "fast" else ()
    given = {name: getattr(arguments, name) or (AUTO if name in default else None) for name in OPEN}
    return tuple(n for n in OPEN if given[n] == AUTO and (n not in FOR_START or arguments.scene is None))


def _starts_from_scene(arguments: argparse.Namespace) -> bool:
    """Say whether the run starts from a scene, by its options or, where it is resumed, by its config.json."""
    folder = RunFolder(arguments.out)
    if arguments.scene is not None or not (arguments.resume and folder.exists()):
        return arguments.scene is not None
    data = folder.read_config().get("data")
    return isinstance(data, dict) and data.get("scene") is not None
