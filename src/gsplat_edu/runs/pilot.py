"""Short trainings that decide which numbers of the cameras are learned with the scene: `--refine auto`.

A small scene is trained on small photos three times: without refinement, with poses, and with poses and intrinsics.
Each is judged by the held-out photos at aligned poses (`gsplat_edu.evaluate.alignment`). More is refined only if that
helps clearly. Two more trainings follow where they may help:

- with the lens, where photos keep their own lens. If that does not help enough, a second training begins with the lens
  that the first one found: the first scene was fitted through the given lens, so the first training changed the lens
  too little;
- with the motion during the readout, where the capture names a readout, or where the scene fits held-out photos better
  once their motion is aligned with their pose. The training is judged at aligned motions too, and so is the one without
  it that it has to beat.

Other lenses do not draw means far outside the image (`gsplat_edu.scene.projection.LENS_MARGIN`), and pinholes do: with
photos of a garden, leaving them out alone gained 1.6 dB after 400 iterations and 0.2 to 1.0 dB after 600. So a lens or
a motion of pinholes at rest has to beat a control: a pilot that learns neither, and whose cameras have a distortion too
small to see.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.alignment import aligned_psnr, scored_halves
from gsplat_edu.parts.poses.capture import with_camera, with_refined_cameras
from gsplat_edu.parts.poses.refinement import DISTORTIONS, FREE, LEARNED, MOTIONS, NEED_LENSES, refinement_of
from gsplat_edu.parts.poses.trials import CONTROL, KEY, RefineTrials
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

SIDE = 240
"""Longest side of the photos of a pilot, px."""

PILOT_STEPS, PILOT_CAP = 600, 10_000
"""Length and cap of a pilot."""

LEAST_GAIN = 0.3
"""Refine more only if it gains at least this, dB. Pilots of captures with correct cameras differed by less
(the earlier results that benchmarks/RESULTS.md names)."""

REPEATED_GAIN = 0.5
"""Refine the lens after its second pilot only if that gains at least this, dB. The second one gains 0.6 to 1.0 dB of a
wrong lens (k1 = -0.1), and -0.1 to 0.3 dB of a right one (each with 6 or more trainings, 24 or 48 photos)."""

MOTION_SIGN = 0.1
"""Try the shutter if aligned motions of the held-out photos add at least this, dB."""

LENS_RATE = 2e-3
"""Learning rate of a lens with distortion, ten times a run's: with that of a run, 400 steps found a twentieth of a
planted k1, with this one a third. Of k1 = -0.1, the first pilot finds -0.037 and gains 0.3 to 0.6 dB; the second, from
there, finds -0.065 to -0.069 and gains 0.6 to 1.0 dB (4 seeds). With four times the rate, the first pilot finds as much
as these two, but learning a lens that is right already seems to gain up to 0.34 dB. With this rate that is 0.14 dB in
the first pilot."""

BARELY = 1e-9
"""k1 of a control: it moves no point by a millionth of a pixel."""

ORDER = ("none", "poses", "both")

WITH_LENS = {"none": "lens", "poses": "poses+lens", "both": "poses+lens"}
"""What is tried with the lens, by the best of `ORDER`."""

WITH_SHUTTER = {
    "none": "shutter",
    "poses": "poses+shutter",
    "both": "both+shutter",
    "lens": "lens+shutter",
    "poses+lens": "all",
}
"""What is tried with the shutter, by the best without it."""


OUT_OF_TIME = "short trainings would take more than a quarter of the time that is left, so none is judged"
"""Why a time limit left no choice."""


class OutOfTimeError(Exception):
    """The time for pilots is over."""


TRIED = "refine"
"""The setting that pilots choose."""

NEED_TRIALS = NEED_LENSES
"""Values of the setting that are judged by pilots also where the user gave them."""


class Chosen(NamedTuple):
    """What a run refines, why, and the scores that say so."""

    value: str
    reason: str  # a clause
    trials: RefineTrials | None  # None if no training was judged

    @property
    def record(self) -> dict[str, Any]:
        """The scores for config.json, by their key there."""
        return {} if self.trials is None else {KEY: self.trials.json()}


def chosen_by_pilots(
    options: RunOptions,
    reader: CaptureReader,
    progress: Callable[[int], None] = lambda total: None,
    asked: str = "",
    is_over: Callable[[int, int], bool] = lambda done, planned: False,
) -> Chosen:
    """Choose `--refine` for a run by pilots, or judge the value that the user gave.

    Args:
        options: Options of the run; its strategy does not matter, since pilots use the recipe fast.
        reader: The run's capture.
        progress: Called after every iteration with the number of iterations of all pilots, as far as it is known.
        asked: The value that the user gave, which is chosen and compared with "none"; "" chooses.
        is_over: Called with the iterations done and those of all pilots, as far as they are known; if it returns true,
            no pilot is judged, and nothing that the user did not ask for is refined.

    Returns:
        What to refine, and why.

    Raises:
        ArgumentError: the capture has no training photos, or the backend cannot learn what was asked for.
        DatasetError: the capture or one of its photos cannot be read.
    """
    if is_over(0, 0):
        return Chosen(asked or "none", OUT_OF_TIME, None)
    pilots = _Pilots(options, reader, progress, is_over)
    if why := pilots.cannot_judge():
        return Chosen(asked or "none", why, None)
    try:
        chosen = _judged(pilots, asked) if asked else _chosen(pilots)
    except OutOfTimeError:
        return Chosen(asked or "none", OUT_OF_TIME, None)
    trials = RefineTrials(pilots.posed, pilots.moving, asked)
    again = f", a lens trained on from what it found less than {REPEATED_GAIN} dB" if pilots.repeated else ""
    rule = "" if asked else f"; what adds less than {LEAST_GAIN} dB is left out{again}"
    return Chosen(chosen, f"{trials}{rule}", trials)


def _chosen(pilots: _Pilots) -> str:
    """Train the pilots that a capture needs, and return the smallest refinement that no other clearly beats."""
    pilots.planned = len(ORDER)
    for refine in ORDER:
        pilots.train(refine)
    chosen = _smallest(pilots.posed, ORDER)
    if pilots.keeps_lenses():
        without = pilots.control(chosen)
        lens = pilots.train(WITH_LENS[chosen])
        chosen = lens if _lens_helps(pilots, lens, without) else chosen
    if pilots.may_move(chosen):
        without = pilots.control(chosen)
        shutter = pilots.train(WITH_SHUTTER[chosen], beside=chosen)
        for name in (without, shutter):
            pilots.score_moving(name)
        chosen = shutter if _gains(pilots.moving, shutter, without) else chosen
    return chosen


def _lens_helps(pilots: _Pilots, lens: str, without: str) -> bool:
    """Return whether a trained pilot with the lens clearly gains; if it does not, train it on and judge that."""
    if _gains(pilots.posed, lens, without):
        return True
    pilots.train_on(lens)
    return _gains(pilots.posed, lens, without, REPEATED_GAIN)


def _gains(scores: dict[str, float], name: str, without: str, least: float = LEAST_GAIN) -> bool:
    return scores[name] >= scores[without] + least


def _judged(pilots: _Pilots, asked: str) -> str:
    """Train pilots without refinement and with what the user asked for, which is returned."""
    pilots.planned = 2
    without = pilots.control("none")
    pilots.train(asked)
    if DISTORTIONS in LEARNED[asked]:
        _lens_helps(pilots, asked, without)
    for name in (without, asked):
        if MOTIONS in LEARNED[asked]:
            pilots.score_moving(name)
    return asked


def _smallest(scores: dict[str, float], order: tuple[str, ...]) -> str:
    """Return the first refinement of an order that no other one in it beats by `LEAST_GAIN`."""
    best = max(scores[refine] for refine in order)
    return next(refine for refine in order if scores[refine] > best - LEAST_GAIN)


class _Pilot(NamedTuple):
    """A training that is over."""

    gaussians: Gaussians
    began: Dataset
    shown: Dataset  # `began` with the cameras that were learned
    extent: float


class _Pilots:
    """Trains pilots on one small dataset and keeps their scenes and scores."""

    def __init__(
        self,
        options: RunOptions,
        reader: CaptureReader,
        progress: Callable[[int], None],
        is_over: Callable[[int, int], bool],
    ) -> None:
        size = options.data_settings.resolution
        small = SIDE if size is None or not 32 <= size <= SIDE else size
        settings = as_trained(replace(options.data_settings, resolution=small), options.config.appearance)
        self._options, self._progress, self._is_over = options, progress, is_over
        self._dataset = Dataset.of(reader, settings, points=options.points)
        self._backend = load_backend(options.backend)
        self._names_readout = any(frame.shutter is not None for frame in reader.capture.frames)
        self._pilots: dict[str, _Pilot] = {}
        self._trainings = self._steps = 0
        self.repeated = False
        self.posed: dict[str, float] = {}
        self.moving: dict[str, float] = {}
        self.planned = 0
        if self._dataset.test:
            self._dataset.preload()

    def cannot_judge(self) -> str:
        """Say as a clause why no pilot can be judged; "" if one can."""
        if not self._dataset.test:
            return "no photos are held out to judge by"
        for view in self._dataset.test:
            if scored_halves(view.read().mask, view.camera.H, view.camera.W) is not None:
                return ""
        return "no pixel of the held-out photos counts"

    def keeps_lenses(self) -> bool:
        """Return whether the lens may be learned: photos keep theirs, and it has a distortion."""
        mode, cameras = self._options.data_settings.lens, [view.camera for view in self._dataset.train]
        if mode == "undistort" or "lens" in self._backend.lacks:
            return False
        return any(c.projection.kind in FREE and (mode == "native" or not c.pinhole) for c in cameras)

    def may_move(self, refine: str) -> bool:
        """Return whether photos may have a rolling shutter, by the capture or by a trained pilot."""
        if "lens" in self._backend.lacks:
            return False
        return self.score_moving(refine) - self.posed[refine] >= MOTION_SIGN or self._names_readout

    def control(self, refine: str) -> str:
        """Return the name of the pilot that another one with a lens or a motion has to beat; train it if needed."""
        name = f"{refine}{CONTROL}"
        if name in self._pilots:
            return name
        if DISTORTIONS in LEARNED.get(refine, ()) or not any(
            view.camera.pinhole for view in self._dataset.train
        ):
            return refine if refine in self._pilots else self.train(refine)
        train, test = (
            tuple(map(_barely_distorted, part)) for part in (self._dataset.train, self._dataset.test)
        )
        return self._train(name, refine, replace(self._dataset, train=train, test=test))

    def train(self, refine: str, beside: str = "") -> str:
        """Train a pilot, score it at aligned poses, and return its name.

        Args:
            refine: What it refines, and its name.
            beside: Begin with the same cameras as this pilot; "" for the capture's.
        """
        return self._train(refine, refine, self._pilots[beside].began if beside else self._dataset)

    def train_on(self, refine: str) -> str:
        """Train a pilot again from the cameras that it has learned: a new scene and score take the old ones' place."""
        self.repeated = True
        self.moving.pop(refine, None)
        return self._train(refine, refine, self._pilots[refine].shown)

    def _train(self, name: str, refine: str, dataset: Dataset) -> str:
        trainer = training(_config(self._options.config, refine), dataset, self._backend)
        refinement = refinement_of(trainer.view_model)
        self._trainings += 1
        total = max(self.planned, self._trainings) * PILOT_STEPS

        def step(trainer: Trainer, event: Event) -> None:
            if isinstance(event, StepEvent):
                self._steps += 1
                self._progress(total)
                self._check_time(total)

        trainer.run(callbacks=[step])
        shown = dataset if refinement is None else with_refined_cameras(refinement, dataset)
        self._pilots[name] = _Pilot(trainer.gaussians, dataset, shown, trainer.extent)
        self.posed[name] = self._score(name)
        return name

    def _check_time(self, total: int) -> None:
        if self._is_over(self._steps, total):
            raise OutOfTimeError

    def score_moving(self, name: str) -> float:
        """Return the score of a trained pilot at aligned poses and motions."""
        if name not in self.moving:
            self.moving[name] = self._score(name, moving=True)
        return self.moving[name]

    def _score(self, name: str, *, moving: bool = False) -> float:
        gaussians, _, shown, extent = self._pilots[name]
        config = _config(self._options.config, "none")  # renders are alike for all
        renderer, colors = replace(self._options, config=config).renderer, config.appearance != "none"
        scores = []
        for view in shown.test:
            self._check_time(self._steps)
            psnr = aligned_psnr(
                gaussians, view, renderer, config.background, extent, colors=colors, moving=moving
            )
            scores.append(psnr)
        return float(np.mean([score for score in scores if score is not None]))


def _barely_distorted(view: View) -> View:
    """Return a view whose camera, if it is a pinhole at rest, is rendered as other lenses are."""
    if not view.camera.pinhole:
        return view
    return with_camera(view, view.camera.through(Projection(distortion=Distortion.of(k1=BARELY))))


def _config(config: TrainConfig, refine: str) -> TrainConfig:
    cap = min(config.max_gaussians or PILOT_CAP, PILOT_CAP)
    learns_distortion = DISTORTIONS in LEARNED.get(refine, ())
    return recipe(
        PILOT_STEPS,
        lens_rate=LENS_RATE if learns_distortion else config.lens_rate,
        strategy="fast",
        max_gaussians=cap,
        refine=refine,
        appearance=config.appearance,
        background=config.background,
        jacobian_limit=config.jacobian_limit,
        antialiased=config.antialiased,
        seed=config.seed,
    )
