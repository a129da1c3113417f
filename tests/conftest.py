"""Fixtures shared by many tests."""

import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

# One thread, because several processes run tests at once, and threads that wait for one another waste CPU time. Tests
# of several threads set their number. This has to precede the import of torch; programs that tests start inherit it.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OMP_WAIT_POLICY"] = (
    "PASSIVE"  # the threads of those tests sleep instead of spinning on a busy core
)

import jaxtyping
import numpy as np
import pytest
import torch
from hypothesis import settings

# Both are read when a kernel's module is imported.
if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # Triton's kernels run in its interpreter
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")  # otherwise triton 3.9 warns at the first compilation

if "GSPLAT_TEST_NATIVE" in os.environ:  # another build of the native module: tools/sanitize.sh
    (built,) = Path(os.environ["GSPLAT_TEST_NATIVE"]).glob("_native*.so")
    spec = importlib.util.spec_from_file_location("gsplat_edu._native", built)
    sys.modules["gsplat_edu._native"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["gsplat_edu._native"])

import browsers
import outside
import photos
import tiers
from gsplat_edu import Camera, build_cov3d_batch, quat_to_R_batch
from shape_checker import pytest_runtest_setup  # noqa: F401
from tiers import pytest_itemcollected, pytest_report_header  # noqa: F401

outside.forbid()

# Programs started in the background of a shell ignore Ctrl-C, and every tested program would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Each run has the same examples, so failures are reproducible. `make soak` tries more, and random ones.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=100)
EXAMPLES = tiers.count("GSPLAT_EDU_EXAMPLES", 100, 5_000)
settings.register_profile("soak", deadline=None, max_examples=EXAMPLES, print_blob=True)
settings.load_profile("soak" if tiers.SOAK else "repeatable")


@pytest.fixture
def as_shipped() -> Iterator[None]:
    """Switch off the shape-checking hook, so that tests see the errors that users get."""
    before = jaxtyping.config.jaxtyping_disable  # the second tier runs without the hook
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture(scope="session", autouse=True)
def photographed_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Share photos among tests."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    os.environ[photos.VARIABLE] = str(folder / "photos")
    photos.keep()


@pytest.fixture(scope="module")
def browser() -> Iterator[browsers.Tabs]:
    """Open tabs in the Chromium of this process; they are closed after the module's tests."""
    with browsers.chromium() as tabs:
        yield tabs


def pytest_sessionfinish() -> None:
    """End this process's Chromium."""
    browsers.stop()


@pytest.fixture
def random_splats():
    """Make n random splats in front of `random_camera`, with distinct depths."""

    def make(n: int, seed: int = 0, scale: float = 0.1):
        rng = np.random.default_rng(seed)
        means = np.stack(
            [rng.uniform(-0.6, 0.6, n), rng.uniform(-0.6, 0.6, n), rng.permutation(n) / max(n, 1)], axis=-1
        )
        cov3ds = build_cov3d_batch(
            scale * rng.uniform(0.2, 1.5, (n, 3)), quat_to_R_batch(rng.normal(size=(n, 4)))
        )
        return means, cov3ds, rng.uniform(0, 1, (n, 3)), rng.uniform(0.02, 1.0, n)

    return make


@pytest.fixture
def random_camera() -> Camera:
    """A camera with an off-centre principal point, whose image is not square and not a multiple of a tile."""
    return Camera(np.eye(3), (0.1, -0.05, -3.0), fx=50.0, fy=45.0, cx=20.3, cy=16.8, H=35, W=41)
