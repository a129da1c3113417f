"""The part that refines cameras: the setting `refine`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.report_parts import Section
from gsplat_edu.parts.bench import Bench
from gsplat_edu.parts.poses.capture import aligned_score, with_refined_cameras, write_refined
from gsplat_edu.parts.poses.choice import chosen_refinement
from gsplat_edu.parts.poses.findings import check_fit
from gsplat_edu.parts.poses.refinement import NEED_LENSES, Refinement, refinement_of
from gsplat_edu.parts.poses.trials import RefineTrials
from gsplat_edu.parts.run_values import Finished, Reported, Tried
from gsplat_edu.survey.finding import Examined
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup
from gsplat_edu.train.trainer import Trainer


class PosesPart(Part):
    """Refines poses, lenses and rolling shutters with the scene."""

    off_device = untimed = ("refine",)

    tried = "refine"

    def needs_trial(self, value: str) -> bool:
        """Return whether a value learns a lens or a motion, which short trainings judge also where the user gave it."""
        return value in NEED_LENSES

    def try_out(self, asked: str, bench: Bench) -> Tried:
        """Choose `refine` by short trainings, or judge the value that the user gave.

        Raises:
            ArgumentError: the backend cannot learn what was asked for.
            OutOfTimeError: the trainings take too long.
        """
        return chosen_refinement(asked, bench)

    def judge(self, settings: TrainConfig, run: Trained) -> Examined:
        """Report training views that the scene does not fit."""
        return Examined({"training views": check_fit(run)})

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the view model that moves the cameras.

        Raises:
            ArgumentError: what is refined makes cameras no pinholes, and the backend knows pinholes only.
        """
        if settings.refine == "none":
            return None
        if settings.refine in NEED_LENSES:
            setup.backend.require("lens", f"refine: {settings.refine}")
        cameras = [view.camera for view in setup.views]
        return Begun(view_model=Refinement(cameras, settings, setup.extent))

    def learned(self, trainer: Trainer, dataset: Dataset) -> Dataset:
        """Return the capture with its refined cameras."""
        refinement = refinement_of(trainer.view_model)
        return dataset if refinement is None else with_refined_cameras(refinement, dataset)

    def finish(self, settings: TrainConfig, run: Finished) -> Mapping[str, Any]:
        """Write the capture with its refined cameras; return the score of held-out views at aligned poses.

        Raises:
            DatasetError: a photo cannot be read.
            OSError: a file cannot be written.
        """
        if refinement_of(run.trainer.view_model) is None:
            return {}
        run.say(f"wrote {write_refined(run.path, run.learned)}: the capture with its refined cameras")
        if not run.is_scored:
            return {}
        extent = run.trainer.extent
        return aligned_score(run.learned.test, run.gaussians, settings, run.renderer, extent, run.say)

    def section(self, settings: TrainConfig, run: Reported) -> Section | None:
        """Return which refinements were tried; None if none were."""
        trials = RefineTrials.of(run.config)
        return None if trials is None else Section("Refined cameras", [trials.note(settings.refine)])


POSES = PosesPart()
