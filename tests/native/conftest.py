from collections.abc import Iterator

import pytest
import torch

from gsplat_edu import _native


@pytest.fixture(params=_native.isas())
def isa(request) -> Iterator[str]:
    """Run the test once for each instruction set of this machine."""
    before = _native.isa()
    _native.choose_isa(request.param)
    yield request.param
    _native.choose_isa(before)


@pytest.fixture
def set_threads() -> Iterator[object]:
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)
