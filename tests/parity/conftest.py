import pytest
import torch

from engine.conftest import device as device, pool as pool, webgpu as webgpu


@pytest.fixture(params=["cuda", "webgpu"])
def backend(request):
    """A backend that computes in float32, ready to be used on `where(backend)`."""
    if request.param == "cuda":
        pytest.importorskip("triton.language", reason="triton is not installed")
        import triton_interpreter

        triton_interpreter.speed_up()
    else:
        request.getfixturevalue("webgpu")
    return request.param


def where(backend: str) -> str:
    """The device of a backend's tensors; without a GPU, Triton's interpreter takes those of the CPU."""
    return "cuda" if backend == "cuda" and torch.cuda.is_available() else "cpu"
