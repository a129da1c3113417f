"""The engine is tested on the first adapter, with no more than what a browser grants by default."""

import os

import pytest

from gsplat_edu.engine import host
from gsplat_edu.engine.passes import LIMITS

os.environ.setdefault("XDG_RUNTIME_DIR", "/tmp")  # Mesa complains without it


@pytest.fixture(scope="session")
def device() -> host.Device:
    if reason := host.missing():
        pytest.skip(reason)
    return host.Device(limits=LIMITS)
