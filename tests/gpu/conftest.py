"""Triton's kernels are tested on a GPU where there is one, else in its interpreter, on CPU tensors."""

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel's module is imported

os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")  # else triton 3.9 warns at the first compilation

pytest.importorskip("triton.language", reason="triton is not installed")


@pytest.fixture(scope="session")
def device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
