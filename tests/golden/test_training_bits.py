"""The trainer gives the bits it gave before: adc, mcmc and the sphere, on one thread and on two.

The hashes were recorded before the trainer was taken apart into groups, objective and view model. They hold for one
instruction set, compiler and arithmetic of torch and NumPy (`training_bits.arithmetic`); on another machine, where
nothing is known, the tests say so and are skipped.
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
def test_a_training_gives_the_recorded_bits(name):
    known = recorded().get(machine := arithmetic())
    if known is None:
        pytest.skip(f"no hashes are recorded for {machine}; tests/training_bits.py --record makes them")
    assert digest(name) == known[name]


def test_recorded_cases_are_those_that_are_run():
    for machine, hashes in recorded().items():
        assert list(hashes) == list(CASES), machine
