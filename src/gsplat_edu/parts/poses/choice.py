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

from dataclasses import replace

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.parts.bench import Bench, Pilot
from gsplat_edu.parts.poses.refinement import DISTORTIONS, FREE, LEARNED, MOTIONS
from gsplat_edu.parts.poses.trials import CONTROL, RefineTrials
from gsplat_edu.parts.run_values import Tried
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.views import View

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


def chosen_refinement(asked: str, bench: Bench) -> Tried:
    """Choose `refine` by pilots, or judge the value that the user gave.

    Args:
        asked: That value, which is chosen and compared with "none"; "" chooses.
        bench: Trains the pilots.

    Raises:
        ArgumentError: the backend cannot learn what was asked for.
        OutOfTimeError: the pilots take too long.
    """
    pilots = _Pilots(bench)
    chosen = _judged(pilots, asked) if asked else _chosen(pilots)
    trials = RefineTrials(pilots.posed, pilots.moving, asked)
    again = f", a lens trained on from what it found less than {REPEATED_GAIN} dB" if pilots.repeated else ""
    rule = "" if asked else f"; what adds less than {LEAST_GAIN} dB is left out{again}"
    return Tried(chosen, f"{trials}{rule}", trials.record)


def _chosen(pilots: _Pilots) -> str:
    """Train the pilots that a capture needs, and return the smallest refinement that no other clearly beats."""
    pilots.plan(len(ORDER))
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
    pilots.plan(2)
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


class _Pilots:
    """Trains pilots and keeps them and their scores, by name."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._names_readout = any(frame.shutter is not None for frame in bench.capture.frames)
        self._pilots: dict[str, Pilot] = {}
        self.repeated = False
        self.posed: dict[str, float] = {}
        self.moving: dict[str, float] = {}

    def plan(self, pilots: int) -> None:
        """Say how many pilots there will be at least."""
        self._bench.planned = pilots

    def keeps_lenses(self) -> bool:
        """Return whether the lens may be learned: photos keep theirs, and it has a distortion."""
        mode, cameras = self._bench.lens, [view.camera for view in self._bench.dataset.train]
        if mode == "undistort" or "lens" in self._bench.backend.lacks:
            return False
        return any(c.projection.kind in FREE and (mode == "native" or not c.pinhole) for c in cameras)

    def may_move(self, refine: str) -> bool:
        """Return whether photos may have a rolling shutter, by the capture or by a trained pilot."""
        if "lens" in self._bench.backend.lacks:
            return False
        return self.score_moving(refine) - self.posed[refine] >= MOTION_SIGN or self._names_readout

    def control(self, refine: str) -> str:
        """Return the name of the pilot that another one with a lens or a motion has to beat; train it if needed."""
        name = f"{refine}{CONTROL}"
        if name in self._pilots:
            return name
        if DISTORTIONS in LEARNED.get(refine, ()) or not any(
            view.camera.pinhole for view in self._bench.dataset.train
        ):
            return refine if refine in self._pilots else self.train(refine)
        train, test = (
            tuple(map(_barely_distorted, part))
            for part in (self._bench.dataset.train, self._bench.dataset.test)
        )
        return self._train(name, refine, replace(self._bench.dataset, train=train, test=test))

    def train(self, refine: str, beside: str = "") -> str:
        """Train a pilot, score it at aligned poses, and return its name.

        Args:
            refine: What it refines, and its name.
            beside: Begin with the same cameras as this pilot; "" for the capture's.
        """
        return self._train(refine, refine, self._pilots[beside].began if beside else self._bench.dataset)

    def train_on(self, refine: str) -> str:
        """Train a pilot again from the cameras that it has learned: a new scene and score take the old ones' place."""
        self.repeated = True
        self.moving.pop(refine, None)
        return self._train(refine, refine, self._pilots[refine].shown)

    def _train(self, name: str, refine: str, dataset: Dataset) -> str:
        rate = {"lens_rate": LENS_RATE} if DISTORTIONS in LEARNED.get(refine, ()) else {}
        self._pilots[name] = self._bench.train(dataset, refine=refine, **rate)
        self.posed[name] = self._bench.score(self._pilots[name])
        return name

    def score_moving(self, name: str) -> float:
        """Return the score of a trained pilot at aligned poses and motions."""
        if name not in self.moving:
            self.moving[name] = self._bench.score(self._pilots[name], moving=True)
        return self.moving[name]


def _barely_distorted(view: View) -> View:
    """Return a view whose camera, if it is a pinhole at rest, is rendered as other lenses are."""
    if not view.camera.pinhole:
        return view
    return view.with_camera(view.camera.through(Projection(distortion=Distortion.of(k1=BARELY))))
