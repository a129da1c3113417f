"""The part that learns from depth that views have (`View.depth`): the user's maps, or points of the capture."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depths import DepthReport, DepthSource, depth_name, with_depth
from gsplat_edu.parts.given_depth.findings import NAME, depth_findings
from gsplat_edu.parts.given_depth.term import DEPTH, DepthTerm
from gsplat_edu.parts.run_values import Captured
from gsplat_edu.scene.given_depth import POINTS_AS_DEPTH
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Examined
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Cost, Setup
from gsplat_edu.train.rendered import Turns

TERM_TIME = {"points": 0.2, "maps": 1.0}
"""Further time of a step that compares its depth with given depth, in times of a plain one, by what gives it. Maps are
taken to have a value for each pixel of a photo
("What the depth term costs" in the earlier results that benchmarks/RESULTS.md names)."""


class GivenDepthPart(Part):
    """Pulls the rendered depth to the given one."""

    def leaves_device(self, settings: TrainConfig, asked: str | None) -> str | None:
        """Say that a device cannot learn from depth, if the user gave some."""
        return None if asked is None else "depth is given"

    def cost(self, settings: TrainConfig, asked: str | None, capture: Any) -> Cost | None:  # noqa: ANN401
        """Return the time of the term, by what gives or will give the depth."""
        given = "points" if asked == POINTS_AS_DEPTH else "maps" if asked else capture.depth
        return Cost(TERM_TIME[given] / settings.depth_every) if given else None

    def examine(self, survey: Survey) -> Examined:
        """Report what is wrong with the depth maps, if the survey has read them."""
        depth = survey.depth
        if depth is None:
            return Examined()
        facts = [(NAME, depth.lines()[0])] if isinstance(depth, DepthReport) else []
        return Examined({NAME: depth_findings(depth)}, facts)

    def recorded(self, asked: str | None) -> dict[str, str | None]:
        """Return where depth comes from: the folder's full path, or the word."""
        return {"depth": None if asked is None else depth_name(Path(asked))}

    def captured(self, settings: TrainConfig, capture: Captured) -> Dataset:
        """Give the training views the depth that the run's options name, and say what was found.

        Raises:
            DatasetError: the depth cannot be used.
        """
        if capture.asked is None:
            return capture.dataset
        source = DepthSource(Path(capture.asked), settings.depth_kind, settings.depth_unit)
        dataset, report = with_depth(capture.dataset, capture.reader, source, capture.points)
        for sentence in report.lines():
            capture.say(sentence)
        return dataset

    def digest(self, dataset: Dataset) -> str | None:
        """Return a digest of the depth of all training views; None if they have none."""
        digest, found = hashlib.sha256(), False
        for view in dataset.train:
            if view.depth is None:
                continue
            given, found = view.depth(), True
            digest.update(f"{view.name} {len(given)} {given.sparse}".encode())
            for array in (given.rays, given.depths, given.weights):
                digest.update(array.tobytes())
        return digest.hexdigest() if found else None

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the term that compares depths, if views have some.

        weight_d mean rho(z / z* - 1), or for points weight_p extent mean |1/z - 1/z*|
        """
        if all(view.depth is None for view in setup.views):
            return None
        turns = Turns(0, settings.depth_every, settings.batch)
        return Begun({DEPTH: DepthTerm(settings.depth_weight, settings.points_weight, setup.extent, turns)})


GIVEN_DEPTH = GivenDepthPart()
