"""Train a scene from a capture, in a run folder from which training can be resumed.

The trainer knows neither files nor datasets; this module provides both and writes the results.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import ArgumentError, CheckpointError, DatasetError
from gsplat_edu.base.files import check_folder, remove_leftovers
from gsplat_edu.base.links import check_links
from gsplat_edu.base.reading import stored_path
from gsplat_edu.data.dataset import Dataset, with_own_files
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.evaluate.report import machine_facts
from gsplat_edu.evaluate.verdict import FULL_LENGTH, USUAL
from gsplat_edu.io.formats import write_scene
from gsplat_edu.parts.run_values import Captured, Finished, Unwritten
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained, data_settings, reader_for
from gsplat_edu.runs.evaluation import Evaluation, Progress, ScoredViews, evaluate_run
from gsplat_edu.runs.identity import (
    DIGESTS,
    check_capture,
    check_digests,
    check_options,
    fingerprint,
    photo_digests,
)
from gsplat_edu.runs.log import LogWriter
from gsplat_edu.runs.options import RunOptions as RunOptions
from gsplat_edu.runs.parts import recorded
from gsplat_edu.runs.processes import Member, Processes, check_alike, digest_of, with_points_of_first
from gsplat_edu.runs.source import Source, capture_scene, capture_up, open_source
from gsplat_edu.runs.start import scene_digest, scene_file, scene_start
from gsplat_edu.runs.thin import usual_size
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.checkpoint import (
    list_checkpoints,
    load_checkpoint,
    read_checkpoint,
    read_seconds,
    save_checkpoint,
)
from gsplat_edu.train.compose import Start, training
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.events import Event
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.part import packages_of, parts
from gsplat_edu.train.schedule import milestone
from gsplat_edu.train.team import ALONE
from gsplat_edu.train.trainer import Callback, Trainer


def document(options: RunOptions) -> dict[str, Any]:
    """Return the part of config.json that a run's options determine."""
    return {
        "version": version("gsplat-edu"),
        "data": {
            "path": str(options.data.resolve()),
            **options.data_settings.record(),
            "points": None if options.points is None else str(options.points.resolve()),
            "scene": None if options.scene is None else str(scene_file(options.scene).resolve()),
            **recorded(options.asked),
        },
        "train": options.config.record(),
        **({} if not (used := options.config.plugins) else {"plugins": packages_of(used)}),
        "render": dataclasses.asdict(options.render_settings),
        "backend": options.backend,
        "machine": machine_facts(),
        **options.records,
    }


Export = Callable[[Source], list[dict[str, Any]]]
"""Writes a scene in further formats and returns a record of each file: "path", "psnr" and more."""


def _with_own_files(options: RunOptions) -> RunOptions:
    """Return the options with what the files of the capture say of its photos: as in config.json, else as it is now."""
    settings, folder = options.data_settings, options.folder
    if folder.exists():
        settings = settings.completed(data_settings(folder.read_config()))
    elif options.data.exists():
        settings = with_own_files(settings, options.data)
    return dataclasses.replace(options, data_settings=settings)


def _checked_folder(options: RunOptions) -> RunOptions:
    """Check the folder against the options; return them with what config.json adds of a resumed run filled in."""
    options = _with_own_files(options)
    folder = options.folder
    check_links("--out", folder.path)
    if folder.exists():
        if not options.resume:
            raise CheckpointError(
                f"--out: {folder.path} already holds a run; add --resume to continue it, or give another folder"
            )
        if "blocks" in folder.read_config():
            raise CheckpointError(
                f"--resume: {folder.path} is merged from blocks; start a new run with --from {folder.path}, or add"
                " --blocks"
            )
        options = _with_scene(options)
        check_options(folder, document(options))
        return options
    check_folder("--out", folder.path)
    if list_checkpoints(folder.checkpoints):
        raise CheckpointError(
            f"--out: {folder.path} contains checkpoints of a run but no config.json; give another folder"
        )
    return options


def _with_scene(options: RunOptions) -> RunOptions:
    """Refuse --from for a run started from points; without --from, use the scene named in config.json."""
    data = options.folder.read_config().get("data")
    stored = data.get("scene") if isinstance(data, dict) else None
    if stored is None and options.scene is not None:
        raise CheckpointError(
            f"--resume: {options.folder.path} was started from points, not --from {options.scene};"
            " leave --from out, or give another --out"
        )
    if stored is not None and options.scene is None and not list_checkpoints(options.folder.checkpoints):
        if (scene := stored_path(stored)) is None:
            raise CheckpointError(
                f"{options.folder.config}: data: scene: is not a path of this computer; name the scene with --from"
            )
        return dataclasses.replace(options, scene=scene)
    return options


def is_finished(options: RunOptions) -> bool:
    """Return whether the folder contains this run, trained to the end and evaluated.

    Raises:
        ArgumentError: a link leads out of the folder.
        CheckpointError: the folder contains a different run, or one that the options do not resume.
        OSError: the folder cannot be written to.
    """
    folder = _checked_folder(options).folder
    done = folder.read_metrics().get("iterations", 0) if folder.exists() else 0
    if not isinstance(done, int):
        raise CheckpointError(f"{folder.metrics}: iterations: is not a number; fix or remove the file")
    return done >= options.config.iterations


class CaptureRun:
    """A training run on a capture, ready to train: its photos are read, and the last checkpoint is loaded.

    The object is complete once constructed, so any program can use it: `train` runs the remaining iterations, and
    `finish` writes the scene and evaluates it. `is_finished` tells beforehand whether anything remains to do. The
    folder is not locked; see `gsplat_edu.base.locks.locked`.

    Args:
        options: Options of the run.
        say: Receives sentences for the user.
        progress: Receives the number of photos read and their total.
        team: The processes that share the training; each makes this object and calls `train`. Only the first uses the
            folder, so the others may run on machines that do not have it.
        prepare: Called with the capture before anything is written; returns it with the views to train, perhaps with
            other masks, and raises an error for a capture that must not be trained. Scores are those of the capture.
        reader: Has read the capture already; None to read it.

    Raises:
        CheckpointError: the folder contains a different run, or one that the options do not resume.
        DatasetError: the capture cannot be read.
        ArgumentError: options contradict each other, or a link leads out of the folder.
        OSError: the folder cannot be written to.

    Attributes:
        options: Options of the run; a resumed run has its start scene filled in.
        folder: Its folder.
        dataset: The capture.
        trainer: The training.
        seconds: Wall time of the training up to the last return of `train`.
    """

    def __init__(
        self,
        options: RunOptions,
        say: Callable[[str], None] = lambda sentence: None,
        progress: Callable[[int, int], None] | None = None,
        team: Member = ALONE,
        prepare: Callable[[Dataset], Dataset] = lambda dataset: dataset,
        reader: CaptureReader | None = None,
    ) -> None:
        self._team, self._leads = team, team.rank == 0
        options = _checked_folder(options) if self._leads else _with_own_files(options)
        scene = team.shared(None if options.scene is None else str(options.scene))
        self.options = dataclasses.replace(options, scene=None if scene is None else Path(scene))
        self.folder, self._say = options.folder, say
        if self._leads:
            self._say_what_is_resumed()
        self.seconds = 0.0
        self._began: float | None = None  # during training: when the count of seconds started
        settings = as_trained(options.data_settings, options.config)
        reader = reader_for(options, reader)
        capture = self._captured(reader, Dataset.of(reader, settings, points=options.points))
        self.dataset = capture.dataset
        for note in self.dataset.notes:
            say(str(note))
        self._trained = prepare(self.dataset)
        self.dataset.preload(progress)
        start, digest = self._start(capture)
        gaussians = start.gaussians
        if self._leads:
            self._write_or_compare(digest)
        self._log = LogWriter(self.folder.log_file)
        self.trainer = self._trainer(start)
        if self._leads:
            self._take_up()
            self._extend()
        if isinstance(team, Processes):
            self._share_start(team, gaussians)

    def _captured(self, reader: CaptureReader, dataset: Dataset) -> Captured:
        """Return the capture with what the parts of the training add to its views."""
        options = self.options
        # a resumed run need not say --from again
        from_scene = self._team.shared(self._leads and self._is_from_scene())
        is_new = not self.folder.exists()
        dataset = with_points_of_first(dataset, self._team)
        capture = Captured(dataset, reader, options.points, None, from_scene, is_new, self._say)
        for name, part in parts().items():
            capture = dataclasses.replace(capture, asked=options.asked.get(name))
            changed = part.captured(options.config.settings_of(name), capture)
            capture = dataclasses.replace(capture, dataset=changed)
        return capture

    def _digests(self) -> dict[str, str]:
        """Return digests of what parts added to the views, by part."""
        digests = {name: part.digest(self.dataset) for name, part in parts().items()}
        return {name: digest for name, digest in digests.items() if digest is not None}

    def _share_start(self, team: Processes, gaussians: Gaussians) -> None:
        """Check that all processes start from equal data, and load the first one's checkpoint in all."""
        views = [(view.name, view.camera.W, view.camera.H) for view in self.dataset.train]
        start = {"photos": fingerprint(self.dataset), "views": digest_of(repr(views).encode())}
        start |= dict.fromkeys(parts(), "none") | self._digests()
        check_alike(team, "start alike", start | {"Gaussians": scene_digest(gaussians)})
        checkpoints = list_checkpoints(self.folder.checkpoints) if self._leads else []
        state = team.shared_state(read_checkpoint(checkpoints[-1]) if checkpoints else None)
        if state is not None and not self._leads:
            self.trainer.load_state(*state)

    def _is_from_scene(self) -> bool:
        stored = self.folder.read_config().get("data") if self.folder.exists() else None
        given = self.options.scene is not None
        return given or (isinstance(stored, dict) and stored.get("scene") is not None)

    def _say_what_is_resumed(self) -> None:
        folder, options = self.folder, self.options
        if not folder.exists():
            if options.resume:
                self._say(f"{folder.path}: contains no run to resume; starting from the beginning")
        elif (before := folder.read_config().get("backend")) != options.backend:
            self._say(
                f"{folder.path}: was started on the backend {before}; {options.backend} rounds differently"
            )

    def _write_or_compare(self, scene: str | None) -> None:
        """Write the settings of a new run, or compare those of a resumed one with the stored ones.

        Args:
            scene: Digest of the scene that the run starts from; None without one.
        """
        options, dataset, folder = self.options, self.dataset, self.folder
        digests = self._digests()
        if folder.exists():
            remove_leftovers(folder.path)
            check_capture(folder, dataset)
            check_digests(folder, digests)
            if scene is not None and folder.read_config().get("start") != scene:
                raise CheckpointError(
                    f"--resume: {folder.path} was not started from {options.scene} as it is now;"
                    " resume with the original scene, or give another --out"
                )
        else:  # config.json comes last: its presence means that the run has started
            folder.write_cameras(dataset.train, dataset.test, dataset.origin)
            folder.write_photos(photo_digests(dataset))
            facts = {"origin": dataset.origin.tolist(), "fingerprint": fingerprint(dataset)}
            facts |= {"up": list(capture_up(dataset))}
            facts |= {} if dataset.scale is None else {"scale": dataset.scale.json()}
            facts |= {DIGESTS: digests} if digests else {}
            folder.write_config(document(options) | facts | ({"start": scene} if scene else {}))

    def _trainer(self, start: Start) -> Trainer:
        options = self.options
        return training(
            options.config,
            self._trained,
            dataclasses.replace(load_backend(options.backend), photo_room=options.data_settings.image_memory),
            start,
            callbacks=[self._record],
            team=self._team,
        )

    def _start(self, capture: Captured) -> tuple[Start, str | None]:
        """Make the start Gaussians, and their digest if they come from a scene."""
        options, config = self.options, self.options.config
        each = (part.start(config.settings_of(name), capture) for name, part in parts().items())
        added = [one for one in each if one is not None]
        shell = next((one.shell for one in added if one.shell is not None), None)
        if options.scene is not None:
            gaussians, notes = scene_start(options.scene, config, capture.dataset.origin)
            for note in notes:
                self._say(note)
            return Start(sorted_in_space(gaussians), shell), scene_digest(gaussians)
        further = [one.gaussians for one in added if one.gaussians is not None]
        if config.max_gaussians is not None and further:
            config = config.changed(max_gaussians=config.max_gaussians - sum(map(len, further)))
        points, colors = capture.dataset.points, capture.dataset.colors
        gaussians = from_points(points, colors, config)
        if len(gaussians) < len(points) and capture.is_new:
            self._say(
                f"the capture has {len(points):,} start points; {len(gaussians):,} of them are used (the cap)"
            )
        return Start(sorted_in_space(Gaussians.concatenated([gaussians, *further])), shell), None

    def _extend(self) -> None:
        """Record in config.json that the run was extended, before the first additional iteration."""
        stored, wanted = self.folder.read_config(), self.options.config.iterations
        before = stored["train"].get("iterations")
        if before == wanted:
            return
        history = stored.get("history")
        entry = {"iteration": self.trainer.iteration, "iterations_before": before, "iterations": wanted}
        train = {**stored["train"], "iterations": wanted}
        past = history if isinstance(history, list) else []
        self.folder.write_config(stored | {"train": train, "history": [*past, entry]})
        self._say(
            f"{self.folder.path}: extended from {before} to {wanted} iterations; milestones and rates are unchanged"
        )

    def _take_up(self) -> None:
        checkpoints = list_checkpoints(self.folder.checkpoints)
        if checkpoints:
            load_checkpoint(checkpoints[-1], self.trainer)
            self.seconds = read_seconds(checkpoints[-1])
            self._say(f"resuming after {self.trainer.iteration} iterations")
        elif self.options.resume and self.folder.log_file.exists():
            self._say(f"{self.folder.path}: contains no checkpoint; starting from the beginning")
        self._log.cut(self.trainer.iteration, self.seconds)

    def train(self, stop: Callable[[], bool] = lambda: False, callbacks: Sequence[Callback] = ()) -> bool:
        """Run the remaining iterations, then save a checkpoint.

        Args:
            stop: Called after every iteration; if it returns true, the run is saved and can be resumed.
            callbacks: Receive every step and every change, after the log.

        Returns:
            Whether `stop` ended the training, in any of the processes that share it.
        """
        asked, whole, alone = False, self.trainer.iteration, self._team.size == 1
        self._began = time.perf_counter() - self.seconds

        def ends() -> bool:
            nonlocal asked, whole
            asked, whole = self._team.any(stop()), self.trainer.iteration
            if not asked:
                self._judge_and_save_where_due(stop)
                asked = alone and stop()
            return asked

        try:
            self.trainer.run(ends, callbacks)
        except DatasetError as error:
            if whole != self.trainer.iteration or not alone:
                raise  # in the middle of an iteration: resume from the last checkpoint
            self.save()
            raise DatasetError(
                f"{error}; saved after {whole} iterations, --resume continues from there"
            ) from None
        finally:
            self._log.close()
        self.seconds, self._began = self.elapsed, None
        self.save()
        return asked

    def _judge_and_save_where_due(self, stop: Callable[[], bool]) -> None:
        done, options = self.trainer.iteration, self.options
        if done == options.config.iterations:
            return  # the end of the run evaluates and saves anyway

        def due(every: int) -> bool:
            return bool(every) and milestone(done, every, options.config.batch) is not None

        if due(options.eval_every) and self.dataset.test and self._leads:
            self._judge(stop)
        if due(options.save_every):
            self.save()

    def _judge(self, stop: Callable[[], bool]) -> None:
        """Score the current scene on the test views; report and log the means. `stop` aborts it."""
        options, done, scores = self.options, self.trainer.iteration, []
        for view in self.dataset.test:
            if stop():
                return
            scores += score_views(self.trainer.gaussians, [view], options.renderer, options.config.background)
        if not scores:
            return
        means = summarize(scores)
        self._log.write({"iteration": done, "psnr": means["psnr"], "ssim": means["ssim"]})
        figures = f"test PSNR {means['psnr']:.2f} dB, SSIM {means['ssim']:.4f}"
        self._say(f"iteration {done}: {figures}, {len(self.trainer.gaussians)} Gaussians")

    def save(self) -> Path | None:
        """Write a checkpoint; see `gsplat_edu.train.checkpoint.save_checkpoint`.

        All processes of the run have to call it. The first one writes the file and returns its path.
        """
        if self._leads:
            return save_checkpoint(self.folder.checkpoints, self.trainer, self.elapsed)
        self.trainer.state()  # sends the moments that this process holds
        return None

    def finish(
        self,
        progress: Progress | None = None,
        export: Export | None = None,
        full_length: int | None = None,
    ) -> Evaluation:
        """Write the scene, in other formats too if `export` is given, and score it on the test and training views.

        With `RunOptions.eval_every` 0, no view is scored; metrics.json and the report say so.

        Args:
            progress: Called for every scored view.
            export: Called with the written scene; metrics.json and the report get its result as "exports".
            full_length: Iterations that the run would have without a time limit; None for those of its configuration.
        """
        trainer, dataset, config = self.trainer, self.dataset, self.options.config
        learned = dataset
        for part in parts().values():
            learned = part.learned(trainer, learned)
        gaussians = trainer.gaussians.map(lambda tensor: tensor[trainer.gaussians.finite_rows()])
        if lost := len(trainer.gaussians) - len(gaussians):
            self._say(f"{lost} Gaussians are NaN or infinite and are left out of the scene")
        facts: dict[str, Any] = {"iterations": trainer.iteration, "seconds": round(self.seconds, 3)}
        facts[FULL_LENGTH] = full_length or config.iterations
        facts[USUAL] = usual_size(config, dataset)
        gaussians, revisions = self._revised(gaussians, learned)
        facts |= revisions
        path = self.folder.scene(trainer.iteration)
        write_scene(path, capture_scene(gaussians, dataset, self.options.render_settings.antialiased))
        if export is not None:
            facts["exports"] = export(open_source(path))
        run = Finished(
            self.folder.path,
            trainer,
            dataset,
            learned,
            gaussians,
            self.options.renderer,
            self.options.scores_at_end,
            self._say,
        )
        for name, part in parts().items():
            facts |= part.finish(config.settings_of(name), run)
        return evaluate_run(
            self.folder,
            ScoredViews(
                dataset.test,
                learned.train,
                config.background,
                dataset.notes,
                skipped=not self.options.scores_at_end,
            ),
            gaussians,
            self.options.renderer,
            facts,
            progress,
        )

    def _revised(self, gaussians: Gaussians, learned: Dataset) -> tuple[Gaussians, dict[str, Any]]:
        """Return the scene as the parts revise it, and entries of metrics.json."""
        options, facts = self.options, dict[str, Any]()
        for name, part in parts().items():
            scene = Unwritten(gaussians, learned, options.render_settings, options.asked.get(name), self._say)
            if (revised := part.revise(options.config.settings_of(name), scene)) is not None:
                gaussians, facts = revised.gaussians, {**facts, **revised.facts}
        return gaussians, facts

    @contextmanager
    def clock_stopped(self) -> Iterator[None]:
        """Exclude the block from the run's seconds, for example a measurement or a live view."""
        before = time.perf_counter()
        yield
        if self._began is not None:
            self._began += time.perf_counter() - before

    @property
    def elapsed(self) -> float:
        """Wall time of the training so far, without the blocks of `clock_stopped` that are over."""
        return self.seconds if self._began is None else time.perf_counter() - self._began

    def _record(self, trainer: Trainer, event: Event) -> None:
        if self._leads:
            self._log.record(event, self.elapsed)
        if not trainer.stepper.count:
            raise ArgumentError(
                f"iteration {trainer.iteration}: every Gaussian was pruned; lower min_opacity or the learning rates"
            )
