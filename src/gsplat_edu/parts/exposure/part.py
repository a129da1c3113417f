"""The part that corrects exposures: the setting `appearance`."""

from __future__ import annotations

import functools
from dataclasses import replace

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.evaluate.verdict import FITTED, JUDGED_BY
from gsplat_edu.parts.exposure.findings import (
    EXPOSURE as CHECK,
    check_exposure,
    compares_exposure,
    correction_of,
    judged_exposure,
)
from gsplat_edu.parts.exposure.model import Exposure
from gsplat_edu.parts.exposure.photos import at_exposure_of_scene
from gsplat_edu.parts.run_values import Compared
from gsplat_edu.render.api import render
from gsplat_edu.survey.capture import Survey, Undecided
from gsplat_edu.survey.finding import Examined, Remedy
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class ExposurePart(Part):
    """Measures the exposure of each photo, and its vignetting if asked for."""

    off_device = untimed = ("appearance",)

    def examine(self, survey: Survey) -> Examined:
        """Report photos that differ from their neighbours; nothing if they cannot be compared."""
        found = check_exposure(survey) if len(survey.shots) > 1 else []
        return Examined({CHECK: found} if found or compares_exposure(survey) else {})

    def choose(self, setting: str, capture: Undecided) -> Remedy | None:
        """Choose `appearance` by what the photos show."""
        return correction_of(capture.survey) if setting == "appearance" else None

    def judge(self, settings: TrainConfig, run: Trained) -> Examined:
        """Report photos that differ from the scene, or from their neighbours if the training corrected nothing."""
        return judged_exposure(run, settings.appearance)

    def reads(self, settings: TrainConfig, data: DataSettings) -> DataSettings:
        """Read photos with their alpha: the correction applies to the object only, before it is composited."""
        return data if settings.appearance == "none" else replace(data, background=None)

    def compared(self, settings: TrainConfig, scene: Compared) -> Dataset:
        """Return the capture with photos at the exposure of the scene, without the vignetting that was measured.

        Raises:
            DatasetError: a photo cannot be read.
        """
        if settings.appearance == "none":
            return scene.dataset
        shown = functools.partial(render, settings=scene.settings, backend=scene.backend)
        background, vignetting = scene.settings.background, settings.appearance == "vignetting"
        return at_exposure_of_scene(scene.dataset, scene.gaussians, shown, background, vignetting=vignetting)

    def scored(self, settings: TrainConfig) -> dict[str, str]:
        """Say that fitted colours judge the run, if exposures are corrected."""
        return {JUDGED_BY: FITTED} if settings.corrects_colors else {}

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the view model that corrects the images."""
        if settings.appearance == "none":
            return None
        length, vignetting = settings.means_rate_iterations, settings.appearance == "vignetting"
        like, recolor = setup.gaussians.means, setup.backend.recolored
        return Begun(view_model=Exposure(len(setup.views), length, like, recolor, vignetting))


EXPOSURE = ExposurePart()
