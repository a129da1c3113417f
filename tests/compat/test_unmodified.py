"""Code that imports gsplat and asks for "cuda" runs as it is after `install()`; `uninstall()` reverts that."""

import sys
import threading
import time
from types import ModuleType

import pytest
import torch

import gsplat_edu.compat.gsplat as ours
from gsplat_edu import ArgumentError
from gsplat_edu.compat import install, uninstall
from gsplat_edu.compat.unmodified import PATCHES
from processes import Program

SCRIPT = """
import sys
import torch
from gsplat import rasterization
from helper import DEVICE

device = torch.device(DEVICE)
g = torch.Generator().manual_seed(0)
means = torch.randn(30, 3, generator=g).to(device).requires_grad_()
scene = [torch.ones(30, 4, device=device), torch.full((30, 3), 0.2).cuda(), torch.full((30,), 0.5, device="cuda")]
colors = torch.rand(30, 3, generator=g).to("cuda").requires_grad_()
view = torch.eye(4, device=0)[None]
view[:, 2, 3] = 4.0
K = torch.tensor([[[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]], device=device)
adam = torch.optim.Adam([means, colors], lr=1e-2)
losses = []
for _ in range(int(sys.argv[1])):
    image = rasterization(means, *scene, colors, view, K, 24, 18)[0]
    loss = (image - 0.5).square().mean()
    adam.zero_grad()
    loss.backward()
    torch.cuda.synchronize()
    adam.step()
    losses.append(loss.item())
print(__name__, losses[-1] < losses[0])
"""

MAIN = """
import os, runpy, sys
os.chdir(sys.argv.pop(1))
sys.path.insert(0, "")  # as `python -m` does
runpy.run_module("gsplat_edu.compat", run_name="__main__", alter_sys=True)
"""


@pytest.fixture
def installed():
    install()
    yield
    uninstall()


@pytest.fixture
def gsplat(installed):
    return pytest.importorskip("gsplat", reason="gsplat is not installed (extra dev)")


def scene(seed, count=40):
    g = torch.Generator().manual_seed(seed)
    return torch.nn.ParameterDict(
        {
            "means": 0.5 * torch.randn(count, 3, generator=g),
            "quats": torch.randn(count, 4, generator=g),
            "scales": torch.randn(count, 3, generator=g) * 0.3 - 1.8,
            "opacities": torch.randn(count, generator=g),
            "colors": torch.randn(count, 3, generator=g),
        }
    ).to("cuda")


def draw(rasterization, params):
    view = torch.eye(4, device="cuda")[None].clone()
    view[0, 2, 3] = 3.0
    K = torch.tensor([[[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]], device="cuda")
    return rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        params["colors"].sigmoid(), view, K, 24, 18, packed=False,
    )  # fmt: skip


def trained(gsplat, strategy, **rates):
    """Train 24 steps with a strategy of gsplat, as its examples do; return losses and parameters."""
    torch.manual_seed(0)  # the strategies draw from the global generator
    with torch.no_grad():
        photo = draw(gsplat.rasterization, scene(1))[0]
    params = scene(2)
    optimizers = {name: torch.optim.Adam([p], lr=2e-2) for name, p in params.items()}
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    for step in range(24):
        image, _, info = draw(gsplat.rendering.rasterization, params)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - photo).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, **rates)
        losses.append(loss.item())
    return losses, params


def test_the_default_strategy_runs_unmodified(gsplat):
    strategy = gsplat.DefaultStrategy(refine_start_iter=4, refine_every=5, grow_grad2d=1e-6, reset_every=1000)
    losses, params = trained(gsplat, strategy, packed=False)
    assert len(params["means"]) > 40 and losses[-1] < 0.7 * losses[0]


def test_the_mcmc_strategy_runs_unmodified(gsplat):
    strategy = gsplat.MCMCStrategy(cap_max=46, refine_start_iter=2, refine_stop_iter=20, refine_every=5)
    losses, params = trained(gsplat, strategy, lr=1e-5)
    assert len(params["means"]) == 46 and losses[-1] < 0.7 * losses[0]


def test_every_function_that_we_export_takes_the_place_of_gsplats(gsplat):
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] == "gsplat"]
    seen = {name: value for module in modules for name, value in vars(module).items() if name in ours.__all__}
    assert {"rasterization", "compute_relocation", "quat_scale_to_covar_preci", "isect_tiles"} <= set(seen)
    for module in modules:
        for name, value in vars(module).items():
            assert name not in ours.__all__ or value is getattr(ours, name), (module.__name__, name)


def test_a_cuda_function_without_a_replacement_is_named(gsplat):
    adam = gsplat.SelectiveAdam([torch.zeros(2, 3, requires_grad=True)], eps=1e-8, betas=(0.9, 0.999))
    adam.param_groups[0]["params"][0].grad = torch.ones(2, 3)
    with pytest.raises(ArgumentError, match="^gsplat: adam needs its CUDA kernels"):
        adam.step(torch.ones(2, dtype=torch.bool))


FRESH = """
import sys
from gsplat_edu.compat import install, uninstall
install()
from gsplat.cuda._backend import _C
from gsplat import rasterization
assert _C is None and rasterization.__module__ == "gsplat_edu.compat.gsplat"
uninstall()
assert not [name for name in sys.modules if name.split(".")[0] == "gsplat"]
from gsplat import rasterization
print(rasterization.__module__)
"""


def test_a_gsplat_that_install_imported_is_forgotten_afterwards(tmp_path):
    """Its extension is not loaded, so it could not be used again with its own kernels."""
    pytest.importorskip("gsplat", reason="gsplat is not installed (extra dev)")
    end, said, complained = Program(FRESH, [], tmp_path).ended(patience=300)
    assert end == 0, complained
    assert said.split() == ["gsplat.rendering"]


def test_gsplats_launcher_runs_the_function_once(gsplat):
    calls = []
    assert gsplat.distributed.cli(lambda *words: calls.append(words), "settings", verbose=True)
    assert calls == [(0, 0, 1, "settings")]


def test_cuda_means_the_cpu_everywhere(installed, tmp_path):
    x = torch.zeros(2)
    path = tmp_path / "x.pt"
    torch.save({"x": x}, path)
    made = [
        torch.ones(2, device="cuda"), torch.tensor([1.0], device=torch.device("cuda", 1)), x.to("cuda:0"), x.to(0),
        x.cuda(), x.cuda(0), x.new_zeros(2, device="cuda"), torch.arange(3, device=0), x.pin_memory(),
        torch.nn.Linear(2, 2, device="cuda").weight, torch.nn.Linear(2, 2).cuda().to("cuda").weight,
        torch.load(path, map_location="cuda")["x"],
    ]  # fmt: skip
    with torch.device("cuda"):
        made.append(torch.zeros(1))
    assert {tensor.device.type for tensor in made} == {"cpu"}
    torch.cuda.synchronize()
    assert x.to(torch.float64).dtype == torch.float64 and x.reshape(2, 1).shape == (2, 1)


def test_a_module_goes_to_a_numbered_device(installed):
    linear = torch.nn.Linear(2, 2)
    assert linear.to(0) is linear and linear.to(device=1).weight.device.type == "cpu"
    assert linear.to("cuda:0", torch.float64).weight.dtype == torch.float64


def test_generators_of_cuda_are_the_cpus(installed):
    for device in ("cuda", torch.device("cuda:1"), 0):
        seeded = torch.Generator(device).manual_seed(3)
        assert isinstance(seeded, torch.Generator) and seeded.device.type == "cpu"
        drawn = torch.rand(4, generator=seeded, device="cuda")
        assert torch.equal(drawn, torch.rand(4, generator=torch.Generator(device="cpu").manual_seed(3)))
    assert isinstance(torch.default_generator, torch.Generator) and not isinstance(3, torch.Generator)


def test_questions_about_the_gpu_have_answers(installed):
    assert torch.cuda.max_memory_allocated() == torch.cuda.memory_allocated(0) == 0
    torch.cuda.set_device(1)
    torch.cuda.reset_peak_memory_stats()
    with torch.cuda.device(torch.cuda.current_device()):
        assert torch.ones(2).to(torch.cuda.current_device()).device.type == "cpu"


def test_events_measure_the_time_between_them(installed):
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(True, blocking=True)
    began = time.perf_counter()
    begin.record()
    torch.ones(100, device="cuda").sum()
    end.record(torch.cuda.current_stream())
    limit = 1000 * (time.perf_counter() - began)
    end.synchronize()
    end.wait()
    assert end.query() and 0 < begin.elapsed_time(end) <= limit
    assert end.elapsed_time(begin) == -begin.elapsed_time(end)


def test_events_without_a_time_are_refused(installed):
    timed = torch.cuda.Event(enable_timing=True)
    with pytest.raises(ArgumentError, match=r"^elapsed_time: the start has no time; call record\(\) first$"):
        timed.elapsed_time(timed)
    timed.record()
    untimed = torch.cuda.current_stream().record_event()
    with pytest.raises(ArgumentError, match="the end has no time; make it with enable_timing=True"):
        timed.elapsed_time(untimed)


def test_streams_run_in_the_order_of_the_program(installed):
    copies, x = torch.cuda.Stream(priority=-1), torch.zeros(3, device="cuda")
    copies.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(copies):
        x += 1
        done = copies.record_event(torch.cuda.Event())
    torch.cuda.default_stream().wait_event(done)
    torch.cuda.set_stream(copies)
    x.record_stream(copies)
    copies.synchronize()
    assert copies.query() and done.query() and x.tolist() == [1, 1, 1]


class Subclassed(threading.Thread):
    """Does its work as a viewer's renderer does: in `run`."""

    def run(self):
        self.made = torch.ones(2, device="cuda")


def test_threads_that_are_started_afterwards_have_the_same_devices(installed):
    made = []
    threads = [Subclassed(), threading.Thread(target=lambda: made.append(torch.zeros(2).to(0)))]
    for thread in threads:
        thread.start()
        thread.join(timeout=60)
    assert [tensor.device.type for tensor in (threads[0].made, *made)] == ["cpu", "cpu"]


class Numbers(torch.utils.data.Dataset):
    """Makes its tensors on "cuda", in the loader's processes."""

    def __len__(self):
        return 6

    def __getitem__(self, index):
        return {"value": torch.tensor(float(index), device="cuda", pin_memory=False)}


@pytest.mark.filterwarnings("ignore:'pin_memory' argument is set as true")
def test_a_loader_with_processes_and_pinned_memory_runs(installed):
    order = torch.Generator("cuda").manual_seed(1)
    loader = torch.utils.data.DataLoader(
        Numbers(), batch_size=2, num_workers=2, pin_memory=True, shuffle=True, generator=order
    )
    values = torch.cat([batch["value"].to("cuda") for batch in loader])
    assert values.sort().values.tolist() == [0, 1, 2, 3, 4, 5]
    assert torch.zeros(1, pin_memory=True).device.type == "cpu"


def test_uninstall_reverts_everything(capsys):
    gsplat = pytest.importorskip("gsplat.strategy.ops", reason="gsplat is not installed (extra dev)")
    before = {name: dict(vars(module)) for name, module in sys.modules.items() if name.startswith("gsplat.")}
    functions = [getattr(owner, name) for owner, name, _ in PATCHES]
    install()
    install()  # changes nothing
    assert gsplat.compute_relocation is ours.compute_relocation
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gsplat_edu: gsplat 1.") and "cuda" in line
    uninstall()
    uninstall()
    for name, names in before.items():
        for key, value in names.items():
            assert key == "__builtins__" or getattr(sys.modules[name], key) is value, (name, key)
    assert functions == [getattr(owner, name) for owner, name, _ in PATCHES]
    if not torch.cuda.is_available():
        with pytest.raises((AssertionError, RuntimeError)):
            torch.zeros(1, device="cuda")


def test_without_gsplat_its_names_have_our_functions(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as if it were not installed
    install()
    try:
        import gsplat
        from gsplat.cuda._wrapper import isect_tiles
        from gsplat.rendering import rasterization

        assert rasterization is gsplat.rasterization is ours.rasterization and isect_tiles is ours.isect_tiles
        with pytest.raises(ImportError, match=r"^gsplat.strategy.DefaultStrategy: .* pip install gsplat"):
            from gsplat.strategy import DefaultStrategy  # noqa: F401
        with pytest.raises(ImportError, match=r"^gsplat.MCMCStrategy: "):
            gsplat.MCMCStrategy  # noqa: B018
    finally:
        uninstall()
    assert sys.modules["gsplat"] is None


def test_a_gsplat_with_cuda_kernels_is_refused(monkeypatch):
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = object()  # what gsplat's extension is on a machine with a GPU
    monkeypatch.setitem(sys.modules, backend.__name__, backend)
    with pytest.raises(ArgumentError, match="^gsplat: is imported with its CUDA kernels"):
        install()
    backend._C = None
    install()
    uninstall()


@pytest.mark.parametrize("as_module", [False, True])
def test_a_script_that_uses_cuda_runs(as_module, tmp_path):
    (tmp_path / "train_gs.py").write_text(SCRIPT)
    (tmp_path / "helper.py").write_text('DEVICE = "cuda:0"\n')
    words = ["-m", "train_gs"] if as_module else ["train_gs.py"]
    end, said, complained = Program(MAIN, [tmp_path, *words, "20"], tmp_path).ended(patience=300)
    assert end == 0, complained
    assert said.split() == ["__main__", "True"]
    assert complained.splitlines()[0].startswith("gsplat_edu: gsplat")


def test_a_script_that_does_not_exist_is_named(tmp_path):
    end, _, complained = Program(MAIN, [tmp_path, "nowhere.py"], tmp_path).ended(patience=300)
    assert end == 2 and "script: nowhere.py is not a file" in complained.splitlines()[-1]
