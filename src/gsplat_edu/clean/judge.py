"""Which splats of a scene its photos do not support, and why.

Rounds of evidence (`gsplat_edu.clean.evidence`) find splats to remove. A floater hides those behind it, so that each
round sees more than the one before. A last round draws the removed splats faintly and takes back those that the photos
miss.

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

from gsplat_edu.clean.evidence import Evidence, gather, peaks
from gsplat_edu.constants import ALPHA_MIN
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.views import View


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
    """Thresholds, none of them in world units.

    Args:
        gap: A splat is in free space from this gap on, as a fraction of its distance (`Evidence.gap`).
        views: It has to be seen by at least so many views.
        against: z above which the photos do not miss a splat in free space.
        refuted: z above which the photos refute a splat.
        share: Share of the squared error of all photos that a refuted splat causes by itself, at least.
        missed: z below which the last round takes a splat back.
        harm: Share of the squared error of all photos that no removed splat may add by itself.
        rounds: Most rounds of removal.
        settled: The rounds end when one removes less than this share of what is removed already.
        work: Splats times views of a round, about; views are left out evenly to stay below it.
        least_views: Views of a round, at least.
    """

    gap: float = 0.15
    views: int = 3
    against: float = -1.0
    refuted: float = 2.0
    share: float = 2e-4
    missed: float = -1.5
    harm: float = 1e-4
    rounds: int = 3
    settled: float = 0.02
    work: float = 2e7
    least_views: int = 24


@dataclass(frozen=True, eq=False)
class Verdict:
    """What `judge` decided.

    Args:
        reasons: (N,) a `Reason` for every splat.
        certainty: (N,) `Evidence.gain` as a share of the squared error of all photos, at the time of the removal.
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
    most = max(rules.least_views, int(rules.work / max(count, 1)))
    number = min(len(views), most)
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
        self._done, self._total = 0, (rules.rounds + 1) * len(views)
        self._reasons: UInt8[np.ndarray, " N"] = np.zeros(len(gaussians), dtype=np.uint8)

    def result(self) -> tuple[UInt8[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
        rules, reasons = self._rules, self._reasons
        seen = np.zeros(len(reasons), dtype=bool)
        certainty = np.zeros(len(reasons))
        for _ in range(rules.rounds):
            found = self._gathered()
            seen |= found.peak > ALPHA_MIN
            kept, share, z = reasons == Reason.KEPT, found.gain / max(found.error, 1e-300), _agreement(found)
            free = (found.gap > rules.gap) & (z > rules.against) & (found.views >= rules.views)
            free &= share > -rules.harm
            refuted = (share > rules.share) & (z > rules.refuted)
            reasons[kept & free] = Reason.IN_FRONT
            reasons[kept & refuted & ~free] = Reason.REFUTED
            certainty[kept] = share[kept]
            new, gone = int((kept & (free | refuted)).sum()), int((reasons != Reason.KEPT).sum())
            if new <= rules.settled * gone:
                break
        if (reasons != Reason.KEPT).any():
            found = self._gathered()
            gone, share = reasons != Reason.KEPT, found.gain / max(found.error, 1e-300)
            reasons[gone & ((_agreement(found) < rules.missed) | (share < -rules.harm))] = Reason.KEPT
            seen |= found.peak > ALPHA_MIN
        if len(self._views) < len(self._everything) and not seen.all():
            rest = [view for view in self._everything if view not in self._views]
            seen |= peaks(self._gaussians, rest, self._settings) > ALPHA_MIN
        reasons[(reasons == Reason.KEPT) & ~seen] = Reason.UNSEEN
        self._progress(self._total, self._total)
        return reasons, certainty

    def _gathered(self) -> Evidence:
        gone = self._reasons != Reason.KEPT
        return gather(self._gaussians, self._views, self._settings, gone, self._step)

    def _step(self) -> None:
        self._done += 1
        self._progress(self._done, self._total)


def _agreement(found: Evidence) -> Float64[np.ndarray, " N"]:
    """Return z; 0 for a splat about which no view has an opinion."""
    spread = np.sqrt(found.spread)
    z: Float64[np.ndarray, " N"] = np.divide(found.gain, spread, out=np.zeros_like(spread), where=spread > 0)
    return z
