"""The backend cuda passes the conformance kit with all outputs and gradients."""

import pytest
import torch

import run
from ours import Renderer

CASES = {case.name: case for case in run.load_cases()}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the interpreter computes with NumPy, which warns
@pytest.mark.parametrize("name", CASES)
def test_the_kernels_pass(device, name):
    renderer = Renderer("cuda", torch.float32)
    report = run.check(renderer.render, renderer.gradients, precision="float32", cases=[CASES[name]])
    assert report.passed, str(report)
    assert not report.left_out
