"""`gsplat-edu doctor`: diagnose a capture before training or a run after it, and give advice."""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.text import option_flag, plain_of
from gsplat_edu.cli.terminal import Bar, Terminal
from gsplat_edu.data.dataset import Dataset, DataSettings, scene_extent
from gsplat_edu.data.depths import own_depth
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.after import examine_run, view_lines
from gsplat_edu.doctor.before import examine
from gsplat_edu.doctor.cameras import side_for_training
from gsplat_edu.doctor.diagnosis import Diagnosis, advice_lines, diagnosis_lines, event_of, table_lines
from gsplat_edu.evaluate.verdict import measured_of
from gsplat_edu.io.formats import read_scene
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Diagnosed
from gsplat_edu.options.asked import asked_of, words_asked
from gsplat_edu.parts.run_values import Compared
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, gpu_of, load_backend, resolve_backend
from gsplat_edu.runs.dataset import data_settings, run_reader
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.parts import judgements, stored_config
from gsplat_edu.survey.capture import Survey, prepare
from gsplat_edu.survey.residuals import residuals
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import BY_NAME, DEFAULT_STRATEGY, WITH_OPTION, TrainConfig, recipe
from gsplat_edu.train.length import DEFAULT_QUALITY, planned_iterations

EXIT_HOPELESS = 1
"""Exit code if training would be pointless."""


def run(arguments: argparse.Namespace) -> None:
    """Print a diagnosis on one screen that ends with advice.

    Raises:
        SystemExit: with 1, if training would be pointless.
    """
    path: Path = arguments.path
    if not path.exists():
        raise ArgumentError(f"{path}: does not exist; give a dataset folder or a run folder")
    console = Terminal()
    if RunFolder(path).exists():
        diagnosis, lines = _after(arguments, console)
    else:
        diagnosis, lines = _before(arguments, console)
    for finding in diagnosis.ranked:
        emitter.emit(event_of(finding))
    advice = tuple(filter(None, map(plain_of, diagnosis.advice)))
    emitter.emit(Diagnosed(diagnosis.facts, diagnosis.fine, advice))
    console.say(*diagnosis_lines(diagnosis), *lines, *advice_lines(diagnosis))
    if diagnosis.hopeless:
        emitter.finish()
        raise SystemExit(EXIT_HOPELESS)


def _before(arguments: argparse.Namespace, console: Console) -> tuple[Diagnosis, Sequence[str]]:
    settings, reader = DataSettings(resolution=arguments.resolution), CaptureReader(arguments.path)
    backend = resolve_backend(arguments.backend)
    if "forecast" in load_backend(backend).lacks and not arguments.no_forecast:
        raise ArgumentError(
            f"--backend {backend}: has no forecast; choose cpu, cuda or webgpu, or add --no-forecast"
        )
    with _bar(console) as bar:
        task = bar.add_task("photos", total=None)
        depth = arguments.depth or own_depth(reader)
        survey = prepare(
            reader,
            lambda done, total: bar.update(task, completed=done, total=total),
            depth=depth,
            trust=arguments.trust_poses,
        )
        reader = reader.under(survey.reading)
        bar.add_task("comparing", total=None)
        diagnosis = examine(survey, _forecast_options(arguments))
    from gsplat_edu.budget.choice import Prospect, choose_backend, usual_choice

    auto = arguments.backend == AUTO
    if arguments.no_forecast or diagnosis.hopeless:
        return diagnosis, [*_gpu_lines(backend), *(_auto_lines(usual_choice()) if auto else ())]
    from gsplat_edu.budget.costs import Facts

    if arguments.resolution is None and (side := side_for_training(survey)) is not None:
        settings = DataSettings(resolution=float(side))  # as the command in the advice trains
    try:
        dataset, full = Dataset.of(reader, settings), Dataset.of(reader)
        facts = Facts.of(dataset)
        length = arguments.iterations or planned_iterations(DEFAULT_QUALITY, facts.train, facts.measured)
        config = recipe(length, strategy=DEFAULT_STRATEGY)
        cap = facts.wanted(config)
        config = dataclasses.replace(config, max_gaussians=cap)
        prospect = Prospect(dataset, full, config, asked=asked_of(arguments))
        chosen = choose_backend(prospect) if auto else None
        backend = backend if chosen is None else chosen.backend
        measured = None if chosen is None else chosen.measured.get(backend)
        said = prospect.forecast(measured or prospect.measured(backend)).lines()
        why = [] if chosen is None else _auto_lines(f"{backend}: {chosen.decision.reason}")
    except DatasetError as error:
        said, why = [f"none, because training would fail: {error}"], []
    rows = zip(("forecast", *[""] * len(said)), said, strict=False)
    return diagnosis, [*table_lines(rows), *_gpu_lines(backend), *why]


def _auto_lines(choice: str) -> list[str]:
    """Return a line that says what `--backend auto` takes, and why."""
    return table_lines([("auto", f"takes {choice}")])


def _gpu_lines(backend: str) -> list[str]:
    """Return a line that names the GPU, if the backend has one."""
    gpu = gpu_of(backend)
    return table_lines([("GPU", f"{gpu} (backend {backend})")]) if gpu else []


def _forecast_options(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the options of the training that is forecast where they are not the defaults."""
    words: tuple[str, ...] = ()
    if arguments.iterations is not None:
        words += ("--iterations", str(arguments.iterations))
    if arguments.resolution is not None:
        words += ("--resolution", f"{arguments.resolution:g}")
    return words + words_asked(arguments)


def _after(arguments: argparse.Namespace, console: Console) -> tuple[Diagnosis, Sequence[str]]:
    backend = resolve_backend(arguments.backend)
    folder = RunFolder(arguments.path)
    config = folder.read_config()
    settings = dataclasses.replace(render_settings(config), depth=True)
    scene, reached = folder.latest_scene()
    reader = run_reader(config, arguments.dataset)
    dataset = Dataset.of(reader, data_settings(config))
    gaussians = read_scene(scene).relative_to(dataset.origin).to(device_of(backend))
    renderer = functools.partial(render, settings=settings, backend=backend)
    used = stored_config(config)
    shown = Compared(dataset, gaussians, settings, load_backend(backend)).photos(used)
    with _bar(console) as bar:
        task = bar.add_task("views", total=len(dataset.train) + len(dataset.test))
        train, test = (
            residuals(gaussians, views, renderer, settings.background, lambda: bar.advance(task))
            for views in (shown.train, shown.test)
        )
    extent = scene_extent([view.camera for view in dataset.train])
    trained = Trained(
        folder.path,
        gaussians,
        extent,
        train,
        test,
        reached,
        used.iterations if "iterations" in config.get("train", {}) else None,
        log=folder.log(),
        capture=reader.path,
        options=_options(config["data"], used),
        strategy=used.strategy,
        measured=measured_of(folder.read_metrics(), config),
        views=dataset.train,
        features=functools.partial(render, backend=backend),
        settings=settings,
        survey=functools.cache(functools.partial(_surveyed, reader, console)),
    )
    views = view_lines(trained) if arguments.all_views else ()
    return examine_run(trained, judgements(config, trained)), [*views, *_gpu_lines(backend)]


def _options(data: Mapping[str, Any], train: TrainConfig) -> tuple[str, ...]:
    """Return the options to repeat in a longer run: those of the input, and of settings that are not the defaults.

    Args:
        data: The section "data" of config.json.
        train: The training.
    """
    given = {"resolution": "resolution", "test_every": "test_every", "points": "points", "scene": "from"}
    named = {option_flag(flag): data.get(name) for name, flag in given.items()}
    if train.strategy != DEFAULT_STRATEGY:
        named["--strategy"] = train.strategy
    if train.alpha_background == "fixed":
        named["--background"] = train.background
    values = train.flat()
    named |= {
        BY_NAME[name].written: values[name]
        for name in WITH_OPTION
        if name not in ("iterations", "strategy", "background") and values[name] != BY_NAME[name].default
    }
    words = []
    for flag, value in named.items():
        if value is not None:
            several = value if isinstance(value, tuple) else () if value is True else (value,)
            words += [flag, *(f"{one:g}" if isinstance(one, float) else str(one) for one in several)]
    return tuple(words)


def _surveyed(reader: CaptureReader, console: Console) -> Survey:
    """Survey the capture of a run, with a progress bar."""
    with _bar(console) as bar:
        task = bar.add_task("photos", total=None)
        return prepare(reader, lambda done, total: bar.update(task, completed=done, total=total))


def _bar(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
