"""gsplat's `MCMCStrategy` runs on the CPU with our `compute_relocation` and `quat_scale_to_covar_preci`."""

import pytest
import torch

from gsplat_edu.compat.gsplat import compute_relocation, quat_scale_to_covar_preci, rasterization

ops = pytest.importorskip("gsplat.strategy.ops", reason="gsplat is not installed (extra dev)")
gsplat = pytest.importorskip("gsplat")
STEPS, N = 24, 40


@pytest.fixture
def on_the_cpu(monkeypatch):
    """Replace the strategy's two CUDA kernels as docs/GSPLAT.md says; return the ratios of each relocation."""
    seen = []

    def counted(opacities, scales, ratios, binoms):
        seen.append(ratios.clone())
        return compute_relocation(opacities, scales, ratios, binoms)

    monkeypatch.setattr(ops, "compute_relocation", counted)
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", quat_scale_to_covar_preci)
    return seen


def draw(params):
    view = torch.eye(4)[None].clone()
    view[0, 2, 3] = 3.0
    K = torch.tensor([[[20.0, 0, 12], [0, 20, 9], [0, 0, 1]]])
    return rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        params["colors"].sigmoid(), view, K, 24, 18,
    )  # fmt: skip


def scene(seed):
    g = torch.Generator().manual_seed(seed)
    return torch.nn.ParameterDict(
        {
            "means": 0.5 * torch.randn(N, 3, generator=g),
            "quats": torch.randn(N, 4, generator=g),
            "scales": torch.randn(N, 3, generator=g) * 0.3 - 1.8,
            "opacities": torch.randn(N, generator=g),
            "colors": torch.randn(N, 3, generator=g),
        }
    )


def test_mcmc_relocates_adds_and_trains(on_the_cpu):
    torch.manual_seed(0)  # the strategy samples from the global generator
    with torch.no_grad():
        photo = draw(scene(1))[0]
    params = scene(2)
    with torch.no_grad():
        params["opacities"][:4] = -8.0  # dead Gaussians, which are relocated
    optimizers = {name: torch.optim.Adam([p], lr=2e-2) for name, p in params.items()}
    strategy = gsplat.MCMCStrategy(
        cap_max=N + 6, refine_start_iter=2, refine_stop_iter=20, refine_every=5, noise_lr=1e2
    )
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    for step in range(STEPS):
        image, _, info = draw(params)
        loss = (image - photo).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-5)
        losses.append(loss.item())
    assert len(params["means"]) == N + 6
    assert len(on_the_cpu[0]) == 4 and int(on_the_cpu[0].max()) > 1  # four dead Gaussians moved to live ones
    assert bool((params["opacities"].sigmoid() > 0.004).all())
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("n", [2, 3, 10])
def test_a_relocation_keeps_the_integral_of_alpha(n):
    """Along a line through the centre, n new Gaussians at one place cover as much as the old one: the sum of 1 - (1 -
    o' g')^n over the line is that of o g. The trapezoidal rule is exact to rounding for Gaussians."""
    opacities, scales = torch.tensor([0.8], dtype=torch.float64), torch.full((1, 3), 0.3, dtype=torch.float64)
    binoms = gsplat.MCMCStrategy().initialize_state()["binoms"]
    new, moved = compute_relocation(opacities, scales, torch.tensor([n]), binoms)
    x = torch.linspace(-4.0, 4.0, 4001, dtype=torch.float64)
    covered = 1 - (1 - new * torch.exp(-0.5 * (x / moved[0, 0]) ** 2)) ** n
    wanted = opacities * torch.exp(-0.5 * (x / scales[0, 0]) ** 2)
    assert abs(float(covered.sum() / wanted.sum()) - 1) < 1e-9
    assert abs(float(covered.max()) - 0.8) < 1e-12
