"""Which backend `--backend auto` takes for a training. The adapters are those that wgpu lists on real computers."""

import pytest

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.budget import choice
from gsplat_edu.budget.choice import decide, resumed_backend, usual_choice
from gsplat_edu.engine.adapters import AdapterName, Listing

NVIDIA = AdapterName("NVIDIA GeForce RTX 4070", "DiscreteGPU", "Vulkan", "560.35.03")
APPLE = AdapterName("Apple M2", "IntegratedGPU", "Metal", "")
LLVMPIPE = AdapterName("llvmpipe (LLVM 15.0.6, 256 bits)", "CPU", "Vulkan", "Mesa 22.3.6 (LLVM 15.0.6)")
DUPLICATE = AdapterName("NVIDIA GeForce RTX 4070/PCIe/SSE2", "DiscreteGPU", "OpenGL", "560.35.03")
STRANGE = AdapterName("Unknown device", "Unknown", "Vulkan", "1.0")

FASTER = {"webgpu": 200.0, "cpu": 725.0}


def decided(*adapters, seconds=FASTER, obstacle=None, failure=None, reason=None, **options):
    """Return the decision, and what was asked for it in this order."""
    asked = []

    def check():
        asked.append("check")
        return failure

    def forecast(backend):
        asked.append(backend)
        return seconds[backend]

    return decide(Listing(adapters, reason), obstacle, check, forecast, **options), asked


@pytest.mark.parametrize("adapter", [NVIDIA, APPLE])
def test_a_gpu_that_is_forecast_to_be_faster_is_taken(adapter):
    found, asked = decided(adapter, LLVMPIPE)
    assert asked == ["check", "webgpu", "cpu"] and found.matters
    where = f"{adapter.name} ({adapter.interface})"
    assert str(found) == (
        f"--backend webgpu: {where} is forecast to take 3 min 20 s, the processor 12 min 5 s"
    )
    assert found.seconds == FASTER


@pytest.mark.parametrize("webgpu", [725.0, 800.0])
def test_a_gpu_that_is_not_faster_is_not_taken(webgpu):
    found, _ = decided(NVIDIA, seconds={"webgpu": webgpu, "cpu": 725.0})
    assert found.backend == "cpu" and found.matters
    assert found.reason.startswith(
        "the processor is forecast to take 12 min 5 s, NVIDIA GeForce RTX 4070 (Vu"
    )


@pytest.mark.parametrize("adapters", [(), (LLVMPIPE,), (DUPLICATE,), (STRANGE,), (LLVMPIPE, DUPLICATE)])
def test_without_a_real_gpu_nothing_is_checked_or_measured(adapters):
    found, asked = decided(*adapters, reason=None if adapters else "wgpu is not installed")
    assert found.backend == "cpu" and not asked and not found.matters
    expected = f"only {', '.join(one.name for one in adapters)}" if adapters else "wgpu is not installed"
    assert expected in found.reason


def test_a_software_adapter_is_taken_by_an_explicit_argument_only():
    assert decided(LLVMPIPE)[0].backend == "cpu"
    assert decided(LLVMPIPE, allow_software=True)[0].backend == "webgpu"


def test_the_adapter_that_the_environment_names_is_the_one_that_counts():
    assert decided(NVIDIA, LLVMPIPE, wanted="llvm")[0].backend == "cpu"
    assert "Apple M2" in decided(NVIDIA, APPLE, wanted="apple")[0].reason


def test_a_training_that_no_device_can_do_is_not_measured():
    found, asked = decided(NVIDIA, obstacle="appearance is exposure")
    assert found.backend == "cpu" and not asked and found.matters
    assert "cannot do this training by itself, because appearance is exposure" in found.reason


def test_a_gpu_that_fails_its_check_is_not_measured():
    found, asked = decided(NVIDIA, failure="its kernels failed their check")
    assert found.backend == "cpu" and asked == ["check"]
    assert found.reason == "NVIDIA GeForce RTX 4070 (Vulkan) is not used: its kernels failed their check"


def test_a_gpu_that_fails_while_it_is_measured_is_not_taken():
    def fail(backend):
        raise BackendUnavailableError("backend 'webgpu': NVIDIA has no 900 MiB; use the backend cpu")

    found = decide(Listing((NVIDIA,), None), None, lambda: None, fail)
    assert found.backend == "cpu" and "has no 900 MiB" in found.reason


def test_a_resumed_run_goes_on_where_it_began(monkeypatch):
    monkeypatch.setattr(choice, "resolve_backend", lambda name: "cpu")
    monkeypatch.setattr(choice, "unavailable", lambda name: None)
    assert [resumed_backend(name).backend for name in ("webgpu", "cpu", "cuda", None)] == [
        "webgpu",
        "cpu",
        "cpu",
        "cpu",
    ]
    monkeypatch.setattr(choice, "unavailable", lambda name: "wgpu is not installed")
    found = resumed_backend("webgpu")
    assert found.backend == "cpu" and found.matters and "wgpu is not installed" in found.reason


def test_what_is_usual_on_a_computer(monkeypatch):
    monkeypatch.setattr(choice, "resolve_backend", lambda name: "cpu")
    monkeypatch.setattr(choice, "unavailable", lambda name: None)
    assert usual_choice(Listing((APPLE,), None)) == (
        "cpu; webgpu for a training that is forecast to be faster on Apple M2 (Metal)"
    )
    assert "no GPU, only llvmpipe" in usual_choice(Listing((LLVMPIPE,), None))
    monkeypatch.setattr(choice, "unavailable", lambda name: "its kernels failed")
    assert usual_choice(Listing((APPLE,), None)) == "cpu: Apple M2 (Metal) is not used: its kernels failed"
    monkeypatch.setattr(choice, "resolve_backend", lambda name: "cuda")
    assert usual_choice(Listing((APPLE,), None)) == "cuda", "CUDA comes first"
