"""Adam, the penalties and the statistics of the engine are those of the other backends."""

import numpy as np
import pytest
import torch

from engine.frames import plain_view
from gsplat_edu.engine import step
from gsplat_edu.engine.frame import CORE, OUT, PAIRS, VISIBLE
from gsplat_edu.engine.step import GROUPS, LIVE, STATE, StepNumbers, adam_program, step_program
from gsplat_edu.ops.adam import adam_in_torch
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import NoiseNumbers, add_noise_in_torch
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.far import Shell

N, K = 301, 3
COLUMNS = {"means": 3, "quats": 4, "log_scales": 3, "sh0": 3, "logit_opacities": 1}
RATES = {name: (0.01 * (k + 1), 0.9, 0.999, 1e-12, 1 - 0.9**3, 1 - 0.999**3) for k, name in enumerate(GROUPS)}
EPS = 2.0**-24

# m, v, their corrections, a root and a quotient: about ten rounded operations for a change of up to three rates, which
# is added to a parameter.
STEPS = 10


@pytest.fixture
def buffers():
    generator = np.random.default_rng(3)

    def normal(*shape):
        return generator.normal(size=shape).astype(np.float32)

    records = normal(N, 4, 4)
    records[:, 2, 3] = generator.random(N) > 0.5  # the depth: not drawn where 0
    return {
        "core": normal(N, CORE),
        "rest": normal(N, K, 3),
        "core_first": normal(N, CORE),
        "core_second": normal(N, CORE) ** 2,
        "rest_first": normal(N, K, 3),
        "rest_second": normal(N, K, 3) ** 2,
        "statistics": np.abs(normal(N, 2)),
        "core_grads": normal(N, OUT),
        "rest_grads": normal(N, K, 3),
        "records": records,
    }


def played(device, buffers, numbers, halted=False):
    counts = {"gaussians": N, "rest": N * K * 3, "live": LIVE}
    memory = device.allocate(adam_program(), counts, poison=True)
    for name, array in buffers.items():
        memory.write(name, array)
    live = np.zeros(LIVE, dtype=np.uint32)
    live[VISIBLE] = (buffers["records"][:, 2, 3] > 0).sum()
    live[step.HALT] = halted
    memory.write("live", live)
    view = plain_view(16, 16).packed(K) + numbers.packed(256, N, False)
    found = memory.play("adam", view, read=(*STATE, "live"))
    shaped = {
        name: found[name].view(np.float32)[: buffers[name].size].reshape(buffers[name].shape)
        for name in STATE
    }
    return shaped, found["live"]


def expected(buffers, numbers):
    """Return the state after a step in float64."""
    exact = {name: torch.tensor(array, dtype=torch.float64) for name, array in buffers.items()}
    gradient, core = exact["core_grads"][:, :CORE].clone(), exact["core"]
    visible = exact["records"][:, 2, 3] > 0
    some = visible if int(visible.sum()) < numbers.few_visible else torch.ones(N, dtype=torch.bool)
    o = torch.sigmoid(core[:, 13])
    gradient[:, 13] += torch.where(some, numbers.opacity_weight * o * (1 - o) / some.sum(), 0.0)
    away = core[:, :3] - torch.tensor(numbers.shell[:3], dtype=torch.float64)
    far = (away**2).sum(1) > numbers.shell[3] if numbers.shell[3] >= 0 else torch.zeros(N, dtype=torch.bool)
    scales = torch.where(far[:, None], 0.0, core[:, 7:10].exp())
    gradient[:, 7:10] += numbers.scale_weight * scales / (3 * N)
    exact["statistics"] += (
        torch.stack([exact["core_grads"][:, 14] * visible, visible.double()], 1) * numbers.collects
    )
    at = 0
    for name, width in COLUMNS.items():
        part = slice(at, at + width)
        tensors = [exact[key][:, part] for key in ("core", "core_first", "core_second")]
        adam_in_torch(*tensors, gradient[:, part], AdamNumbers(*numbers.rates[name]))
        at += width
    rest = (exact[name] for name in ("rest", "rest_first", "rest_second", "rest_grads"))
    adam_in_torch(*rest, AdamNumbers(*numbers.rates["sh_rest"]))
    return exact, (float(o[some].sum()), float(scales.sum()))


@pytest.mark.parametrize("few", [0, N], ids=["all", "visible"])
def test_a_step_is_the_reference_s(device, buffers, few):
    shell = (0.5, 0.0, 0.0, 4.0)
    numbers = StepNumbers(RATES, 0.2, 3.0, few, 5.0, shell, collects=True)
    found, live = played(device, buffers, numbers)
    wanted, (opacity, scale) = expected(buffers, numbers)
    for name in STATE:
        error, size = np.abs(found[name] - wanted[name].numpy()), np.abs(wanted[name].numpy())
        assert (error <= STEPS * EPS * (size + 1)).all(), name
    # exp is off by 2 ULP, a sum of 301 numbers by nine roundings of a tree
    sums = live.view(np.float32)[[step.OPACITY, step.SCALE]]
    assert sums == pytest.approx([opacity, scale], rel=2 * 13 * EPS)


def test_a_halted_step_changes_nothing(device, buffers):
    found, _ = played(device, buffers, StepNumbers(RATES, collects=True), halted=True)
    for name in STATE:
        assert np.array_equal(found[name], buffers[name]), name


def test_without_collecting_statistics_stay(device, buffers):
    found, _ = played(device, buffers, StepNumbers(RATES))
    assert np.array_equal(found["statistics"], buffers["statistics"])
    assert not np.array_equal(found["core"], buffers["core"])


def test_the_gate_shuts_when_pairs_have_no_room():
    """Every pass that changes the state comes after it, and reads `live`."""
    passes = step_program(8).parts["step"]
    gate = next(k for k, one in enumerate(passes) if one.entry == "gate")
    assert passes[gate].live == PAIRS
    for k, one in enumerate(passes):
        if set(one.writes) & set(STATE):
            assert k > gate and "live" in one.reads, one.entry


@pytest.mark.parametrize("seed", [0, 1, 2**62 - 1])
def test_noise_is_that_of_the_other_backends(device, buffers, seed):
    """The words are the same, so the steps differ by rounding: by up to 1e-5 of the largest step (ops/noise.py)."""
    buffers["core"][:, 13] = np.linspace(-9, 3, N)
    shell = (0.5, 0.0, 0.0, 4.0)
    counts = {"gaussians": N, "rest": N * K * 3, "live": LIVE}
    memory = device.allocate(adam_program(), counts)
    memory.write("core", buffers["core"])
    noise = step.Noise((seed & 0xFFFFFFFF, seed >> 32), 0.1, 100.0, 0.005, shell)
    core = memory.play("noise", noise.packed(), read=("core",))["core"].view(np.float32).reshape(N, CORE)
    columns = dict(
        zip(COLUMNS, np.split(buffers["core"].astype(np.float64), [3, 7, 10, 13], axis=1), strict=True)
    )
    tensors = {name: torch.tensor(array) for name, array in columns.items()}
    tensors["sh0"] = tensors["sh0"].reshape(N, 1, 3)
    tensors["logit_opacities"] = tensors["logit_opacities"].reshape(N)
    gaussians = Gaussians(**tensors, sh_rest=torch.zeros(N, 0, 3, dtype=torch.float64))
    before = gaussians.means.clone()
    add_noise_in_torch(gaussians, NoiseNumbers(seed, 0.1, 100.0, 0.005))
    far = Shell(np.array(shell[:3]), 2 * shell[3] ** 0.5).holds(before)
    assert 0 < int(far.sum()) < N
    wanted = torch.where(far[:, None], before, gaussians.means).numpy()
    largest = 5.8 * 0.1 * gaussians.scales.numpy().max(axis=1, keepdims=True) ** 2
    assert (np.abs(core[:, :3] - wanted) <= 1e-5 * largest + EPS * np.abs(wanted)).all()
    assert np.abs(core[:, :3] - buffers["core"][:, :3]).max() > 0.1
    assert np.array_equal(core[:, 3:], buffers["core"][:, 3:])
