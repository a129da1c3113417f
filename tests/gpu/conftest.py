"""The Triton kernels are tested on a GPU if there is one, else in Triton's interpreter on CPU tensors."""

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel's module is imported

os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")  # otherwise triton 3.9 warns at the first compilation

pytest.importorskip("triton.language", reason="triton is not installed")


@pytest.fixture(scope="session")
def device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
