"""The Triton kernels are tested on a GPU if there is one, else in Triton's interpreter on CPU tensors."""

import pytest
import torch

pytest.importorskip("triton.language", reason="triton is not installed")

import triton_interpreter

triton_interpreter.speed_up()


@pytest.fixture(scope="session")
def device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
