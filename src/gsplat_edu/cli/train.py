"""`gsplat-edu train`: a capture becomes a scene."""

from __future__ import annotations

import argparse
import functools
import importlib
import inspect
import math
import re
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsplat_edu.cli.arguments import add_backend, bytes_text, seconds_text, whole_number_text
from gsplat_edu.cli.eval import score_lines
from gsplat_edu.cli.exporting import export_all
from gsplat_edu.data.dataset import DataSettings
from gsplat_edu.errors import ArgumentError
from gsplat_edu.evaluate.metrics import ImageScore, psnr
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.runs.evaluation import Evaluation
from gsplat_edu.runs.training import CaptureRun, RunOptions
from gsplat_edu.train.config import ONLY_FOR, RECIPE_ITERATIONS, STRATEGIES, TrainConfig, recipe
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Callback, Trainer
from gsplat_edu.viewer.export import check_target
from gsplat_edu.viewer.serve import exposure

EXAMPLE = "example: gsplat-edu train captures/plush --out runs/plush --iterations 7000"

NAMED = ("iterations", "seed", "strategy", "max_gaussians", "antialiased", "background")
"""Fields of the recipe that have their options spelled out below; the others are made from `TrainConfig`."""

LINES = 20
"""Lines that tell of the training where there is no terminal to draw a bar on."""

PSNR_EVERY = 20
"""Iterations between two looks at the last view's loss and PSNR, which cost a few milliseconds each."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "data", type=Path, metavar="DATA", help="a capture: COLMAP, transforms.json or Blender"
    )
    parser.add_argument("--out", type=Path, metavar="RUN", required=True, help="folder of the run")
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint in RUN")
    _add_budget(parser.add_argument_group("budget"))
    _add_view(parser.add_argument_group("live view"))
    _add_data(parser.add_argument_group("photos"))
    group = parser.add_argument_group("recipe, see docs/RECIPE.md; defaults are those of 30,000 iterations")
    behind = group.add_mutually_exclusive_group()
    behind.add_argument(
        "--white-background", action="store_true", help="white behind everything (default: black)"
    )
    behind.add_argument(
        "--background", type=float, nargs=3, metavar=("R", "G", "B"), help="another colour, 0 to 1"
    )
    group.add_argument(
        "--antialiased", action="store_true", help="train for antialiased rendering (Mip-Splatting)"
    )
    meanings = _meanings()
    for field in fields(TrainConfig):
        if field.name not in NAMED:
            _add_field(group, field.name, field.default, meanings[field.name])


def _add_budget(group: argparse._ArgumentGroup) -> None:
    def number(flag: str, text: str, default: int | None = None) -> None:
        group.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=text)

    number("--iterations", f"steps of training (default: {RECIPE_ITERATIONS})", RECIPE_ITERATIONS)
    group.add_argument(
        "--no-rescale",
        action="store_true",
        help="keep the schedule of 30,000 iterations whatever --iterations is",
    )
    names = ", ".join(STRATEGIES)
    group.add_argument("--strategy", metavar="NAME", default="adc", help=f"one of {names} (default: adc)")
    number("--max-gaussians", "cap on the number of Gaussians (default: none; mcmc needs one)")
    number("--seed", "seed of all that is drawn at random (default: 0)", 0)
    for flag, what, every in (
        ("--eval-every", "judgements by the test views", RunOptions.eval_every),
        ("--save-every", "checkpoints", RunOptions.save_every),
    ):
        number(flag, f"iterations between {what}, 0 for none (default: {every})", every)
    group.add_argument(
        "--time-limit",
        type=seconds_text,
        metavar="TIME",
        help="end training after, for example, 90s, 20m or 2h",
    )
    group.add_argument(
        "--export",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="write the scene in other formats too, as `gsplat-edu convert --verify` does: scene.spz scene.html ...",
    )
    add_backend(group)


def _add_view(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--view",
        action="store_true",
        help="show the training in the browser while it runs, with pause and single step; it takes at most a fifth of"
        " the time and changes no bit. Afterwards the scene is shown until the last browser is closed, or Ctrl-C",
    )
    group.add_argument(
        "--view-host", metavar="ADDRESS", help="where to listen (default: 127.0.0.1, for this computer only)"
    )
    group.add_argument(
        "--view-port",
        type=whole_number_text,
        metavar="N",
        help="port, 0 for any that is free (default: 8080)",
    )


def _add_data(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--resolution",
        type=float,
        metavar="R",
        help="below 32: divide sizes by it; from 32 on: longest side in px (default: as they are)",
    )
    group.add_argument(
        "--test-every",
        type=whole_number_text,
        metavar="N",
        help="every n-th view by name is for testing, 0 for none (default: the capture's own split, or 8)",
    )
    group.add_argument(
        "--image-memory",
        type=bytes_text,
        metavar="SIZE",
        default=DataSettings.image_memory,
        help="decoded photos kept in memory, for example 500MB; others are read again (default: 4GiB)",
    )
    group.add_argument(
        "--points", type=Path, metavar="X.ply", help="start from these points, not the capture's"
    )


def _meanings() -> dict[str, str]:
    """Return what the docstring of `TrainConfig` says of each field."""
    text = (inspect.getdoc(TrainConfig) or "").partition("Args:")[2].partition("Raises:")[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", text, flags=re.MULTILINE)
    found = {name: " ".join(words.split()).replace("%", "%%") for name, words in entries}
    return {field.name: found.get(field.name, "") for field in fields(TrainConfig)}


def _add_field(group: argparse._ArgumentGroup, name: str, default: object, meaning: str) -> None:
    flag, text = f"--{name.replace('_', '-')}", f"{meaning} (default: {default})"
    if isinstance(default, bool):
        group.add_argument(flag, action="store_true", default=None, help=text)
    elif isinstance(default, str):
        group.add_argument(flag, metavar="NAME", help=text)
    elif isinstance(default, int):
        group.add_argument(flag, type=whole_number_text, metavar="N", help=text)
    else:
        kind = _number_or_none if name == "jacobian_limit" else _number
        group.add_argument(flag, type=kind, metavar="X", help=text)


def _number_or_none(text: str) -> float | str:
    return text if text == "none" else _number(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def options_from(arguments: argparse.Namespace) -> RunOptions:
    """Turn what `add_arguments` parsed into the options of a run.

    Raises:
        ArgumentError: an option is out of range.
        BackendUnavailableError: the backend does not run here.
    """
    changes: dict[str, Any] = {}
    for field in fields(TrainConfig):
        given = getattr(arguments, field.name, None)
        if given is not None and field.name not in ("iterations", "background"):
            changes[field.name] = None if field.name == "jacobian_limit" and given == "none" else given
    if arguments.white_background or arguments.background:
        changes["background"] = tuple(arguments.background or (1.0, 1.0, 1.0))
    for strategy, names in ONLY_FOR.items():
        if strategy != arguments.strategy and (idle := [name for name in names if name in changes]):
            flag = f"--{idle[0].replace('_', '-')}"
            raise ArgumentError(
                f"{flag}: is looked at by --strategy {strategy} only; leave it out or choose that"
            )
    config = recipe(arguments.iterations, rescale=not arguments.no_rescale, **changes)
    if config.strategy == "mcmc" and config.max_gaussians is None:
        raise ArgumentError("--max-gaussians: mcmc grows up to a cap; give one, for example 200000")
    settings = DataSettings(
        resolution=arguments.resolution,
        test_every=arguments.test_every,
        background=None if config.random_background else config.background,
        image_memory=arguments.image_memory,
    )
    return RunOptions(
        data=arguments.data,
        out=arguments.out,
        config=config,
        data_settings=settings,
        points=arguments.points,
        backend=resolve_backend(arguments.backend),
        eval_every=arguments.eval_every,
        save_every=arguments.save_every,
        time_limit=arguments.time_limit,
        resume=arguments.resume,
    )


def run(arguments: argparse.Namespace) -> None:
    """Train, showing how it goes; write the scene, the metrics and the report."""
    console = Console(highlight=False, markup=False)

    def say(sentence: str) -> None:
        console.print(sentence, soft_wrap=True)

    live = _live(arguments)
    for path in arguments.export:
        check_target("--export", path)
    with interruptible() as interrupted, ExitStack() as closing:
        capture = CaptureRun(options_from(arguments), say)
        if capture.finished:
            return
        view = None
        if live is not None:
            host, port = arguments.view_host or live.LOOPBACK, arguments.view_port
            view = live.LiveView(capture, interrupted, host, live.PORT if port is None else port)
            closing.enter_context(view)
            say(f"live view: {view.url}")
            if warning := exposure(host, "sees the training and can pause it"):
                say(warning)
        with _bar(console, "{task.fields[state]}") as bar:
            _train(capture, bar, interrupted, [] if view is None else [view.show])
        if interrupted():
            raise KeyboardInterrupt(
                f"interrupted after {capture.trainer.iteration} iterations;"
                " the same command with --resume goes on from there"
            )
        with _bar(console, "") as bar:
            task = bar.add_task("judging", total=len(capture.dataset.test) + len(capture.dataset.train))

            def scored(split: str, score: ImageScore) -> None:
                if interrupted():
                    raise KeyboardInterrupt(
                        "interrupted while judging; the scene is written, --resume judges it again"
                    )
                bar.advance(task)
                if view is not None:
                    view.look("judging")

            backend = capture.options.backend
            result = capture.finish(
                scored,
                functools.partial(export_all, arguments.export, bar, backend, say)
                if arguments.export
                else None,
            )
        _report(capture, result, say)
        if view is not None and view.watched:
            say("the live view stays until its last browser is closed, or Ctrl-C")
            view.stay()


def _report(capture: CaptureRun, result: Evaluation, say: Callable[[str], None]) -> None:
    trainer = capture.trainer
    rate = f"{1e3 * capture.seconds / max(trainer.iteration, 1):.1f} ms/iter"
    say(
        f"{trainer.iteration} iterations in {capture.seconds:.1f} s -> {rate}, {len(trainer.gaussians)} Gaussians"
    )
    for line in score_lines(result.test, result.train):
        say(line)
    say(f"wrote {capture.folder.scene(trainer.iteration)}, {capture.folder.report}")
    if (planned := trainer.config.iterations) > trainer.iteration:
        folder = capture.folder.path
        say(f"the time limit ended it before {planned}; --resume with a longer one goes on: {folder}")


def _live(arguments: argparse.Namespace) -> ModuleType | None:
    """Import the live view where it is asked for: it needs viser, which is optional."""
    if not arguments.view:
        for flag, value in (("--view-host", arguments.view_host), ("--view-port", arguments.view_port)):
            if value is not None:
                raise ArgumentError(f"{flag}: is looked at with --view only; add that, or leave it out")
        return None
    try:
        return importlib.import_module("gsplat_edu.viewer.live")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gsplat_edu"):
            raise
        how = "pip install -c constraints.txt 'gsplat-edu[viewer]'"
        raise ArgumentError(f"--view: {error.name} is not installed; {how}, or leave it out") from None


def _train(
    capture: CaptureRun, bar: Progress, interrupted: Callable[[], bool], callbacks: Sequence[Callback]
) -> None:
    iterations = capture.options.config.iterations
    photos = bar.add_task("photos", total=None, state="")
    task = bar.add_task("training", total=iterations, state="", visible=False)

    def show(trainer: Trainer, event: Event) -> None:
        if not isinstance(event, StepEvent):
            return
        if event.iteration % PSNR_EVERY == 0 or trainer.iteration == iterations:
            speed = bar.tasks[-1].speed or 0.0
            state = f"loss {event.loss:.3f}  PSNR {_psnr(trainer):.1f}  {event.num_gaussians} Gaussians"
            bar.update(task, state=f"{state}  {speed:.0f} it/s")
        bar.update(task, completed=trainer.iteration)
        if bar.disable and trainer.iteration % max(iterations // LINES, 1) == 0:
            figures = f"loss {event.loss:.4f}, PSNR {_psnr(trainer):.2f} dB, {event.num_gaussians} Gaussians"
            bar.console.print(f"iteration {trainer.iteration}/{iterations}: {figures}", soft_wrap=True)

    def loaded(done: int, total: int) -> None:
        if interrupted():
            raise KeyboardInterrupt("interrupted while reading photos; nothing was begun")
        bar.update(photos, completed=done, total=total)

    trainer = capture.start(loaded, [show, *callbacks])
    bar.remove_task(photos)
    bar.reset(task, total=iterations, completed=trainer.iteration, visible=True)
    capture.train(interrupted)


def _psnr(trainer: Trainer) -> float:
    if trainer.last is None:
        return math.nan
    return psnr(*trainer.last)


def _bar(console: Console, state: str) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TextColumn(state),
    )
    quiet = not console.is_terminal
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=not state, disable=quiet)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM end a training between two iterations; a second one ends it at once.

    Yields:
        Says whether one came. A loop that asks it is expected to end soon.
    """
    came = False

    def note(number: int, frame: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt(
                "interrupted; what was saved before is unharmed, --resume goes on from it"
            )
        came = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
