"""Write the best file of a scene within a budget of bytes: an SPZ, a SOG, a compressed PLY or a page.

`gsplat_edu.io.sized` searches; here are the formats' encoders and what they can choose from, and the judge: renders of
the files, as read back, against those of the whole scene (`gsplat_edu.runs.importance`).
"""

from __future__ import annotations

import functools
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float

from gsplat_edu.base.constants import SIZED
from gsplat_edu.base.files import written_aside
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.io import compressed_ply, spz
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sized import Choices, Encode, Judge, Part, Ranked, Setting, Sized, best_file
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.palette import ALL_KEPT, MOST_ENTRIES
from gsplat_edu.render.api import render
from gsplat_edu.runs.importance import BACKEND, Importance
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.gaussians import Gaussians
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

_SPZ, _SOG, _COMPRESSED_PLY, _PAGE = SIZED

CHOICES = {
    _SPZ: Choices(len(SPZ_PRECISIONS), SHARES),
    _SOG: Choices(len(SOG_SHARES), SHARES, MOST_ENTRIES),
    _COMPRESSED_PLY: Choices(),  # no byte of its harmonics means 0
    _PAGE: Choices(len(PAGE_STEPS), SHARES),
}
"""What each format can choose from."""


def write_sized(path: Path, source: Source, tour: page.Tour, importance: Importance, most: int) -> Sized:
    """Write the best file of a scene within a budget.

    Args:
        path: Output file, whose name ends as one of `SIZED`.
        source: The scene.
        tour: What a page offers to look at.
        importance: How important each splat is, and the judging views.
        most: The budget, bytes.

    Returns:
        The file.

    Raises:
        ArgumentError: no useful file is as small, or the format cannot hold the scene.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    source.scene.gaussians.check_finite()
    ranked = Ranked(source.scene.gaussians, importance.splats)
    ending = next(ending for ending in SIZED if path.name.lower().endswith(ending))
    encode = _encoder(ending, path.stem, source, tour)
    found = best_file(ranked, encode, _judge(ending, source, importance), most, CHOICES[ending])
    with written_aside(path) as aside:
        aside.write_bytes(found.data)
    return found


def _encoder(ending: str, title: str, source: Source, tour: page.Tour) -> Encode:
    if ending == _PAGE:
        return functools.partial(_page, title, source, with_poster(tour, source))
    encoders = {_SPZ: _spz, _SOG: _sog, _COMPRESSED_PLY: _compressed_ply}
    return functools.partial(encoders[ending], source.scene)


def _judge(ending: str, source: Source, importance: Importance) -> Judge:
    """Return what scores a file: mean PSNR of its renders in the judging views, dB."""
    shown = functools.partial(render, settings=source.settings, backend=BACKEND)

    def score(data: bytes) -> float:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / f"scene{ending}"
            place.write_bytes(data)
            written = read_back(place).relative_to(source.origin)
        scores = score_views(written, importance.judges, shown, source.settings.background)
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
