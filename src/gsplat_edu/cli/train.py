"""`gsplat-edu train`: train a scene from a capture."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.links import check_links
from gsplat_edu.base.locks import locked
from gsplat_edu.base.text import Told, option_flag
from gsplat_edu.budget.choice import Prospect, choose_backend, resumed_backend
from gsplat_edu.budget.deadline import Deadline, TrialTime, stopwatch
from gsplat_edu.budget.pace import Pace
from gsplat_edu.budget.plan import Limits, Plan, look_ahead, plan
from gsplat_edu.budget.planned import PLANNED
from gsplat_edu.cli.exporting import export_all
from gsplat_edu.cli.findings import with_known_photos, with_right_poses
from gsplat_edu.cli.process import interruptible, process_age
from gsplat_edu.cli.result import tell_result
from gsplat_edu.cli.terminal import Bar, Field, Terminal, stage_bars
from gsplat_edu.data.colmap import find_model
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.point_files import read_points
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.doctor.remedies import remedies_for
from gsplat_edu.evaluate.metrics import ImageScore, psnr
from gsplat_edu.jobs.ranks import num_processes
from gsplat_edu.options.asked import asked_of
from gsplat_edu.options.length import quality_of
from gsplat_edu.options.settings import given
from gsplat_edu.options.train import AUTO, RANDOM_POINTS, left_open, options_from
from gsplat_edu.runs.pilot import chosen_by_pilots
from gsplat_edu.runs.processes import Member, joined
from gsplat_edu.runs.start_points import with_start_points
from gsplat_edu.runs.thin import LENGTHS
from gsplat_edu.runs.training import CaptureRun, RunOptions, is_finished
from gsplat_edu.server.address import PORT, free_port, warning_for
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.sfm.source import check_time_for_poses, needs_poses
from gsplat_edu.survey.capture import Undecided
from gsplat_edu.survey.finding import Remedy
from gsplat_edu.train.capacity import advised_side
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.part import parts
from gsplat_edu.train.schedule import milestone
from gsplat_edu.train.trainer import Callback, Trainer
from gsplat_edu.viewer.export import check_target
from gsplat_edu.viewer.live_folder import LiveFolder
from gsplat_edu.viewer.snapshots import Broadcast, FolderWatcher, Watcher, page_facts

if TYPE_CHECKING:
    from gsplat_edu.viewer.live import LiveView

LINES = 20
"""Number of progress lines if there is no terminal for a progress bar."""

NAME_WIDTH = 20
"""Characters of a view's name in the progress bar."""

PSNR_EVERY = 20
"""Iterations between two updates of the last view's loss and PSNR, which cost a few milliseconds each."""

STOPPED_LATE = Told(
    "interrupted during the evaluation; the scene is saved, and --resume repeats the evaluation",
    "stopped during the evaluation; the scene is saved, and the evaluation can be repeated",
)
"""What an interrupted evaluation says."""


def run(arguments: argparse.Namespace) -> None:
    """Train with progress output; write the scene, the metrics and the report."""
    console = Terminal()

    def say(sentence: str) -> None:
        console.print(sentence, soft_wrap=True)

    _check_view(arguments)
    for path in arguments.export:
        check_target("--export", path)
    size = num_processes()
    if size > 1 and needs_poses(arguments.data):
        raise ArgumentError(
            f"{arguments.data}: has no poses; find them first, in one process, by `gsplat-edu sfm`"
        )
    with joined(size) as team:
        if team.rank > 0:
            _follow(arguments, team)
            return
        with locked("--out", arguments.out, "gsplat-edu train", say):
            _run(arguments, console, say, team)


def _follow(arguments: argparse.Namespace, team: Member) -> None:
    """Train together with process 0, which reads the options, prints, and writes the run."""
    told = team.shared(None)
    if told["finished"]:
        return
    options = RunOptions(
        arguments.data,
        arguments.out,
        TrainConfig.of_record(told["train"]),
        DataSettings.of_record(told["data"]),
        asked=asked_of(arguments),
        eval_every=arguments.eval_every,
        save_every=arguments.save_every,
    )
    with interruptible(patient=True) as interrupted:
        CaptureRun(options, team=team).train(interrupted)
    if interrupted():
        raise KeyboardInterrupt


def _run(arguments: argparse.Namespace, console: Console, say: Callable[[str], None], team: Member) -> None:
    seconds = arguments.time_limit
    deadline = None if seconds is None else Deadline(seconds, stopwatch(process_age()))
    options = with_poses(options_from(arguments), arguments, console, say, seconds)
    reader = CaptureReader(options.data)
    options, reader = with_right_poses(options, reader, arguments, say)
    if arguments.points != RANDOM_POINTS:
        options = with_points(options, reader, seconds, console, say)
    chosen = _planned(arguments, options, reader, deadline, console, say)
    with interruptible(patient=team.size > 1) as interrupted, ExitStack() as closing:
        options = chosen.options
        if _is_over(options, team, say):
            return
        host, port = arguments.view_host or LOOPBACK, arguments.view_port
        if arguments.view:
            from gsplat_edu.viewer.live import NAMES

            port = PORT if port is None else port
            free_port(host, port, NAMES)  # before the run writes anything
        options = with_known_photos(options, reader)
        with progress_bar(console, "") as bar:
            capture = CaptureRun(options, say, photos_read(bar, interrupted), team, reader=reader)
        callbacks: list[Callback] = []
        ends = interrupted
        pace = None
        if deadline is not None:
            pace = Pace(capture, deadline, profile=chosen.profile if team.size == 1 else None, say=say)
            callbacks.append(pace)
            ends = functools.partial(_either, interrupted, pace.over)
        view = _view(capture, host, port, say, closing) if arguments.view else None
        watchers: list[Watcher] = [_folder_watcher(capture, say, closing)] if team.size == 1 else []
        broadcast = Broadcast(capture, interrupted, watchers if view is None else [*watchers, view])
        with progress_bar(console, "{task.fields[state]}") as bar:
            ended = train_with_bar(capture, bar, ends, [*callbacks, broadcast.show])
        if interrupted() or (ended and team.size > 1 and not ends()):  # or another process was
            raise KeyboardInterrupt(_stopped(capture.trainer.iteration))
        if pace is not None and pace.outcome is not None:
            say(pace.outcome)
        with progress_bar(console, "") as bar:
            scored_views = len(capture.dataset.test) + len(capture.dataset.train)
            task = bar.add_task("evaluating", total=scored_views, visible=capture.options.scores_at_end)

            def scored(split: str, score: ImageScore) -> None:
                if interrupted():
                    raise KeyboardInterrupt(STOPPED_LATE)
                bar.advance(task)
                broadcast.update("evaluating")

            export = functools.partial(export_all, arguments.export, bar, options.backend, say)
            exporting = export if arguments.export else None
            result = capture.finish(scored, exporting, chosen.full_length)
        tell_result(capture, result, say, limited=deadline is not None)
        if view is not None and view.watched:
            say("the live view stays open until its last browser is closed, or Ctrl-C")
            broadcast.stay(lambda: view.watched)


def _stopped(iterations: int) -> Told:
    """Return the line that says that a training was interrupted and how to resume it."""
    return Told(
        f"interrupted after {iterations} iterations; add --resume to the same command to continue",
        f"stopped after {iterations:,} iterations; it can be continued from there",
    )


def with_points(
    options: RunOptions,
    reader: CaptureReader,
    time_limit: float | None,
    console: Console,
    say: Callable[[str], None],
) -> RunOptions:
    """Make the start points that the capture lacks, or those of a scan."""
    with stage_bars(console) as progress:
        return with_start_points(options, reader, say, progress, time_limit)


def _view(
    capture: CaptureRun, host: str, port: int, say: Callable[[str], None], closing: ExitStack
) -> LiveView:
    """Open the live view and say where it is."""
    from gsplat_edu.viewer.live import LiveView  # imports a web server

    view = closing.enter_context(LiveView(capture, host, port))
    say(f"live view: {view.url}")
    if warning := warning_for(host, "sees the training and can pause it", token=True):
        say(warning)
    return view


def _folder_watcher(capture: CaptureRun, say: Callable[[str], None], closing: ExitStack) -> FolderWatcher:
    """Let another process watch by files in the run's folder; they are removed in the end."""
    watcher = FolderWatcher(LiveFolder(capture.folder.path), functools.partial(page_facts, capture), say)
    closing.callback(watcher.close)
    return watcher


def _is_over(options: RunOptions, team: Member, say: Callable[[str], None]) -> bool:
    """Tell the other processes the options; return whether nothing is left to do, and say so."""
    if team.size > 1 and options.backend != "cpu":
        raise ArgumentError(f"--backend: is {options.backend}, but several processes train on cpu; give that")
    finished = is_finished(options)
    settings = {"train": options.config.record(), "data": asdict(options.data_settings)}
    team.shared({"finished": finished, **settings})
    if finished:
        say(f"{options.out}: is finished, {options.config.iterations} iterations; nothing to do")
    return finished


def with_poses(
    options: RunOptions,
    arguments: argparse.Namespace,
    console: Console,
    say: Callable[[str], None],
    time_limit: float | None = None,
) -> RunOptions:
    """Find the poses first if the input is plain photos or a video; keep the capture in the run's folder."""
    if not needs_poses(options.data):
        for name in ("panorama", "scale"):
            if getattr(arguments, name) != "auto":
                raise ArgumentError(f"--{name}: has an effect only if DATA has no poses; omit it")
        return options
    if options.points is not None:
        read_points(options.points)  # report errors in the file before the long computation
    check_links("--out", options.folder.path)
    found = options.folder.path / "capture"
    if options.folder.exists():
        if not options.resume:
            raise CheckpointError(
                f"--out: {options.folder.path} already holds a run; add --resume to continue it, "
                "or choose another folder"
            )
        if find_model(found) is not None:
            say(f"{found}: using the poses that this run started with; {options.data} is not read again")
            return replace(options, data=found)
    if time_limit is not None and not found.exists():
        check_time_for_poses(options.data, time_limit, say)
    say(f"{options.data}: has no poses; finding them first and writing them to {found}")
    with locked("--out", found, "gsplat-edu train", say), stage_bars(console) as progress:
        try:
            chosen = SfmOptions(options.data, found, panorama=arguments.panorama, scale=arguments.scale)
            reconstruct(chosen, say, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                Told(
                    "interrupted while finding poses; the same command resumes after the last completed stage",
                    "stopped while finding poses; it can be continued after the last completed step",
                )
            ) from None
    return replace(options, data=found)


def _planned(
    arguments: argparse.Namespace,
    options: RunOptions,
    reader: CaptureReader,
    deadline: Deadline | None,
    console: Console,
    say: Callable[[str], None],
) -> Plan:
    """Choose the options that are auto, and those that the limits leave open."""
    if arguments.resolution == AUTO and not (arguments.resume and options.folder.exists()):
        options = _with_resolution(options, reader, say)
    limits, fixed = Limits(arguments.max_memory, deadline), given(arguments, PLANNED)
    outlook = look_ahead(options, limits, fixed, rescale=not arguments.no_rescale, reader=reader)
    if outlook is not None and outlook.warning:
        say(outlook.warning)
    time = None if deadline is None else TrialTime(deadline, 0.0 if outlook is None else outlook.shortest)
    options = with_choices(options, reader, left_open(arguments), console, say, time)
    if arguments.backend == AUTO and num_processes() == 1:
        options = with_backend(options, reader, say)
    with progress_bar(console, "") as bar:
        task = bar.add_task("finding the right length", total=sum(LENGTHS), visible=False)

        def progress() -> None:
            bar.update(task, advance=1, visible=True)

        chosen = plan(
            options,
            limits,
            fixed,
            rescale=not arguments.no_rescale,
            reader=reader,
            quality=quality_of(arguments),
            progress=progress,
            outlook=outlook,
        )
    for sentence in chosen.sentences:
        say(sentence)
    return chosen


def with_backend(
    options: RunOptions, reader: CaptureReader, say: Callable[[str], None], allow_software: bool = False
) -> RunOptions:
    """Choose the backend, and say so if there is a GPU; a resumed run goes on with its own if that is webgpu."""
    if options.resume and options.folder.exists():
        decision = resumed_backend(options.folder.read_config().get("backend"))
    else:
        decision = choose_backend(Prospect.of(options, reader), allow_software=allow_software).decision
    if decision.matters:
        say(str(decision))
    return replace(options, backend=decision.backend)


def _with_resolution(options: RunOptions, reader: CaptureReader, say: Callable[[str], None]) -> RunOptions:
    """Choose the size of the photos that the planned Gaussians resolve, and say so."""
    dataset = Dataset.of(reader, options.data_settings, points=options.points)
    sizes = [(view.camera.W, view.camera.H) for view in (*dataset.train, *dataset.test)]
    W, H = max(sizes, key=max)
    side = advised_side(sizes, len(dataset.train))
    if side is None:
        kept = f"photos of up to {W}x{H} keep their size"
        say(Told(f"--resolution auto: {kept}", kept))
        return options
    finer = f"of photos of up to {W}x{H}"
    say(
        Told(
            f"--resolution {side}: the planned Gaussians do not resolve more {finer}",
            f"photos are reduced to {side} px: the planned splats do not resolve more {finer}",
        )
    )
    return replace(options, data_settings=replace(options.data_settings, resolution=float(side)))


def with_choices(
    options: RunOptions,
    reader: CaptureReader,
    names: tuple[str, ...],
    console: Console,
    say: Callable[[str], None],
    time: TrialTime | None = None,
) -> RunOptions:
    """Choose the settings whose option is auto, judge what parts want tried out, and say what was found.

    Short trainings end when `time` is over.
    """

    def take(options: RunOptions, name: str, remedy: Remedy) -> RunOptions:
        if remedy.reason:
            say(Told(f"{option_flag(name)} {remedy.value}: {remedy.reason}", remedy.reason))
        return replace(options, config=options.config.changed(**{name: remedy.value}))

    tried = {part.tried: part for part in parts().values() if part.tried}
    if undecided := [name for name in names if name not in tried]:
        with progress_bar(console, "") as bar:
            progress = photos_read(bar, lambda: False)
            remedies = remedies_for(
                Undecided(reader, options.data_settings, options.points, progress), undecided
            )
        for name, remedy in remedies.items():
            options = take(options, name, remedy)
    is_new = not (options.resume and options.folder.exists())
    for name, part in tried.items():
        asked = "" if name in names else options.config.flat()[name]
        if asked and not (is_new and part.needs_trial(asked)):
            continue
        with progress_bar(console, "") as bar:
            advance = functools.partial(_advance, bar, bar.add_task("short trainings", total=None))
            limit = () if time is None else (time.is_over,)
            chosen = chosen_by_pilots(part, options, reader, advance, asked, *limit)
        options = replace(options, records={**options.records, **chosen.record})
        options = take(options, name, Remedy(chosen.value, chosen.reason))
    return options


def _advance(bar: Bar, task: TaskID, total: int) -> None:
    bar.update(task, advance=1, total=total)


def _either(first: Callable[[], bool], second: Callable[[], bool]) -> bool:
    return first() or second()


def _check_view(arguments: argparse.Namespace) -> None:
    """Refuse options of the live view without it."""
    for flag, value in (("--view-host", arguments.view_host), ("--view-port", arguments.view_port)):
        if value is not None and not arguments.view:
            raise ArgumentError(f"{flag}: has an effect only with --view; add --view, or omit {flag}")


def train_with_bar(
    capture: CaptureRun,
    bar: Bar,
    ends: Callable[[], bool],
    callbacks: Sequence[Callback],
) -> bool:
    """Run the remaining iterations with a progress bar.

    Args:
        capture: The run.
        bar: Shows the state.
        ends: Whether to stop, asked after every iteration.
        callbacks: Receive every step.

    Returns:
        Whether `ends`, in any of the processes that share the training, ended it.
    """
    iterations, start = capture.options.config.iterations, capture.trainer.iteration
    task = bar.add_task("training", total=iterations, completed=start, state="", lines=False)

    def show(trainer: Trainer, event: Event) -> None:
        if not isinstance(event, StepEvent):
            return
        iterations = trainer.config.iterations  # a time limit may have raised it
        batch = trainer.config.batch
        if milestone(event.iteration, PSNR_EVERY, batch) is not None or trainer.iteration == iterations:
            speed = bar.tasks[-1].speed or 0.0
            state = f"loss {event.loss:.3f}  PSNR {_psnr(trainer):.1f} of {_short(trainer.last_name)}"
            bar.update(task, state=f"{state}  {event.num_gaussians} Gaussians  {speed:.0f} it/s")
        bar.update(task, completed=trainer.iteration, total=iterations)
        if not bar.disable:
            return
        if milestone(trainer.iteration, max(iterations // LINES, 1), batch) is not None or bar.due(task):
            figures = f"{bar.times(task)}, loss {event.loss:.4f}"
            figures += f", PSNR {_psnr(trainer):.2f} dB of {trainer.last_name}"
            figures += f", {event.num_gaussians} Gaussians"
            bar.console.print(f"iteration {trainer.iteration}/{iterations}: {figures}", soft_wrap=True)

    return capture.train(ends, [show, *callbacks])


def photos_read(bar: Progress, interrupted: Callable[[], bool]) -> Callable[[int, int], None]:
    """Return what shows how many photos have been read."""
    task = bar.add_task("photos", total=None)

    def loaded(done: int, total: int) -> None:
        if interrupted():
            raise KeyboardInterrupt("interrupted while loading photos; nothing was written")
        bar.update(task, completed=done, total=total)

    return loaded


def _short(name: str) -> str:
    """Return the end of a view's name, which distinguishes views."""
    return name if len(name) <= NAME_WIDTH else f"...{name[3 - NAME_WIDTH :]}"


def _psnr(trainer: Trainer) -> float:
    if trainer.last is None:
        return math.nan
    return psnr(*trainer.last)


def progress_bar(console: Console, state: str) -> Bar:
    """Make a progress bar; one that shows a state stays on the screen.

    Args:
        console: The terminal; without one, lines show the progress of long tasks.
        state: Template of the text behind the bar.
    """
    columns = (
        Field("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),  # before the state, which is cut where the terminal is narrow
        Field(state),
    )
    return Bar(*columns, console=console, transient=not state, disable=not console.is_terminal)
