"""The shaders fit their description and a browser's default limits, and what fails says so in one line."""

import re
import subprocess
import sys

import pytest

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine import adapters
from gsplat_edu.engine.frame import program
from gsplat_edu.engine.passes import FOLDER, LIMITS, MODULES, Buffer, Pass, Program, Size, module_source
from gsplat_edu.engine.statistics import statistics_program
from gsplat_edu.engine.step import step_program

PROGRAM, PANORAMA = program(16, True), program(16, True, "panorama")
PROGRAMS = (
    *(PROGRAM, step_program(16), statistics_program(PROGRAM, False)),
    *(program(16, True, "lens"), PANORAMA, statistics_program(PANORAMA, False)),
)
PASSES = {(one.module, one.entry): one for each in PROGRAMS for one in each.passes()}
BYTES = {"u32": 4, "f32": 4, "vec2<f32>": 8, "vec4<f32>": 16, "Splat": 48}


def bindings(module, entry):
    """Return kind and name of the storage buffers that an entry point uses, itself or through functions, by binding."""
    text = re.sub(r"//.*", "", module_source(module))
    declared = re.findall(r"@group\(1\) @binding\((\d)\) var<storage, (\w+)> (\w+)", text)
    functions = dict(re.findall(r"fn (\w+)\([^{]*\{(.*?)^\}", text, re.DOTALL | re.MULTILINE))
    waiting, reached = [entry], set()
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += [called for called in re.findall(r"(\w+)\(", functions[name]) if called in functions]
    used = set(re.findall(r"(?<!\.)\b\w+", " ".join(functions[name] for name in reached)))
    return [(int(place), kind) for place, kind, name in declared if name in used]


@pytest.mark.parametrize("key", PASSES, ids=".".join)
def test_a_pass_binds_what_its_entry_point_declares(key):
    one = PASSES[key]
    kinds = ["read"] * len(one.reads) + ["read_write"] * len(one.writes)
    found = bindings(*key)
    assert len({place for place, _ in found}) == len(found), "no binding is used twice"
    assert all(kinds[place] == kind for place, kind in found)
    assert max(place for place, _ in found) == len(kinds) - 1, "the last buffer is used"
    assert len(kinds) <= LIMITS["max-storage-buffers-per-shader-stage"]
    assert not set(one.reads) & set(one.writes) and len(set(one.reads + one.writes)) == len(kinds)


@pytest.mark.parametrize("module", MODULES)
def test_workgroup_memory_and_size_are_within_the_limits(module):
    text = module_source(module)
    constants = dict(re.findall(r"const (\w+) = (\d+)u?;", text))
    used = 0
    for kind, count in re.findall(r"var<workgroup> \w+: array<(.+), (\w+)>;", text):
        used += BYTES[kind.removeprefix("atomic<").removesuffix(">" if "atomic" in kind else "")] * int(
            constants.get(count, count)
        )
    assert used <= LIMITS["max-compute-workgroup-storage-size"]
    for size in re.findall(r"@workgroup_size\((\w+)\)", text):
        assert int(constants.get(size, size)) <= LIMITS["max-compute-invocations-per-workgroup"]


def test_every_shader_belongs_to_a_module():
    assert {path.stem for path in FOLDER.glob("*.wgsl")} == {
        name for files in MODULES.values() for name in files
    }
    assert {module for module, _ in PASSES} == set(MODULES)


def test_no_float_atomics_and_no_test_that_a_compiler_may_assume_away():
    for path in FOLDER.glob("*.wgsl"):
        text = re.sub(r"//.*", "", path.read_text())
        assert set(re.findall(r"atomic<(\w+)>", text)) <= {"u32"}, path.name
        assert not re.search(r"\b(\w+) ([!=]=) \1\b|isNan|isInf", text), path.name


def test_a_buffer_that_is_too_large_is_named(device):
    counts = {"gaussians": 10**6, "rest": 45 * 10**6, "pairs": 1, "pixels": 1, "edges": 2, "live": 4}
    with pytest.raises(
        BackendUnavailableError, match=r"^backend 'webgpu': the buffer rest needs 172 MiB for 1000000"
    ):
        device.allocate(PROGRAM, counts)


def test_a_shader_that_does_not_compile_is_one_line(device, monkeypatch):
    monkeypatch.setitem(MODULES, "broken", ("job", "view"))
    broken = Program(
        (Buffer("a", Size("n")),), {"part": (Pass("broken", "absent", (), ("a",), Size("n"), 1),)}
    )
    with pytest.raises(BackendUnavailableError, match=r"refuses the shader broken.absent") as raised:
        device.allocate(broken, {"n": 1})
    assert "\n" not in str(raised.value) and str(raised.value).endswith("; use the backend cpu")


def test_without_wgpu_or_an_adapter_the_reason_says_what_to_install(monkeypatch):
    monkeypatch.setattr(adapters.importlib.util, "find_spec", lambda name: None)
    assert (
        adapters.why_unavailable()
        == 'wgpu is not installed; pip install "gsplat-edu[gpu]", or use the backend cpu'
    )
    monkeypatch.undo()
    pytest.importorskip("wgpu")
    monkeypatch.setattr(adapters, "listed_adapters", lambda: ())
    assert adapters.why_unavailable().startswith(
        "wgpu finds no adapter for Vulkan, Metal or DirectX 12; install the driver"
    )


def test_the_adapter_can_be_named(device, monkeypatch):
    monkeypatch.setenv("GSPLAT_EDU_ADAPTER", device.name.name[:4].upper())
    assert adapters.why_unavailable() is None
    monkeypatch.setenv("GSPLAT_EDU_ADAPTER", "Voodoo 2")
    assert adapters.why_unavailable().startswith(
        "GSPLAT_EDU_ADAPTER: is 'Voodoo 2', which no adapter's name contains; there are: "
    )


@pytest.mark.own_process
def test_torch_can_import_triton_after_an_adapter_was_used(device):
    """Two libraries of LLVM, Mesa's and Triton's, are then in one process."""
    pytest.importorskip("triton")
    script = """
import torch
from gsplat_edu.engine.host import Device
Device.default()
torch.optim.LBFGS([torch.zeros(1, requires_grad=True)])
print("both")
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "both\n"), done.stderr
