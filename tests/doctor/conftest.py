"""Fixtures for the doctor's tests: a capture written to disk and examined."""

from collections.abc import Callable

import numpy as np
import pytest

from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.doctor.before import examine
from gsplat_edu.doctor.diagnosis import Diagnosis
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Severity


@pytest.fixture
def diagnosed(tmp_path) -> Callable[..., Diagnosis]:
    """Write views as a capture (COLMAP if there are points), call `spoil` on its folder, and examine it."""

    def examined(views, points=None, spoil=None) -> Diagnosis:
        folder = tmp_path / "capture"
        if points is None:
            write_transforms(folder, views)
        else:
            write_colmap(folder, views, points, np.full((len(points), 3), 0.5))
        if spoil is not None:
            spoil(folder)
        # some tests change cameras whose photos show where they were
        return examine(prepare(CaptureReader(folder), trust=True))

    return examined


@pytest.fixture
def named(diagnosed) -> Callable[..., dict]:
    """Like `diagnosed`, but return the labelled images of every finding above a note, by the finding's name."""

    def warnings(views, points=None, spoil=None) -> dict:
        findings = diagnosed(views, points, spoil).findings
        return {f.name: f.labels for f in findings if f.severity > Severity.NOTE}

    return warnings
