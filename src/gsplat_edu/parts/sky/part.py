"""The part that adds a sky: the setting `sky`."""

from __future__ import annotations

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.parts.run_values import Added, Captured
from gsplat_edu.parts.sky.findings import check_haze, check_sky, sky_of
from gsplat_edu.parts.sky.start import shell_around, start_sky
from gsplat_edu.survey.capture import Survey, Undecided
from gsplat_edu.survey.finding import Examined, Remedy
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Setup


class SkyPart(Part):
    """Starts a run with a shell of splats far behind the scene."""

    untimed = ("sky",)

    def examine(self, survey: Survey) -> Examined:
        """Report a sky if there are photos to compare."""
        return Examined({"sky": check_sky(survey)} if len(survey.shots) > 1 else {})

    def choose(self, setting: str, capture: Undecided) -> Remedy | None:
        """Choose `sky` by what the photos show."""
        return sky_of(capture.survey) if setting == "sky" else None

    def judge(self, settings: TrainConfig, run: Trained) -> Examined:
        """Report splats that stand for a sky that the scene does not have."""
        return Examined({"splats": check_haze(run)})

    def start(self, settings: TrainConfig, capture: Captured) -> Added | None:
        """Return the splats of the sky and the shell where they lie.

        A scene to start from may have a sky, so a run that starts from one has a shell.

        Raises:
            ArgumentError: no photo shows a sky.
        """
        if capture.starts_from_scene:
            return Added(shell=shell_around(capture.dataset))
        if settings.sky == "none":
            return None
        splats, shell = start_sky(capture.dataset, settings)
        if capture.is_new:
            capture.say(f"{len(splats)} splats of the sky lie {shell.radius:.3g} world units away")
        return Added(splats, shell)

    def begin(self, settings: TrainConfig, setup: Setup) -> None:
        """Check that the start has the shell, which `gsplat_edu.parts.sky.start` makes of a capture.

        Raises:
            ArgumentError: it has none.
        """
        if settings.sky != "none" and setup.shell is None:
            raise ArgumentError(
                f"sky: is {settings.sky!r}, but start has no shell of splats; gsplat_edu.parts.sky.start makes it, or"
                " set sky='none'"
            )


SKY = SkyPart()
