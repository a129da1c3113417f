"""Write the best file of a scene within a budget of bytes: an SPZ, a SOG, a compressed PLY or a page.

`gsplat_edu.io.sized` searches; here are the formats' encoders and what they can choose from, and the judge: renders of
the files, as read back, against those of the whole scene (`gsplat_edu.runs.importance`). Then the same number of splats
is merged from more (`gsplat_edu.io.lod.merge`), and the splats of the better file are trained on the photos of a run.
"""

from __future__ import annotations

import functools
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64

from gsplat_edu.base.constants import SIZED
from gsplat_edu.base.files import written_aside
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.io import compressed_ply, spz
from gsplat_edu.io.lod.merge import merged_to
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sized import Choices, Encode, Judge, Part, Ranked, Setting, Sized, best_file, fitted
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.palette import ALL_KEPT, MOST_ENTRIES
from gsplat_edu.render.api import render
from gsplat_edu.runs.importance import BACKEND, Importance, splat_importance
from gsplat_edu.runs.lod_refinement import retrained, spread
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.viewer import page
from gsplat_edu.viewer.export import read_back, with_poster

STEP = 1 / 32
"""Largest step of positions, as a fraction of the median scale."""

SPZ_PRECISIONS = (
    spz.FULL,
    spz.Precision(STEP),
    spz.Precision(STEP, (6, 5)),
    spz.Precision(STEP, (5, 4)),
)
"""The coarsest one has the coefficients of Niantic's library."""

SOG_SHARES = (None, 1 / 4, 1 / 16, 1 / 64)
"""Entries of the palette of coefficients per splat, at least `ALL_KEPT`; None for the usual number."""

PAGE_STEPS = (None, STEP)
"""Steps to which a page's numbers are rounded before they are compressed; see `_rounded`."""

SHARES = (1.0, 0.5, 0.25)
"""Fractions of the splats that keep harmonics above degree 0."""

MERGED_FROM = (1.3, 1.7, 2.2)
"""Numbers of splats that are merged into those of a file, as multiples of them."""

SPARE = 1.02
"""So many times as many splats are merged as a file may have, the least important of which may have to go."""

STEPS = 1_000
"""Iterations of tuning."""

_SPZ, _SOG, _COMPRESSED_PLY, _PAGE = SIZED

CHOICES = {
    _SPZ: Choices(len(SPZ_PRECISIONS), SHARES),
    _SOG: Choices(len(SOG_SHARES), SHARES, MOST_ENTRIES),
    _COMPRESSED_PLY: Choices(),  # no byte of its harmonics means 0
    _PAGE: Choices(len(PAGE_STEPS), SHARES),
}
"""What each format can choose from."""


@dataclass(frozen=True, eq=False)
class Written:
    """A file of limited size, and how it was made.

    Args:
        file: The file.
        merged: Whether splats were merged, instead of leaving the least important ones out.
        tuned: PSNR against photos before and after tuning on them, dB, if that made it better.
    """

    file: Sized
    merged: bool = False
    tuned: tuple[float, float] | None = None


def write_sized(
    path: Path,
    source: Source,
    tour: page.Tour,
    importance: Importance,
    most: int,
    photos: Sequence[View] = (),
    progress: Callable[[], object] = lambda: None,
) -> Written:
    """Write the best file of a scene within a budget.

    Args:
        path: Output file, whose name ends as one of `SIZED`.
        source: The scene.
        tour: What a page offers to look at.
        importance: How important each splat is, and the judging views.
        most: The budget, bytes.
        photos: Photos that the scene was trained on, to tune its splats on; none to leave them as they are.
        progress: Called after every one of `STEPS` steps of tuning.

    Raises:
        ArgumentError: no useful file is as small, or the format cannot hold the scene.
        DatasetError: a photo cannot be read.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    source.scene.gaussians.check_finite()
    ending = next(ending for ending in SIZED if path.name.lower().endswith(ending))
    ranked = Ranked(source.scene.gaussians, importance.splats)
    search = _Search(ending, source, ranked, _encoder(ending, path.stem, source, tour), most)
    judge = _judge(ending, source, importance.judges)
    written = Written(best_file(ranked, search.encode, judge, most, CHOICES[ending]))
    if not written.file.whole:
        written, splats = search.merged(written, judge, () if tour.proof else MERGED_FROM)
        if photos:
            written = search.tuned(written, splats, photos, progress)
    with written_aside(path) as aside:
        aside.write_bytes(written.file.data)
    return written


@dataclass(frozen=True, eq=False)
class _Search:
    """What other files of a scene there are within a budget than those that leave splats out."""

    ending: str
    source: Source
    ranked: Ranked
    encode: Encode
    most: int

    def merged(self, written: Written, judge: Judge, multiples: Sequence[float]) -> tuple[Written, Gaussians]:
        """Return the best file of about as many splats that were merged from more, and its splats with some to spare.

        Args:
            written: A file without merged ones; it and its splats are returned if no other is better.
            judge: Scores files.
            multiples: From how many splats to merge, as multiples of those of the file; a page that knows of each
                splat whether photos saw it has none.
        """
        count = round(SPARE * len(written.file.part.rows))
        splats = self.ranked.gaussians[torch.from_numpy(self.ranked.most_important(count))]
        for kept in sorted({min(round(times * count), len(self.ranked)) for times in multiples}):
            more = self.ranked.gaussians[torch.from_numpy(self.ranked.most_important(kept))]
            merged, _ = merged_to(more, count)
            found = self._fitted(merged, written.file.setting)
            if found is None or found.fills(self.most) < written.file.fills(self.most):
                continue
            if (score := judge(found.data)) > (written.file.score or 0.0):
                written, splats = Written(replace(found, score=score), merged=True), merged
        return written, splats

    def tuned(
        self, written: Written, splats: Gaussians, photos: Sequence[View], progress: Callable[[], object]
    ) -> Written:
        """Return the file after a training of its splats, or the given one if that is better."""
        judge, setting = _judge(self.ending, self.source, spread(photos)), written.file.setting
        before = judge(written.file.data)
        rows = None if written.merged else self.ranked.most_important(len(splats))
        stored = (
            self._ranked(splats).part(setting, len(splats)).gaussians
        )  # without what the file has no room for
        tuned = retrained(self.source, stored, photos, STEPS, BACKEND, progress)
        found = self._fitted(tuned, setting, rows)
        if found is None or found.fills(self.most) < written.file.fills(self.most):
            return written
        after = judge(found.data)
        return replace(written, file=found, tuned=(before, after)) if after > before else written

    def _fitted(
        self, gaussians: Gaussians, setting: Setting, rows: Int64[np.ndarray, " N"] | None = None
    ) -> Sized | None:
        """Return the largest file of some splats, which are those of some rows of the scene, or merged ones."""

        def encode(part: Part, setting: Setting) -> bytes:
            return self.encode(part if rows is None else replace(part, rows=rows[part.rows]), setting)

        return fitted(self._ranked(gaussians), setting, encode, self.most, CHOICES[self.ending])

    def _ranked(self, gaussians: Gaussians) -> Ranked:
        return Ranked(gaussians, splat_importance(self.source, gaussians))


def _encoder(ending: str, title: str, source: Source, tour: page.Tour) -> Encode:
    if ending == _PAGE:
        return functools.partial(_page, title, source, with_poster(tour, source))
    encoders = {_SPZ: _spz, _SOG: _sog, _COMPRESSED_PLY: _compressed_ply}
    return functools.partial(encoders[ending], source.scene)


def _judge(ending: str, source: Source, views: Sequence[View]) -> Judge:
    """Return what scores a file: mean PSNR of its renders in some views, dB."""
    shown = functools.partial(render, settings=source.settings, backend=BACKEND)

    def score(data: bytes) -> float:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / f"scene{ending}"
            place.write_bytes(data)
            written = read_back(place).relative_to(source.origin)
        scores = score_views(written, views, shown, source.settings.background)
        return float(summarize(scores)["psnr"] or 0.0)

    return score


def _spz(scene: Scene, part: Part, setting: Setting) -> bytes:
    return spz.packed(replace(scene, gaussians=part.gaussians), SPZ_PRECISIONS[setting.precision])


def _sog(scene: Scene, part: Part, setting: Setting) -> bytes:
    share, entries = SOG_SHARES[setting.precision], None
    if share is not None:
        entries = min(MOST_ENTRIES, max(ALL_KEPT, round(share * len(part.rows))) + part.finer)
    return sog.bundled(replace(scene, gaussians=part.gaussians), entries)


def _compressed_ply(scene: Scene, part: Part, setting: Setting) -> bytes:
    return compressed_ply.packed(replace(scene, gaussians=part.gaussians))


def _page(title: str, source: Source, tour: page.Tour, part: Part, setting: Setting) -> bytes:
    if tour.proof is not None and tour.proof.seen is not None:
        tour = replace(tour, proof=replace(tour.proof, seen=tour.proof.seen[part.rows]))
    step = PAGE_STEPS[setting.precision]
    gaussians = part.gaussians if step is None else _rounded(part.gaussians, step)
    scene = replace(source.scene, gaussians=gaussians)
    return page.shared(title, scene, source.cameras, source.settings, source.held_out, tour)


def _rounded(gaussians: Gaussians, step: float) -> Gaussians:
    """Round numbers so that they compress: all but rotations and opacities become multiples of a power of two.

    It is at most `step` times the median scale for positions, `step` for logarithms of scales, half of it for
    coefficients, and an eighth for those of degree 0.
    """
    finest = step * float(gaussians.log_scales.median().exp())
    positions = 2.0 ** math.floor(math.log2(finest))
    return replace(
        gaussians,
        means=_to_multiples(gaussians.means, positions),
        log_scales=_to_multiples(gaussians.log_scales, step),
        sh0=_to_multiples(gaussians.sh0, step / 8),
        sh_rest=_to_multiples(gaussians.sh_rest, step / 2),
    )


def _to_multiples(values: Float[torch.Tensor, "*shape"], unit: float) -> Float[torch.Tensor, "*shape"]:
    return torch.round(values.double() / unit).mul(unit).to(values.dtype)
