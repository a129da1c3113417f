"""Clean a scene: remove what the photos do not support, as long as held-out photos do not suffer.

The training views judge the splats. The held-out views guard the result: if their PSNR falls by more than the allowed
loss, only the more certain half of the floaters is removed, then a quarter, and so on. In the end only splats that no
view sees are removed, or nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64, UInt8

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import in_range
from gsplat_edu.clean.evidence import judging_backend
from gsplat_edu.clean.judge import Progress, Reason, Verdict, judge
from gsplat_edu.evaluate.metrics import outside_cut_out, photo_psnr
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

MAX_LOSS = 0.05
"""Default of the largest loss of PSNR, dB."""

LEAST_DIVIDED = 8
"""If fewer floaters than this are left and the loss is still too large, keep them all."""


@dataclass(frozen=True, eq=False)
class Cleaning:
    """The result of `clean`.

    Args:
        reasons: (N,) a `Reason` for every splat of the scene; not KEPT: removed.
        judged: (N,) the reasons before the guard took anything back.
        before: Mean PSNR of the guard's views, dB, of the scene; None if no view has a pixel that counts.
        after: Mean PSNR without the removed splats.
        all_removed: Mean PSNR without all splats that were judged removable; equal to `after` if the guard took nothing
            back.
        held_out: Whether the guard's views were held out; otherwise the scene was trained on them.
        guards: Number of the guard's views.
        views: Number of views that judged.
        outside: Mean of `outside_cut_out` over the guard's views without the removed splats; None without alpha.
    """

    reasons: UInt8[np.ndarray, " N"]
    judged: UInt8[np.ndarray, " N"]
    before: float | None
    after: float | None
    all_removed: float | None
    held_out: bool
    guards: int
    views: int
    outside: float | None

    @property
    def kept(self) -> Bool[np.ndarray, " N"]:
        """Splats that stay."""
        kept: Bool[np.ndarray, " N"] = self.reasons == Reason.KEPT
        return kept

    def counts(self) -> dict[Reason, int]:
        """Return the number of removed splats by reason."""
        return {reason: int((self.reasons == reason).sum()) for reason in Reason if reason != Reason.KEPT}

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians that stay, in their order.

        Args:
            gaussians: The Gaussians that were judged.
        """
        return _rows(gaussians, self.kept)


def clean(
    gaussians: Gaussians,
    train: Sequence[View],
    test: Sequence[View],
    settings: RenderSettings,
    max_loss: float = MAX_LOSS,
    backend: Backend | None = None,
    progress: Progress = lambda done, total: None,
) -> Cleaning:
    """Find the splats that the photos do not support, and decide how many of them to remove.

    Args:
        gaussians: N Gaussians on the CPU, in the frame of the cameras.
        train: The views that the scene was trained on; they judge.
        test: The views that were held out; they guard. If there are none, the training views do.
        settings: The scene's render settings.
        max_loss: Largest loss of the guard's mean PSNR, dB.
        backend: What renders; None takes the backend cpu.
        progress: Called after every view that judges.

    Raises:
        ArgumentError: there are no training views, no splat would be left, `max_loss` is negative, or the
            backend collects no statistics.
        DatasetError: a photo cannot be read.
    """
    in_range("max_loss", max_loss, 0.0)
    backend = judging_backend(backend)
    gaussians = gaussians.map(lambda tensor: tensor.detach())
    with reused_buffers():
        verdict = judge(gaussians, train, settings, backend, progress)
    if len(gaussians) and verdict.removed.all():
        raise ArgumentError(
            f"scene: none of its {len(gaussians):,} splats is supported by the photos; check that the capture"
            " belongs to the scene"
        )
    guards = test or train
    score = functools.partial(_score, gaussians, views=guards, settings=settings, backend=backend)
    reasons = verdict.reasons
    before = score(np.ones(len(gaussians), dtype=bool))
    whole = after = before if not verdict.removed.any() else score(reasons == Reason.KEPT)
    ranked = _ranked(verdict)
    while before is not None and after is not None and before - after > max_loss:
        stay = ranked[len(ranked) // 2 if len(ranked) >= 2 * LEAST_DIVIDED else 0 :]
        reasons = reasons.copy()
        reasons[stay if len(ranked) else slice(None)] = Reason.KEPT
        ranked = ranked[: len(ranked) - len(stay)]
        after = score(reasons == Reason.KEPT)
    cut_out = [view for view in guards if view.read().alpha is not None]
    outside = _outside(_rows(gaussians, reasons == Reason.KEPT), cut_out, settings, backend)
    return Cleaning(
        reasons, verdict.reasons, before, after, whole, bool(test), len(guards), verdict.views, outside
    )


def _ranked(verdict: Verdict) -> Int64[np.ndarray, " M"]:
    """Return the indices of the floaters, the most certain first; ties by index."""
    ids = np.flatnonzero(verdict.removed & (verdict.reasons != Reason.UNSEEN))
    ranked: Int64[np.ndarray, " M"] = ids[np.argsort(-verdict.certainty[ids], kind="stable")]
    return ranked


def _rows(gaussians: Gaussians, kept: Bool[np.ndarray, " N"]) -> Gaussians:
    rows = torch.from_numpy(kept).to(gaussians.means.device)
    return gaussians.map(lambda tensor: tensor[rows])


def _score(
    gaussians: Gaussians,
    kept: Bool[np.ndarray, " N"],
    views: Sequence[View],
    settings: RenderSettings,
    backend: Backend,
) -> float | None:
    """Return the mean PSNR over the views, dB; None if no view has a pixel that counts."""
    some, scores = _rows(gaussians, kept), []
    for view in views:
        photo = view.read()
        if photo.mask is not None and not photo.mask.any():
            continue
        with torch.no_grad():
            output = render(some, view.camera, settings=settings, backend=backend)
        scores.append(photo_psnr(photo, output, settings.background))
    return float(np.mean(scores)) if scores else None


def _outside(
    gaussians: Gaussians, views: Sequence[View], settings: RenderSettings, backend: Backend
) -> float | None:
    """Return `Cleaning.outside`."""
    shares = []
    for view in views:
        with torch.no_grad():
            output = render(gaussians, view.camera, settings=settings, backend=backend)
        share = outside_cut_out(view.read(), output)
        if share is not None:
            shares.append(share)
    return float(np.mean(shares)) if shares else None
