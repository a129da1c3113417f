"""Training gives the recorded bits: adc, mcmc, fast and the sphere, on one thread and on two.

The hashes were recorded before the trainer was split into groups, objective and view model. They hold for one
combination of instruction set, compiler and arithmetic of torch and NumPy (`training_bits.arithmetic`). The tests are
skipped on machines without recorded hashes.
"""

import pytest
import torch

from training_bits import CASES, arithmetic, digest, recorded


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", CASES)
def test_training_gives_the_recorded_bits(name):
    known = recorded().get(machine := arithmetic())
    if known is None:
        pytest.skip(f"no hashes are recorded for {machine}; tests/training_bits.py --record makes them")
    assert digest(name) == known[name]


def test_every_case_has_a_recorded_hash():
    for machine, hashes in recorded().items():
        assert list(hashes) == list(CASES), machine
