"""Which splats of a scene its photos do not support, and why.

Rounds of evidence (`gsplat_edu.clean.evidence`) find the doubtful splats. A floater hides those behind it, so that each
round sees more than the one before. Then all doubtful splats are judged together (`gsplat_edu.clean.settle`).

    z = sum over views of gain / sqrt(sum over views of gain²)

measures how well the views agree that a splat should go: at most 1 in size if a single view has an opinion, and the
square root of their number if all agree.
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
from gsplat_edu.clean.evidence import Evidence, gather, peak_weights
from gsplat_edu.clean.settle import Doubtful, settle
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View


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


@dataclass(frozen=True)
class Rules:
    """Thresholds of a judgement.

    Distances are fractions of the distance from the camera. Errors are multiples of the average squared error per
    splat: that of all photos divided by the number of splats.

    Args:
        gap: A splat is in free space from this gap on, as a fraction of the distance (`Evidence.gap`).
        against: z below which the photos miss a splat in free space; it then stays.
        far_gap: From this gap on, it takes more to keep a splat:
        far_against: z below which the photos miss it.
        rare: With such a gap, a splat that at most this share of the views see goes even if they miss it: few views fit
            their noise with splats right in front of them.
        near_gap: A splat is refuted from this gap on if removing it alone lowers the error by
        near_error: this much, with a z above
        near_z: this one.
        error: A splat is refuted, wherever it is, if removing it alone lowers the error by this much, with a z above
        agreement: this one;
        gross_error: or by this much, with a z above
        gross_z: this one.
        doubt: From this gap on, a splat that the rounds kept is doubtful, unless it changes the error by less than the
        price: a doubtful splat goes if its absence adds less than this much error. One whose removal lowers the error
            by `gross_error` is doubtful wherever it is.
        missed: The photos miss a splat whose absence adds more than this error.
        passes: The doubtful splats are judged together in this many steps for each view of a round,
        joint_work: in fewer if splats times steps would be more than this,
        least_steps: but then in at least this many.
        least_views: Fewer views than this do not find floaters, only what they do not see.
        rounds: Most rounds of evidence.
        few: The rounds end once one removes at most this share of the splats.
        work: Splats times views of a round; views are left out evenly to stay below it.
        round_views: Views of a round, at least.
    """

    gap: float = 0.15
    against: float = -0.9
    far_gap: float = 0.3
    far_against: float = -2.0
    rare: float = 0.05
    near_gap: float = 0.05
    near_error: float = 10.0
    near_z: float = 0.3
    error: float = 20.0
    agreement: float = 2.0
    gross_error: float = 100.0
    gross_z: float = 1.0
    doubt: float = 0.1
    price: float = 0.01
    missed: float = 1.0
    passes: int = 8
    joint_work: float = 6e7
    least_steps: int = 40
    least_views: int = 3
    rounds: int = 4
    few: float = 1e-4
    work: float = 1.5e7
    round_views: int = 12

    def views_of_round(self, splats: int, views: int) -> int:
        """Return how many of a capture's views judge a scene of this many splats in a round."""
        return min(views, max(self.round_views, int(self.work / max(splats, 1))))

    def joint_steps(self, splats: int, views: int) -> int:
        """Return the steps in which the doubtful ones of this many splats are judged together.

        Args:
            splats: Number of splats.
            views: Number of views of a round.
        """
        return min(self.passes * views, max(self.least_steps, int(self.joint_work / max(splats, 1))))


@dataclass(frozen=True, eq=False)
class Verdict:
    """What `judge` decided.

    Args:
        reasons: (N,) a `Reason` for every splat.
        certainty: (N,) how sure it is that a doubtful splat should go; 0 at the border, and for all that are not
            doubtful.
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
    rules: Rules | None = None,
    progress: Progress = lambda done, total: None,
) -> Verdict:
    """Decide which splats the photos do not support.

    Args:
        gaussians: N Gaussians on the CPU, in the frame of the cameras.
        views: The views that the scene was trained on.
        settings: The scene's render settings; photos that are not opaque are judged over their background.
        rules: Thresholds; None takes the defaults.
        progress: Called after every view.

    Raises:
        ArgumentError: there are no views.
        DatasetError: a photo cannot be read.
    """
    rules = rules or Rules()
    if not views:
        raise ArgumentError("views: there are none; a scene can only be judged by photos")
    finite = gaussians.finite_rows().numpy()
    some = gaussians if finite.all() else gaussians.map(lambda tensor: tensor[torch.from_numpy(finite)])
    reasons = np.full(len(gaussians), Reason.UNSEEN, dtype=np.uint8)
    certainty = np.zeros(len(gaussians))
    chosen = _chosen(views, rules, len(some))
    reasons[finite], certainty[finite] = _Rounds(some, views, chosen, settings, rules, progress).result()
    return Verdict(reasons, certainty, len(chosen))


def _chosen(views: Sequence[View], rules: Rules, count: int) -> list[View]:
    """Return views spread evenly over the list, as many as the work of a round allows."""
    number = rules.views_of_round(count, len(views))
    return [views[i * len(views) // number] for i in range(number)]


class _Rounds:
    """The rounds of `judge` on finite Gaussians."""

    def __init__(
        self,
        gaussians: Gaussians,
        everything: Sequence[View],
        views: Sequence[View],
        settings: RenderSettings,
        rules: Rules,
        progress: Progress,
    ) -> None:
        self._gaussians, self._views, self._rules, self._progress = gaussians, views, rules, progress
        self._everything = everything
        self._settings = replace(settings, depth=False, median_depth=True)
        self._steps = rules.joint_steps(len(gaussians), len(views))
        self._done, self._total = 0, rules.rounds * len(views) + self._steps
        self._reasons: UInt8[np.ndarray, " N"] = np.zeros(len(gaussians), dtype=np.uint8)

    def result(self) -> tuple[UInt8[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
        rules, reasons = self._rules, self._reasons
        seen, doubtful, rare = (np.zeros(len(reasons), dtype=bool) for _ in range(3))
        for _ in range(rules.rounds):
            found = gather(self._gaussians, self._views, self._settings, reasons != Reason.KEPT, self._step)
            seen |= found.peak > ALPHA_MIN
            free, refuted = self._found(found)
            kept = reasons == Reason.KEPT
            rare |= kept & self._rare(found)
            reasons[kept & refuted] = Reason.REFUTED
            reasons[kept & free] = Reason.IN_FRONT
            doubtful |= (reasons != Reason.KEPT) | self._doubtful(found)
            if (kept & (free | refuted)).sum() <= rules.few * len(reasons):
                break
        certainty = self._settled(doubtful, rare, found)
        if len(self._views) < len(self._everything) and not seen.all():
            rest = [view for view in self._everything if view not in self._views]
            seen |= peak_weights(self._gaussians, rest, self._settings) > ALPHA_MIN
        reasons[(reasons == Reason.KEPT) & ~seen] = Reason.UNSEEN
        self._progress(self._total, self._total)
        return reasons, certainty

    def _settled(
        self, doubtful: Bool[np.ndarray, " N"], rare: Bool[np.ndarray, " N"], last: Evidence
    ) -> Float64[np.ndarray, " N"]:
        """Judge the doubtful splats together, and return how certain their removal is; rare ones stay removed.

        Those that the rounds kept, and those that the photos miss in the last round, start as needed.
        """
        certainty = np.zeros(len(doubtful))
        if not doubtful.any() or len(self._views) < self._rules.least_views:
            return certainty
        ids = np.flatnonzero(doubtful)
        needed = (self._reasons == Reason.KEPT) | (_errors(last) < -self._rules.missed)
        start = np.where(needed[ids], 1.0, -1.0)
        unit = max(last.error / len(doubtful) / len(self._views), np.finfo(np.float64).tiny)
        logits = settle(
            self._gaussians,
            Doubtful(ids, start),
            self._views,
            self._settings,
            unit=unit,
            price=self._rules.price,
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
        rules, errors, z = self._rules, _errors(found), _agreement(found)
        free = (found.gap > rules.gap) & (z > rules.against)
        free |= (found.gap > rules.far_gap) & (z > rules.far_against) | self._rare(found)
        free &= found.views > 0
        refuted = (found.gap > rules.near_gap) & (errors > rules.near_error) & (z > rules.near_z)
        refuted |= (errors > rules.error) & (z > rules.agreement)
        refuted |= (errors > rules.gross_error) & (z > rules.gross_z)
        enough = len(self._views) >= rules.least_views
        return free & enough, refuted & enough

    def _doubtful(self, found: Evidence) -> Bool[np.ndarray, " N"]:
        """Return which splats may have to go, if the photos agree to it."""
        rules, errors = self._rules, _errors(found)
        doubtful: Bool[np.ndarray, " N"] = (np.abs(errors) > rules.price) & (found.gap > rules.doubt)
        return (doubtful | (errors > rules.gross_error)) & (found.views > 0)

    def _rare(self, found: Evidence) -> Bool[np.ndarray, " N"]:
        rare: Bool[np.ndarray, " N"] = found.views <= self._rules.rare * len(self._views)
        return rare & (found.gap > self._rules.far_gap) & (found.views > 0)

    def _step(self) -> None:
        self._done += 1
        self._progress(self._done, self._total)


def _agreement(found: Evidence) -> Float64[np.ndarray, " N"]:
    """Return z; 0 for a splat about which no view has an opinion."""
    spread = np.sqrt(found.spread)
    z: Float64[np.ndarray, " N"] = np.divide(found.gain, spread, out=np.zeros_like(spread), where=spread > 0)
    return z


def _errors(found: Evidence) -> Float64[np.ndarray, " N"]:
    """Return the gains as multiples of the average error per splat."""
    errors: Float64[np.ndarray, " N"] = (
        found.gain * len(found.gain) / max(found.error, np.finfo(np.float64).tiny)
    )
    return errors
