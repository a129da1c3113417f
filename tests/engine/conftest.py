"""The engine is tested on the first adapter, with no more than what a browser grants by default."""

import os
import tempfile

import pytest

os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # Mesa complains without it

from gsplat_edu.engine import adapters, host
from gsplat_edu.engine.frame import Pool
from gsplat_edu.engine.passes import LIMITS


@pytest.fixture(scope="session")
def device() -> host.Device:
    if reason := adapters.why_unavailable():
        pytest.skip(reason)
    return host.Device(limits=LIMITS)


@pytest.fixture(scope="session")
def pool(device) -> Pool:
    return Pool(device)


@pytest.fixture
def webgpu(pool):
    """Let the backend use that device."""
    from gsplat_edu.render.webgpu.render import rendering_with

    with rendering_with(pool):
        yield
