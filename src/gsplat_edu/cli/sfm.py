"""`gsplat-edu sfm`: photos or a video without poses become a capture."""

from __future__ import annotations

import argparse
import shlex
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from gsplat_edu.cli.arguments import whole_number_text
from gsplat_edu.sfm.mapping import CAMERA_MODELS, MAPPERS
from gsplat_edu.sfm.reconstruct import MATCHERS, SfmOptions, reconstruct

EXAMPLE = "example: gsplat-edu sfm holiday.mp4 captures/holiday --frames 200"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="PHOTOS",
        help="a folder of photos (with masks/ or alpha, if any), or a video",
    )
    parser.add_argument(
        "out", type=Path, metavar="OUT", help="folder of the capture; work is kept in OUT/sfm"
    )

    def number(flag: str, text: str, default: int) -> None:
        parser.add_argument(
            flag, type=whole_number_text, metavar="N", default=default, help=f"{text} (default: {default})"
        )

    def choice(flag: str, text: str, names: tuple[str, ...]) -> None:
        parser.add_argument(
            flag, metavar="NAME", default="auto", help=f"{text}: {', '.join(names)} (default: auto)"
        )

    number("--frames", "frames taken from a video, at most", SfmOptions.frames)
    choice("--matcher", "which photos are compared", MATCHERS)
    choice("--mapper", "how poses are found", MAPPERS)
    choice("--camera-model", "lens model; auto frees what held-out photos support", CAMERA_MODELS)
    number("--max-features", "features of a photo, at most", SfmOptions.max_features)
    number("--max-image-size", "longest side at which features are found, px", SfmOptions.max_image_size)
    number("--threads", "threads of COLMAP, 0 for all", SfmOptions.threads)


def options_from(arguments: argparse.Namespace) -> SfmOptions:
    """Turn what `add_arguments` parsed into options.

    Raises:
        ArgumentError: one is out of range.
    """
    return SfmOptions(
        arguments.source,
        arguments.out,
        arguments.frames,
        arguments.matcher,
        arguments.mapper,
        arguments.camera_model,
        arguments.max_features,
        arguments.max_image_size,
        arguments.threads,
    )


def run(arguments: argparse.Namespace) -> None:
    """Find the poses, showing how it goes."""
    options = options_from(arguments)
    console = Console(highlight=False, markup=False)

    def say(sentence: str) -> None:
        console.print(sentence, soft_wrap=True)

    with stage_bars(console) as progress:
        try:
            reconstruct(options, say, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "interrupted; the same command resumes after the last finished stage"
            ) from None
    say(f"wrote {options.out}; next: gsplat-edu train {shlex.quote(str(options.out))} --out RUN")


@contextmanager
def stage_bars(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar per stage while the block runs, on a terminal; let SIGTERM end it as Ctrl-C does.

    Args:
        console: Where to.

    Yields:
        The progress that `reconstruct` tells.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
            tasks: dict[str, TaskID] = {}

            def show(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    for task in tasks.values():
                        bar.update(task, visible=False)
                    tasks[stage] = bar.add_task(stage, total=total)
                bar.update(tasks[stage], completed=done, total=total)

            yield show
    finally:
        signal.signal(signal.SIGTERM, before)
