"""Decide which splats of a scene its photos do not support, and why.

Rounds of evidence (`gsplat_edu.clean.evidence`) find the doubtful splats. A floater hides the floaters behind it, so
each round finds more than the one before. Then all doubtful splats are judged together (`gsplat_edu.clean.settle`).

    z = sum over views of gain / sqrt(sum over views of gain²)

measures how well the views agree that a splat should be removed. |z| is at most 1 if a single view has a gain, and at
most sqrt(n) for n views, if all agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.clean.evidence import Evidence, gather, judging_backend, peak_weights
from gsplat_edu.clean.settle import Doubtful, settle
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

# The thresholds. gap: distance of a splat in front of the surface that the views see, as a fraction of the surface's
# distance (`Evidence.gap`). error: decrease of the squared error if this splat alone is removed, in multiples of the
# error of all photos divided by the number of splats. z: defined above.

FREE_GAP = 0.15
"""Remove as in free space if gap > FREE_GAP and z > FREE_Z."""

FREE_Z = -0.9
"""See `FREE_GAP`; a lower z says that the photos miss the splat."""

FAR_GAP = 0.3
"""Remove as in free space if gap > FAR_GAP and z > FAR_Z."""

FAR_Z = -2.0
"""See `FAR_GAP`."""

RARE_VIEWS = 0.05
"""Remove for any z if gap > FAR_GAP and at most this fraction of the views see the splat: a few views fit their noise
with splats close to them."""

NEAR_GAP = 0.05
"""Refute if gap > NEAR_GAP, error > NEAR_ERROR and z > NEAR_Z."""

NEAR_ERROR = 10.0
"""See `NEAR_GAP`."""

NEAR_Z = 0.3
"""See `NEAR_GAP`."""

LARGE_ERROR = 20.0
"""Refute for any gap if error > LARGE_ERROR and z > LARGE_Z."""

LARGE_Z = 2.0
"""See `LARGE_ERROR`."""

GROSS_ERROR = 100.0
"""Refute for any gap if error > GROSS_ERROR and z > GROSS_Z. For any z, the splat is doubtful."""

GROSS_Z = 1.0
"""See `GROSS_ERROR`."""

DOUBTFUL_GAP = 0.1
"""A kept splat is doubtful if gap > DOUBTFUL_GAP and |error| > PRICE."""

PRICE = 0.01
"""Remove a doubtful splat if the joint judgement finds that this adds less than this error."""

MISSED_ERROR = 1.0
"""A removed splat with error < -MISSED_ERROR enters the joint judgement as kept, because the photos miss it."""

STEPS_PER_VIEW = 8
"""The joint judgement takes this many steps per view of a round, unless `JOINT_WORK` allows fewer."""

JOINT_WORK = 6e7
"""Largest number of splats times steps of the joint judgement; `LEAST_STEPS` may exceed it."""

LEAST_STEPS = 40
"""Least number of steps that `JOINT_WORK` can reduce the joint judgement to."""

LEAST_VIEWS = 3
"""With fewer views, only splats that no view sees are removed."""

MAX_ROUNDS = 4
"""Largest number of rounds of evidence."""

LAST_ROUND_REMOVED = 1e-4
"""Stop the rounds after one that removes at most this fraction of the splats."""

ROUND_WORK = 1.5e7
"""Largest number of splats times views of a round; views are left out evenly to stay below it."""

LEAST_ROUND_VIEWS = 12
"""A round has at least this many views, if the capture has them; `ROUND_WORK` may be exceeded."""


class Reason(IntEnum):
    """Why a splat is removed."""

    KEPT = 0
    UNSEEN = 1
    IN_FRONT = 2
    REFUTED = 3

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return SENTENCES[self]


SENTENCES = {
    Reason.KEPT: "kept",
    Reason.UNSEEN: "visible in no view",
    Reason.IN_FRONT: "in free space: in front of what the views see, and the photos do not miss it",
    Reason.REFUTED: "refuted: the photos fit better without it",
}


def views_of_round(splats: int, views: int) -> int:
    """Return how many of a capture's views judge a scene in one round.

    Args:
        splats: Number of splats.
        views: Number of views of the capture.
    """
    return min(views, max(LEAST_ROUND_VIEWS, int(ROUND_WORK / max(splats, 1))))


def joint_steps(splats: int, views: int) -> int:
    """Return the number of steps in which the doubtful splats are judged together.

    Args:
        splats: Number of splats of the scene.
        views: Number of views of a round.
    """
    return min(STEPS_PER_VIEW * views, max(LEAST_STEPS, int(JOINT_WORK / max(splats, 1))))


@dataclass(frozen=True, eq=False)
class Verdict:
    """What `judge` decided.

    Args:
        reasons: (N,) a `Reason` for every splat.
        certainty: (N,) how certain the removal of a doubtful splat is; negative if it is kept, and 0 for all other
            splats.
        views: Number of views that judged.
    """

    reasons: UInt8[np.ndarray, " N"]
    certainty: Float64[np.ndarray, " N"]
    views: int

    @property
    def removed(self) -> Bool[np.ndarray, " N"]:
        """Splats to remove."""
        removed: Bool[np.ndarray, " N"] = self.reasons != Reason.KEPT
        return removed


Progress = Callable[[int, int], None]
"""Called with (views done, most views)."""


def judge(
    gaussians: Gaussians,
    views: Sequence[View],
    settings: RenderSettings,
    backend: Backend | None = None,
    progress: Progress = lambda done, total: None,
) -> Verdict:
    """Decide which splats the photos do not support.

    Args:
        gaussians: N Gaussians on the CPU, in the frame of the cameras.
        views: The views that the scene was trained on.
        settings: The scene's render settings; photos with alpha are judged over black and white.
        backend: What renders; None takes the backend cpu.
        progress: Called after every view.

    Raises:
        ArgumentError: there are no views, or the backend collects no statistics.
        DatasetError: a photo cannot be read.
    """
    backend = judging_backend(backend)
    if not views:
        raise ArgumentError("views: there are none; a scene can only be judged by photos")
    finite = gaussians.finite_rows().numpy()
    some = gaussians if finite.all() else gaussians.map(lambda tensor: tensor[torch.from_numpy(finite)])
    reasons = np.full(len(gaussians), Reason.UNSEEN, dtype=np.uint8)
    certainty = np.zeros(len(gaussians))
    chosen = _chosen(views, len(some))
    reasons[finite], certainty[finite] = _Rounds(some, views, chosen, settings, backend, progress).result()
    return Verdict(reasons, certainty, len(chosen))


def _chosen(views: Sequence[View], count: int) -> list[View]:
    """Return `views_of_round` views, spread evenly over the list."""
    number = views_of_round(count, len(views))
    return [views[i * len(views) // number] for i in range(number)]


class _Rounds:
    """The rounds of `judge` on finite Gaussians."""

    def __init__(
        self,
        gaussians: Gaussians,
        everything: Sequence[View],
        views: Sequence[View],
        settings: RenderSettings,
        backend: Backend,
        progress: Progress,
    ) -> None:
        self._gaussians, self._views, self._backend, self._progress = gaussians, views, backend, progress
        self._everything = everything
        self._settings = replace(settings, depth=False, median_depth=True)
        self._steps = joint_steps(len(gaussians), len(views))
        self._done, self._total = 0, MAX_ROUNDS * len(views) + self._steps
        self._reasons: UInt8[np.ndarray, " N"] = np.zeros(len(gaussians), dtype=np.uint8)

    def result(self) -> tuple[UInt8[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
        reasons = self._reasons
        seen, doubtful, rare = (np.zeros(len(reasons), dtype=bool) for _ in range(3))
        for _ in range(MAX_ROUNDS):
            found = gather(
                self._gaussians,
                self._views,
                self._settings,
                self._backend,
                reasons != Reason.KEPT,
                self._step,
            )
            seen |= found.peak > ALPHA_MIN
            free, refuted = self._found(found)
            kept = reasons == Reason.KEPT
            rare |= kept & self._rare(found)
            reasons[kept & refuted] = Reason.REFUTED
            reasons[kept & free] = Reason.IN_FRONT
            doubtful |= (reasons != Reason.KEPT) | self._doubtful(found)
            if (kept & (free | refuted)).sum() <= LAST_ROUND_REMOVED * len(reasons):
                break
        certainty = self._settled(doubtful, rare, found)
        if len(self._views) < len(self._everything) and not seen.all():
            rest = [view for view in self._everything if view not in self._views]
            seen |= peak_weights(self._gaussians, rest, self._settings, self._backend) > ALPHA_MIN
        reasons[(reasons == Reason.KEPT) & ~seen] = Reason.UNSEEN
        self._progress(self._total, self._total)
        return reasons, certainty

    def _settled(
        self, doubtful: Bool[np.ndarray, " N"], rare: Bool[np.ndarray, " N"], last: Evidence
    ) -> Float64[np.ndarray, " N"]:
        """Judge the doubtful splats together, and return how certain their removal is; rare ones stay removed.

        Splats that the rounds kept, and splats that the photos miss in the last round, start as needed.
        """
        certainty = np.zeros(len(doubtful))
        if not doubtful.any() or len(self._views) < LEAST_VIEWS:
            return certainty
        ids = np.flatnonzero(doubtful)
        needed = (self._reasons == Reason.KEPT) | (_errors(last) < -MISSED_ERROR)
        start = np.where(needed[ids], 1.0, -1.0)
        unit = max(last.error / len(doubtful) / len(self._views), np.finfo(np.float64).tiny)
        logits = settle(
            self._gaussians,
            Doubtful(ids, start, PRICE),
            self._views,
            self._settings,
            self._backend,
            unit=unit,
            steps=self._steps,
            progress=self._step,
        )
        certainty[ids] = -logits
        goes = certainty[ids] > 0.0
        self._reasons[ids[~goes & ~rare[ids]]] = Reason.KEPT
        self._reasons[ids[goes & (self._reasons[ids] == Reason.KEPT)]] = Reason.IN_FRONT
        return certainty

    def _found(self, found: Evidence) -> tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
        """Return which splats are in free space, and which the photos refute."""
        errors, z = _errors(found), _agreement(found)
        free = (found.gap > FREE_GAP) & (z > FREE_Z)
        free |= (found.gap > FAR_GAP) & (z > FAR_Z) | self._rare(found)
        free &= found.views > 0
        refuted = (found.gap > NEAR_GAP) & (errors > NEAR_ERROR) & (z > NEAR_Z)
        refuted |= (errors > LARGE_ERROR) & (z > LARGE_Z)
        refuted |= (errors > GROSS_ERROR) & (z > GROSS_Z)
        enough = len(self._views) >= LEAST_VIEWS
        return free & enough, refuted & enough

    def _doubtful(self, found: Evidence) -> Bool[np.ndarray, " N"]:
        """Return which splats are doubtful, so that the joint judgement decides."""
        errors = _errors(found)
        doubtful: Bool[np.ndarray, " N"] = (np.abs(errors) > PRICE) & (found.gap > DOUBTFUL_GAP)
        return (doubtful | (errors > GROSS_ERROR)) & (found.views > 0)

    def _rare(self, found: Evidence) -> Bool[np.ndarray, " N"]:
        rare: Bool[np.ndarray, " N"] = found.views <= RARE_VIEWS * len(self._views)
        return rare & (found.gap > FAR_GAP) & (found.views > 0)

    def _step(self) -> None:
        self._done += 1
        self._progress(self._done, self._total)


def _agreement(found: Evidence) -> Float64[np.ndarray, " N"]:
    """Return z; 0 for a splat without a gain in any view."""
    spread = np.sqrt(found.spread)
    z: Float64[np.ndarray, " N"] = np.divide(found.gain, spread, out=np.zeros_like(spread), where=spread > 0)
    return z


def _errors(found: Evidence) -> Float64[np.ndarray, " N"]:
    """Return the gains as multiples of the average error per splat."""
    errors: Float64[np.ndarray, " N"] = (
        found.gain * len(found.gain) / max(found.error, np.finfo(np.float64).tiny)
    )
    return errors
