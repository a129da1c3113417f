"""How many planted floaters does cleaning find, what else does it remove, and how much PSNR and time does it cost?

    python benchmarks/clean.py [RUN] [--count N] [--seed S] [--million] [--smoke] [--out FILE.json]

Floaters are planted in the scene of a run (lab/captures/plant.py), between its training cameras and the surfaces
that they see. Then the scene is cleaned with the run's photos. Recall is the fraction of planted floaters that are
removed. Precision is the fraction of planted floaters among all splats that are removed as floaters, so removing a
splat of the scene lowers it, whether or not the scene needs this splat. Splats that no view sees are listed
separately. A scene has floaters of its own, which cleaning should remove. Therefore the scene is also cleaned without
planting, and a second precision counts only splats of the scene that are removed in addition. The loss is the
held-out PSNR of the scene before planting minus that of the planted and cleaned one. The removed splats of the scene
are also removed from the scene without floaters, which shows whether it needed them.

--million instead splits the scene's splats until it has a million, and measures the time of a whole cleaning.

Without a run, one is trained on a procedural capture.
"""

from __future__ import annotations

import functools
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hardware
import numpy as np
import torch
from captures import capture

import gsplat_edu.cli.main as command_line
from gsplat_edu.clean.guard import Cleaning, clean
from gsplat_edu.clean.judge import Reason
from gsplat_edu.cli.running import run_command
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import Subject, open_subject
from gsplat_edu.scene.gaussians import Gaussians, quat_to_R_t
from lab.captures.plant import floaters

MILLION = 1_000_000


@contextmanager
def trained(run: Path | None) -> Iterator[Path]:
    """Yield the given run, or one trained on a tiny procedural capture."""
    if run is not None:
        yield run
        return
    with TemporaryDirectory() as scratch, capture(None, smoke=True) as made:
        out = Path(scratch) / "run"
        words = ["train", str(made), "--out", str(out), "--iterations", "100", "--backend", "cpu"]
        if command_line.main(words) != 0:
            raise SystemExit("the training failed")
        yield out


def rows(gaussians: Gaussians, kept: np.ndarray) -> Gaussians:
    """Return some of the Gaussians."""
    chosen = torch.from_numpy(kept)
    return gaussians.map(lambda tensor: tensor[chosen])


def held_out(subject: Subject, gaussians: Gaussians) -> float:
    """Return the mean PSNR of the held-out views, dB."""
    settings = subject.source.settings
    renderer = functools.partial(render, settings=settings, backend="cpu")
    scores = score_views(gaussians, subject.dataset.test, renderer, settings.background)
    return float(summarize(scores)["psnr"] or math.nan)


def timed(subject: Subject, gaussians: Gaussians) -> tuple[Cleaning, float]:
    """Clean; return the result and the seconds. Photos are decoded before."""
    subject.dataset.preload()
    began = time.perf_counter()
    found = clean(gaussians, subject.dataset.train, subject.dataset.test, subject.source.settings)
    return found, time.perf_counter() - began


def planted(subject: Subject, count: int, seed: int) -> dict[str, Any]:
    """Plant, clean and compare."""
    own = subject.source.scene.gaussians
    cameras = [view.camera for view in subject.dataset.train]
    added = floaters(own, cameras, subject.source.settings, count, seed)
    found, seconds = timed(subject, Gaussians.concatenated([own, added]))
    original, removed = held_out(subject, own), found.reasons != Reason.KEPT
    mine, theirs = found.reasons[: len(own)], found.reasons[len(own) :]
    hits, misses = int(removed[len(own) :].sum()), int((mine > Reason.UNSEEN).sum())
    alone, _ = timed(subject, own)
    caused = int(((mine > Reason.UNSEEN) & (alone.reasons == Reason.KEPT)).sum())
    return {
        "splats": len(own),
        "planted": count,
        "views": found.views,
        "psnr_original": original,
        "psnr_planted": found.before,
        "psnr_cleaned": found.after,
        "loss": original - (found.after or math.nan),
        "recall": hits / count,
        "precision": hits / max(hits + misses, 1),
        "precision_beyond_own": hits / max(hits + caused, 1),
        "own_unseen": int((mine == Reason.UNSEEN).sum()),
        "own_in_front": int((mine == Reason.IN_FRONT).sum()),
        "own_refuted": int((mine == Reason.REFUTED).sum()),
        "own_only_with_planted": caused,
        "own_as_it_is": int((alone.reasons > Reason.UNSEEN).sum()),
        "planted_by_reason": {reason.name.lower(): int((theirs == reason).sum()) for reason in Reason},
        "loss_of_own_alone": original - held_out(subject, rows(own, mine == Reason.KEPT)),
        "seconds": seconds,
    }


def split(gaussians: Gaussians, count: int) -> Gaussians:
    """Replace every splat by several smaller ones inside it, `count` in total."""
    generator = torch.Generator().manual_seed(0)
    parts, times = [], -(-count // len(gaussians))
    for _ in range(times):
        offsets = 0.8 * torch.randn(len(gaussians), 3, generator=generator) * gaussians.scales
        moved = gaussians.means + (quat_to_R_t(gaussians.quats) @ offsets[..., None])[..., 0]
        parts.append(replace(gaussians, means=moved, log_scales=gaussians.log_scales - 0.5 * math.log(times)))
    return Gaussians.concatenated(parts).map(lambda tensor: tensor[:count])


def million(subject: Subject, count: int) -> dict[str, Any]:
    """Time a scene of `count` splats."""
    scene = split(subject.source.scene.gaussians, count)
    used = time.process_time()
    found, seconds = timed(subject, scene)
    used = time.process_time() - used
    removed = int((found.reasons != Reason.KEPT).sum())
    return {
        "splats": len(scene),
        "views": found.views,
        "removed": removed,
        "seconds": seconds,
        "processor_seconds": used,
    }


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser("Planted floaters: recall, precision, loss and time of cleaning.")
    parser.add_argument("run", nargs="?", type=Path, help="run folder (default: a tiny one is trained)")
    parser.add_argument("--count", type=int, default=2_000, help="floaters (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the floaters (default: %(default)s)")
    parser.add_argument("--million", action="store_true", help="time a million splats instead")
    parser.add_argument("--threads", type=int, help="threads (default: torch's choice)")
    options = parser.parse_args()
    if options.threads is not None:
        torch.set_num_threads(options.threads)

    def measure() -> None:
        with trained(None if options.smoke else options.run) as run:
            subject = open_subject(run, None, load_backend("cpu"))
            if options.million:
                result = million(subject, 1_000 if options.smoke else MILLION)
            else:
                result = planted(subject, 20 if options.smoke else options.count, options.seed)
        for name, value in result.items():
            print(f"{name:22} {value:.4f}" if isinstance(value, float) else f"{name:22} {value}")
        hardware.report(result, options.out)

    return run_command("clean.py", measure, debug=False)


if __name__ == "__main__":
    sys.exit(main())
