"""The part that removes floaters from the trained scene: `gsplat-edu train --clean`."""

from __future__ import annotations

import torch

from gsplat_edu.clean.guard import clean
from gsplat_edu.clean.report import record_of, report_lines
from gsplat_edu.parts.floaters.findings import check_floaters
from gsplat_edu.parts.run_values import Compared, Revised, Unwritten
from gsplat_edu.render.backends import load_backend
from gsplat_edu.survey.finding import Examined
from gsplat_edu.survey.trained import Trained
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part


class FloatersPart(Part):
    """Removes what the photos do not support, as `gsplat-edu clean` does."""

    def judge(self, settings: TrainConfig, run: Trained) -> Examined:
        """Report views with splats close to the camera."""
        return Examined({"floaters": check_floaters(run)})

    def revise(self, settings: TrainConfig, scene: Unwritten) -> Revised | None:
        """Return the scene without floaters if the user asked for that; metrics.json gets "cleaning".

        Raises:
            DatasetError: a photo cannot be read.
        """
        if scene.asked is None:
            return None
        backend = load_backend("cpu")  # no other one collects the statistics of each splat
        here = scene.gaussians.to(torch.device("cpu"))
        photos = Compared(scene.dataset, here, scene.settings, backend).photos(settings)
        cleaning = clean(here, photos.train, photos.test, scene.settings, backend=backend)
        for line in report_lines(cleaning):
            scene.say(line)
        return Revised(cleaning.apply(scene.gaussians), {"cleaning": record_of(cleaning)})


FLOATERS = FloatersPart()
