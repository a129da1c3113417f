"""Evaluate a run: write scores, pictures and the report into its folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from gsplat_edu.base.links import check_links
from gsplat_edu.base.text import image_file_names
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.data.loading_notes import LoadingNote
from gsplat_edu.evaluate.comparison import save_comparison
from gsplat_edu.evaluate.metrics import BLURRED_FROM, ImageScore, Renderer, score_views, summarize
from gsplat_edu.evaluate.report import Picture, Report, write_report
from gsplat_edu.evaluate.verdict import BLURRED, SKIPPED
from gsplat_edu.parts.run_values import Reported
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.meshes import mesh_entries
from gsplat_edu.runs.parts import scored, sections
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

Image = UInt8[np.ndarray, "H W 3"]

EVALUATED = "evaluated"
"""Key of a metrics.json written outside the run's folder: which run was scored, and on which dataset."""

SCORES = ("test", "train", "test_views", "psnr_aligned", BLURRED)
"""Keys of metrics.json that hold scores."""

Progress = Callable[[str, ImageScore], None]
"""Called with the split and the score of every scored view."""


@dataclass(frozen=True)
class ScoredViews:
    """The views that a scene is scored on.

    Args:
        test: Held-out views.
        train: Training views; empty to skip them.
        background: (3,) colour behind the renders and behind photos that are not opaque.
        notes: Notes of the capture, for the report.
        skipped: Score none of the views; metrics.json and the report say how many were left out.
    """

    test: Sequence[View]
    train: Sequence[View] = ()
    background: ArrayLike = (0.0, 0.0, 0.0)
    notes: Sequence[LoadingNote] = ()
    skipped: bool = False


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Args:
        test: Scores of the held-out views.
        train: Scores of the training views.
        metrics: Contents of metrics.json.
    """

    test: list[ImageScore]
    train: list[ImageScore]
    metrics: dict[str, Any]


def evaluate_run(
    folder: RunFolder,
    judged: ScoredViews,
    gaussians: Gaussians,
    render: Renderer,
    facts: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    into: RunFolder | None = None,
) -> Evaluation:
    """Score a scene and write metrics.json, renders/test/NAME.png (photo | render) and report.html.

    Other keys of an existing metrics.json are kept; old scores and renders never are. The report lists known meshes.

    Args:
        folder: The run's folder; its config and log go into the report.
        judged: The views.
        gaussians: The scene, in the frame of the views' cameras.
        render: Renders Gaussians from a camera, over the background of `judged`.
        facts: Further numbers for metrics.json: "iterations", "seconds".
        progress: Called for every scored view.
        into: Folder to write to; the run's own folder if None, and its other metrics are then kept.

    Returns:
        The scores and the metrics.

    Raises:
        ArgumentError: a link leads out of the folder that is written to.
        CheckpointError: a file of the folder is damaged.
        DatasetError: a photo cannot be read.
        OSError: a file cannot be written.
    """
    into = into or folder
    own = into.path == folder.path
    check_links("RUN" if own else "--out", into.path)
    config, log, before = folder.read_config(), folder.log(), into.read_metrics()
    stale = SCORES if judged.skipped else (SKIPPED,)
    earlier = {key: value for key, value in before.items() if own and key not in stale}
    test_views, train_views = ((), ()) if judged.skipped else (judged.test, judged.train)
    gallery = _Gallery(into, test_views, progress)

    def tell(view: View, score: ImageScore) -> None:
        if progress is not None:
            progress("train", score)

    test = score_views(gaussians, test_views, render, judged.background, gallery.add)
    train = score_views(gaussians, train_views, render, judged.background, on_score=tell)
    metrics = {**earlier, **_scores(judged, test, train), "num_gaussians": len(gaussians)}
    metrics |= scored(config) | dict(facts or {})
    title, notes = f"{folder.path.resolve().name}: 3D Gaussian Splatting", [*map(str, judged.notes)]
    run = Reported(
        *(folder.path, config, metrics, log, train_views),
        *(gaussians.map(lambda tensor: tensor.detach()), render, judged.background),
    )
    known = mesh_entries(folder), sections(run)
    report = Report(title, metrics, log, config, test, gallery.pictures, notes, *known)
    write_report(into.report, report)
    gallery.remove_others(before)
    into.write_metrics(metrics)  # last: its presence marks the run as evaluated
    return Evaluation(test, train, metrics)


def _scores(judged: ScoredViews, test: list[ImageScore], train: list[ImageScore]) -> dict[str, Any]:
    """Return the scores for metrics.json, or how many views were skipped."""
    if judged.skipped:
        return {SKIPPED: {"test": len(judged.test), "train": len(judged.train)}}
    views = [dataclasses.asdict(score) for score in test]
    means = {"test": summarize(test), "train": summarize(train), "test_views": views}
    ranked = sorted((*test, *train), key=lambda score: -(score.added_detail or 0.0))
    return means | {BLURRED: [score.name for score in ranked if (score.added_detail or 0.0) >= BLURRED_FROM]}


class _Gallery:
    """Writes each test view beside its photo, and keeps a thumbnail for the report."""

    def __init__(self, folder: RunFolder, views: Sequence[View], progress: Progress | None) -> None:
        names = image_file_names([view.name for view in views])
        self._files = {
            id(view): folder.renders / "test" / name for view, name in zip(views, names, strict=True)
        }
        self._folder = folder.renders / "test"
        self._progress = progress
        self.pictures: list[Picture] = []

    def remove_others(self, metrics: dict[str, Any]) -> None:
        """Remove renders that the metrics of an earlier evaluation list and that show none of these views."""
        scores = metrics.get("test_views", [])
        known = (
            [score.get("name") for score in scores if isinstance(score, dict)]
            if isinstance(scores, list)
            else []
        )
        names = image_file_names([name for name in known if isinstance(name, str)])
        for path in {self._folder / name for name in names} - set(self._files.values()):
            path.unlink(missing_ok=True)

    def add(self, view: View, score: ImageScore, image: Image, truth: Image) -> None:
        save_comparison(self._files[id(view)], truth, image)
        self.pictures.append(Picture.of(view.name, image, truth))
        if self._progress is not None:
            self._progress("test", score)
